"""Slow, plain references for kernels/geometry: one pulse, point or direction after the other."""

from collections import defaultdict

import numpy as np
from scipy.optimize import least_squares


def group_times(gps_time, longest=64):
    """First row of equal time of each packet; rows of a time of many packets, or of time 0 or NaN, are alone."""
    times = [float(time) for time in gps_time]
    alone = [not time or time != time or times.count(time) >= longest for time in times]
    return [row if alone[row] else times.index(time) for row, time in enumerate(times)]


def find_rays(group, scanner, start, step, aligned=1e-4, beside=0.1):
    """First row of the ray of each packet: of one group and scanner, of one direction, on one line."""
    heads = []
    for row in range(len(group)):
        for head in sorted(set(heads)):
            away = start[row] - start[head]
            way = step[head] * (away @ step[head]) / (step[head] @ step[head])
            near = np.linalg.norm(away - way) <= beside + aligned * np.linalg.norm(way)
            turned = np.linalg.norm(step[row] - step[head]) > aligned * np.linalg.norm(step[head])
            if group[head] == group[row] and scanner[head] == scanner[row] and near and not turned:
                heads.append(head)
                break
        else:
            heads.append(row)
    return heads


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


def _usable(time, point, direction, weight):
    rows = [
        i for i in range(len(time))
        if np.isfinite([time[i], *point[i], *direction[i]]).all() and np.any(direction[i] != 0)
    ]  # fmt: skip
    unit = np.array([direction[i] / np.linalg.norm(direction[i]) for i in rows])
    return time[rows], point[rows], unit, np.ones(len(rows)) if weight is None else weight[rows]


def _without_outliers(error, weight):
    """Weights, 0 beyond four robust standard deviations."""
    return np.where(error <= 4 * 1.482602 * np.median(error), weight, 0.0)


def meet_lines(powers, ground, unit, weight):
    """Coefficients of the path that comes nearest to the lines, each weighed by its distance, without outliers."""
    used, found = weight, None
    for _ in range(3):
        rows, right = [], []
        for power, place, along, w in zip(powers, ground, unit, used, strict=True):
            across = np.sqrt(w) * (np.eye(3) - np.outer(along, along))
            rows.append(np.hstack([p * across for p in power]))
            right.append(across @ place)
        found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0].reshape(-1, 3)
        away = ground - powers @ found
        distance = np.linalg.norm(away, axis=1)
        off = np.linalg.norm(np.cross(unit, away), axis=1)
        used = _without_outliers(off / distance * np.sqrt(weight), weight / distance**2)
    return found


