"""Traffic: which vehicle is where at which time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.synth.scene.scene import Lane, RoadScene, road_to_image
from labelgen.synth.vehicle.vehicle import VehicleModel, body_kinds, make_vehicle, vehicle_size

__all__ = ["Trip", "near_path_x", "random_traffic"]


@dataclass(frozen=True, eq=False)
class Trip:
    """One vehicle's drive through the scene.

    Args:
        track_id: its number.
        kind: body type.
        vehicle_seed: seed of its proportions and looks.
        lane: where it drives.
        size_lwh: (3,) metres, its bounding cuboid.
        knots_s: (K,) times, rising.
        knots_x: (K,) metres, X of its contact point at those times; linear between and beyond. The contact point is the
            middle of the bottom edge nearest to the camera.
        offset_y: metres beside the middle of the lane.
        car_id: its number in `gt_data.pkl`, None when it is not measured there.
    """

    track_id: int
    kind: str
    vehicle_seed: tuple[int, ...]
    lane: Lane
    size_lwh: NDArray[np.float64]
    knots_s: NDArray[np.float64]
    knots_x: NDArray[np.float64]
    offset_y: float
    car_id: int | None

    def near_x(self, time_s: float) -> float:
        """Return X of its contact point, metres."""
        t, x = self.knots_s, self.knots_x
        k = int(np.clip(np.searchsorted(t, time_s) - 1, 0, len(t) - 2))
        return float(x[k] + (x[k + 1] - x[k]) * (time_s - t[k]) / (t[k + 1] - t[k]))

    def speed_ms(self, time_s: float) -> float:
        """Return the speed at a time, m/s, always positive."""
        t = self.knots_s
        k = int(np.clip(np.searchsorted(t, time_s) - 1, 0, len(t) - 2))
        along = (self.knots_x[k + 1] - self.knots_x[k]) / (t[k + 1] - t[k])
        return abs(float(along)) * float(np.hypot(1, self.lane.slope))

    def near_point(self, time_s: float) -> NDArray[np.float64]:
        """Return its contact point (2,), metres on the road."""
        x = self.near_x(time_s)
        return np.array([x, float(self.lane.y(x)) + self.offset_y])

    def span_s(self, x_range: tuple[float, float]) -> tuple[float, float]:
        """Return the first and last time, seconds, at which any part of it lies in a range of X, metres."""
        low, high = x_range[0] - self.size_lwh[0], x_range[1]
        times = [self.time_at(x) for x in (low, high)]
        return min(times), max(times)

    def time_at(self, x: float) -> float:
        """Return the time, seconds, at which its contact point passes X, metres."""
        t, knots = self.knots_s, self.knots_x
        rising = knots[-1] > knots[0]
        after = np.searchsorted(knots if rising else -knots, x if rising else -x)
        k = int(np.clip(after - 1, 0, len(t) - 2))
        return float(t[k] + (x - knots[k]) * (t[k + 1] - t[k]) / (knots[k + 1] - knots[k]))

    def vehicle(self, *, lamps: bool, plates: str | None = None) -> VehicleModel:
        """The vehicle itself; always the same one. `plates`: see `make_vehicle`."""
        return make_vehicle(self.kind, np.random.default_rng(list(self.vehicle_seed)), lamps=lamps, plates=plates)


def near_path_x(scene: RoadScene, line: NDArray[np.float64], lane: Lane, offset_y: float) -> float:
    """Return X, metres, at which a vehicle crosses a homogeneous px line.

    The vehicle drives `offset_y` metres beside the middle of the lane.
    """
    a, b, c = road_to_image(scene.camera).T @ line
    y0 = lane.y0 + offset_y
    return float(-(b * y0 + c) / (a + b * lane.slope))


def random_traffic(
    scene: RoadScene, duration_s: float, seed: int, *, per_minute: float = 18.0, kinds: Sequence[str] | None = None
) -> list[Trip]:
    """Make up traffic on all lanes from time 0 on.

    Vehicles keep their speed, so that true speeds are exact. A vehicle that would catch up with the one before it
    starts later.

    Args:
        scene: lanes and the range that is shown.
        duration_s: length of the traffic.
        seed: everything that varies comes from it.
        per_minute: vehicles per lane and minute on average.
        kinds: body types to choose from; by their shares in traffic when None.
    """
    trips: list[Trip] = []
    low, high = scene.x_range
    for number, lane in enumerate(scene.lanes):
        rng = np.random.default_rng([seed, 11, number])
        start, end = (low, high) if lane.heading > 0 else (high, low)
        # Vehicles are already under way when the recording begins.
        clock = -(high - low) / (lane.speed_kmh / 3.6)
        before: tuple[float, float, float] | None = None
        while clock < duration_s:
            clock += rng.exponential(60.0 / per_minute * 0.8) + rng.uniform(0.6, 1.4)
            names, shares = body_kinds()
            kind = str(rng.choice(list(kinds))) if kinds else str(rng.choice(names, p=shares))
            slow = 0.85 if kind in ("lorry", "articulated", "bus") else 1.0
            speed = lane.speed_kmh / 3.6 * slow * float(np.clip(rng.normal(1, 0.09), 0.7, 1.35))
            vehicle_seed = (seed, number, len(trips))
            size = vehicle_size(kind, np.random.default_rng(list(vehicle_seed)))
            entry = clock
            if before is not None:
                gap = rng.uniform(0.7, 1.6)
                length = max(before[2], float(size[0]))
                entry = max(
                    entry, before[0] + gap + length / speed, before[1] + gap + length / speed - (high - low) / speed
                )
            leave = entry + (high - low) / speed
            before = (entry, leave, size[0])
            clock = max(clock, entry)
            car = len(trips) + 1
            # Motorcycles ride anywhere in their lane.
            aside = rng.normal(0, 0.22) if kind != "motorcycle" else float(np.clip(rng.normal(0, 0.6), -1.1, 1.1))
            trips.append(
                Trip(
                    car, kind, vehicle_seed, lane, size, np.array([entry, leave]), np.array([start, end]),
                    float(aside), car if lane.index is not None else None,
                )
            )  # fmt: skip
    return trips
