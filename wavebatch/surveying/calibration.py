"""The calibration of a sensor: its constants, what they were measured with, and the stages that it adds to a chain.

`calibrating.calibrate_flight` measures a calibration, `calibrating.calibration_files` keeps it as CAL.toml, and
`wavebatch run` fits it to each strip with `matching.strip_match`. Before you change it: give new fields a default,
since older files lack them.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, field, replace
from typing import Annotated, Any

from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.core.schema import Key, Range
from wavebatch.core.waveforms import SystemPulse
from wavebatch.stages.chain import STAGES, Chain, Step

NEEDS_SENSOR = (
    "range", "backscatter_coefficient", "cross_section", "reflectance", "level_reflectance", "incidence_angle",
    "amplitude_normalized", "amplitude_normalized_db", "relative_backscatter", "relative_cross_section",
    "relative_reflectance",
)  # fmt: skip
"""Columns that need the sensor's position."""

LEAST_ATTENUATION, MOST_ATTENUATION = 0.01, 12.0
"""Of air near the ground [dB/km]: what molecules alone scatter at 1064 nm is 0.004, and haze is never absent. Nobody
flies by sight below a visibility of 1.5 km, where green light loses 11."""

_REPORTED = ("strip", "date", "sensor", "flight", "chain", "decomposer", "height", "distance")
_MOST_DESCRIBED = 8
"""Strips that a description lists one by one."""


def check_attenuation(value: float) -> None:
    """Raise ConfigError for an attenuation [dB/km] that no flight has, as of a value per metre; 0 is no air at all."""
    if 0.0 < value < LEAST_ATTENUATION:
        problem = f"attenuation: {value:g} dB/km is less than any air has near the ground; is it per metre?"
    elif value > MOST_ATTENUATION:
        problem = f"attenuation: {value:g} dB/km is fog, in which nobody flies; is it {value / 100:g}?"
    else:
        return
    raise ConfigError(f"{problem} Clear air has 0.1 to 0.5 dB/km")


ONE_VIEW = ", even light across the swath assumed"
"""End of the conditions where each place was seen at one angle, as by one strip: overlaps did not show the light."""

CHANGE_CHANCE = 0.3
"""Of another energy or gain under the same header, where no calibration says it."""


@frozen
class TargetResult:
    """What one reference target gave; where it gave no constant, `refused` says why."""

    name: str
    reflectance: float
    echoes: int
    """Clean single echoes on the target."""
    constant: float | None = None
    """Median of the echoes' constants [1/(m2 DN ns)]."""
    spread: float | None = None
    """Robust standard deviation of the echoes' constants, relative."""
    incidence_deg: float | None = None
    """Median angle between ray and normal [deg]."""
    incidence_error_deg: float | None = None
    """Standard deviation of that angle [deg]."""
    inset_m: float | None = None
    """Echoes nearer to the outline than this do not count: their footprint is not all on the target [m]."""
    edge: float | None = None
    """Constant of the echoes near the outline over that of the others, less 1; None where they agree."""
    strange: float = 0.0
    """Share of its echoes that are far darker or brighter than the others."""
    relative_error: float | None = None
    """Standard deviation of the constant from this target alone, relative."""
    air: float | None = None
    """Share of the air that a column of reflectances held, which was taken off; None where it is not known."""
    apart: float = 0.0
    """Scatter of the constants of its parts, relative; of dark and bright echoes of a column of reflectances."""
    hidden_m: float | None = None
    """Width of its middle in which no echo lies [m]; None where it is a small part of its outline."""
    refused: str = ""
    """Why the target gave no constant."""
    channel: str = ""
    """Digitizer and scanner channel whose echoes these are; empty where the strip has one channel."""

    @property
    def label(self) -> str:
        """Return the name, with the channel where there are several."""
        return ", ".join(filter(None, (self.name, self.channel)))


