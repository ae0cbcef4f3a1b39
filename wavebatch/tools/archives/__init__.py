"""Import of waveforms from archives of other formats, and export to others (`wavebatch import`, `wavebatch export`)."""
