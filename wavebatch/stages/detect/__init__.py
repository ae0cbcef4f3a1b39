"""Stages that find echoes in waveforms."""
