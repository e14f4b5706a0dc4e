"""Where instance masks come from: Mask R-CNN, a background model, or ready-made COCO masks."""

from labelgen.masks.instances import InstanceMasks, crop_mask
from labelgen.masks.source import MASK_SOURCES, MaskSource, create_mask_source, masked_frames, prime_masks

__all__ = [
    "MASK_SOURCES",
    "InstanceMasks",
    "MaskSource",
    "create_mask_source",
    "crop_mask",
    "masked_frames",
    "prime_masks",
]
