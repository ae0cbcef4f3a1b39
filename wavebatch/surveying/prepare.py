"""Pulse, chain, sensor and calibration of a strip: one preparation for every command that decomposes waveforms.

`run`, `calibrate`, `voxelize`, `compare --strip` and `plot waveform` call `prepare`, so that all see the echoes that a
run sees. Before you change it: the result must depend on the strip and the request alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from enum import Enum

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.pulse_energy import NONE
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.stages.chain import Chain
from wavebatch.surveying.calibration import Calibration, needs_sensor
from wavebatch.surveying.choose_chain import ChainChoice, Request, make_choice
from wavebatch.surveying.look import check_saved
from wavebatch.surveying.matching.strip_energies import StripEnergies, take_energies
from wavebatch.surveying.measuring.return_scatter import measure_returns
from wavebatch.surveying.sensor import UNKNOWN, SensorRequest, SensorSource, find_sensor


class Positions(Enum):
    """Whether the sensor's positions are looked for."""

    IF_NEEDED = "where the chain needs them"
    IF_KNOWN = "where the strip gives them"
    REQUIRED = "always: without them the strip fails"
    NONE = "never"


@frozen(eq=False)
class Setup:
    """What a strip is decomposed with; picklable."""

    choice: ChainChoice
    """Chain and survey, with the reasons."""
    sensor: SensorSource = UNKNOWN
    calibration: Calibration | None = None
    """As it holds for this strip."""
    sent: StripEnergies = StripEnergies(None)
    """Of its pulses, where the chain or a calibration needs them."""
    doubts: tuple[str, ...] = ()
    """Why the calibration may not fit."""
    stranger: str = ""
    """Why the strip does not belong to its flight and got a survey of its own; empty where it does."""
    forced: str = ""
    """What contradicts the saved survey with which the strip is run, by --force or in doubt; empty for nothing."""

    @property
    def chain(self) -> Chain:
        """The chain that was chosen."""
        return self.choice.chain

    @property
    def system(self) -> SystemPulse:
        """The pulse with its calibration and the errors of the places of returns and sensor."""
        system = self.sensor.place(self.choice.survey.system)
        return system if self.calibration is None else self.calibration.apply(system)


def prepare(
    reader: StripReader,
    scan: StripScan,
    chain: Chain,
    request: Request,
    *,
    sensor: SensorRequest | None = None,
    positions: Positions = Positions.IF_NEEDED,
    calibration: Calibration | None = None,
    air: float | None = None,
    energy: str | None = NONE,
    extend: Callable[[Chain], Chain] | None = None,
) -> Setup:
    """Choose pulse and chain of a strip, find its sensor, and see whether its calibration fits.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    chain : Chain
        Used where the request does not choose one.
    request : Request
    sensor : SensorRequest, optional
        Where positions shall come from; by default from the strip.
    positions : Positions
    calibration : Calibration, optional
    air : float, optional
        Attenuation during the flight [dB/km]; None: that of the calibration.
    energy : str, optional
        Energies of the pulses, as `find_pulse_energy`.
    extend : callable, optional
        Adds stages to a chain that the request chose.

    Returns
    -------
    Setup

    Raises
    ------
    InputError
        Where the strip contradicts the saved survey or the calibration, or its sensor is required and not known.
    ConfigError
        Where no chain meets the tolerance.
    """
    stranger = forced = ""  # why it does not belong to its flight, and what contradicts a saved survey
    if request.system is not None and request.flight:
        from wavebatch.surveying.flight import compare_flight  # and with it the survey

        stranger = compare_flight(reader, scan, request.system)
    elif request.system is not None:
        forced = check_saved(reader, scan, request.system.survey, force=request.force)
    used = replace(request, system=None) if stranger else request
    choice = make_choice(reader, scan, chain, used)
    if extend is not None and used.describe() is not None:
        choice = replace(choice, chain=extend(choice.chain))
    source = UNKNOWN
    if positions is not Positions.IF_NEEDED or needs_sensor(choice.chain):
        source = _find_sensor(reader, scan, sensor or SensorRequest(), positions)
    elif "incidence_angle_normals" in choice.chain.makes:  # only to see whether its vectors are turned
        source = _find_sensor(reader, scan, SensorRequest(), Positions.IF_KNOWN)
    system, sent = choice.survey.system, StripEnergies(None)
    returns, late = measure_returns(reader, scan, system), choice.survey.figures.sent_time_error_ns
    if late and returns.source != "neighbours":  # within a packet nothing shows when its pulse was sent
        returns = returns._replace(scatter=math.hypot(returns.scatter, HALF_C * late))
    source = replace(source, returns=returns)
    if calibration is not None or positions is not Positions.IF_NEEDED or needs_sensor(choice.chain):
        sent = take_energies(reader, scan, energy, calibration)
    if calibration is None:
        return Setup(choice, source, None, sent, (), stranger, forced)
    from wavebatch.surveying.matching.strip_match import match_strip

    level = None if sent.energy is None else sent.energy.level
    fitted, doubts = match_strip(calibration, reader, scan, system, source, choice.chain, air, level)
    return Setup(choice, source, sent.widen(fitted), sent, doubts, stranger, forced)


def _find_sensor(
    reader: StripReader, scan: StripScan, request: SensorRequest, positions: Positions
) -> SensorSource:
    if positions is Positions.NONE:
        return UNKNOWN
    try:
        source = find_sensor(reader, scan, request)
    except InputError:  # coordinates in feet or degrees
        if positions is not Positions.IF_KNOWN:
            raise
        return UNKNOWN
    if source.kind == "none" and positions is Positions.REQUIRED:
        raise InputError(
            f"{reader.facts.path}: the sensor's position is unknown: give --trajectory or --flight-height"
        )
    return source