def sum_correlation(values):
    """1 + 2 sum of the autocorrelation (n, 3) until it first falls to what noise shows, lag by lag."""
    n = len(values)
    whole, total = np.sum(values * values), 1.0
    for lag in range(1, n // 4):
        share = np.sum(values[lag:] * values[:-lag]) / whole
        if share < 1 / np.sqrt(n):
            break
        total += 2 * share
    return total


def fit_sensor(time, point, direction, weight, order):
    """Path by scipy's least squares of the angles: dict of the values of a SensorFit."""
    time, point, unit, weight = _usable(time, point, direction, weight)
    centre, half = (min(time) + max(time)) / 2, (max(time) - min(time)) / 2
    origin = np.median(point, axis=0)
    ground = point - origin
    powers = np.array([[((t - centre) / half) ** k for k in range(order + 1)] for t in time])
    found = meet_lines(powers, ground, unit, weight)
    unit = np.array([u if u @ a >= 0 else -u for u, a in zip(unit, ground - powers @ found, strict=True)])

    def angles(flat):
        away = ground - powers @ flat.reshape(-1, 3)
        return unit - away / np.linalg.norm(away, axis=1)[:, None]

    for _ in range(6):
        used = _without_outliers(np.linalg.norm(angles(found), axis=1) * np.sqrt(weight), weight)
        result = least_squares(
            lambda flat, used=used: (angles(flat) * np.sqrt(used)[:, None]).ravel(), found.ravel(), x_scale="jac",
            xtol=1e-13, ftol=1e-14, gtol=1e-14,
        )  # fmt: skip
        found = result.x.reshape(-1, 3)
    away = ground - powers @ found
    normal, side = 0.0, []
    for power, ahead, r, w in zip(powers, away, angles(found), used, strict=True):
        distance = np.linalg.norm(ahead)
        across = np.eye(3) - np.outer(ahead, ahead) / distance**2
        normal = normal + w / distance**2 * np.kron(np.outer(power, power), across)
        side.append(np.sqrt(w) * (across @ r))
    side, off = np.array(side), unit - unit.mean(axis=0)
    residual = np.sqrt(2 * result.cost / max(2 * np.count_nonzero(used) - found.size, 1))
    turned = off @ np.linalg.svd(off)[2][0]
    by_time, by_angle = (sum_correlation(side[np.argsort(key, kind="stable")]) for key in (time, turned))
    mean = unit.mean(axis=0) / np.linalg.norm(unit.mean(axis=0))
    return {
        "coefficients": found + np.vstack([origin, np.zeros((order, 3))]),
        "covariance": residual**2 * max(np.sqrt(by_time), 1 + 4 * (by_angle - 1)) * np.linalg.inv(normal),
        "condition": np.linalg.cond(normal[:3, :3]),
        "distance": np.median([np.linalg.norm(ahead) for ahead in away]),
        "spread": 2 * np.quantile([np.arccos(min(u @ mean, 1.0)) for u in unit], 0.98),
        "residual": residual,
        "half": half,
        "centre": centre,
    }


def sensor_at(fit, time):
    """Position and velocity at one time, from the values of `fit_sensor`."""
    tau = (time - fit["centre"]) / fit["half"]
    curves = [np.polynomial.Polynomial(column) for column in np.transpose(fit["coefficients"])]
    return np.array([c(tau) for c in curves]), np.array([c.deriv()(tau) / fit["half"] for c in curves])


def range_error(fit, time, direction):
    """Standard deviation of the distance at one time, with the motion that the order does not follow."""
    tau, order = (time - fit["centre"]) / fit["half"], len(fit["coefficients"]) - 1
    along = np.concatenate([tau**k * np.asarray(direction) for k in range(order + 1)])
    # Root mean squares over the window of a speed and of an acceleration that the model does not have.
    stray = (80.0 * fit["half"] / np.sqrt(3), 1.0 * fit["half"] ** 2 / 6, 0.0)[order]
    return np.sqrt(along @ fit["covariance"] @ along + stray**2 * fit["condition"])


def fit_best(time, point, direction, weight):
    """Order of the fit with the least error of the range, None where none is sound."""
    errors = {}
    for order in (2, 1, 0):
        fit = fit_sensor(time, point, direction, weight, order)
        if fit["condition"] < 1e5 and fit["spread"] > np.radians(2):
            places = np.linspace(fit["centre"] - fit["half"], fit["centre"] + fit["half"], 9)
            error = np.sqrt(np.mean([range_error(fit, at, [0, 0, -1]) ** 2 for at in places]))
            errors[order] = error / fit["distance"]
    best = min(errors, key=errors.get, default=None)
    return best if best is not None and errors[best] < 0.01 else None


def number_returns(pulse, xyz, direction):
    """(number, count, ordered) of each point: its place along the first ray that is known of its pulse."""
    found = []
    for row, own in enumerate(pulse):
        same = [i for i in range(len(pulse)) if pulse[i] == own]
        ray = next((i for i in same if np.any(direction[i] != 0)), None)
        head = same[0] if ray is None else ray
        place = {i: sum((xyz[i] - xyz[head]) * direction[head]) for i in same}
        found.append((1 + sorted(same, key=place.get).index(row), len(same), ray is not None))
    return found
