"""Physical constants and the few conversions between units that more than one module needs."""

import math

C = 0.299792458
"""Speed of light in vacuum [m/ns]."""

HALF_C = C / 2
"""One-way distance per two-way travel time [m/ns]."""

PS_PER_NS = 1000.0

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian, in standard deviations (2.354820)."""

SQRT_PI = math.sqrt(math.pi)
SQRT_2PI = math.sqrt(2.0 * math.pi)

QUANTISATION_STD = 1.0 / math.sqrt(12.0)
"""Standard deviation of rounding to whole counts (0.2887): no noise estimate may be lower."""

MAD_TO_STD = 1.4826
"""Median absolute deviation of a normal distribution to its standard deviation."""
