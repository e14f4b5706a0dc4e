"""A trained detector at work: frames in, detections out.

The network runs channels-last, its batch normalisation folded into its convolutions, on a GPU in half precision and
compiled where asked for. There frames are rectified on the device, too; on a CPU OpenCV does it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812
from torch.nn.utils.fusion import fuse_conv_bn_eval
from torchvision.models._utils import IntermediateLayerGetter
from torchvision.models.resnet import BasicBlock, Bottleneck

from detector.checkpoint import Card, load_detector
from detector.detections import Detections
from detector.evaluate import Found
from detector.model import CcRetinaNet
from detector.variants import Variant, View
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, Rectification, RoadMask
from labelgen.labels import Labels
from labelgen.sources.frames import Frame, FrameSource

__all__ = ["Detector", "DeviceRectifier", "ModelDetections", "choose_device", "fold_batch_norm"]

_GPU_BATCH = 8
_RUN_IN_ORDER = (nn.Sequential, IntermediateLayerGetter, BasicBlock, Bottleneck)


def choose_device(name: str | None) -> torch.device:
    """The device of this name; the GPU when there is one, by default.

    Raises:
        LabelgenError: no such device here.
    """
    try:
        device = torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as err:
        raise LabelgenError(f"--device {name}: {' '.join(str(err).split())[:100]}; use cpu or cuda") from None
    return device


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


class Detector:
    """A model set up for inference.

    Args:
        model: trained; folded and moved in place.
        card: of its checkpoint.
        device: where to run; None for the GPU when there is one.
        half: half precision; None for where it gains, on GPUs.
        compiled: compile the network; worth it for long videos on a GPU.
        fold: fold batch normalisation into convolutions.
    """

    def __init__(
        self, model: CcRetinaNet, card: Card, *, device: str | None = None, half: bool | None = None,
        compiled: bool = False, fold: bool = True,
    ) -> None:  # fmt: skip
        self.card, self.device = card, choose_device(device)
        self._half = self.device.type == "cuda" if half is None else half
        model.eval()
        if fold:
            fold_batch_norm(model)
        self.model = model.to(self.device, memory_format=torch.channels_last)
        if compiled:
            self.model.backbone = torch.compile(self.model.backbone)
            self.model.head = torch.compile(self.model.head)

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

    def detect(self, images: Sequence[NDArray[np.uint8]]) -> list[Labels]:
        """The vehicles in rectified pictures (H, W, 3) uint8 BGR: `detector.sources.Detector`."""
        found = []
        for output in self([self.tensor(image) for image in images]):
            # Boxes cut at the border may have no area left.
            solid = output[(output.boxes_xyxy[:, :2] < output.boxes_xyxy[:, 2:]).all(axis=1)]
            found.append(Labels(solid.boxes_xyxy, solid.cc, scores=solid.scores.astype(np.float32)))
        return found

    def tensor(self, image: NDArray[np.uint8]) -> Tensor:
        """A rectified picture (H, W, 3) uint8 BGR as input."""
        return to_tensor(image, self.device)

    def __call__(self, images: Sequence[Tensor]) -> list[Found]:
        """Detections in rectified pictures, each (3, H, W) float RGB in [0, 1] on the device."""
        with (
            torch.inference_mode(),
            torch.autocast(self.device.type, dtype=torch.float16 if self.device.type == "cuda" else torch.bfloat16,
                           enabled=self._half),
        ):  # fmt: skip
            outputs = self.model(list(images))
        return [Found(*(out[key].double().cpu().numpy() for key in ("boxes", "cc", "scores"))) for out in outputs]


class ModelDetections:
    """A detector as the `DetectionSource` of one scene, see `detector.sources`.

    Args:
        detector: the model.
        camera: with a scale.
        road: the road mask.
        variant: how the measured point is found; transform2d for models without c_c.
        batch: frames at a time; 1 keeps the delay of a live camera low.

    Raises:
        LabelgenError: the variant needs no rectification of the road, or c_c from a model that has none.
        RectificationError: the scene admits no rectification of the model's pair and size.
    """

    def __init__(
        self, detector: Detector, camera: Camera, road: RoadMask, *, variant: Variant | None = None, batch: int = 1
    ) -> None:
        card = detector.card
        chosen = variant or (Variant.TRANSFORM3D if card.config.cc_weight else Variant.TRANSFORM2D)
        if chosen.in_frame:
            raise LabelgenError(f"--variant {chosen}: this detector works on rectified pictures; use transform3d")
        if chosen.is_3d and not card.config.cc_weight:
            raise LabelgenError(f"--variant {chosen}: this detector was trained without c_c; use transform2d")
        self._detector, self._batch = detector, batch
        self._view = View.create(chosen, camera, road, card.pair, card.size_wh)
        assert self._view.rectification is not None
        self._rectification = self._view.rectification
        on_gpu = detector.device.type != "cpu"
        self._rectifier = DeviceRectifier(self._rectification, detector.device) if on_gpu else None
        self._rejects: Counter[str] = Counter()

    @property
    def view(self) -> View:
        """Where the detections lie."""
        return self._view

    @property
    def rejects(self) -> Counter[str]:
        """Boxes into which no 3D box fits."""
        return self._rejects

    @property
    def problems(self) -> list[str]:
        """None: the model takes every frame."""
        return []

    def rectify(self, frame: NDArray[np.uint8]) -> Tensor:
        """A frame as the model's input."""
        if self._rectifier is not None:
            return self._rectifier(frame)
        return self._detector.tensor(self._rectification.warp_image(frame))

    def stream(self, frames: FrameSource) -> Iterator[tuple[Frame, Detections]]:
        """See `DetectionSource.stream`."""
        return self.detections(frames.frames())

    def detections(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, Detections]]:
        """Each of some frames with its detections, in order."""
        coming = iter(frames)
        while batch := list(islice(coming, self._batch)):
            outputs = self._detector([self.rectify(frame.image) for frame in batch])
            for frame, found in zip(batch, outputs, strict=True):
                placed, valid = self._view.place(frame.number, frame.time_s, found.boxes_xyxy, found.cc, found.scores)
                if not valid.all():
                    self._rejects["no place on the road"] += int(np.count_nonzero(~valid))
                yield frame, placed
