"""The deconvolved profiles of single pulses as an .npz: sigma(t) of every pulse, not only its sum in voxels.

`strip.voxelize_strip` adds every block. Only samples with signal are stored, so a file is about as large as the cloud
of the strip. The output must not depend on block size: nothing here may mix waveforms of a block.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.disk.npz import NpzWriter
from wavebatch.files.disk.protect import protecting
from wavebatch.files.disk.publish import Draft
from wavebatch.tools.voxels.profile import Profiles
from wavebatch.tools.voxels.rays import RayTable

PULSE_COLUMNS = {
    "point": ("<i8", "index in the file of the first point of the pulse's packet"),
    "gps_time": ("<f8", "time of the pulse [s]"),
    "start": (("<f8", (3,)), "position of sample 0, from the returns of the packet where they are known [m]"),
    "step": (("<f8", (3,)), "away from the sensor, per time [m/ns]"),
    "spacing": ("<f8", "time between two samples [ns]"),
    "anchored": ("<u1", "1 where a return of the packet lies at the signal, else the raw location is used"),
    "clipped": ("<u1", "1 where samples are at the digitizer's limit: energies are too low"),
    "first": ("<i8", "row of the pulse's first sample in the arrays of samples"),
    "count": ("<i8", "number of its samples with signal"),
}
"""Arrays with a value per pulse that has signal: dtype and meaning."""

SAMPLE_COLUMNS = {
    "time": ("<f4", "after sample 0 [ns]"),
    "energy": ("<f4", "integral of the signal from this sample, as if each was a pulse of its own [DN ns]"),
    "cross_section": ("<f4", "backscatter cross section of this sample [m2]; NaN where the range is unknown"),
}
"""Arrays with a value per sample with signal; cross_section only with a calibration."""


class ProfileWriter(NpzWriter):
    """Writes profiles block by block: `add_block` for each, then `complete_profiles`."""

    def __init__(self, target: Path, strip: Path, *, sections: bool, overwrite: bool) -> None:
        if target.suffix.lower() != ".npz":
            raise ConfigError(f"--profiles {target}: profiles are written as .npz")
        self._names = [name for name in SAMPLE_COLUMNS if sections or name != "cross_section"]
        columns = {**PULSE_COLUMNS, **{name: SAMPLE_COLUMNS[name] for name in self._names}}
        self._meanings = {name: meaning for name, (_, meaning) in columns.items()}
        with protecting([strip]):
            super().__init__(target, {name: dtype for name, (dtype, _) in columns.items()}, overwrite=overwrite)
        self.pulses = self.samples = 0

    def add_block(self, block: WaveformBlock, profiles: Profiles, rays: RayTable) -> None:
        """Adds the pulses of a block that have signal."""
        rows = np.flatnonzero(profiles.seen)
        pulse, sample = np.nonzero(profiles.value[rows])
        owner = rows[pulse]
        count = np.bincount(pulse, minlength=len(rows))
        values = {
            "point": block.point[rows],
            "gps_time": block.gps_time[rows],
            "start": rays.start[rows],
            "step": rays.step[rows],
            "spacing": np.full(len(rows), block.spacing),
            "anchored": profiles.anchored[rows],
            "clipped": profiles.clipped[rows],
            "first": self.samples + np.cumsum(count) - count,
            "count": count,
            "time": sample * block.spacing,
            "energy": profiles.value[owner, sample] * profiles.area,
        }
        if "cross_section" in self._names:
            section = np.diff(rays.section, axis=1)[owner, sample]
            values["cross_section"] = np.where(rays.unknown[owner], np.nan, section)
        self.add(values)
        self.pulses += len(rows)
        self.samples += len(sample)

    def complete_profiles(self, meta: Mapping[str, Any], crs: str) -> Draft:
        """Writes the file, with how it was made as JSON in `meta`."""
        text = json.dumps({**meta, "columns": self._meanings}, sort_keys=True)
        return self.complete({"crs": crs, "meta": text})
