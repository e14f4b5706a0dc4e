"""Traffic on straight lanes, and what a camera's masks tell of it: places, sizes, misses and mistakes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from labelgen.labeling.fitted.passages import Sightings

_LANE_WIDTH_M = 3.5
_STEP_S = 0.1


@dataclass(frozen=True)
class Traffic:
    """A scene of `random_sightings`; speeds in m/s, times in seconds, lengths in metres."""

    directions: tuple[int, ...] = (1, 1, -1, -1)
    speed_ms: float = 22.0
    speed_spread: float = 0.12
    headway_s: float = 2.5
    range_m: tuple[float, float] = (15.0, 95.0)
    duration_s: float = 120.0
    step_s: float = 0.5
    stops: bool = False
    noise_m: float = 0.3
    drift: float = 0.01
    miss: float = 0.06
    double: float = 0.03
    false: float = 0.01
    resize: float = 0.08
    lorries: float = 0.15


@dataclass(frozen=True)
class PairCounts:
    """How many pairs of successive sightings were to join, and were joined rightly and wrongly."""

    true: int
    right: int
    joins: int
    wrong: int

    @property
    def found(self) -> float:
        return self.right / max(self.true, 1)

    @property
    def error(self) -> float:
        return self.wrong / max(self.joins, 1)


def random_sightings(traffic: Traffic, seed: int) -> tuple[Sightings, NDArray[np.int64]]:
    """Return sightings of random traffic and the vehicle (N,) of each, -1 for masks of nothing."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[float, ...]] = []
    vehicle = 0
    for lane, direction in enumerate(traffic.directions):
        places, lengths = _drive(traffic, rng)
        for along, length in zip(places.T, lengths, strict=True):
            rows += _seen(traffic, rng, along, float(length), lane, direction, vehicle)
            vehicle += 1
    times = np.unique([row[0] for row in rows])
    for time in times[rng.random(len(times)) < traffic.false * 5]:
        point = rng.uniform(traffic.range_m[0], traffic.range_m[1]), rng.uniform(-2, 14)
        rows.append((time, *point, rng.uniform(0.5, 3), rng.uniform(0.5, 3), 0, 0, -1))
    order = rng.permutation(len(rows))
    table = np.array(rows)[order]
    table = table[np.argsort(table[:, 0], kind="stable")]
    frames = np.rint(table[:, 0] / traffic.step_s).astype(np.int64)
    noise = traffic.noise_m / 0.7 * np.clip((table[:, 1] - traffic.range_m[0]) / np.ptp(traffic.range_m), 0, 1)
    columns = table[:, 3], table[:, 4], table[:, 5].astype(np.int64), table[:, 6] > 0
    return Sightings(
        table[:, 0], frames, table[:, 1:3], *columns, m_per_px=np.stack([noise, noise * 0], axis=1)
    ), table[:, 7].astype(np.int64)


def count_pairs(
    sightings: Sightings, vehicles: NDArray[np.int64], passages: NDArray[np.int64], max_gap_s: float = 1.6
) -> PairCounts:
    """Compare passages (N,) with the true vehicles (N,)."""
    looks = sightings.frames // sightings.every_frame
    true = right = joins = wrong = 0
    for vehicle in np.unique(vehicles[vehicles >= 0]).tolist():
        index = np.flatnonzero(vehicles == vehicle)
        seen = np.unique(looks[index])
        for a, b in pairwise(seen.tolist()):
            i, j = index[looks[index] == a], index[looks[index] == b]
            if b <= a + 3 and sightings.times_s[j[0]] - sightings.times_s[i[0]] <= max_gap_s:
                true += 1
                right += bool(np.isin(passages[i], passages[j]).any())
    order = np.argsort(passages, kind="stable")
    same = passages[order][1:] == passages[order][:-1]
    i, j = order[:-1][same], order[1:][same]
    joins, wrong = len(i), int((vehicles[i] != vehicles[j]).sum())
    return PairCounts(true, int(right), joins, wrong)


