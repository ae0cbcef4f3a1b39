"""The algorithms: every stage is a plain function. Importing this package registers all of them in `chain.STAGES`."""

from wavebatch.stages import noise  # noqa: F401
from wavebatch.stages.attribute import basic, radiometry  # noqa: F401
from wavebatch.stages.decompose import fit, models  # noqa: F401
from wavebatch.stages.detect import direct, transformed  # noqa: F401
