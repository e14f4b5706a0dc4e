"""Options of mask sources: what a file of masks, or a network, does not say itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from labelgen.errors import DataError
from labelgen.labels import VehicleClass

__all__ = ["MASK_OPTIONS", "MaskOptions"]


@dataclass(frozen=True)
class MaskOptions:
    """Options of a mask source; each source takes some of them.

    Args:
        first_frame: number that a COCO file gives to the first frame of the video; None takes 0, or 1 where the numbers
            show it.
        scale_masks: whether a COCO file's masks of frames of another size and the same ratio are scaled; otherwise they
            are skipped.
        classes: classes by the name or the id of a category, see `labelgen.masks.class_names.parse_classes`; they go
            before the own names of a COCO file or an ONNX network.
        tiles: parts of the frame that an ONNX network sees enlarged: "auto", or columns and rows as "3x2".
    """

    first_frame: int | None = None
    scale_masks: bool = False
    classes: Mapping[str, VehicleClass] | None = None
    tiles: str | None = None

    def describe(self) -> dict[str, Any]:
        """Return the options that differ from the defaults, as plain values; `from_dict` reads them."""
        values = {
            "first_frame": self.first_frame,
            "scale_masks": self.scale_masks or None,
            "classes": {name: int(value) for name, value in sorted((self.classes or {}).items())} or None,
            "tiles": self.tiles,
        }
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def from_dict(cls, values: Any) -> MaskOptions:
        """Return the options of `describe`; the defaults for None.

        Raises:
            DataError: other values.
        """
        try:
            values = dict(values or {})
            classes = {str(name): VehicleClass(value) for name, value in dict(values.get("classes") or {}).items()}
            first, tiles = values.get("first_frame"), values.get("tiles")
            return cls(
                None if first is None else int(first),
                bool(values.get("scale_masks")),
                classes or None,
                None if tiles is None else str(tiles),
            )
        except (TypeError, ValueError, OverflowError) as err:
            raise DataError(f"options of a mask source: not as they were written ({err})") from None


MASK_OPTIONS = MaskOptions()