def _drive(traffic: Traffic, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the places (T, V) of the fronts of a lane's vehicles, one each `_STEP_S`, metres, and their lengths."""
    count = int(traffic.duration_s / traffic.headway_s) + 1
    headways = np.maximum(rng.exponential(traffic.headway_s - 0.9, count) + 0.9, 0.9)
    lengths = np.where(rng.random(count) < traffic.lorries, rng.uniform(7, 16, count), rng.uniform(3.6, 5.2, count))
    wanted = traffic.speed_ms * np.exp(rng.normal(0, traffic.speed_spread, count))
    start_s = np.cumsum(headways)
    place, speed = -start_s * traffic.speed_ms - np.cumsum(lengths), wanted.copy()
    out = []
    for step in range(int(traffic.duration_s / _STEP_S)):
        gap = np.concatenate([[1e9], place[:-1] - lengths[:-1] - place[1:]])
        closing = speed - np.concatenate([[speed[0]], speed[:-1]])
        desired = 2 + np.maximum(speed * 1.0 + speed * closing / (2 * np.sqrt(1.5 * 2.5)), 0)
        acceleration = 1.5 * (1 - (speed / wanted) ** 4 - (desired / np.maximum(gap, 0.5)) ** 2)
        if traffic.stops:
            stop_at = 0.6 * traffic.range_m[0] + 0.4 * traffic.range_m[1] + 30
            red = step * _STEP_S % 30 < 15
            distance = np.where(place < stop_at, stop_at - place, 1e9)
            braking = speed**2 / (2 * np.maximum(distance, 0.3))
            acceleration = np.where(red & (braking > 1.5) & (braking < 5), -braking, acceleration)
        speed = np.maximum(speed + np.clip(acceleration, -6, 2) * _STEP_S, 0)
        place = place + speed * _STEP_S
        out.append(place)
    return np.array(out), lengths


def _seen(
    traffic: Traffic,
    rng: np.random.Generator,
    along: NDArray[np.float64],
    length: float,
    lane: int,
    direction: int,
    vehicle: int,
) -> list[tuple[float, ...]]:
    """Return the sightings of one vehicle: time, place along and across, width, height, class, cut, vehicle."""
    low, high = traffic.range_m
    times = np.arange(0, traffic.duration_s - 2 * _STEP_S, traffic.step_s)
    front = np.interp(times, np.arange(len(along)) * _STEP_S, along)
    end = front if direction < 0 else front - length  # the end towards the camera, at low X
    x = end if direction > 0 else high + low - end
    inside = (x > low - length) & (x < high) & (rng.random(len(x)) >= traffic.miss)
    large = length > 6
    width, height = (2.5, 3.4) if large else (rng.uniform(1.6, 1.9), rng.uniform(1.3, 1.8))
    kind = (3 if rng.random() < 0.7 else 1) if large else 1
    bias, slope, across = rng.uniform(-1, 0.3), rng.normal(0, traffic.drift), rng.normal(0, 0.3)
    out: list[tuple[float, ...]] = []
    for time, place in zip(times[inside], x[inside], strict=True):
        cut = place < low
        noise = rng.normal(0, traffic.noise_m * (0.5 + (place - low) / (high - low)))
        shown = max(place, low) + bias + slope * (place - low) + noise
        y = lane * _LANE_WIDTH_M + across + rng.normal(0, 0.12)
        sizes = np.array([width, height]) * np.exp(rng.normal(0, traffic.resize, 2)) * (1 if not cut else 0.8)
        out.append((time, shown, y, *sizes, kind if rng.random() < 0.97 else 2, cut, vehicle))
        if rng.random() < traffic.double:
            out.append((time, shown + rng.uniform(0, 6), y + rng.normal(0, 0.3), *(sizes * 0.6), kind, cut, vehicle))
    return out
