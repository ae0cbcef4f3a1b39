"""Strips of sensors that do not exist, with their truth; `strangers.py` judges a survey by them.

Nothing here comes from wavebatch: pulses are tables, noise is filtered, files are written byte by byte.
Times are in samples. A strip depends on its number alone.
"""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy  # its parts load when they are first asked for

SEED = 34
"""Of the whole list. Who changes this, or a draw in this file, makes other strips, and no older result compares."""

FINE = 256
"""Steps of a pulse's table per FWHM: linear interpolation then misses the pulse by 1e-5 of its height."""

BEFORE, AFTER = 6.0, 12.0
"""Reach of a pulse's table [FWHM]."""

WIDENINGS = np.linspace(0.0, 1.5, 31)
"""Widths (standard deviations) of targets over that of the pulse; truth has these only, so that tables are exact."""

MOST_SAMPLES = 2_000_000
POINT = np.dtype(
    [("xyz", "<i4", 3), ("intensity", "<u2"), ("bits", "u1"), ("class", "u1"), ("angle", "i1"), ("user", "u1"),
     ("source", "<u2"), ("time", "<f8"), ("index", "u1"), ("offset", "<u8"), ("size", "<u4"), ("location", "<f4"),
     ("vector", "<f4", 3)]
)  # fmt: skip
"""Point format 4."""
TOWARD = np.array([0.02, -0.01, 0.1482]) / 1000.0
"""Vector of every pulse toward the sensor [m/ps]."""


@dataclass
class Sensor:
    """What a strip was drawn with."""

    number: int
    shape: str
    fwhm: float
    shape_value: float
    """Skew, ratio of widths or height of the second part: by shape."""
    width_change: float
    """Standard deviation of the pulse's width from shot to shot, relative."""
    noise: float
    """[count]"""
    filter: tuple[float, ...]
    """Of the noise: coefficients of an autoregression; empty for white noise."""
    gain: float
    """Growth of the variance per count of signal [count]."""
    bits: int
    base: float
    base_spread: float
    top: float
    """Largest echo of the scene, in noises."""
    samples: int
    packets: int
    spacing: float
    scene: str
    empty: float
    saturated: bool

    def causes(self) -> list[str]:
        """Rows of the table that a strip counts in."""
        rules = {
            "gaussian": self.shape == "gaussian", "skewed": self.shape in ("lognormal", "exponential", "gamma"),
            "ringing": self.shape == "ringing", "pre- or after-pulse": self.shape in ("before", "after"),
            "shot to shot > 1 %": self.width_change > 0.01, "shot to shot .2-1 %": 0 < self.width_change <= 0.01,
            "AR(1) noise": len(self.filter) == 1, "AR(2) noise": len(self.filter) == 2, "growing noise": self.gain > 0,
            "8 bit": self.bits == 8, "14 or 16 bit": self.bits >= 14, "above 1,000 noises": self.top > 1000,
            "FWHM < 2": self.fwhm < 2, "FWHM > 15": self.fwhm > 15, "fewer than 150 packets": self.packets < 150,
            "short (< 12 FWHM)": self.samples < 12 * self.fwhm, "long (> 500)": self.samples > 500,
            f"scene {self.scene}": True, "empties > 30 %": self.empty > 0.3, "levels vary": self.base_spread > 0,
            "saturated": self.saturated,
        }  # fmt: skip
        return [name for name, holds in rules.items() if holds]


