"""Slow, plain references for kernels/geometry and kernels/physics: one pulse, point or direction after the other."""

from collections import defaultdict

import numpy as np


def find_pulses(gps_time, longest=64):
    """First row of the run of equal times of each point; rows of a long run, or of time 0, are alone."""
    first = []
    for row, time in enumerate(gps_time):
        start = end = row
        while start and gps_time[start - 1] == time:
            start -= 1
        while end < len(gps_time) and gps_time[end] == time:
            end += 1
        first.append(row if time == 0 or end - start >= longest else start)
    return first


def group_pulses(time, number):
    """Rows at which the time changes or the return number does not rise."""
    return [i for i in range(len(time)) if i == 0 or time[i] != time[i - 1] or number[i] <= number[i - 1]]


def thin_out(xyz, row, radius, fineness, most):
    """At most so many points of each cell: those with the least hash of their place in the file."""
    cells = defaultdict(list)
    for i, point in enumerate(xyz):
        cells[tuple(np.floor(point * fineness / radius).astype(int))].append(i)
    kept = np.zeros(len(xyz), bool)
    for members in cells.values():
        members.sort(key=lambda i: int(row[i]) * 0x9E3779B97F4A7C15 % 2**64)
        kept[members[:most]] = True
    return kept


def variety(u, v, directions=24):
    """Least kurtosis - skewness^2 - 1 of the places across any of the directions: 0 for two lines."""
    found = []
    for angle in np.pi * np.arange(directions) / directions:
        across = np.cos(angle) * u + np.sin(angle) * v
        second, third, fourth = (np.mean((across - across.mean()) ** power) for power in (2, 3, 4))
        found.append(fourth / second**2 - third**2 / second**3 - 1)
    return min(found)


def find_nearest(echo_waveform, echo_time, return_waveform, return_time):
    """Row of the nearest return of the same waveform, -1 without one."""
    rows = []
    for w, t in zip(echo_waveform, echo_time, strict=True):
        gaps = [(abs(u - t), u, j) for j, (v, u) in enumerate(zip(return_waveform, return_time, strict=True)) if v == w]
        rows.append(min(gaps)[2] if gaps else -1)
    return rows


def total_until(profile, time, spacing):
    """Sum of one profile before a time; a sample lies evenly half a spacing to both sides of its time."""
    return sum(y * min(max(time / spacing - i + 0.5, 0.0), 1.0) for i, y in enumerate(profile))


def slope_error(incidence, slope, directions=3600):
    """Root mean square of cos(true angle) / cos(incidence) - 1 over surfaces that slope in any direction."""
    ray = np.array([np.sin(incidence), 0.0, np.cos(incidence)])
    off = []
    for turn in 2 * np.pi * np.arange(directions) / directions:
        normal = np.array([np.sin(slope) * np.cos(turn), np.sin(slope) * np.sin(turn), np.cos(slope)])
        off.append(ray @ normal / ray[2] - 1)
    return np.sqrt(np.mean(np.square(off)))
