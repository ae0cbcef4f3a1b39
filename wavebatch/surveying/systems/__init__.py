"""Measured pulses of known sensors, and the table of a SYSTEM.toml that holds one."""
