"""Instance masks of vehicles: from Mask R-CNN, from a background model, or from a COCO file."""

from labelgen.masks.clip import Clip
from labelgen.masks.coco_options import COCO_OPTIONS, CocoOptions
from labelgen.masks.instances import InstanceMasks, crop_mask
from labelgen.masks.source import (
    MaskKind,
    MaskSource,
    check_masks,
    check_masks_file,
    create_mask_source,
    masked_frames,
    parse_masks,
    prime_masks,
)

__all__ = [
    "COCO_OPTIONS",
    "Clip",
    "CocoOptions",
    "InstanceMasks",
    "MaskKind",
    "MaskSource",
    "check_masks",
    "check_masks_file",
    "create_mask_source",
    "crop_mask",
    "masked_frames",
    "parse_masks",
    "prime_masks",
]
