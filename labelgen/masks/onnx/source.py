"""Masks from an instance segmentation network of the user's: an ONNX file that any of several tools exported."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.geometry.camera import Camera
from labelgen.masks.instances import Crop, InstanceMasks
from labelgen.masks.mask_options import MASK_OPTIONS, MaskOptions
from labelgen.masks.onnx.candidates import Candidates, suppress_boxes
from labelgen.masks.onnx.crops import candidate_crops, drop_doubles
from labelgen.masks.onnx.family import Family, Trial
from labelgen.masks.onnx.network_classes import class_table, names_of
from labelgen.masks.onnx.placement import Placement, Window
from labelgen.masks.onnx.rf_detr import match_rf_detr
from labelgen.masks.onnx.session import NetworkSession
from labelgen.masks.onnx.tiles import check_tiles, choose_windows
from labelgen.masks.onnx.torchvision_maskrcnn import TorchvisionMaskRcnn, match_torchvision
from labelgen.masks.onnx.yolo import match_yolo
from labelgen.problem_counts import ProblemCounts

__all__ = ["OnnxMasks"]

_log = logging.getLogger(__name__)

_FAMILIES = (match_yolo, match_rf_detr, match_torchvision)
_EXPECTED = (
    "expected YOLO's (batch, 4 + classes + M, anchors) or (batch, K, 6 + M) with prototypes (batch, M, h, w); "
    "RF-DETR's boxes (batch, Q, 4), logits (batch, Q, classes) and masks (batch, Q, h, w); or "
    "torchvision's boxes (N, 4), labels (N), scores (N) and masks (N, 1, h, w)"
)
# Sides of the picture where the network takes any, px; torchvision's own network resizes to these itself.
_SIDE, _STRIDE, _TORCHVISION_SIDES = 640, 32, (800, 1333)
_BATCH_CPU, _BATCH_GPU = 4, 8
# Box suppression leaves what masks decide, and at most so many vehicles in a frame.
_MAX_BOX_IOU, _MAX_VEHICLES = 0.7, 1000
# A box that ends within this distance of a tile's inner border is cut by it: px of the picture, or a share of its side.
_CUT_PX, _CUT_SHARE = 4.0, 0.1
# One that ends within this share of its side may be, and comes after all others.
_DOUBTFUL_SHARE = 0.25
# What twice the enlargement is worth, as a score: masks of tiles are finer.
_FINER_BONUS = 0.1
# A vehicle up to this share of the picture is seen better in a tile than in the whole frame.
_MAX_FINE_SHARE = 0.4


class OnnxMasks:
    """A `labelgen.masks.source.MaskSource`: instance masks of vehicles by a network in an ONNX file.

    Args:
        path: the file.
        score_threshold: masks with a lower score are left out.
        device: see `labelgen.before_torch.device_parts`; None for the best that onnxruntime has.
        options: classes and tiles.
        camera: of the frames, for tiles "auto".
        road_mask: (H, W), not 0 on the road, for tiles "auto".

    Attributes:
        problems: what the network gave and could not be used, one line for each kind.
        family: how its outputs are read.

    Raises:
        LabelgenError: onnxruntime is missing, there is no such device, or tiles that cannot be.
        DataError: not a network that can be read; the message says what was found and what is expected.
    """

    every_frame = 0
    prime_frames = 0

    def __init__(
        self,
        path: str | Path,
        *,
        score_threshold: float = 0.5,
        device: str | None = None,
        options: MaskOptions = MASK_OPTIONS,
        camera: Camera | None = None,
        road_mask: NDArray[Any] | None = None,
    ) -> None:
        self.path = Path(path)
        self._score_threshold, self._tiles = score_threshold, options.tiles
        self._camera, self._road_mask = camera, road_mask
        check_tiles(options.tiles, camera)
        self._session = NetworkSession(self.path, device=device)
        layout = self._session.layout
        self._network_batch = layout.batch or (_BATCH_GPU if self._session.on_gpu else _BATCH_CPU)
        self.batch_size = self._network_batch
        names = names_of(self._session.metadata)
        self.family = self._recognise(names)
        self._classes = self._class_table(names, options)
        self._not_finite = ProblemCounts()
        self._windows: dict[tuple[int, int], list[Placement]] = {}
        _log.debug("%s: %s, run by %s", self.path.name, self.family.title, self._session.providers[0])

    @property
    def problems(self) -> list[str]:
        """What the network gave and could not be used, one line each."""
        return [f"{self.path.name}: {line}" for line in self._not_finite.lines()]

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Do nothing: frames are segmented one by one."""

    def observe(self, image: NDArray[np.uint8]) -> None:
        """Do nothing: frames are segmented one by one."""

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """Return the vehicles' masks in each image; see `MaskSource.masks`."""
        work = [
            (i, image, placement)
            for i, image in enumerate(images)
            for placement in self._placements((image.shape[1], image.shape[0]))
        ]
        found: list[list[tuple[Placement, Candidates]]] = [[] for _ in images]
        for _, same_size in groupby(work, key=lambda item: item[2].picture_wh):
            group = list(same_size)
            for start in range(0, len(group), self._network_batch):
                batch = group[start : start + self._network_batch]
                outputs = self._run([placement.picture(image) for _, image, placement in batch])
                for k, (i, _, placement) in enumerate(batch):
                    found[i].append((placement, self._read(outputs, k, placement)))
        return [
            self._vehicles(pictures, (image.shape[1], image.shape[0]))
            for pictures, image in zip(found, images, strict=True)
        ]

    def _recognise(self, names: dict[int, str] | None) -> Family:
        """Return the family of the network, by what it gives for a grey picture."""
        layout = self._session.layout
        size = (layout.width or self._side(), layout.height or self._side())
        outputs = self._session.run(np.full((max(1, layout.batch), 3, size[1], size[0]), 0.5, dtype=np.float32))
        trial = Trial(outputs, self._session.output_names, self._session.metadata, names, size)
        for match in _FAMILIES:
            family: Family | None = match(trial)
            if family is not None:
                return family
        shapes = ", ".join(
            f"{name} {output.shape}" for name, output in zip(self._session.output_names, outputs, strict=True)
        )
        raise DataError(
            f"{self.path}: not a network for instance segmentation that can be read: it gives "
            f"{shapes[:300]}; {_EXPECTED}",
            parameter="masks",
        )

    def _class_table(self, names: dict[int, str] | None, options: MaskOptions) -> NDArray[np.uint8]:
        count = self.family.class_count
        if not count:
            numbers = [int(key) for key in options.classes or () if key.isdecimal() and len(key) < 5]
            count = 1 + max([*(names or ()), *numbers], default=90)
        return class_table(self.path, count, names, options.classes)

    def _side(self) -> int:
        """Return the longer side of the picture where the network takes any, px."""
        texts = self._session.metadata.get("imgsz", "").strip("[]() ").split(",")
        stated = [int(text) for text in texts if text.strip().isdecimal() and len(text) < 6]
        return max(stated) if stated and 32 <= max(stated) <= 8192 else _SIDE

    def _placements(self, frame_wh: tuple[int, int]) -> list[Placement]:
        if frame_wh not in self._windows:
            whole: Window = (0, 0, *frame_wh)
            windows = choose_windows(self._tiles, frame_wh, self._picture_wh(whole), self._camera, self._road_mask)
            self._windows[frame_wh] = [self.family.place(window, self._picture_wh(window)) for window in windows]
        return self._windows[frame_wh]

    def _picture_wh(self, window: Window) -> tuple[int, int]:
        """Return the size of the picture that the network takes of a window, px."""
        layout = self._session.layout
        if layout.width and layout.height:
            return layout.width, layout.height
        sides = window[2] - window[0], window[3] - window[1]
        if isinstance(self.family, TorchvisionMaskRcnn):
            scale = min(1.0, _TORCHVISION_SIDES[0] / min(sides), _TORCHVISION_SIDES[1] / max(sides))
            width, height = (max(1, round(side * scale)) for side in sides)
        else:
            scale = self._side() / max(sides)
            width, height = (_STRIDE * max(1, -(-round(side * scale) // _STRIDE)) for side in sides)
        return layout.width or width, layout.height or height

    def _run(self, pictures: list[NDArray[np.uint8]]) -> list[NDArray[Any]]:
        """Run the network on pictures (H, W, 3) BGR of one size, no more than a batch."""
        if self._session.layout.batch:
            # What is missing to a fixed batch is repeated.
            pictures = pictures + pictures[-1:] * (self._session.layout.batch - len(pictures))
        blob = np.asarray(cv2.dnn.blobFromImages(pictures, 1 / 255, swapRB=True), dtype=np.float32)
        return self._session.run(self.family.normalise(blob))

    def _read(self, outputs: list[NDArray[Any]], index: int, placement: Placement) -> Candidates:
        try:
            found = self.family.read(outputs, index, placement.picture_wh, self._classes, self._score_threshold)
        except DataError as err:
            raise DataError(f"{self.path}: {err}", parameter="masks") from None
        boxes = found.boxes_xyxy
        usable = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        for box in boxes[~usable]:
            self._not_finite.add("without a box", f"a box {box.tolist()}", noun="detection")
        limits = np.array(placement.picture_wh * 2, dtype=np.float32)
        kept = np.flatnonzero(usable)
        logits = found.mask_logits
        return Candidates(
            np.clip(boxes[kept], -limits, 2 * limits),
            found.class_ids[kept],
            found.scores[kept],
            lambda some: logits(kept[some]),
            found.fill_box,
        )

    def _vehicles(self, pictures: list[tuple[Placement, Candidates]], frame_wh: tuple[int, int]) -> InstanceMasks:
        """Return the vehicles of one frame, of all its pictures together."""
        boxes, ranks, places = [], [], []
        for number, (placement, candidates) in enumerate(pictures):
            usable = np.flatnonzero(~_cut_by_tile(candidates, placement, frame_wh, _CUT_PX, _CUT_SHARE))
            sides = (candidates.boxes_xyxy[:, 2:] - candidates.boxes_xyxy[:, :2]).max(axis=1, initial=0)[usable]
            is_fine = (sides <= _MAX_FINE_SHARE * min(placement.picture_wh)) | (number == 0)
            doubtful = _cut_by_tile(candidates, placement, frame_wh, _CUT_PX, _DOUBTFUL_SHARE)[usable]
            bonus = _FINER_BONUS * float(np.log2(placement.scale.min() / pictures[0][0].scale.min()))
            boxes.append(placement.boxes_to_frame(candidates.boxes_xyxy[usable]))
            ranks.append(candidates.scores[usable] + np.where(is_fine, bonus, 0) - doubtful)
            places += [(number, i) for i in usable.tolist()]
        order = np.argsort(-np.concatenate(ranks), kind="stable")
        kept = suppress_boxes(np.concatenate(boxes), order, _MAX_BOX_IOU, _MAX_VEHICLES).tolist()
        crops: dict[int, Crop] = {}
        for number, (placement, candidates) in enumerate(pictures):
            mine = [k for k in kept if places[k][0] == number]
            indices = np.array([places[k][1] for k in mine], dtype=np.int64)
            made = candidate_crops(candidates, indices, placement)
            crops |= {k: crop for k, crop in zip(mine, made, strict=True) if crop is not None}
        left = [k for k in kept if k in crops]
        left = [left[i] for i in drop_doubles([crops[k] for k in left])]
        chosen = [(pictures[places[k][0]][1], places[k][1]) for k in left]
        return InstanceMasks.from_crops(
            frame_wh,
            [crops[k] for k in left],
            [candidates.class_ids[i] for candidates, i in chosen],
            [candidates.scores[i] for candidates, i in chosen],
            are_predicted=True,
        )


def _cut_by_tile(
    candidates: Candidates, placement: Placement, frame_wh: tuple[int, int], least_px: float, least_share: float
) -> NDArray[np.bool_]:
    """Return (N,) which candidates end at a border of the window that is none of the frame.

    Args:
        candidates: of the picture.
        placement: of the picture in the frame.
        frame_wh: size of the frame, px.
        least_px: distance from the border up to which a box ends at it, px of the picture.
        least_share: the same as a share of the box's side.
    """
    x, y, width, height = placement.inner
    window = np.array(placement.window)
    is_inner = np.concatenate([window[:2] > 0, window[2:] < np.array(frame_wh)])
    boxes = candidates.boxes_xyxy
    inside = np.concatenate([boxes[:, :2] - [x, y], [x + width, y + height] - boxes[:, 2:]], axis=1)
    sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    return np.asarray(((inside < np.maximum(least_px, least_share * sides)) & is_inner).any(axis=1))
