"""Reader of PulseWaves files (.pls with .wvs): header, descriptors, pulses and their waves."""
