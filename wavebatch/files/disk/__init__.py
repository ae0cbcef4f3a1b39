"""Files as such: whole-or-not-at-all output, temporary data, fingerprints, raw bytes."""
