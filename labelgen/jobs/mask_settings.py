"""What a mask job is told about masks, and how they become labels."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from labelgen.before_torch import check_device, check_torch_file
from labelgen.choices import Region, Rule
from labelgen.datasets.scene import SceneFiles
from labelgen.errors import CalibrationError
from labelgen.geometry.camera import Camera
from labelgen.labeling.screening import LABEL_LIMITS, LabelLimits
from labelgen.masks import MASK_OPTIONS, MaskKind, MaskOptions, check_masks_file, parse_masks
from labelgen.shards.index import file_hash

__all__ = ["MaskSettings", "with_rule"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MaskSettings:
    """The mask source of a job, and how masks become labels.

    Args:
        masks: name of a mask source, see `labelgen.masks.parse_masks`.
        weights: state dict for Mask R-CNN; None for the COCO weights.
        score: least score of a mask, in [0, 1].
        rule: how masks become labels; None for `Rule.FITTED`, and `Rule.WIDER` where a camera has no scale.
        limits: thresholds for labels.
        device: torch device; None for the GPU where there is one.
        options: of the mask source, where it takes any.
    """

    masks: str = "maskrcnn"
    weights: Path | None = None
    score: float = 0.5
    rule: Rule | None = None
    limits: LabelLimits = LABEL_LIMITS
    device: str | None = None
    options: MaskOptions = MASK_OPTIONS

    def __post_init__(self) -> None:
        check_masks_file(self.masks)
        check_device(self.device)
        if self.weights is not None:
            check_torch_file(self.weights, f"weights {self.weights}", parameter="weights")

    @property
    def is_made_before(self) -> bool:
        """Whether the masks, or the detections that gate them, come from a file."""
        return parse_masks(self.masks).kind is MaskKind.COCO

    def describe(self) -> dict[str, Any]:
        """Return the settings as entries of the shards' settings."""
        name = parse_masks(self.masks)
        return {
            "masks": name.label,
            "masks_sha256": _digest(name.file) if name.file else None,
            "weights_sha256": _digest(self.weights) if self.weights else None,
            "score": self.score,
            "rule": str(self.rule),
            "min_height_px": self.limits.min_height_px,
            **({str(name.kind): described} if (described := self.options.describe()) else {}),
        }


def _digest(path: Path) -> str | None:
    if not path.is_file():
        return None  # the mask source raises the error
    return file_hash(path)


def with_rule(settings: MaskSettings, scenes: Sequence[SceneFiles], region: Region) -> MaskSettings:
    """Return the settings with a rule that goes with all cameras.

    Raises:
        CalibrationError: the fitted rule is wanted, and a camera has no scale.
    """
    if settings.rule not in (None, Rule.FITTED) or region is Region.NONE:
        return settings if settings.rule else replace(settings, rule=Rule.WIDER)
    lacking = [files.name for files in scenes if Camera.load(files.calibration_path).scale is None]
    if not lacking:
        return replace(settings, rule=Rule.FITTED)
    if settings.rule is Rule.FITTED:
        raise CalibrationError(
            f"{lacking[0]}: its calibration has no scale, which the rule fitted needs; choose another rule, or add "
            "'scale' to the calibration",
            parameter="rule",
        )
    _log.info("%s: its calibration has no scale: labels by the rule wider, without bodies", lacking[0])
    return replace(settings, rule=Rule.WIDER)
