"""Masks from COCO JSON, so that the output of any segmentation tool can be used.

A frame's image entry is looked up by the entry's `frame` number where it has one. Otherwise a frame of a folder is
looked up by file name, and a frame of a video by the number at the end of the file name (000123.jpg is frame 123).

Both forms of COCO files are read: annotation files, which are an object with `images` and `annotations`, and lists of
results, whose image ids are taken as frame numbers.

Source of the format: https://cocodataset.org/#format-data.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.labels import VehicleClass
from labelgen.masks.coco_segmentation import check_segmentation, decode_segmentation
from labelgen.masks.instances import InstanceMasks

__all__ = ["CLASS_BY_COCO_ID", "CocoMasks"]

CLASS_BY_COCO_ID = {
    3: VehicleClass.CAR,
    4: VehicleClass.MOTORCYCLE,
    6: VehicleClass.BUS,
    8: VehicleClass.TRUCK,
}
_CLASS_BY_NAME = {
    "car": VehicleClass.CAR,
    "van": VehicleClass.CAR,
    "motorcycle": VehicleClass.MOTORCYCLE,
    "motorbike": VehicleClass.MOTORCYCLE,
    "bus": VehicleClass.BUS,
    "truck": VehicleClass.TRUCK,
    "lorry": VehicleClass.TRUCK,
    "vehicle": VehicleClass.VEHICLE,
}
# A message names at most this many of the categories that are no vehicles.
_MAX_NAMED_CATEGORIES = 5


class CocoMasks:
    """A `labelgen.masks.source.MaskSource` that looks masks up in a COCO file; see the module for how.

    Args:
        path: COCO JSON.
        score_threshold: annotations with a lower `score` are left out; those without one count as 1.
        frame_wh: size of the frames, px; all masks are checked against it at once. None takes the first frame's size.

    Attributes:
        problems: what is skipped or left out, with the reason. Complete from the beginning where `frame_wh` is given,
            otherwise from the first frame on.

    Raises:
        DataError: the file is missing, not JSON, not COCO, or has no category that is a vehicle.
    """

    every_frame = 0
    prime_frames = 0
    batch_size = 16

    def __init__(
        self, path: str | Path, *, score_threshold: float = 0.0, frame_wh: tuple[int, int] | None = None
    ) -> None:
        self.path = Path(path)
        self.problems: list[str] = []
        self._score_threshold = score_threshold
        self._reported: set[str] = set()
        data = _load(self.path)
        if isinstance(data, list):
            data = {"annotations": data}
        self._classes = self._read_categories(data.get("categories"))
        self._images = self._read_images(data, frame_wh)
        self._annotations = self._read_annotations(data["annotations"])
        self._checked_wh: tuple[int, int] | None = None
        self._usable: dict[Any, list[dict[str, Any]]] = {}
        if frame_wh is not None:
            self._check(frame_wh)

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
        """Return the masks of each frame, none for frames without an image entry; see `MaskSource.masks`."""
        numbers = [-1] * len(images) if frame_numbers is None else frame_numbers
        names = [""] * len(images) if file_names is None else file_names
        return [
            self._masks_of((image.shape[1], image.shape[0]), self._image_id(number, name))
            for image, number, name in zip(images, numbers, names, strict=True)
        ]

    def _image_id(self, number: int, name: str) -> Any:
        if name:
            path = PurePosixPath(name.replace("\\", "/"))
            for key in (str(path), path.name):
                if key in self._by_name:
                    return self._by_name[key]
        for table in (self._by_frame, {} if name else self._by_number):
            if number in table:
                return table[number]
        return None

    def _masks_of(self, frame_wh: tuple[int, int], image_id: Any) -> InstanceMasks:
        if frame_wh != self._checked_wh:
            self._check(frame_wh)
        usable = self._usable.get(image_id, [])
        if not usable:
            return InstanceMasks.empty(frame_wh)
        return InstanceMasks.from_crops(
            frame_wh,
            [decode_segmentation(annotation["segmentation"], frame_wh) for annotation in usable],
            [annotation["_class"] for annotation in usable],
            [annotation.get("score", 1.0) for annotation in usable],
        )

    def _check(self, frame_wh: tuple[int, int]) -> None:
        """Keep the annotations that give masks in frames of this size; report what is wrong with the others."""
        self._checked_wh, self._usable = frame_wh, {}
        low_count = 0
        for image_id, entries in self._annotations.items():
            for index, annotation in entries:
                try:
                    score = _score(annotation.get("score", 1.0))
                    check_segmentation(annotation.get("segmentation"), frame_wh)
                except ValueError as error:
                    self._report(f"annotation {annotation.get('id', f'number {index}')}: {error}; skipped")
                    continue
                if score < self._score_threshold:
                    low_count += 1
                else:
                    self._usable.setdefault(image_id, []).append(annotation)
        if low_count:
            self._report(f"{_many(low_count, 'annotation')} with a score below {self._score_threshold:g} left out")

    def _report(self, problem: str) -> None:
        if problem not in self._reported:
            self._reported.add(problem)
            # JSON may hold lone surrogates, which no output accepts.
            safe = problem.encode("utf-8", "backslashreplace").decode()
            self.problems.append(f"{self.path.name}: {safe}")

    def _read_categories(self, categories: Any) -> dict[int, VehicleClass]:
        """Return the class of each vehicle category; keep the names of the other categories."""
        self._other_names: dict[int, str] = {}
        if not isinstance(categories, list) or not categories:
            return dict(CLASS_BY_COCO_ID)
        classes = {}
        for category in categories:
            if not isinstance(category, dict) or not isinstance(category.get("id"), int):
                self._report(f"category without an id: {str(category)[:60]}; skipped")
                continue
            name = str(category.get("name", "")).strip().lower()
            if name in _CLASS_BY_NAME:
                classes[category["id"]] = _CLASS_BY_NAME[name]
            else:
                self._other_names[category["id"]] = name or f"id {category['id']}"
        if not classes:
            known, others = ", ".join(_CLASS_BY_NAME), ", ".join(sorted(self._other_names.values())[:10]) or "none"
            raise DataError(f"{self.path}: none of its categories is a vehicle (found {others}); name them {known}")
        return classes

    def _read_images(self, data: dict[str, Any], frame_wh: tuple[int, int] | None) -> set[Any]:
        """Return the image ids; fill the tables from frame number and from file name to image id."""
        self._by_frame: dict[int, Any] = {}
        self._by_name: dict[str, Any] = {}
        self._by_number: dict[int, Any] = {}
        images = data.get("images")
        if images is None:
            ids = {a["image_id"] for a in data["annotations"] if isinstance(a, dict) and _is_id(a.get("image_id"))}
            self._by_frame = {i: i for i in ids if isinstance(i, int)}
            return ids
        ids = set()
        base_names: Counter[str] = Counter()
        for entry in images:
            if not isinstance(entry, dict) or not _is_id(entry.get("id")):
                self._report(f"image entry without an id: {str(entry)[:60]}; skipped")
                continue
            ids.add(entry["id"])
            size = (entry.get("width"), entry.get("height"))
            if frame_wh is not None and None not in size and size != tuple(frame_wh):
                self._report(
                    f"images announce {size[0]}x{size[1]} px, but the frames are {frame_wh[0]}x{frame_wh[1]}; "
                    "masks of another size are skipped"
                )
            if isinstance(entry.get("frame"), int):
                self._by_frame.setdefault(entry["frame"], entry["id"])
                continue  # a frame of a video; its file name is the video's
            path = PurePosixPath(str(entry.get("file_name") or "").replace("\\", "/"))
            if not path.name:
                continue
            self._by_name[str(path)] = entry["id"]
            base_names[path.name] += 1
            if base_names[path.name] == 1:
                self._by_name.setdefault(path.name, entry["id"])
            number = re.search(r"([0-9]+)[^0-9]*$", path.stem)
            if number and len(number[1]) < 19:
                self._by_number.setdefault(int(number[1]), entry["id"])
        repeated = sum(count > 1 for count in base_names.values())
        if repeated:
            self._report(f"{repeated} file names occur several times; frames named without a folder use the first")
        return ids

    def _read_annotations(self, annotations: list[Any]) -> dict[Any, list[tuple[int, dict[str, Any]]]]:
        """Return the vehicles' annotations by image id, each with its index in the file."""
        by_image: dict[Any, list[tuple[int, dict[str, Any]]]] = {}
        others: Counter[str] = Counter()
        crowds = 0
        for index, annotation in enumerate(annotations):
            if not isinstance(annotation, dict):
                self._report(f"annotation number {index}: not a JSON object; skipped")
                continue
            label = f"annotation {annotation.get('id', f'number {index}')}"
            image_id, category = annotation.get("image_id"), annotation.get("category_id")
            if not _is_id(image_id) or image_id not in self._images:
                self._report(f"{label}: no image with id {image_id!r}; skipped")
            elif not isinstance(category, int):
                self._report(f"{label}: category_id {category!r} is not a number; skipped")
            elif annotation.get("iscrowd") == 1:
                crowds += 1
            elif category not in self._classes:
                others[self._other_names.get(category, f"id {category}")] += 1
            else:
                entry = {**annotation, "_class": self._classes[category]}
                by_image.setdefault(image_id, []).append((index, entry))
        if others:
            names = [name for name, _ in others.most_common(_MAX_NAMED_CATEGORIES)]
            more = [f"{len(others) - len(names)} more"] if len(others) > len(names) else []
            count = _many(others.total(), "annotation")
            self._report(f"{count} of other categories ({', '.join(names + more)}) left out")
        if crowds:
            self._report(f"{_many(crowds, 'crowd region')} left out")
        return by_image


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _score(value: Any) -> float:
    if not isinstance(value, int | float) or not 0 <= value <= 1:
        raise ValueError(f"its score {repr(value)[:40]} is not in [0, 1]")
    return float(value)


def _is_id(value: Any) -> bool:
    return isinstance(value, int | str) and not isinstance(value, bool)


def _load(path: Path) -> Any:
    try:
        with path.open(encoding="utf-8") as file:
            data = json.load(file)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; masks coco:FILE needs a COCO JSON file", parameter="masks") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not a JSON file ({str(error).splitlines()[0]})") from None
    if isinstance(data, list):
        if all(isinstance(a, dict) and "image_id" in a for a in data[:100]):
            return data
    elif isinstance(data, dict):
        images = data.get("images")
        if isinstance(data.get("annotations"), list) and (images is None or isinstance(images, list)):
            return data
    raise DataError(f'{path}: JSON, but not COCO; expected an object with lists "images" and "annotations"')
