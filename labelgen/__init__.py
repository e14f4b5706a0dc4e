"""Training labels for monocular 3D vehicle detection and speed measurement from traffic cameras.

What a notebook needs, by what it is for:

- shards: `ShardDataset` (iterate samples; a PyTorch data set), `ShardReader`, `ShardWriter`, `Sample`
- labels: `Labels`, `VehicleClass`, `Flag`, `Split`, `IgnoredBoxes`, `IgnoreReason`
- geometry: `Camera`, `Rectification`, `RoadMask`, `Pair`, `Region`, `encode_boxes`, `decode_boxes`, `road_cuboids`
- labels from masks: `InstanceMasks`, `label_masks`, `Rule`, `create_mask_source`
- inputs: `find_scene`, `open_frames`
- errors: `LabelgenError`

Names are imported from their rooms when they are first used, so that `import labelgen` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from labelgen.version import __version__

if TYPE_CHECKING:
    from labelgen.choices import Pair, Region, Rule
    from labelgen.datasets.scene import find_scene
    from labelgen.errors import LabelgenError
    from labelgen.geometry import Camera, Rectification, RoadMask, decode_boxes, encode_boxes, road_cuboids
    from labelgen.labeling.from_masks import label_masks
    from labelgen.labels import Flag, IgnoredBoxes, IgnoreReason, Labels, Sample, Split, VehicleClass
    from labelgen.masks import InstanceMasks, create_mask_source
    from labelgen.media.open_frames import open_frames
    from labelgen.shards import ShardDataset, ShardReader, ShardWriter

__all__ = [
    "Camera",
    "Flag",
    "IgnoreReason",
    "IgnoredBoxes",
    "InstanceMasks",
    "LabelgenError",
    "Labels",
    "Pair",
    "Rectification",
    "Region",
    "RoadMask",
    "Rule",
    "Sample",
    "ShardDataset",
    "ShardReader",
    "ShardWriter",
    "Split",
    "VehicleClass",
    "__version__",
    "create_mask_source",
    "decode_boxes",
    "encode_boxes",
    "find_scene",
    "label_masks",
    "open_frames",
    "road_cuboids",
]

_ROOMS = {
    "labelgen.choices": ("Pair", "Region", "Rule"),
    "labelgen.datasets.scene": ("find_scene",),
    "labelgen.errors": ("LabelgenError",),
    "labelgen.geometry": ("Camera", "Rectification", "RoadMask", "decode_boxes", "encode_boxes", "road_cuboids"),
    "labelgen.labeling.from_masks": ("label_masks",),
    "labelgen.labels": ("Flag", "IgnoreReason", "IgnoredBoxes", "Labels", "Sample", "Split", "VehicleClass"),
    "labelgen.masks": ("InstanceMasks", "create_mask_source"),
    "labelgen.media.open_frames": ("open_frames",),
    "labelgen.shards": ("ShardDataset", "ShardReader", "ShardWriter"),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module 'labelgen' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_ROOM_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
