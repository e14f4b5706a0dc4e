"""What goes into torchvision's RetinaNet beside its weights: normalised images of their own size, and exact anchors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.transform import GeneralizedRCNNTransform

__all__ = ["IMAGE_MEAN", "IMAGE_STD", "CachedAnchorGenerator", "IdentityTransform"]

IMAGE_MEAN, IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class IdentityTransform(GeneralizedRCNNTransform):  # type: ignore[misc]
    """Normalises and pads, never resizes: labels and detections are in the image's own px."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__(1, 1, list(IMAGE_MEAN), list(IMAGE_STD))
        # On the device once: torchvision sends them there for every image.
        self.register_buffer("mean", torch.tensor(IMAGE_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGE_STD)[:, None, None], persistent=False)

    def resize(self, image: Tensor, target: Any = None) -> Any:
        """Image and target unchanged."""
        return image, target

    def normalize(self, image: Tensor) -> Tensor:
        """(3, H, W) in [0, 1] -> as the trunk was trained on."""
        return (image - self.mean) / self.std


class CachedAnchorGenerator(AnchorGenerator):  # type: ignore[misc]
    """torchvision's, in float32 (it makes them in the precision of the features), and made once per size in use."""

    def __init__(self, sizes: tuple[tuple[float, ...], ...], ratios: tuple[tuple[float, ...], ...]) -> None:
        super().__init__(sizes, ratios)
        self._made: tuple[Any, Tensor] | None = None

    def forward(self, image_list: Any, feature_maps: list[Tensor]) -> list[Tensor]:
        """Anchors (A, 4) of each image; of the features only size and device count."""
        grids = [f.shape[-2:] for f in feature_maps]
        device = feature_maps[0].device
        key = (image_list.tensors.shape[-2:], grids, device)
        # Tensors of inference mode are not for training.
        if self._made is None or self._made[0] != key or self.training or torch.is_grad_enabled():
            shapes = [torch.empty(grid, device=device) for grid in grids]
            self._made = key, super().forward(image_list, shapes)[0]
        return [self._made[1]] * len(image_list.image_sizes)
