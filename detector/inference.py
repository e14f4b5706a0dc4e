"""A trained detector at work: frames in, detections out.

The network runs channels-last, its batch normalisation folded into its convolutions, in half precision where the
device gains from it, and compiled where asked for. On a GPU frames are rectified on the device, too; on a CPU OpenCV
does it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812
from torch.nn.utils.fusion import fuse_conv_bn_eval
from torchvision.models._utils import IntermediateLayerGetter
from torchvision.models.resnet import BasicBlock, Bottleneck

from detector.checkpoint import Card, load_detector
from detector.device import choose_device, gains_from_half
from detector.metrics import Found
from detector.model.retinanet import CcRetinaNet
from detector.model.vehicle_size import merge_sizes, scene_vector
from labelgen.geometry import Camera, Rectification
from labelgen.labels import Labels, Sample

__all__ = ["Detector", "DeviceRectifier", "Picture", "fold_batch_norm", "to_found"]

_GPU_BATCH = 8
_RUN_IN_ORDER = (nn.Sequential, IntermediateLayerGetter, BasicBlock, Bottleneck)


def fold_batch_norm(model: nn.Module) -> None:
    """Fold batch normalisations that follow a convolution into it, in place; for inference only.

    Only where the order of a module's parts is known to be the order in which they run.
    """
    for parent in model.modules():
        children = list(parent.named_children())
        if not isinstance(parent, _RUN_IN_ORDER):
            continue
        for (name, conv), (after, norm) in pairwise(children):
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                setattr(parent, name, fuse_conv_bn_eval(conv.eval(), norm.eval()))
                setattr(parent, after, nn.Identity())


class DeviceRectifier:
    """Rectifies frames on a torch device.

    Args:
        rectification: with the size of its frame.
        device: where.
    """

    def __init__(self, rectification: Rectification, device: torch.device) -> None:
        assert rectification.frame_wh is not None
        (w, h), frame = rectification.size_wh, np.asarray(rectification.frame_wh, dtype=np.float64)
        xs, ys = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        points = rectification.points_back(np.stack([xs, ys], axis=-1))
        # grid_sample counts from -1 to 1 between the picture's borders; what lies nowhere goes far outside.
        grid = np.nan_to_num(2 * points / frame - 1, nan=9.0, posinf=9.0, neginf=-9.0).clip(-9, 9)
        self._grid = torch.from_numpy(grid.astype(np.float32))[None].to(device)
        self._device = device

    def __call__(self, image: NDArray[np.uint8]) -> Tensor:
        """(H, W, 3) uint8 BGR frame -> (3, h, w) float RGB in [0, 1]."""
        frame = torch.from_numpy(image).to(self._device, non_blocking=True)
        frame = frame.flip(-1).permute(2, 0, 1)[None].float() / 255
        return F.grid_sample(frame, self._grid, mode="bilinear", padding_mode="zeros", align_corners=False)[0]


def to_tensor(image: NDArray[np.uint8], device: torch.device) -> Tensor:
    """(H, W, 3) uint8 BGR -> (3, H, W) float RGB in [0, 1]."""
    rgb = np.ascontiguousarray(image[:, :, ::-1].transpose(2, 0, 1))
    return torch.from_numpy(rgb).to(device).float() / 255


class _ToHalf(nn.Module):
    """Images in 16 bits."""

    def forward(self, images: Tensor) -> Tensor:
        return images.half()


class Picture(NamedTuple):
    """A network's input.

    Args:
        image: (3, H, W) float RGB in [0, 1] on the device, rectified.
        scene: (4,) of `detector.model.vehicle_size.scene_vector`.
    """

    image: Tensor
    scene: Tensor


def _scene(rectification: Rectification, camera: Camera) -> Tensor:
    return torch.from_numpy(scene_vector(rectification.matrix, rectification.vpu, rectification.pair, camera))


def to_found(detections: dict[str, Tensor], scene: Tensor, card: Card) -> Found:
    """A model's output for one picture as arrays.

    Args:
        detections: of the model.
        scene: (4,) of `detector.model.vehicle_size.scene_vector`.
        card: of the model.
    """
    parts = [detections["boxes"], detections["scores"][:, None], detections["cc"][:, None]]
    parts += [detections["sizes"]] if "sizes" in detections else []
    # In one piece: a GPU is waited for each time something is fetched from it.
    table = torch.cat(parts, dim=1).detach().cpu().double()
    boxes, scores, cc, sizes = table[:, :4], table[:, 4], table[:, 5], table[:, 6:]
    if "sizes" in detections:
        place, weight = scene.double().cpu(), card.config.size_weight
        cc, boxes = merge_sizes(cc, boxes, sizes, place, weight=weight, height_px=card.size_wh[1])
    return Found(boxes.numpy(), cc.numpy(), scores.numpy())


class Detector:
    """A model set up for inference.

    Args:
        model: trained; folded and moved in place.
        card: of its checkpoint.
        device: where to run; None for the GPU when there is one.
        half: half precision (float16 on GPUs, bfloat16 by autocast on CPUs); None for where it gains.
        compiled: compile the network; worth it for long videos on a GPU.
        fold: fold batch normalisation into convolutions.
    """

    def __init__(
        self, model: CcRetinaNet, card: Card, *, device: str | None = None, half: bool | None = None,
        compiled: bool = False, fold: bool = True,
    ) -> None:  # fmt: skip
        self.card, self.device = card, choose_device(device)
        self.half = gains_from_half(self.device) if half is None else half
        model.eval()
        if fold:
            fold_batch_norm(model)
        self.model = model.to(self.device, memory_format=torch.channels_last)
        self._whole_batches = compiled
        if self.half and self.device.type == "cuda":
            # Once: autocast would convert every weight anew for each batch, which takes a small network's time.
            self.model.backbone = nn.Sequential(_ToHalf(), model.backbone.half())
            self.model.head = model.head.half()
        if compiled:
            self.model.backbone = torch.compile(self.model.backbone, dynamic=False)
            self.model.head = torch.compile(self.model.head, dynamic=False)

    @classmethod
    def load(cls, path: Path, *, score: float = 0.05, **options: Any) -> Detector:
        """From a checkpoint.

        Args:
            path: the file.
            score: least score of a detection.
            options: as of the class.

        Raises:
            DataError: not a checkpoint of a detector.
        """
        model, card = load_detector(path, score_thresh=score)
        return cls(model, card, **options)

    @property
    def batch_size(self) -> int:
        """How many pictures to give at once: more than one gains on a GPU alone."""
        return 1 if self.device.type == "cpu" else _GPU_BATCH

    def rectifier(self, rectification: Rectification, camera: Camera) -> Callable[[NDArray[np.uint8]], Picture]:
        """Rectifies frames, on the device where that is a GPU: `detector.speed.model_detections.Detector`."""
        scene = _scene(rectification, camera)
        if self.device.type != "cpu":
            warp = DeviceRectifier(rectification, self.device)
            return lambda frame: Picture(warp(frame), scene)
        return lambda frame: Picture(to_tensor(rectification.warp_image(frame), self.device), scene)

    def detect(self, pictures: Sequence[Picture]) -> list[Labels]:
        """The vehicles in rectified pictures: `detector.speed.model_detections.Detector`."""
        found = []
        for output in self(pictures):
            # Boxes cut at the border may have no area left.
            solid = output[(output.boxes_xyxy[:, :2] < output.boxes_xyxy[:, 2:]).all(axis=1)]
            found.append(Labels(solid.boxes_xyxy, solid.cc, scores=solid.scores.astype(np.float32)))
        return found

    def picture(self, sample: Sample) -> Picture:
        """The rectified picture of a shard's sample."""
        return Picture(to_tensor(sample.image, self.device), _scene(sample.rectification, sample.camera))

    def __call__(self, pictures: Sequence[Picture]) -> list[Found]:
        """Detections in rectified pictures, as `picture` and `rectifier` make them."""
        images = [picture.image for picture in pictures]
        if self._whole_batches and images:
            # A last batch that is smaller would be compiled for, which takes longer than some videos.
            images += images[-1:] * (-len(images) % self.batch_size)
        autocast = self.half and self.device.type == "cpu"
        with torch.inference_mode(), torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=autocast):
            outputs = self.model(images)
        return [to_found(out, picture.scene, self.card) for out, picture in zip(outputs, pictures, strict=False)]