def draw_sensor(number: int) -> tuple[Sensor, np.random.Generator]:
    """A sensor and its scene, and the generator for the rest of the strip."""
    rng = np.random.default_rng([SEED, number])
    shape = str(rng.choice(["gaussian", "lognormal", "exponential", "gamma", "ringing", "before", "after"],
                           p=[0.2, 0.22, 0.13, 0.1, 0.15, 0.05, 0.15]))  # fmt: skip
    low, high = {"lognormal": (0.03, 0.2), "exponential": (0.3, 1.5), "gamma": (3.0, 12.0)}.get(shape, (0.01, 0.05))
    value = rng.uniform(low, high)
    fwhm = _spread(rng, 1.2, 40)
    least, most = [(50, 300), (300, 2000), (2000, 8000)][rng.choice(3, p=[0.2, 0.65, 0.15])]
    samples = int(np.clip(_spread(rng, 24, 2000), 6 * fwhm + 8, 2000))
    packets = int(min(_spread(rng, least, most), MOST_SAMPLES // samples))
    bits = int(rng.choice([8, 10, 12, 14, 16], p=[0.35, 0.1, 0.15, 0.1, 0.3]))
    noise = _spread(rng, 0.4, 2.5) if bits < 12 else _spread(rng, 0.5, 15)
    base = 5 * noise + rng.uniform(0, 10)
    room = (2**bits - 1 - base) / noise
    saturated = bool(rng.random() < 0.12)
    top = 1.6 * room if saturated else _spread(rng, 45, max(min(0.9 * room, 5000), 50))
    colour = rng.choice(["white", "one", "two"], p=[0.5, 0.3, 0.2])
    radius, angle = rng.uniform(0.5, 0.8), rng.uniform(0.3, 0.9)
    filters = {"white": (), "one": (rng.uniform(0.3, 0.9),), "two": (2 * radius * np.cos(angle), -(radius**2))}
    grows, varies, changes, holes = rng.random(4)
    growth = _spread(rng, 1, 10) * noise**2 / (min(top, room) * noise)
    change = rng.uniform(0.002, 0.04)
    spread, empty = rng.uniform(0.2, 2) * noise, rng.uniform(0.1, 0.7)
    return Sensor(
        number, shape, fwhm, value, change if changes < 0.4 else 0.0, noise, tuple(map(float, filters[str(colour)])),
        growth if grows < 0.25 else 0.0, bits, base, spread if varies < 0.3 else 0.0, top, samples, packets,
        float(rng.choice([0.5, 1.0, 2.0])), str(rng.choice(["open", "mixed", "canopy", "slopes"], p=[0.2, 0.25, 0.35,
                                                                                                0.2])),
        empty if holes < 0.25 else 0.0, saturated,
    ), rng  # fmt: skip


def _spread(rng: np.random.Generator, low: float, high: float) -> float:
    """A draw, even in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def make_shape(sensor: Sensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pulses by the widening of their targets.

    Returns
    -------
    lag : (k,), FWHM after the peak of the plain pulse
    height : (31, k), with a peak of 1
    fwhm : (31,), FWHM of the plain pulse
    """
    x = np.arange(-3 * BEFORE, 3 * AFTER, 1 / FINE) * 2.3548  # standard deviations, before it is scaled
    value, gaussian = sensor.shape_value, np.exp(-0.5 * x**2)
    if sensor.shape == "lognormal":
        inside = 1 + value * x
        pulse = np.where(inside > 0, np.exp(-0.5 * (np.log(np.maximum(inside, 1e-9)) / value) ** 2), 0)
    elif sensor.shape == "exponential":
        pulse = scipy.signal.lfilter([1.0], [1.0, -np.exp(-(x[1] - x[0]) / value)], gaussian)
    elif sensor.shape == "gamma":
        rise = np.maximum(x / np.sqrt(value) + 1, 1e-9)
        pulse = np.where(rise > 1e-9, np.exp(value * (np.log(rise) - rise + 1)), 0)
    elif sensor.shape == "ringing":
        after = np.maximum(x - 2.0, 0)
        pulse = gaussian + value * np.exp(-after / 4) * np.sin(after * 1.4) * 1.5
    elif sensor.shape == "before":
        pulse = gaussian + value * np.exp(-0.5 * (x + 6) ** 2)
    elif sensor.shape == "after":
        pulse = gaussian + value * np.exp(-0.5 * ((x - 5 - 60 * value) / 1.3) ** 2)
    else:
        pulse = gaussian
    x, pulse = x - x[np.argmax(pulse)], pulse / pulse.max()
    x /= _measure_fwhm(x, pulse)
    lag = np.arange(-BEFORE, AFTER, 1 / FINE)
    plain = np.interp(lag, x, pulse)
    frequency = np.fft.rfftfreq(2 * len(lag), 1 / FINE)
    spectrum = np.fft.rfft(plain, 2 * len(lag))
    blurred = [np.fft.irfft(spectrum * np.exp(-2 * (np.pi * frequency * w / 2.3548) ** 2))[: len(lag)]
               for w in WIDENINGS]  # fmt: skip
    height = np.array([one / one.max() for one in blurred])
    return lag, height, np.array([_measure_fwhm(lag, one) for one in height])


def _measure_fwhm(x: np.ndarray, pulse: np.ndarray) -> float:
    top = int(np.argmax(pulse))
    left = np.interp(0.5, pulse[: top + 1][-8 * FINE :], x[: top + 1][-8 * FINE :])
    right = np.interp(-0.5, -pulse[top : top + 8 * FINE], x[top : top + 8 * FINE])
    return float(right - left)


def draw_scene(sensor: Sensor, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Echoes: packet, time [samples], amplitude [count], and row of the widening."""
    n, f, room = sensor.packets, sensor.fwhm, sensor.samples
    begin, end = min(2.0 * f + 2, 0.3 * room), room - min(2.0 * f + 2, 0.3 * room)
    fits = max(int((end - begin) / (0.8 * f)), 1)
    number = {
        "open": np.where(rng.random(n) < 0.95, 1, 2), "mixed": rng.choice([1, 2, 3], n, p=[0.6, 0.25, 0.15]),
        "canopy": rng.integers(1, 9, n), "slopes": np.where(rng.random(n) < 0.8, 1, 2),
    }[sensor.scene]  # fmt: skip
    number = np.where(rng.random(n) < sensor.empty, 0, np.minimum(number, fits))
    packet = np.repeat(np.arange(n), number)
    first = np.cumsum(number) - number
    m = len(packet)
    close = sensor.scene == "canopy"
    gap = f * (0.5 + rng.exponential(1.0, m) if close else rng.uniform(0.6, 8, m))
    gap[first[number > 0]] = 0
    time = np.cumsum(gap)
    time -= np.repeat(time[first[number > 0]], number[number > 0])
    last = np.zeros(n)
    last[number > 0] = time[first[number > 0] + number[number > 0] - 1]
    # What does not fit is pressed together.
    press = np.minimum(1, (end - begin) / np.maximum(last, 1e-9))
    start = begin + rng.random(n) * np.maximum(end - begin - last * press, 0)
    time = time * press[packet] + start[packet]
    bright = np.minimum(rng.lognormal(0, 0.6, n) / 3, 1)
    taken = rng.beta(1.2, 2, m)
    if close:
        passed = np.log1p(-taken)
        before = np.cumsum(passed) - passed
        taken = taken * np.exp(before - np.repeat(before[first[number > 0]], number[number > 0]))
    else:
        taken = np.where(gap == 0, 1.0, rng.uniform(0.1, 1, m))
    amplitude = sensor.top * sensor.noise * bright[packet] * taken
    mean = {"open": 0.05, "mixed": 0.15, "canopy": 0.3, "slopes": 0.6}[sensor.scene]
    widening = rng.exponential(mean, m) * (rng.random(m) < 0.6)
    row = np.minimum(np.rint(widening / WIDENINGS[1]), len(WIDENINGS) - 1).astype(int)
    good = amplitude > 0.5 * sensor.noise
    return {"packet": packet[good], "time": time[good], "amplitude": amplitude[good], "row": row[good]}


def render(sensor: Sensor, echoes: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Counts of all packets; adds what a judge must know of each echo: fwhm, snr, clipped, misfit of neighbours."""
    lag, height, fwhm = make_shape(sensor)
    f, n, s = sensor.fwhm, sensor.packets, sensor.samples
    packet, time, amplitude, row = (echoes[name] for name in ("packet", "time", "amplitude", "row"))
    stretch = 1 + sensor.width_change * rng.standard_normal(n)
    signal = np.zeros((n, s))
    reach = np.arange(-int(BEFORE * f), int(AFTER * f) + 1)
    for one in np.unique(row):
        for part in np.array_split(np.flatnonzero(row == one), np.count_nonzero(row == one) * len(reach) // 10**7 + 1):
            at = np.rint(time[part]).astype(int)[:, None] + reach
            value = np.interp((at - time[part, None]) / (f * stretch[packet[part], None]), lag, height[one], 0, 0)
            inside = (at >= 0) & (at < s)
            place = (packet[part, None] * s + at)[inside]
            signal += np.bincount(place, (value * amplitude[part, None])[inside], n * s).reshape(n, s)
    colour = [1.0, *(-a for a in sensor.filter)]
    noise = scipy.signal.lfilter([1.0], colour, rng.standard_normal((n, s + 200)), axis=1)[:, 200:]
    noise *= sensor.noise / noise.std()
    if sensor.gain:
        noise += rng.standard_normal((n, s)) * np.sqrt(sensor.gain * np.maximum(signal, 0))
    level = sensor.base + sensor.base_spread * rng.standard_normal((n, 1))
    most = 2**sensor.bits - 1
    counts = np.clip(np.rint(level + signal + noise), 0, most).astype("u1" if sensor.bits == 8 else "<u2")
    echoes["fwhm"] = f * fwhm[row]
    echoes["snr"] = amplitude * _see(sensor, lag, height[0], amplitude)
    near = (np.rint(time)[:, None] + np.arange(-int(1.5 * f) - 1, int(1.5 * f) + 2)).astype(int)
    echoes["clipped"] = (counts[packet[:, None], np.clip(near, 0, s - 1)] == most).any(axis=1)
    return counts


def _see(sensor: Sensor, lag: np.ndarray, height: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """1 over the error of an amplitude by a plain matched filter, for echoes of these amplitudes."""
    x = np.arange(-int(2 * sensor.fwhm) - 1, int(2 * sensor.fwhm) + 2)
    pulse = np.interp(x / sensor.fwhm, lag, height)
    impulse = scipy.signal.lfilter([1.0], [1.0, *(-a for a in sensor.filter)], np.r_[1.0, np.zeros(400)])
    lags = np.correlate(impulse, impulse, "full")[400:]
    colour = np.interp(np.abs(x[:, None] - x), np.arange(401), lags / lags[0])
    seen = sensor.noise**2 * pulse @ colour @ pulse + pulse @ pulse / 12
    return pulse @ pulse / np.sqrt(seen + sensor.gain * amplitude * np.sum(pulse**3))


def make_strip(number: int, folder: Path) -> Path:
    """The strip NNNN.las in a folder, with NNNN.npz and NNNN.json of its truth; made where they are not there."""
    path = folder / f"{number:04d}.las"
    sensor, rng = draw_sensor(number)
    note, described = path.with_suffix(".json"), json.dumps({**asdict(sensor), "causes": sensor.causes()})
    if path.exists() and note.read_text() == described:
        return path
    folder.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    echoes = draw_scene(sensor, rng)
    counts = render(sensor, echoes, rng)
    np.savez_compressed(path.with_suffix(".npz"), **echoes)
    note.write_text(described)
    strongest = np.full(sensor.packets, np.nan)
    order = np.argsort(echoes["amplitude"])
    strongest[echoes["packet"][order]] = echoes["time"][order]
    strongest = np.where(np.isnan(strongest), np.argmax(counts, axis=1), strongest)
    part = path.with_suffix(".part")
    part.write_bytes(format_las(counts, sensor.spacing, strongest))
    part.rename(path)  # last, so that a strip that is there is whole
    return path


def format_las(counts: np.ndarray, spacing: float, place: np.ndarray) -> bytes:
    """LAS 1.3, point format 4, packets inside: one point per packet, at `place` [samples]."""
    n, s = counts.shape
    width = counts.itemsize * s
    points = np.zeros(n, POINT)
    location = np.float32(place * spacing * 1000)
    start = np.stack([np.arange(n) * 0.5, np.zeros(n), np.full(n, 500.0)], axis=1)
    points["xyz"] = np.rint((start - location[:, None].astype(float) * TOWARD) * 1000)
    points["bits"] = 1 | 1 << 3
    points["time"] = 1000 + np.arange(n) * 1e-5
    points["index"], points["size"], points["vector"] = 1, width, TOWARD
    points["offset"] = 60 + np.arange(n) * width
    points["location"] = location
    payload = struct.pack("<BBIIdd", 8 * counts.itemsize, 0, s, round(spacing * 1000), 1.0, 0.0)
    record = struct.pack("<H16sHH32s", 0, b"LASF_Spec", 100, len(payload), b"") + payload
    begin = 235 + len(record)
    head = struct.pack(
        "<4sHH16sBB32s32sHHHIIBHI5I12dQ", b"LASF", 0, 2, b"", 1, 3, b"", b"", 1, 2025, 235, begin, 1, 4,
        POINT.itemsize, n, n, 0, 0, 0, 0, *(0.001,) * 3, *(0.0,) * 3, *(0.0,) * 6, begin + n * POINT.itemsize,
    )  # fmt: skip
    return head + record + points.tobytes() + struct.pack("<H16sHQ32s", 0, b"LASF_Spec", 65535, n * width, b"") + (
        counts.tobytes()
    )
