"""What pictures of waveforms and clouds show, as arrays, and the pictures themselves."""
