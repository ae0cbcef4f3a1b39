"""All that knows files: formats, paths, picoseconds, volts and temporary files. Other rooms get arrays and facts."""
