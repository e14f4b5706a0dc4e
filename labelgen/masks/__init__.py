"""Instance masks of vehicles: from Mask R-CNN, from a background model, or from a COCO file."""

from labelgen.masks.instances import InstanceMasks, crop_mask
from labelgen.masks.source import (
    MaskKind,
    MaskSource,
    create_mask_source,
    masked_frames,
    parse_masks,
    prime_masks,
)

__all__ = [
    "InstanceMasks",
    "MaskKind",
    "MaskSource",
    "create_mask_source",
    "crop_mask",
    "masked_frames",
    "parse_masks",
    "prime_masks",
]