@frozen
class ChannelConstant:
    """The calibration of one channel, a digitizer together with a scanner channel, and how that channel records.

    What is None or empty is not known: the file is of an earlier version.
    """

    digitizer: Annotated[int, Range(1, 255), Key()]
    """Index of the wave packet descriptor."""
    scanner: Annotated[int, Range(0, 3), Key(missing=0)]
    """Scanner channel of the points."""
    constant: Annotated[float, Range(1e-30, 1e30), Key()]
    relative_error: Annotated[float, Range(0.0, 10.0), Key()]
    spread: Annotated[float, Range(0.0, 1e6), Key()] = 0.0
    """Robust standard deviation of the echoes' constants, relative."""
    echoes: Annotated[int, Range(0, 10**12), Key()] = 0
    """Echoes that the constant was measured from."""
    shot_energy: Annotated[float, Range(0.0, 1e6), Key()] = 0.0
    """Scatter of the energy from shot to shot and of the targets' surfaces, relative: `spread` without fit errors."""
    bits: Annotated[int | None, Range(1, 32), Key()] = None
    """Bits per sample."""
    samples: Annotated[int | None, Range(1, 1 << 32), Key()] = None
    """Samples per waveform."""
    spacing_ns: Annotated[float | None, Range(1e-6, 1e9), Key()] = None
    gain: Annotated[float | None, Range(-math.inf, math.inf), Key()] = None
    """Volts per count, as the descriptor has it."""
    pulse_ns: Annotated[float | None, Range(1e-6, 1e9), Key()] = None
    """Full width at half maximum of the system pulse [ns]."""
    noise_dn: Annotated[float | None, Range(0.0, 1e12), Key()] = None
    """Standard deviation of the noise of a sample [DN]."""
    brightest: Annotated[float | None, Range(0.0, 1e30), Key()] = None
    """Light of its strongest waveforms [DN m2]: see `setting.Setting`."""
    scene: Annotated[tuple[Annotated[float, Range(-100.0, 100.0)], ...], Key(blank=True)] = ()
    """Quantiles of the light of its waveforms, logarithms: see `setting.Setting`."""

    @property
    def is_described(self) -> bool:
        """Whether anything is known of how the channel records."""
        return any(value is not None for value in (self.bits, self.spacing_ns, self.gain, self.pulse_ns))


@frozen
class StripConstant:
    """The constant of one channel on one strip of the flight that was calibrated."""

    strip: Annotated[str, Key(missing="")]
    """Name of the strip's file."""
    sha256: Annotated[str, Key()]
    """Of the strip, from its fingerprint: a strip is known by it, not by its name."""
    digitizer: Annotated[int, Range(1, 255), Key()]
    scanner: Annotated[int, Range(0, 3), Key(missing=0)]
    constant: Annotated[float, Range(1e-30, 1e30), Key()]
    relative_error: Annotated[float, Range(0.0, 10.0), Key()]
    drift: Annotated[float, Range(-1.0, 1e6), Key()] = 0.0
    """Constant over the mean constant of the channel, less 1."""
    drift_error: Annotated[float, Range(0.0, 1e6), Key()] = 0.0
    """Standard deviation of the drift."""
    ties: Annotated[int, Range(0, 10**12), Key()] = 0
    """Places that tie it to other strips or channels."""


