"""Whether a calibration fits the strip that it is used for, and what the strip lacks against it.

`strip_match` is the entry point and compares day, air, rate and light, `setting` measures them, and `strip_energies`
finds the energies of the pulses. What does not fit is refused, or goes into the errors with one line.
"""
