"""Filters and estimates on waveforms: arrays in, arrays out."""