@frozen
class Calibration:
    """Constants that turn amplitudes into backscatter; picklable."""

    constant: Annotated[
        float,
        Range(1e-30, 1e30),
        Key("constant", "C' [1/(m2 count ns)]: gamma = C' R^2 amplitude sigma / transmission"),
    ]
    """C' [1/(m2 DN ns)]."""
    relative_error: Annotated[
        float, Range(0.0, 10.0), Key("relative_error", "standard deviation of the constant, relative")
    ]
    """Standard deviation of the constant, relative."""
    attenuation: Annotated[
        float, Range(0.0, 100.0), Key("attenuation_db_km", "of the air, one way, as it was used for the constant")
    ] = 0.22
    """Of the air, one way [dB/km]."""
    haze: Annotated[
        float | None, Range(1e-6, 10.0), Key("haze", "of the flight over usual ones: other heights have other air")
    ] = None
    """As `SensorSource.haze`, where the attenuation was not given: that at other heights follows."""
    divergence: Annotated[
        float | None,
        Range(1e-3, 100.0),
        Key("divergence_mrad", "full angle of the beam between the 1/e^2 points; needed for m2"),
    ] = None
    """Full angle of the beam between the 1/e^2 points [mrad]; None where unknown."""
    strip: Annotated[str, Key()] = ""
    date: Annotated[str, Key()] = ""
    conditions: Annotated[str, Key()] = ""
    sensor: Annotated[str, Key()] = ""
    """System identifier of the strip's header."""
    software: Annotated[str, Key()] = ""
    """Generating software of the strip's header."""
    flight: Annotated[str, Key()] = ""
    """Day of the flight by GPS time, as 2026-11-22; empty where the time does not say."""
    chain: Annotated[str, Key()] = ""
    """Name of the chain that decomposed the echoes."""
    decomposer: Annotated[str, Key()] = ""
    """Its decompose stage."""
    height: Annotated[float | None, Range(0.0, 1e7), Key("height_m", "of the sensor above the targets, median")] = None
    """Median height of the sensor above the targets [m]."""
    distance: Annotated[
        float | None,
        Range(0.0, 1e7),
        Key("distance_m", "from the sensor to the targets, median: others are less certain"),
    ] = None
    """Median distance from the sensor to the targets [m]."""
    rate: Annotated[
        float | None,
        Range(1e-3, 1e12),
        Key("pulse_rate_hz", "by GPS times: a laser has another energy at another rate"),
    ] = None
    """Pulses per second by GPS times; None where they do not show it."""
    fingerprint: Mapping[str, Any] = field(default_factory=dict)
    """Of the strip that was measured."""
    targets: tuple[TargetResult, ...] = ()
    channels: Annotated[tuple[ChannelConstant, ...], Key("channel")] = ()
    """Channels that have a constant of their own."""
    strips: Annotated[tuple[StripConstant, ...], Key("flight_strip")] = ()
    """Constants of single strips, where several were calibrated together."""
    change_chance: Annotated[
        float,
        Range(0.0, 0.9),
        Key("change_chance", "assumed: of another energy or gain under the same header; 0: logs exclude it"),
    ] = CHANGE_CHANCE
    """Chance that a strip has another energy or gain under the same header, or a laser that fades, before its light is
    seen. Nothing in a strip tells it: it is high, since errors must hold for those who have one."""
    energy_mean: Annotated[
        float | None,
        Range(1e-30, 1e30),
        Key("energy_mean", "mean energy of the pulses: light was divided by the energy over it"),
    ] = None
    """Mean energy of the pulses by which the light was divided, in the unit of its source; None where it was not."""
    energy_spread: Annotated[
        float, Range(0.0, 1e6), Key("energy_spread", "of the energies from shot to shot, relative")
    ] = 0.0
    """Standard deviation of these energies from shot to shot, relative."""
    energy_source: Annotated[str, Key()] = ""
    energy_unit: Annotated[str, Key()] = ""
    places: Annotated[tuple[Annotated[float, Range(-1e9, 1e9)], ...], Key(blank=True)] = ()
    """Ground that other strips may see again: channel (`setting.number_channel`), east, north, logarithm of its light,
    and so on."""
    swath: tuple[float, ...] = ()
    """How the constant grows with the scan angle, as `Radiometry.swath`; empty where it was not fitted."""
    right: tuple[float, float] = (0.0, 0.0)
    """Of the strip's flight, as `Radiometry.right`; not kept in the file."""
    bent: float = 0.0
    """By how much the constant is off for echoes unlike the targets', since the receiver compresses, relative; all
    channels and strips share it. Not kept in the file, whose errors hold it."""
    notes: tuple[str, ...] = ()
    """What is doubtful about it, or would not show in the strip that it is used for; not kept in the file."""

    @property
    def section_constant(self) -> float | None:
        """C_cal [1/(m2 DN ns)]; None where the divergence is unknown."""
        if self.divergence is None or math.isnan(self.constant):
            return None
        return 0.25 * math.pi * (1e-3 * self.divergence) ** 2 * self.constant

    def apply(self, system: SystemPulse) -> SystemPulse:
        """Return the system pulse with this calibration; a divergence that the system has already stays."""
        return system.with_radiometry(
            constant=self.constant,
            constant_error=self.relative_error,
            channels={(row.digitizer, row.scanner): (row.constant, row.relative_error) for row in self.channels},
            shot_error=max((row.shot_energy for row in self.channels), default=0.0),
            swath=self.swath,
            right=self.right,
            attenuation=self.attenuation,
            divergence=self.divergence if system.radiometry.divergence is None else system.radiometry.divergence,
        )

    def widened(self, growth: float) -> Calibration:
        """Return the calibration with a further relative error of all its constants."""
        channels = tuple(replace(row, relative_error=math.hypot(row.relative_error, growth)) for row in self.channels)
        strips = tuple(replace(row, relative_error=math.hypot(row.relative_error, growth)) for row in self.strips)
        whole = math.hypot(self.relative_error, growth)
        return replace(self, relative_error=whole, channels=channels, strips=strips)

    def describe(self) -> dict[str, Any]:
        """Return the calibration as plain values for reports."""
        strips: Any = [asdict(row) for row in self.strips]
        if len(strips) > _MOST_DESCRIBED:  # every cloud of a flight holds this description
            text = repr([tuple(row.values()) for row in strips])
            strips = {"number": len(strips), "sha256": hashlib.sha256(text.encode(errors="replace")).hexdigest()}
        return {
            "constant": None if math.isnan(self.constant) else self.constant,
            "relative_error": self.relative_error,
            "attenuation_db_km": self.attenuation,
            "divergence_mrad": self.divergence,
            "section_constant": self.section_constant,
            **({"scan_angle_terms": list(self.swath)} if self.swath else {}),
            **{name: getattr(self, name) for name in _REPORTED},
            "channels": [asdict(row) for row in self.channels],
            "strips": strips,
        }


