"""The algorithms: every stage is a plain function, registered in `wavebatch.stages.chain.STAGES` by this import."""

from wavebatch.stages import noise
from wavebatch.stages.attribute import basic, normal_angle, radiometry, width_angle
from wavebatch.stages.decompose import fit, loops, models
from wavebatch.stages.detect import classic, correlation, maximum, wavelet

__all__ = [
    "basic",
    "classic",
    "correlation",
    "fit",
    "loops",
    "maximum",
    "models",
    "noise",
    "normal_angle",
    "radiometry",
    "wavelet",
    "width_angle",
]
