"""Vehicles at their places on the road, and the order in which they hide each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.synth.vehicle.vehicle import VehicleModel

__all__ = ["PlacedVehicle", "painting_order"]


@dataclass(frozen=True, eq=False)
class PlacedVehicle:
    """A vehicle at its place on the road.

    Args:
        track_id: number of the vehicle; its shadow is kept under this number.
        vehicle: its model.
        centre_xy: (2,) metres, middle of its cuboid's floor in the road frame.
        heading: +1 away from the camera, -1 towards it.
        speed_ms: speed for its motion blur, m/s.
    """

    track_id: int
    vehicle: VehicleModel
    centre_xy: NDArray[np.float64]
    heading: int
    speed_ms: float

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Ground that it covers: x0, x1, y0, y1, metres on the road."""
        half = self.vehicle.size_lwh / 2
        x, y = self.centre_xy
        return x - half[0], x + half[0], y - half[1], y + half[1]

    def world(self) -> NDArray[np.float64]:
        """Return the vertices of its mesh (V, 3) in the road frame, metres."""
        turned = self.vehicle.mesh.vertices * np.array([self.heading, self.heading, 1.0])
        turned[:, :2] += self.centre_xy
        return np.asarray(turned)


def painting_order(vehicles: Sequence[PlacedVehicle]) -> list[int]:
    """Return the vehicles' indices from back to front, for a camera above X = 0, Y = 0."""

    def behind(a: PlacedVehicle, b: PlacedVehicle) -> bool:
        """Whether `a` may be hidden by `b`."""
        ax0, ax1, ay0, ay1 = a.bounds
        bx0, bx1, by0, by1 = b.bounds
        # A plane between the two decides: the one on the camera's side of it may hide the other.
        if ay0 >= by1:
            return by1 > 0
        if by0 >= ay1:
            return by0 < 0
        if ax0 >= bx1:
            return bx1 > 0
        return bx0 >= ax1 and bx0 < 0

    left = sorted(range(len(vehicles)), key=lambda i: -float(np.hypot(*vehicles[i].centre_xy)))
    order: list[int] = []
    while left:
        # The first one that hides none of the others still to be drawn; cycles fall back to the farthest.
        free = (
            i
            for i in left
            if not any(
                behind(vehicles[j], vehicles[i]) for j in left if j != i and not behind(vehicles[i], vehicles[j])
            )
        )
        farthest = next(free, left[0])
        left.remove(farthest)
        order.append(farthest)
    return order
