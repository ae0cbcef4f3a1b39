"""The deconvolved profiles of single pulses as an .npz: sigma(t) of every pulse, not only its sum in voxels.

`strip.voxelize_strip` adds every batch. Only samples with signal are stored, so a file is about as large as the cloud
of the strip. The output must not depend on block size: nothing here may mix pulses of a batch.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.npz import NpzWriter
from wavebatch.files.disk.publish import Draft, protecting
from wavebatch.tools.voxels.rays import Rays

PULSE_COLUMNS = {
    "point": ("<i8", "index in the file of the first point of the pulse's packets"),
    "gps_time": ("<f8", "time of the pulse [s]"),
    "start": (("<f8", (3,)), "position at time 0, from the returns of the packet where they are known [m]"),
    "step": (("<f8", (3,)), "away from the sensor, per time [m/ns]"),
    "packets": ("<u2", "number of the pulse's packets; between them nothing was recorded: no light triggered it"),
    "known": ("<f8", "time up to which the light is known: infinite, unless a packet of the pulse was lost [ns]"),
    "anchored": ("<u1", "1 where a return of each packet lies at the signal, else the raw location is used"),
    "clipped": ("<u1", "1 where samples are at the digitizer's limit: energies are too low"),
    "first": ("<i8", "row of the pulse's first sample in the arrays of samples"),
    "count": ("<i8", "number of its samples with signal"),
}
"""Arrays with a value per pulse that has signal: dtype and meaning."""

SAMPLE_COLUMNS = {
    "time": ("<f4", "after sample 0 of the pulse's first packet along the ray [ns]"),
    "spacing": ("<f4", "time that the sample spans [ns]"),
    "energy": ("<f4", "integral of the signal from this sample, as if each was a pulse of its own [DN ns]"),
    "cross_section": ("<f4", "backscatter cross section of this sample [m2]; NaN where the range is unknown"),
}
"""Arrays with a value per sample with signal; cross_section only with a calibration."""


class ProfileWriter(NpzWriter):
    """Writes profiles batch by batch: `add_rays` for each, then `complete_profiles`."""

    def __init__(self, target: Path, strip: Path, *, sections: bool, overwrite: bool) -> None:
        if target.suffix.lower() != ".npz":
            raise ConfigError(f"--profiles {target}: profiles are written as .npz")
        self._names = [name for name in SAMPLE_COLUMNS if sections or name != "cross_section"]
        columns = {**PULSE_COLUMNS, **{name: SAMPLE_COLUMNS[name] for name in self._names}}
        self._meanings = {name: meaning for name, (_, meaning) in columns.items()}
        with protecting([strip]):
            super().__init__(target, {name: dtype for name, (dtype, _) in columns.items()}, overwrite=overwrite)
        self.pulses = self.samples = 0

    def add_rays(self, rays: Rays) -> None:
        """Adds the pulses that have signal."""
        rays = rays.take(np.flatnonzero(rays.table["count"]))
        table, samples = rays.table, rays.samples
        values = {name: table[name] for name in PULSE_COLUMNS} | {"first": self.samples + table["first"]}
        values |= {name: samples[name] for name in ("time", "spacing", "energy")}
        if "cross_section" in self._names:
            values["cross_section"] = np.where(table["unknown"][rays.owner], np.nan, samples["section"])
        self.add(values)
        self.pulses += len(table)
        self.samples += len(samples)

    def complete_profiles(self, meta: Mapping[str, Any], crs: str) -> Draft:
        """Writes the file, with how it was made as JSON in `meta`."""
        text = json.dumps({**meta, "columns": self._meanings}, sort_keys=True)
        return self.complete({"crs": crs, "meta": text})
