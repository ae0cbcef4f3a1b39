"""Shared types and constants: units, errors, waveform blocks, echo tables and the declaration of every column.

All other rooms import from here; core imports nothing from them.
"""