_CHOSEN: dict[str, dict[str, Any]] = {"attribute.incidence_angle_normals": {"radius": 0.0}}
"""Parameters of stages that are added to a chain: the radius then follows the distance between the points."""


def with_physics(chain: Chain, *, sensor: bool, calibrated: bool, divergence: bool) -> Chain:
    """Add the physical stages that the given inputs allow to the end of a chain.

    Parameters
    ----------
    chain : Chain
    sensor : bool
        Whether the user gave a trajectory or a flight height.
    calibrated : bool
        Whether there is a calibration.
    divergence : bool
        Whether the beam's divergence is known.

    Returns
    -------
    Chain
        The same object where the chain has these stages already.
    """
    names = ["attribute.range"] if sensor or calibrated or divergence else []
    names += ["attribute.incidence_angle"] if divergence else []
    names += ["attribute.backscatter_coefficient"] if calibrated else []
    names += ["attribute.cross_section"] if calibrated and divergence else []
    have = {step.stage.name for step in chain.steps}
    if calibrated and "attribute.reflectance" not in have:
        names += ["attribute.level_reflectance", "attribute.incidence_angle_normals", "attribute.reflectance"]
    added = tuple(Step(STAGES[name], _CHOSEN.get(name, {})) for name in names if name not in have)
    return replace(chain, steps=(*chain.steps, *added)) if added else chain


_USUAL = ("attribute.amplitude", "attribute.echo_width", "attribute.position")
"""Stages that a shipped chain has or leaves out on purpose; asking for their columns does not add them."""


def with_columns(chain: Chain, wanted: Iterable[str]) -> Chain:
    """Add the attribute stages that make wanted columns, with those that they need, to the end of a chain.

    Parameters
    ----------
    chain : Chain
    wanted : iterable of str
        Names of columns; those that no stage makes are left to others.

    Returns
    -------
    Chain
        The same object where nothing is missing.
    """
    for name in wanted:
        makers = [stage for stage in STAGES.values() if name in stage.makes and stage.name not in _USUAL]
        if name not in chain.makes and makers:
            step = Step(makers[0], _CHOSEN.get(makers[0].name, {}))
            chain = with_columns(chain, step.needs)
            chain = replace(chain, steps=(*chain.steps, step))
    return chain


def needs_sensor(chain: Chain) -> bool:
    """Return whether a chain computes a column that needs the sensor's position."""
    return any(name in NEEDS_SENSOR for name in chain.makes)
