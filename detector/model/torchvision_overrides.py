"""Parts that replace torchvision's own in RetinaNet: a transform that never resizes, and float32 anchors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.transform import GeneralizedRCNNTransform

__all__ = ["CachedAnchorGenerator", "IdentityTransform"]

_IMAGE_MEAN, _IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's RGB in [0, 1], with which torchvision's networks were trained."""


class IdentityTransform(GeneralizedRCNNTransform):  # type: ignore[misc]
    """Normalise and pad images, never resize them: labels and detections are in the image's own px."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__(1, 1, list(_IMAGE_MEAN), list(_IMAGE_STD))
        # Buffers are moved to the device once; torchvision moves its own for every image.
        self.register_buffer("mean", torch.tensor(_IMAGE_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(_IMAGE_STD)[:, None, None], persistent=False)

    def resize(self, image: Tensor, target: Any = None) -> Any:
        """Return image and target unchanged."""
        return image, target

    def normalize(self, image: Tensor) -> Tensor:
        """Normalise an image (3, H, W) in [0, 1] to zero mean and unit variance of ImageNet."""
        return (image - self.mean) / self.std


class CachedAnchorGenerator(AnchorGenerator):  # type: ignore[misc]
    """Generate anchors in float32, once per image size.

    torchvision generates them for each batch, in the precision of the features.

    Args:
        sizes: per pyramid level, sides px of square anchors.
        ratios: per pyramid level, heights over widths.
    """

    def __init__(self, sizes: tuple[tuple[float, ...], ...], ratios: tuple[tuple[float, ...], ...]) -> None:
        super().__init__(sizes, ratios)
        self._cached: tuple[Any, Tensor] | None = None

    def forward(self, image_list: Any, feature_maps: list[Tensor]) -> list[Tensor]:
        """Return the anchors (A, 4) px of each image.

        Args:
            image_list: torchvision's ImageList, padded to one size.
            feature_maps: per level (N, C, h, w); only their size and device are used.
        """
        grids = [f.shape[-2:] for f in feature_maps]
        device = feature_maps[0].device
        key = (image_list.tensors.shape[-2:], grids, device)
        # Tensors made in inference mode cannot be used in training.
        if self._cached is None or self._cached[0] != key or self.training or torch.is_grad_enabled():
            shapes = [torch.empty(grid, device=device) for grid in grids]
            self._cached = key, super().forward(image_list, shapes)[0]
        return [self._cached[1]] * len(image_list.image_sizes)
