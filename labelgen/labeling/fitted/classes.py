"""Which classes a vehicle may be of, by those that its masks say."""

from __future__ import annotations

from collections.abc import Iterable

from labelgen.labels import VehicleClass

__all__ = ["possible_classes"]

_SEEN_AS = {
    VehicleClass.CAR: {VehicleClass.CAR},
    # Networks call vans and pickups trucks, and coaches as well.
    VehicleClass.TRUCK: {VehicleClass.TRUCK, VehicleClass.CAR, VehicleClass.BUS},
    VehicleClass.BUS: {VehicleClass.BUS, VehicleClass.TRUCK, VehicleClass.CAR},
    VehicleClass.MOTORCYCLE: {VehicleClass.MOTORCYCLE},
}


def possible_classes(class_ids: Iterable[int]) -> frozenset[int]:
    """Return the numbers of the classes that a vehicle may be of; empty for any.

    Args:
        class_ids: `VehicleClass` numbers of its masks.
    """
    found: set[int] = set()
    for name in set(class_ids) - {int(VehicleClass.VEHICLE)}:
        found |= {int(c) for c in _SEEN_AS[VehicleClass(name)]}
    return frozenset(found)
