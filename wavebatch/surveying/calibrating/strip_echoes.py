"""Clean single echoes of a strip, decomposed as `wavebatch run` does, with their energy, range and channel.

`calibrate_flight` opens each strip with `open_source` and reads echoes on targets and on tie cells. Pulse, chain and
energy are those of a run: the same choice, and the stage of `backscatter_coefficient` with a constant of 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import field, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoFlag, EchoTable
from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.schema import Range, check_options, option
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.cloud.cloud_reader import CloudReader
from wavebatch.files.cloud.point_filter import EVERY, PlannedFilter, PointFilter
from wavebatch.files.pulse_energy import PulseEnergy, find_column, name_columns, take_records
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.strip.scanner import StripScan
from wavebatch.kernels.physics.radiometry import usual_attenuation
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.surveying.calibration import Calibration
from wavebatch.surveying.choose_chain import ChainChoice, Request, widest_chain
from wavebatch.surveying.matching.setting import SCANNERS, Setting, measure_setting
from wavebatch.surveying.matching.strip_energies import StripEnergies, take_energies
from wavebatch.surveying.prepare import Positions, prepare
from wavebatch.surveying.sensor import SensorRequest, SensorSource

CLEAN_ECHO = np.dtype([
    ("xyz", "<f8", 3), ("ray", "<f8", 3), ("distance", "<f8"), ("light", "<f8"), ("light_err", "<f8"),
    ("channel", "<i4"), ("time", "<f8"), ("given", "<f8"), ("amplitude", "<f4"),
])  # fmt: skip
"""An echo: position [m], unit direction of its ray, range [m], R^2 A sigma / eta and the error of its fit, channel, GPS
time [s], value of the column that was asked for, amplitude [DN]."""

_BLOCK = 8192
"""Waveforms that are read at a time."""

_LIGHT = "relative_backscatter"


@frozen
class CalibrationOptions:
    """How a calibration is measured."""

    sensor: SensorRequest = field(default_factory=SensorRequest)
    """Where the sensor's positions come from; by default from the strip's packets."""
    chain: Chain | None = None
    """The chain that decomposes; None: the widest that the request may choose."""
    request: Request = field(default_factory=lambda: Request(auto=True))
    """How pulse and chain are chosen: as for `wavebatch run`."""
    column: str | None = option(
        None, "In place of targets: an extra byte with the vendor's reflectances, in dB or as shares of 1.",
        form="NAME", name="from_column",
    )
    reflectance_error: Annotated[float, Range(0.0, 1.0)] = option(
        0.03, "Relative standard deviation of the reflectances of the targets, or of the column.", form="SHARE"
    )
    attenuation: Annotated[float | None, Range(0.0, 100.0)] = option(
        None, "Attenuation of the air, one way [dB/km].", form="DB_KM", unset="0.22 at 1064 nm"
    )
    wavelength: Annotated[float, Range(300.0, 2500.0)] = option(
        1064.0, "Wavelength of the laser [nm]: it gives the attenuation if --attenuation is missing.", form="NM"
    )
    divergence: Annotated[float | None, Range(0.001, 100.0)] = option(
        None, "Full angle of the beam between the 1/e^2 points [mrad]; cross sections need it.", form="MRAD"
    )
    """None: that of a saved survey, if it has one."""
    scan_angle: bool = option(
        False, "Fit how the light falls with the scan angle, where strips overlap; `run` corrects for it."
    )
    direction: str = "auto"
    """Where packet vectors point: auto, toward or away."""
    energy: str | None = None
    """Energy of each emitted pulse, as for `wavebatch run`; see `find_pulse_energy`."""
    selection: PointFilter = EVERY
    """Only echoes of pulses with a chosen return count."""
    before: Calibration | None = None
    """Of the strips of the flight that were read before, by whose energies those of the next ones count."""

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def air(self) -> float:
        """Attenuation of the air [dB/km]: the given one, or that of clear air at the wavelength and sea level."""
        return usual_attenuation(self.wavelength) if self.attenuation is None else self.attenuation


@frozen(eq=False)
class EchoSource:
    """An open strip with pulse, chain and sensor."""

    reader: StripReader
    scan: StripScan
    choice: ChainChoice
    chain: Chain
    """The chosen one, and the stage that gives the energy."""
    system: SystemPulse
    sensor: SensorSource
    setting: Setting
    sent: StripEnergies
    air: float
    """Attenuation [dB/km]."""
    haze: float | None
    """As `Calibration.haze`."""
    column: PulseEnergy | None = None
    """The extra byte whose values go with the echoes, if one was asked for."""
    keep: PlannedFilter | None = None
    """Chooses pulses by their returns; None: all."""

    @property
    def path(self) -> Path:
        """Of the strip."""
        return self.reader.facts.path

    def echoes(self, wanted: Callable[[np.ndarray], np.ndarray]) -> Iterator[np.ndarray]:
        """Yield arrays of CLEAN_ECHO.

        wanted: which returns at positions f8 (k, 3) are of interest, bool (k,); only their waveforms are decomposed.
        """
        for unit in self.reader.read_units(self.scan):
            chosen = True if self.keep is None else unit.choose_packets(self.keep)
            for block, packets in self.reader.read_blocks(unit, _BLOCK, owned_only=True):
                if block.returns is None:
                    continue
                near = np.unique(block.returns.waveform[wanted(block.returns.xyz)])
                near = near[np.broadcast_to(chosen, len(unit.packets))[packets[near]]]
                if len(near):
                    part = block.rows(near)
                    records = take_records(part, unit)
                    given = None if self.column is None else self.column.read_column(records)
                    part = self.sensor.fill(part if self.sent.energy is None else self.sent.energy.fill(part, unit))
                    yield take_clean(part, self.chain.run(part, self.system), given)


@contextmanager
def open_source(path: Path, options: CalibrationOptions) -> Iterator[EchoSource]:
    """Open a strip, choose pulse and chain as `wavebatch run` does, and find the sensor.

    Parameters
    ----------
    path : Path
    options : CalibrationOptions

    Yields
    ------
    EchoSource

    Raises
    ------
    InputError
        Where the strip cannot be read or the sensor's position is unknown.
    """
    keep = None
    if options.selection:
        with CloudReader(path) as cloud:
            keep = cloud.plan(options.selection)
    with StripReader(path, direction=options.direction) as reader, reader.scan() as scan:
        chain = options.chain or widest_chain()
        setup = prepare(reader, scan, chain, options.request, sensor=options.sensor, positions=Positions.REQUIRED)
        # The error of the sensor's position is the same for all echoes: it belongs to the constant, not to them.
        haze = setup.sensor.haze if options.attenuation is None else None
        air = options.air * (haze or 1.0)
        system = setup.system.with_radiometry(attenuation=air, sensor_error=0.0)
        sent = take_energies(reader, scan, options.energy, options.before)
        setting = measure_setting(reader, scan, setup.sensor, air, sent.energy.level if sent.energy else 1.0)
        column = options.column
        given = find_column(reader, column) if column else None
        if column and given is None:
            hint = name_columns(reader, column)
            raise InputError(f"{path}: --from-column: no extra byte is called {column!r}; {hint}")
        # Without the physical attributes, and with the energy of each echo.
        needed = ("attribute.amplitude", "attribute.echo_width", "attribute.position")
        steps = [step for step in setup.chain.steps if step.stage.kind != "attribute" or step.stage.name in needed]
        have = {step.stage.name for step in steps}
        steps += [Step(STAGES[name]) for name in ("attribute.position", f"attribute.{_LIGHT}") if name not in have]
        chain = replace(setup.chain, steps=tuple(steps))
        yield EchoSource(reader, scan, setup.choice, chain, system, setup.sensor, setting, sent, air, haze, given, keep)


def take_clean(block: WaveformBlock, echoes: EchoTable, given: np.ndarray | None = None) -> np.ndarray:
    """Take the echoes of a block that are alone in their waveform and whose place and energy are sure, as CLEAN_ECHO.

    Clipped echoes are there too, with an infinite error of their light: a target may be too bright.

    given: values of a column for each waveform, f8 (n,).
    """
    alone = echoes.alone(len(block))
    unclean = UNCLEAN & ~EchoFlag.SATURATED | EchoFlag.UNANCHORED
    echoes = echoes.take(np.flatnonzero(alone & ((echoes.flags & np.uint16(unclean)) == 0)))
    clipped = (echoes.flags & np.uint16(EchoFlag.SATURATED)) != 0
    rows = np.zeros(len(echoes), CLEAN_ECHO)
    rows["xyz"] = np.stack([echoes.attributes[name] for name in "xyz"], axis=1)
    away = rows["xyz"] - np.asarray(block.sensor)[echoes.waveform]
    rows["distance"] = np.sqrt((away * away).sum(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        rows["ray"] = away / rows["distance"][:, None]
    rows["light"] = np.where(clipped, 1.0, echoes.attributes[_LIGHT])
    rows["light_err"] = np.where(clipped, np.inf, echoes.attributes[f"{_LIGHT}_err"])
    scanner = 0 if block.scanner is None else block.scanner[echoes.waveform].astype(np.int32)
    rows["time"] = block.gps_time[echoes.waveform]
    rows["amplitude"] = echoes.amplitude
    rows["given"] = np.nan if given is None else given[echoes.waveform]
    rows["channel"] = SCANNERS * block.digitizer.index + scanner
    known = np.isfinite(rows["ray"]).all(axis=1) & (rows["light"] > 0) & ~np.isnan(rows["light_err"])
    return rows[known]
