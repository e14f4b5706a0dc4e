"""How a COCO file is to be read, where the file itself does not say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from labelgen.errors import DataError, LabelgenError
from labelgen.labels import VehicleClass

__all__ = ["CLASS_BY_NAME", "COCO_OPTIONS", "CocoOptions", "parse_classes"]

CLASS_BY_NAME = {
    "car": VehicleClass.CAR,
    "van": VehicleClass.CAR,
    "motorcycle": VehicleClass.MOTORCYCLE,
    "motorbike": VehicleClass.MOTORCYCLE,
    "bus": VehicleClass.BUS,
    "truck": VehicleClass.TRUCK,
    "lorry": VehicleClass.TRUCK,
    "vehicle": VehicleClass.VEHICLE,
}
"""Names of categories that are vehicles, in lower case."""


@dataclass(frozen=True)
class CocoOptions:
    """How a COCO file is to be read.

    Args:
        first_frame: number that the file gives to the first frame of the video; None takes 0, or 1 where the numbers
            show it.
        scale_masks: whether masks of frames of another size and the same ratio are scaled; otherwise they are skipped.
        classes: classes by the name or the id of a category, in lower case, see `parse_classes`; they go before the
            file's own names.
    """

    first_frame: int | None = None
    scale_masks: bool = False
    classes: Mapping[str, VehicleClass] | None = None

    def describe(self) -> dict[str, Any]:
        """Return the options that differ from the defaults, as plain values; `from_dict` reads them."""
        values = {
            "first_frame": self.first_frame,
            "scale_masks": self.scale_masks or None,
            "classes": {name: int(value) for name, value in sorted((self.classes or {}).items())} or None,
        }
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def from_dict(cls, values: Any) -> CocoOptions:
        """Return the options of `describe`; the defaults for None.

        Raises:
            DataError: other values.
        """
        try:
            values = dict(values or {})
            classes = {str(name): VehicleClass(value) for name, value in dict(values.get("classes") or {}).items()}
            first = values.get("first_frame")
            return cls(None if first is None else int(first), bool(values.get("scale_masks")), classes or None)
        except (TypeError, ValueError, OverflowError) as err:
            raise DataError(f"options of a COCO file: not as they were written ({err})") from None


COCO_OPTIONS = CocoOptions()


def parse_classes(text: str) -> dict[str, VehicleClass]:
    """Parse the classes of categories.

    Args:
        text: names or ids of categories with their classes, such as "2=car,7=truck,pickup=car".

    Raises:
        LabelgenError: not of this form, or an unknown class.
    """
    classes = {}
    for part in text.split(","):
        category, separator, name = (piece.strip().lower() for piece in part.rpartition("="))
        if not category or not separator or name not in CLASS_BY_NAME:
            raise LabelgenError(
                f"classes {text}: expected names or ids of categories with one of {', '.join(CLASS_BY_NAME)}, "
                "as 2=car,7=truck,pickup=car",
                parameter="classes",
            )
        classes[category] = CLASS_BY_NAME[name]
    return classes
