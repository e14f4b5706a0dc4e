"""A trained detector at work: rectified pictures in, labels with c_c and scores out.

The network runs channels-last, with its batch normalisation folded into its convolutions, in half precision where the
device gains from it, and compiled on request. On a GPU, frames are rectified on the device; on a CPU, by OpenCV.
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

from detector.checkpoint import ModelMetadata, load_model
from detector.device import choose_device, gains_from_half
from detector.model.retinanet import CcRetinaNet
from detector.model.vehicle_size import merge_sizes, scene_vector
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, Rectification
from labelgen.labels import Labels, Sample

__all__ = ["Detector", "DeviceRectifier", "ModelInput", "fold_batch_norm", "labels_from_output", "load_detector"]

_GPU_BATCH = 8
"""Pictures per batch on a GPU: more gain little and delay the first result."""
_SEQUENTIAL_MODULES = (nn.Sequential, IntermediateLayerGetter, BasicBlock, Bottleneck)
"""Modules whose parts run in the order in which they are registered."""


def fold_batch_norm(model: nn.Module) -> None:
    """Fold each batch normalisation that follows a convolution into it, in place; for inference only.

    Modules that may run their parts in another order than they list them are left as they are.

    Args:
        model: is changed, and set to evaluation where it is folded.
    """
    for parent in model.modules():
        children = list(parent.named_children())
        if not isinstance(parent, _SEQUENTIAL_MODULES):
            continue
        for (conv_name, conv), (norm_name, norm) in pairwise(children):
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                setattr(parent, conv_name, fuse_conv_bn_eval(conv.eval(), norm.eval()))
                setattr(parent, norm_name, nn.Identity())


class DeviceRectifier:
    """Rectify frames on a torch device.

    Args:
        rectification: with the size of its frame.
        device: where to rectify.
    """

    def __init__(self, rectification: Rectification, device: torch.device) -> None:
        assert rectification.frame_wh is not None
        (w, h), frame = rectification.size_wh, np.asarray(rectification.frame_wh, dtype=np.float64)
        xs, ys = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        points = rectification.points_back(np.stack([xs, ys], axis=-1))
        # grid_sample counts from -1 to 1 between the frame's borders; points without an image go far outside.
        grid = np.nan_to_num(2 * points / frame - 1, nan=9.0, posinf=9.0, neginf=-9.0).clip(-9, 9)
        self._grid = torch.from_numpy(grid.astype(np.float32))[None].to(device)
        self._device = device

    def __call__(self, image: NDArray[np.uint8]) -> Tensor:
        """Rectify a frame (H, W, 3) uint8 BGR to (3, h, w) float32 RGB in [0, 1]."""
        frame = torch.from_numpy(image).to(self._device, non_blocking=True)
        frame = frame.flip(-1).permute(2, 0, 1)[None].float() / 255
        return F.grid_sample(frame, self._grid, mode="bilinear", padding_mode="zeros", align_corners=False)[0]


def image_to_tensor(image: NDArray[np.uint8], device: torch.device) -> Tensor:
    """Convert an image (H, W, 3) uint8 BGR to (3, H, W) float32 RGB in [0, 1] on a device."""
    rgb = np.ascontiguousarray(image[:, :, ::-1].transpose(2, 0, 1))
    return torch.from_numpy(rgb).to(device).float() / 255


class _ToHalf(nn.Module):
    """Convert images to float16."""

    def forward(self, images: Tensor) -> Tensor:
        return images.half()


class ModelInput(NamedTuple):
    """One rectified picture as a network takes it.

    Args:
        image: (3, H, W) float32 RGB in [0, 1], on the network's device.
        scene: (4,) of `detector.model.vehicle_size.scene_vector`.
    """

    image: Tensor
    scene: Tensor


def _scene_tensor(rectification: Rectification, camera: Camera) -> Tensor:
    return torch.from_numpy(scene_vector(rectification.matrix, rectification.vpu, rectification.pair, camera))


def labels_from_output(output: dict[str, Tensor], scene: Tensor, metadata: ModelMetadata) -> Labels:
    """Convert a network's output for one picture to labels.

    Detections without an area are left out: at the picture's border a box may have been cut to a line.

    Args:
        output: `boxes` (N, 4) px, `scores` (N,), `cc` (N,), and `sizes` (N, 2) of networks that give them.
        scene: (4,) of `detector.model.vehicle_size.scene_vector`.
        metadata: of the network.

    Returns:
        at most N labels in the rectified picture, with scores, in the order of the output.
    """
    parts = [output["boxes"], output["scores"][:, None], output["cc"][:, None]]
    parts += [output["sizes"]] if "sizes" in output else []
    # In one piece: each transfer from a GPU waits for it.
    table = torch.cat(parts, dim=1).detach().cpu().double()
    boxes, scores, cc, sizes = table[:, :4], table[:, 4], table[:, 5], table[:, 6:]
    if "sizes" in output:
        cc, boxes = merge_sizes(
            cc, boxes, sizes, scene.double().cpu(), weight=metadata.config.size_weight, height_px=metadata.size_wh[1]
        )
    solid = (boxes[:, :2] < boxes[:, 2:]).all(dim=1) & cc.isfinite()
    return Labels(boxes[solid].numpy(), cc[solid].numpy(), scores=scores[solid].numpy().astype(np.float32))


class Detector:
    """A network set up for inference.

    Args:
        model: trained; it is folded and moved in place.
        metadata: of its checkpoint.
        device: torch device to run on; None for the GPU where there is one.
        half: half precision (float16 on GPUs, bfloat16 by autocast on CPUs); None for where the device gains from it.
        compiled: compile the network, which takes half a minute; worth it for long videos on a GPU.
        fold: fold batch normalisation into convolutions.

    Raises:
        LabelgenError: no such device.
    """

    def __init__(
        self, model: CcRetinaNet, metadata: ModelMetadata, *, device: str | None = None, half: bool | None = None,
        compiled: bool = False, fold: bool = True,
    ) -> None:  # fmt: skip
        self.metadata, self.device = metadata, choose_device(device)
        self.half = gains_from_half(self.device) if half is None else half
        model.eval()
        if fold:
            fold_batch_norm(model)
        self.model = model.to(self.device, memory_format=torch.channels_last)
        self._fixed_batch = compiled
        if self.half and self.device.type == "cuda":
            # Once: autocast would convert every weight again for each batch, which costs a small network's time.
            self.model.backbone = nn.Sequential(_ToHalf(), model.backbone.half())
            self.model.head = model.head.half()
        if compiled:
            self.model.backbone = torch.compile(self.model.backbone, dynamic=False)
            self.model.head = torch.compile(self.model.head, dynamic=False)

    @property
    def batch_size(self) -> int:
        """Number of pictures to give to `detect` at once: more than one is faster on a GPU alone."""
        return 1 if self.device.type == "cpu" else _GPU_BATCH

    def rectifier(self, rectification: Rectification, camera: Camera) -> Callable[[NDArray[np.uint8]], ModelInput]:
        """Return a function that turns a frame into the network's input, for the frames of one camera.

        Args:
            rectification: of the network's pair and size (`metadata`), with the size of its frame.
            camera: of the frames; its scale, where known, makes c_c more exact.

        Returns:
            frame (H, W, 3) uint8 BGR -> input of `detect`.

        Raises:
            LabelgenError: the rectification is of another pair or size than the network was trained on.
        """
        own, other = (f"{r.pair} {r.size_wh[0]}x{r.size_wh[1]}" for r in (self.metadata, rectification))
        if own != other:
            raise LabelgenError(
                f"rectification: it gives pictures of {other}, this detector sees {own}; make one with its "
                "metadata.pair and metadata.size_wh",
                parameter="rectification",
            )
        scene = _scene_tensor(rectification, camera)
        if self.device.type != "cpu":
            warp = DeviceRectifier(rectification, self.device)
            return lambda frame: ModelInput(warp(frame), scene)
        return lambda frame: ModelInput(image_to_tensor(rectification.warp_image(frame), self.device), scene)

    def input_of_sample(self, sample: Sample) -> ModelInput:
        """Return the network's input for a sample of a shard, which is rectified already."""
        return ModelInput(
            image_to_tensor(sample.image, self.device), _scene_tensor(sample.rectification, sample.camera)
        )

    def detect(self, inputs: Sequence[ModelInput]) -> list[Labels]:
        """Detect vehicles in rectified pictures.

        Args:
            inputs: pictures of one size, made by `rectifier` or `input_of_sample`.

        Returns:
            labels of each picture, in its px, with scores.
        """
        images = [item.image for item in inputs]
        if self._fixed_batch and images:
            # A smaller last batch would be compiled for, which takes longer than some videos.
            images += images[-1:] * (-len(images) % self.batch_size)
        autocast = self.half and self.device.type == "cpu"
        with torch.inference_mode(), torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=autocast):
            outputs = self.model(images)
        return [
            labels_from_output(output, item.scene, self.metadata) for output, item in zip(outputs, inputs, strict=False)
        ]


def load_detector(path: str | Path, *, score: float = 0.05, **options: Any) -> Detector:
    """Load a detector from a checkpoint.

    Args:
        path: written by `detector.training.train.train`.
        score: lowest score of a detection, in [0, 1].
        options: further ones of `Detector`: `device`, `half`, `compiled`, `fold`.

    Raises:
        DataError: not a checkpoint of a detector.
        LabelgenError: no such device.
    """
    model, metadata = load_model(path, score_thresh=score)
    return Detector(model, metadata, **options)
