"""The algorithms, each a plain function; importing this package fills `wavebatch.chain.STAGES`."""

from wavebatch.stages import (
    angle,
    attributes,
    decompose,
    decompose_loops,
    decompose_models,
    detect,
    detect_correlation,
    detect_edges,
    detect_wavelet,
    noise,
    normals,
    physics,
)

__all__ = [
    "angle",
    "attributes",
    "decompose",
    "decompose_loops",
    "decompose_models",
    "detect",
    "detect_correlation",
    "detect_edges",
    "detect_wavelet",
    "noise",
    "normals",
    "physics",
]
