"""Masks from COCO JSON, so that the output of any segmentation tool can be used.

`coco_file` reads the file, `coco_frames` finds the entry of each frame, `coco_segmentation` decodes the masks.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError, NoVehiclesError
from labelgen.geometry.frame_size import scale_between, size_text
from labelgen.masks.clip import Clip
from labelgen.masks.coco_file import Annotation, CocoFile
from labelgen.masks.coco_frames import EntryMatch, match_files, match_video, unnamed_by_number
from labelgen.masks.coco_segmentation import SegmentationError, check_segmentation, decode_segmentation
from labelgen.masks.instances import InstanceMasks
from labelgen.masks.mask_options import MASK_OPTIONS, MaskOptions
from labelgen.problem_counts import ProblemCounts, count_of

__all__ = ["CocoMasks"]

_log = logging.getLogger(__name__)

# Polygons of frames of an unknown size are refused where at least so many, and this share of them, reach beyond the
# frame by more than this share of it: they were drawn on larger pictures.
_MIN_BEYOND, _MIN_BEYOND_SHARE, _BEYOND = 10, 0.05, 0.1


class CocoMasks:
    """A `labelgen.masks.source.MaskSource` that looks masks up in a COCO file.

    Args:
        path: COCO JSON.
        score_threshold: annotations with a lower `score` are left out; those without one count as 1.
        frame_wh: size of the frames, px; all masks are checked against it at once. None takes the clip's, or the first
            frame's.
        clip: the frames that the masks are of; where it is given, all entries are matched at once.
        options: how the file is to be read.

    Attributes:
        problems: what is skipped or left out, one line for each kind with an example. Complete from the beginning where
            the frame size is given, otherwise from the first frame on.
        no_masks: why no frame of the clip has a mask; None where one has, or where the clip is not known.

    Raises:
        DataError: the file is missing, not JSON, not COCO, has no category that is a vehicle, or several of its entries
            are of the same frame.
    """

    every_frame = 0
    prime_frames = 0
    batch_size = 16

    def __init__(
        self,
        path: str | Path,
        *,
        score_threshold: float = 0.0,
        frame_wh: tuple[int, int] | None = None,
        clip: Clip | None = None,
        options: MaskOptions = MASK_OPTIONS,
    ) -> None:
        self.path = Path(path)
        self._options = options
        self._score_threshold = score_threshold
        self._file = CocoFile(self.path, self._options.classes)
        self._clip = clip or Clip(Path())
        self._match = self._match_clip() if clip is not None else None
        self._found: dict[str, EntryMatch] = {}
        self._checked_wh: tuple[int, int] | None = None
        self._usable: dict[int, list[tuple[Annotation, float]]] = {}
        self._annotation_problems, self._annotation_notes = ProblemCounts(), list[str]()
        frame_wh = frame_wh or self._clip.frame_wh
        if frame_wh is not None:
            self._check(frame_wh)
        if self._match is not None and self._match.usage not in self._match.problems:
            _log.info("%s: %s", self.path.name, self._match.usage)

    @property
    def problems(self) -> list[str]:
        """What is skipped or left out, one line each."""
        lines = [
            *self._file.problems.lines(),
            *self._file.notes,
            *(self._match.problems if self._match is not None else ()),
            *self._annotation_notes,
            *self._annotation_problems.lines(),
        ]
        # JSON may hold lone surrogates, which no output accepts.
        return [f"{self.path.name}: {line.encode('utf-8', 'backslashreplace').decode()}" for line in lines]

    @property
    def no_masks(self) -> NoVehiclesError | None:
        """Why no frame of the clip has a mask; None where one has, or where the clip is not known."""
        match = self._match
        if match is None:
            return None
        if match.no_frames is not None:
            return NoVehiclesError(
                f"{self.path}: no vehicles found: {match.no_frames}", parameter=match.no_frames.parameters
            )
        taken = {*match.by_number.values(), *match.by_name.values()}
        if self._checked_wh is None or any(self._usable.get(entry) for entry in taken):
            return None
        reasons = [line.removeprefix(f"{self.path.name}: ") for line in self.problems]
        parameter = next((name for name in ("scale_masks", "classes") if name in " ".join(reasons).split()), None)
        if not reasons:
            return None  # a scene without vehicles
        text = "; ".join(reasons)
        return NoVehiclesError(
            f"{self.path}: no vehicles found, no mask in it can be used: {text}", parameter=parameter
        )

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Do nothing: the masks are there already."""

    def observe(self, image: NDArray[np.uint8]) -> None:
        """Do nothing: the masks are there already."""

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """Return the masks of each frame, none for frames without an image entry; see `MaskSource.masks`.

        Raises:
            DataError: several entries are of the same frame; only where the clip is not known.
        """
        numbers = [-1] * len(images) if frame_numbers is None else frame_numbers
        names = [""] * len(images) if file_names is None else file_names
        return [
            self._masks_of((image.shape[1], image.shape[0]), self._entry_of(number, name))
            for image, number, name in zip(images, numbers, names, strict=True)
        ]

    def _match_clip(self) -> EntryMatch:
        try:
            if self._clip.file_names is None:
                return match_video(self._file.entries, self._clip, self._options.first_frame)
            return match_files(self._file.entries, self._clip.file_names, self._clip, self._options.first_frame)
        except DataError as err:
            raise DataError(f"{self.path}: {err}", parameter=err.parameters) from None

    def _entry_of(self, number: int, name: str) -> int | None:
        match = self._match
        if match is None:
            match = self._match_one(name)
        if name in match.by_name:
            return match.by_name[name]
        return match.by_number.get(number)

    def _match_one(self, name: str) -> EntryMatch:
        """Match a frame on its own, where nothing is known of the others."""
        if name not in self._found:
            entries = self._file.entries
            if name:
                # The position of one image among the others is not known here, its number is.
                by_name = match_files(entries, [name], self._clip).by_name
                self._found[name] = EntryMatch(unnamed_by_number(entries), by_name)
            else:
                self._found[name] = match_video(entries, self._clip, self._options.first_frame)
        return self._found[name]

    def _masks_of(self, frame_wh: tuple[int, int], entry: int | None) -> InstanceMasks:
        if frame_wh != self._checked_wh:
            self._check(frame_wh)
        usable = self._usable.get(entry, []) if entry is not None else []
        if entry is None or not usable:
            return InstanceMasks.empty(frame_wh)
        drawn_wh, scale = self._file.entries[entry].size_wh, self._options.scale_masks
        return InstanceMasks.from_crops(
            frame_wh,
            [decode_segmentation(a.segmentation, frame_wh, drawn_wh=drawn_wh, scale=scale) for a, _ in usable],
            [annotation.class_id for annotation, _ in usable],
            [score for _, score in usable],
            # People draw masks to the border, and once; only networks score them.
            are_predicted=any(annotation.score is not None for annotation, _ in usable),
        )

    def _check(self, frame_wh: tuple[int, int]) -> None:
        """Keep the annotations that give masks in frames of this size; count what is wrong with the others."""
        self._checked_wh, self._usable = frame_wh, {}
        problems = ProblemCounts()
        other_sizes: Counter[tuple[int, int] | None] = Counter()
        low_count = 0
        reach = self._is_beyond(frame_wh)
        entries, scale = self._file.entries, self._options.scale_masks
        for number, group in self._file.annotations.items():
            drawn_wh = entries[number].size_wh
            for annotation in group:
                try:
                    score = _score(annotation.score)
                    if reach and drawn_wh is None and isinstance(annotation.segmentation, list):
                        raise SegmentationError(reach)
                    check_segmentation(annotation.segmentation, frame_wh, drawn_wh=drawn_wh, scale=scale)
                except SegmentationError as err:
                    if err.drawn_wh is not None:
                        other_sizes[err.drawn_wh] += 1
                    else:
                        problems.add(err.kind, f"{annotation.label}: {err}")
                    continue
                if score < self._score_threshold:
                    low_count += 1
                else:
                    self._usable.setdefault(number, []).append((annotation, score))
        noun = "mask"
        if not self._file.annotations:
            noun = "image"
            other_sizes.update(e.size_wh for e in entries if e.size_wh not in (None, frame_wh))
        self._annotation_notes = [
            _size_line(count_of(count, noun), size, frame_wh, scale) for size, count in other_sizes.items() if size
        ]
        if low_count:
            low = f"{count_of(low_count, 'annotation')} with a score below {self._score_threshold:g} left out"
            self._annotation_notes.append(low)
        self._annotation_problems = problems

    def _is_beyond(self, frame_wh: tuple[int, int]) -> str:
        """Return a reason if polygons of an unknown size were drawn on larger frames; "" otherwise."""
        limit = (1 + _BEYOND) * np.array(frame_wh)
        total = beyond = 0
        farthest = np.zeros(2)
        for number, group in self._file.annotations.items():
            if self._file.entries[number].size_wh is not None:
                continue
            for annotation in group:
                corner = _far_corner(annotation.segmentation)
                if corner is not None:
                    total += 1
                    beyond += bool((corner > limit).any())
                    farthest = np.maximum(farthest, corner)
        if beyond < _MIN_BEYOND or beyond < _MIN_BEYOND_SHARE * total:
            return ""
        return (
            f"its polygon has no announced size, and such polygons reach to ({farthest[0]:g}, {farthest[1]:g}) in "
            f"frames of {size_text(frame_wh)} px, as if they were drawn on larger ones"
        )


def _size_line(what: str, size: tuple[int, int], frame_wh: tuple[int, int], scale: bool) -> str:
    if scale_between(size, frame_wh) is None:
        how = "another ratio, so they cannot be scaled"
    else:
        how = "with scale_masks they are scaled" if not scale else "they are too large to be scaled"
    return f"{what} made for frames of {size_text(size)} px, but the frames are {size_text(frame_wh)} ({how}); skipped"


def _far_corner(segmentation: Any) -> NDArray[np.float64] | None:
    """Return (2,) the largest x and y of polygons; None for what is none."""
    try:
        points = [np.asarray(polygon, dtype=np.float64).reshape(-1, 2).max(axis=0) for polygon in segmentation]
        corner = np.max(points, axis=0)
    except (TypeError, ValueError, OverflowError):
        return None
    return corner if corner.shape == (2,) and np.isfinite(corner).all() else None


def _score(value: Any) -> float:
    if value is None:
        return 1.0
    try:
        score = float(value) if not isinstance(value, bool) else -1.0
    except (TypeError, ValueError, OverflowError):
        score = -1.0
    if not 0 <= score <= 1:
        raise SegmentationError(f"its score {repr(value)[:40]} is not in [0, 1]", "its score is not in [0, 1]")
    return score
