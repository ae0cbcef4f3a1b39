"""The algorithms: every stage is a plain function. Importing this package registers all of them in `chain.STAGES`."""

from wavebatch.stages import noise  # noqa: F401
from wavebatch.stages.attribute import basic, normal_angle, radiometry, width_angle  # noqa: F401
from wavebatch.stages.decompose import fit, loops, models, skew  # noqa: F401
from wavebatch.stages.detect import classic, correlation, maximum, wavelet  # noqa: F401
