"""Cameras, rectification, the box codec, and labels from outlines: functions of NumPy arrays.

Convention:
    float64 px, x right, y down; pixels are areas: pixel (column j, row i) covers [j, j + 1) x [i, i + 1).
    Sizes are (width, height), boxes (x0, y0, x1, y1), images (height, width) or (height, width, channels).
    VP1: direction of travel; VP2: across the road; VP3: vertical; VPU: the one that a rectification leaves finite.
"""

from labelgen.choices import Pair, Region, Rule, parse_size
from labelgen.geometry.box_codec import (
    EncodedBoxes,
    decode_boxes,
    encode_boxes,
    front_bottom_midpoints,
    reorder_vertices,
)
from labelgen.geometry.camera import Camera
from labelgen.geometry.cuboid import cuboid_sizes, road_cuboids
from labelgen.geometry.outline_label import (
    MaskLabels,
    RectifiedOutline,
    label_outlines,
    mask_outline,
    mask_polygon,
    rectified_outline,
)
from labelgen.geometry.rectification import Rectification
from labelgen.geometry.rectifying_homography import rectify_windows
from labelgen.geometry.road_mask import RoadMask
from labelgen.geometry.tangent_box import tangent_boxes, window_around

__all__ = [
    "Camera",
    "EncodedBoxes",
    "MaskLabels",
    "Pair",
    "Rectification",
    "RectifiedOutline",
    "Region",
    "RoadMask",
    "Rule",
    "cuboid_sizes",
    "decode_boxes",
    "encode_boxes",
    "front_bottom_midpoints",
    "label_outlines",
    "mask_outline",
    "mask_polygon",
    "parse_size",
    "rectified_outline",
    "rectify_windows",
    "reorder_vertices",
    "road_cuboids",
    "tangent_boxes",
    "window_around",
]
