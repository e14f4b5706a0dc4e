"""Instance masks of vehicles: from a network, from a background model, or from a COCO file."""

from labelgen.masks.clip import Clip
from labelgen.masks.create import create_mask_source
from labelgen.masks.instances import InstanceMasks, crop_mask
from labelgen.masks.labelled_frames import labelled_frames
from labelgen.masks.mask_options import MASK_OPTIONS, MaskOptions
from labelgen.masks.source import (
    MaskKind,
    MaskName,
    MaskSource,
    check_masks,
    check_masks_file,
    masked_frames,
    parse_masks,
    prime_masks,
)

__all__ = [
    "MASK_OPTIONS",
    "Clip",
    "InstanceMasks",
    "MaskKind",
    "MaskName",
    "MaskOptions",
    "MaskSource",
    "check_masks",
    "check_masks_file",
    "create_mask_source",
    "crop_mask",
    "labelled_frames",
    "masked_frames",
    "parse_masks",
    "prime_masks",
]
