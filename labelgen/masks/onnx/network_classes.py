"""Which of a network's class numbers are vehicles."""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.labels import VehicleClass
from labelgen.masks.class_names import CLASS_BY_COCO_ID, COCO_NAMES_FROM_0, normal_name, vehicle_class

__all__ = ["NOT_A_VEHICLE", "class_table", "names_of"]

NOT_A_VEHICLE = 255
_COCO_CLASSES, _COCO_IDS = 80, 91
_MAX_NAMED = 10


def names_of(metadata: Mapping[str, str]) -> dict[int, str] | None:
    """Return the names of the classes that a network states, by number; None where it states none that can be read.

    Ultralytics writes a Python literal, others JSON; both as a list or with numbers as keys.
    """
    text = metadata.get("names") or metadata.get("classes") or ""
    for read in (ast.literal_eval, json.loads):
        try:
            found = read(text)
            items = found.items() if isinstance(found, dict) else enumerate(found)
            names = {int(number): str(name) for number, name in items if not isinstance(found, str)}
        except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError, OverflowError):
            continue
        if names:
            return names
    return None


def class_table(
    path: Path, count: int, names: Mapping[int, str] | None, given: Mapping[str, VehicleClass] | None
) -> NDArray[np.uint8]:
    """Return the class of each class number.

    Args:
        path: of the network, for messages.
        count: number of classes.
        names: as the network states them.
        given: classes by name or number, before the network's own names.

    Returns:
        (count,) uint8, `VehicleClass` or `NOT_A_VEHICLE`.

    Raises:
        DataError: a given name that the network does not have, or no vehicle among its classes.
    """
    table = np.full(count, NOT_A_VEHICLE, dtype=np.uint8)
    known = {number: name for number, name in (names or {}).items() if 0 <= number < count}
    if not known and count == _COCO_CLASSES:
        known = dict(COCO_NAMES_FROM_0)
    for number, name in known.items():
        member = vehicle_class(name)
        table[number] = NOT_A_VEHICLE if member is None else member
    if not known and count in (_COCO_IDS, _COCO_IDS - 1):
        table[list(CLASS_BY_COCO_ID)] = list(CLASS_BY_COCO_ID.values())
    numbers_of: dict[str, list[int]] = {}
    for number, name in known.items():
        numbers_of.setdefault(normal_name(name), []).append(number)
    for key, member in (given or {}).items():
        numbers = numbers_of.get(key, [int(key)] if key.isdecimal() and len(key) < 9 and int(key) < count else [])
        if not numbers:
            raise DataError(f"{path}: it has no class {key} ({_describe(count, known)})", parameter="classes")
        table[numbers] = member
    if (table == NOT_A_VEHICLE).all():
        raise DataError(
            f"{path}: none of its classes is known as a vehicle ({_describe(count, known)}); say which are, as "
            f"{next(iter(known.values()), '0').split(',')[0]}=car",
            parameter="classes",
        )
    return table


def _describe(count: int, names: Mapping[int, str]) -> str:
    if not names:
        return f"{count} classes without names, numbered from 0"
    shown = ", ".join(list(names.values())[:_MAX_NAMED])
    return f"found {shown}{' and so on' if len(names) > _MAX_NAMED else ''}"
