"""Filters and estimates on waveforms: arrays (samples, n) in, arrays out."""
