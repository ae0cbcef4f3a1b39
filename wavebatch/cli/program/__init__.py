"""What all commands have in common as a program: help, manual pages, version, settings."""
