"""What all commands have in common as a program: help pages, manual pages, version, settings, log file."""
