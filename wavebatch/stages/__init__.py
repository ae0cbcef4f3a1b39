"""The algorithms, each a plain function; importing this package fills `wavebatch.chain.STAGES`."""

from wavebatch.stages import attributes, decompose, detect, noise

__all__ = ["attributes", "decompose", "detect", "noise"]
