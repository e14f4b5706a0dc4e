"""Which names of classes are vehicles: those of COCO, Open Images, VisDrone and other data sets, and `classes`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from labelgen.errors import DataError, LabelgenError
from labelgen.labels import VehicleClass

__all__ = ["CLASS_BY_COCO_ID", "CLASS_WORDS", "COCO_NAMES_FROM_0", "normal_name", "parse_classes", "vehicle_class"]

CLASS_BY_COCO_ID = {
    3: VehicleClass.CAR,
    4: VehicleClass.MOTORCYCLE,
    6: VehicleClass.BUS,
    8: VehicleClass.TRUCK,
}
"""COCO's own ids of categories, 1 to 90."""

COCO_NAMES_FROM_0 = {2: "car", 3: "motorcycle", 5: "bus", 7: "truck"}
"""The vehicles among COCO's 80 classes counted from 0, as most networks number them."""

CLASS_WORDS = ("car", "motorcycle", "bus", "truck", "vehicle")
"""One word for each class, for messages."""

_NAMES = {
    VehicleClass.CAR: (
        "car, van, minivan, passenger car, automobile, suv, jeep, sedan, saloon, hatchback, coupe, convertible, "
        "estate, station wagon, wagon, taxi, cab, limousine, pickup, pick up, pickup truck, police car, ambulance, mpv"
    ),
    VehicleClass.MOTORCYCLE: (
        "motorcycle, motorbike, motor bike, motor, scooter, motor scooter, moped, tricycle, awning tricycle"
    ),
    VehicleClass.BUS: "bus, minibus, mini bus, coach, school bus, city bus, articulated bus, double decker, trolleybus",
    VehicleClass.TRUCK: (
        "truck, lorry, hgv, heavy truck, light truck, semi, semi truck, trailer truck, tractor trailer, box truck, "
        "dump truck, tow truck, fire truck, fire engine, garbage truck, cargo truck, tank truck, tanker, snowplow"
    ),
    VehicleClass.VEHICLE: "vehicle, land vehicle, motor vehicle, other vehicle, small vehicle, large vehicle",
}
_CLASS_BY_NAME = {name.strip(): member for member, names in _NAMES.items() for name in names.split(",")}
_EXPECTED = (
    f"names or ids of categories with one of {', '.join(CLASS_WORDS)}, as 2=car,7=truck,pickup=car, or a text file of "
    "them"
)
_MAX_FILE_BYTES = 1 << 20


def normal_name(name: str) -> str:
    """Return a name of a class in lower case, with single blanks instead of hyphens and underscores."""
    return " ".join(re.sub(r"(?<=\w)[_-]+(?=\w)", " ", name).lower().split())


def vehicle_class(name: str) -> VehicleClass | None:
    """Return the class of a known name of vehicles, in any case, such as "Land vehicle"; None for other names."""
    return _CLASS_BY_NAME.get(normal_name(name))


def parse_classes(text: str) -> dict[str, VehicleClass]:
    """Parse the classes of categories.

    Args:
        text: names or ids of categories with their classes, such as "2=car,7=truck,pickup=car"; or a text file. A file
            has one such pair a line, or the plain names of all classes, one a line, of which the first has number 0.

    Returns:
        Classes by name, see `normal_name`, or by id.

    Raises:
        LabelgenError: not of this form, or an unknown class.
        DataError: the file cannot be read, or names no vehicle.
    """
    if "=" in text:
        return _parse_pairs(text.split(","), text)
    lines = _read_lines(text)
    if any("=" in line for line in lines):
        return _parse_pairs([line for line in lines if line], text)
    by_number = {str(i): member for i, line in enumerate(lines) if (member := vehicle_class(line)) is not None}
    if not by_number:
        raise DataError(f"classes {text}: none of its lines is a vehicle; expected {_EXPECTED}", parameter="classes")
    return by_number


def _parse_pairs(parts: Sequence[str], text: str) -> dict[str, VehicleClass]:
    classes = {}
    for part in parts:
        category, separator, name = part.rpartition("=")
        member = vehicle_class(name)
        if not category.strip() or not separator or member is None:
            raise LabelgenError(f"classes {text}: expected {_EXPECTED}", parameter="classes")
        classes[normal_name(category)] = member
    return classes


def _read_lines(text: str) -> list[str]:
    """Return the lines of a text file without comments; blank ones count, as line numbers may be class numbers."""
    path = Path(text)
    try:
        if not path.is_file():
            raise LabelgenError(f"classes {text}: no such file; expected {_EXPECTED}", parameter="classes")
        with path.open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
        if len(content) > _MAX_FILE_BYTES:
            raise DataError(f"classes {text}: more than 1 MiB; expected {_EXPECTED}", parameter="classes")
        lines = content.decode("utf-8-sig").splitlines()
    except (OSError, ValueError) as err:
        reason = err.strerror if isinstance(err, OSError) else "not a text file"
        raise DataError(
            f"classes {text}: cannot be read ({reason}); expected {_EXPECTED}", parameter="classes"
        ) from None
    return [line.strip() for line in lines if not line.lstrip().startswith("#")]
