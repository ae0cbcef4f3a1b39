"""Stages that fit echoes to waveforms."""
