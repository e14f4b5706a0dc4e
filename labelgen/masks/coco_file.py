"""Read a COCO JSON file: its image entries, and the vehicles' annotations of each.

Both forms are read: annotation files, which are an object with `images` and `annotations`, and lists of results. Types
are taken as exporters write them: ids as numbers, as floats or as text; image ids that are file names; a byte order
mark; single masks that are marked as crowds.

Source of the format: https://cocodataset.org/#format-data.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from labelgen.errors import DataError, NoVehiclesError
from labelgen.json_file import read_json
from labelgen.labels import VehicleClass
from labelgen.masks.class_names import CLASS_BY_COCO_ID, CLASS_WORDS, normal_name, vehicle_class
from labelgen.printable import printable
from labelgen.problem_counts import ProblemCounts, count_of

__all__ = ["Annotation", "CocoFile", "ImageEntry", "whole_number"]

# COCO's 80 classes counted from 0, as many networks number them: bicycle, airplane and train by COCO's own ids.
_COUNTED_FROM_0 = {2: "car", 5: "bus", 7: "truck"}
_CLASSES_HINT = "2=car,3=motorcycle,5=bus,7=truck for COCO's 80 classes counted from 0"
# A message names at most this many of the categories that are no vehicles.
_MAX_NAMED_CATEGORIES = 5
_MAX_DIGITS = 18
# Beyond this share of the vehicles' annotations, crowds are single masks: in COCO they are one in a hundred.
_MAX_CROWD_SHARE = 0.5

_Id = int | str


@dataclass(frozen=True, slots=True)
class ImageEntry:
    """One image that the file names.

    Args:
        name: file name with its folders, `/` between them; "" where there is none.
        frame: number of the frame that the entry states by a key of its own; None where it states none.
        id_number: the id of an entry that has nothing but an id, where it is a number; None otherwise.
        size_wh: size that the entry announces, px; None where it announces none.
        video: name of the video that the entry states, or "".
    """

    name: str = ""
    frame: int | None = None
    id_number: int | None = None
    size_wh: tuple[int, int] | None = None
    video: str = ""


@dataclass(frozen=True, slots=True)
class Annotation:
    """The mask of one vehicle.

    Args:
        label: name of the annotation in messages.
        class_id: of the vehicle.
        segmentation: as in the file.
        score: as in the file.
    """

    label: str
    class_id: VehicleClass
    segmentation: Any
    score: Any


class CocoFile:
    """The contents of a COCO file.

    Args:
        path: of the file.
        classes: classes by the name or the id of a category, in lower case, before the file's own names.

    Attributes:
        entries: the images.
        annotations: the vehicles' annotations by the number of their entry.
        problems: what was skipped while reading.
        notes: what is left out or understood otherwise than it is written, one line each.

    Raises:
        DataError: the file is missing, not JSON or not COCO, or which of its categories are vehicles is not known.
    """

    def __init__(self, path: Path, classes: Mapping[str, VehicleClass] | None = None) -> None:
        self.path = path
        self.problems = ProblemCounts()
        self.notes: list[str] = []
        data = _load(path)
        annotations = data["annotations"]
        self._named = isinstance(data.get("categories"), list) and bool(data["categories"])
        self._classes, self._other_names = self._read_categories(data.get("categories"), classes or {})
        self._entry_of: dict[_Id, int] = {}
        self.entries: list[ImageEntry] = []
        if data.get("images") is None:
            self._entries_of_results(annotations)
        else:
            self._read_images(data["images"], _video_names(data.get("videos")))
        self.annotations = self._read_annotations(annotations, bool(classes))

    def _read_categories(
        self, categories: Any, given: Mapping[str, VehicleClass]
    ) -> tuple[dict[_Id, VehicleClass], dict[_Id, str]]:
        """Return the class of each vehicle category, and the names of the other categories."""
        classes: dict[_Id, VehicleClass] = {}
        others: dict[_Id, str] = {}
        unknown = set(given)
        for category in categories if self._named else ():
            keys = _id_keys(category.get("id")) if isinstance(category, dict) else ()
            if not keys:
                self.problems.add("without an id", partial(_no_id, "category", category), noun="category")
                continue
            name = str(category.get("name", "")).strip().lower()
            names = tuple(normal_name(text) for text in (name, *map(str, keys)))
            unknown.difference_update(names)
            chosen = next((given[n] for n in names if n in given), vehicle_class(name))
            if chosen is None:
                others.update(dict.fromkeys(keys, name or f"id {keys[0]}"))
            else:
                classes.update(dict.fromkeys(keys, chosen))
        if not self._named:
            if given:
                classes.update({key: c for name, c in given.items() for key in _id_keys(name)})
            else:
                classes.update(CLASS_BY_COCO_ID.items())
            unknown = {name for name in given if whole_number(name) is None}
        if unknown:
            other_names = ", ".join(sorted(set(others.values()))[:10]) or "none of another name"
            raise DataError(
                f"{self.path}: it has no category {', '.join(sorted(unknown))} (found {other_names})",
                parameter="classes",
            )
        if self._named and not classes:
            other_names = ", ".join(sorted(set(others.values()))[:10]) or "none"
            raise NoVehiclesError(
                f"{self.path}: none of its categories is a vehicle (found {other_names}); name them "
                f"{', '.join(CLASS_WORDS)}, or say which are vehicles, as {_example_class(others)}=car",
                parameter="classes",
            )
        return classes, others

    def _read_images(self, images: list[Any], videos: dict[_Id, str]) -> None:
        names: dict[str, int] = {}
        for entry in images:
            keys = _id_keys(entry.get("id")) if isinstance(entry, dict) else ()
            if not keys:
                self.problems.add("without an id", partial(_no_id, "image entry", entry), noun="image entry")
                continue
            number = len(self.entries)
            name = _file_name(entry.get("file_name"))
            size = whole_number(entry.get("width")), whole_number(entry.get("height"))
            self.entries.append(
                ImageEntry(
                    name,
                    whole_number(entry.get("frame")),
                    None,
                    (size[0], size[1]) if size[0] and size[1] and min(size[0], size[1]) > 0 else None,
                    next((videos[key] for key in _id_keys(entry.get("video_id")) if key in videos), ""),
                )
            )
            for key in keys:
                first = self._entry_of.setdefault(key, number)
                if first != number and self.entries[first].name != name:
                    raise DataError(
                        f"{self.path}: the image id {printable(str(key))} stands for two images, "
                        f"{printable(self.entries[first].name)} and {printable(name)}, so that nothing says which one "
                        "its masks belong to; give each image an id of its own, or one file for each video",
                        parameter="masks",
                    )
            path = PurePosixPath(name)
            for text in (name, path.name, path.stem):
                names.setdefault(text, number)
        # Some exporters write file names, or what is left of them, as the annotations' image ids.
        for text, number in names.items():
            if text:
                self._entry_of.setdefault(text, number)

    def _entries_of_results(self, annotations: list[Any]) -> None:
        """Make an entry of each image id of a list of results."""
        for annotation in annotations:
            keys = _id_keys(annotation.get("image_id")) if isinstance(annotation, dict) else ()
            if keys and keys[0] not in self._entry_of:
                number = whole_number(keys[0])
                for key in keys:
                    self._entry_of.setdefault(key, len(self.entries))
                # An id of digits alone may be a file name without its suffix.
                self.entries.append(ImageEntry(_file_name(keys[0]), id_number=number))

    def _read_annotations(self, annotations: list[Any], is_mapped: bool) -> dict[int, list[Annotation]]:
        vehicles: list[tuple[int, Annotation, bool]] = []
        others: Counter[_Id] = Counter()
        counts: Counter[_Id] = Counter()
        for index, annotation in enumerate(annotations):
            if not isinstance(annotation, dict):
                self.problems.add("not a JSON object", partial("annotation number {}: not a JSON object".format, index))
                continue
            image_id, category = annotation.get("image_id"), annotation.get("category_id")
            entry = next((self._entry_of[key] for key in _id_keys(image_id) if key in self._entry_of), None)
            if entry is None:
                self.problems.add("no image of this id", partial(_no_image, annotation, index))
                continue
            label, keys = _label(annotation, index), _id_keys(category)
            known = next((key for key in keys if key in self._classes or key in self._other_names), None)
            if known is None and all(isinstance(key, str) for key in keys):
                self.problems.add(
                    "category_id is not a number", f"{label}: category_id {repr(category)[:60]} is not a number"
                )
                continue
            key = keys[-1] if known is None else known
            counts[key] += 1
            if key not in self._classes:
                others[key] += 1
                continue
            vehicle = Annotation(label, self._classes[key], annotation.get("segmentation"), annotation.get("score"))
            vehicles.append((entry, vehicle, _is_crowd(annotation.get("iscrowd"))))
        if not self._named and not is_mapped:
            self._check_counting(counts)
        self._note_others(others, is_mapped)
        crowds = sum(is_crowd for _, _, is_crowd in vehicles)
        are_single = crowds > _MAX_CROWD_SHARE * len(vehicles)
        if are_single:
            self.notes.append(f"{count_of(crowds, 'annotation')} marked as crowds: taken as single masks")
        elif crowds:
            self.notes.append(f"{count_of(crowds, 'crowd region')} left out")
        by_entry: dict[int, list[Annotation]] = {}
        for entry, vehicle, is_crowd in vehicles:
            if are_single or not is_crowd:
                by_entry.setdefault(entry, []).append(vehicle)
        return by_entry

    def _note_others(self, others: Counter[_Id], is_mapped: bool) -> None:
        if not others:
            return
        names: Counter[str] = Counter()
        for other, number in others.items():
            names[self._other_names.get(other, f"id {other}")] += number
        named = [f"{count} {name}" for name, count in names.most_common(_MAX_NAMED_CATEGORIES)]
        more = [f"{len(names) - len(named)} more"] if len(names) > len(named) else []
        count = count_of(others.total(), "annotation")
        self.notes.append(f"{count} of other categories ({', '.join(named + more)}) left out")

    def _check_counting(self, counts: Counter[_Id]) -> None:
        """Refuse class ids that are not COCO's own; note those that may not be."""
        if counts[0]:
            raise DataError(
                f"{self.path}: it has no categories, and its class ids begin with 0, which COCO's do not; say what "
                f"they mean, as {_CLASSES_HINT}",
                parameter="classes",
            )
        if sum(counts[key] for key in _COUNTED_FROM_0) > sum(counts[key] for key in CLASS_BY_COCO_ID):
            self.notes.append(
                "it has no categories, and most of its class ids are no vehicles by COCO's own ids (3 car, "
                f"4 motorcycle, 6 bus, 8 truck): otherwise say what they mean with classes, as {_CLASSES_HINT}"
            )


def whole_number(value: Any) -> int | None:
    """Return a whole number that is written as a number, a float or text; None for anything else."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int):
        return value if abs(value) < 10**_MAX_DIGITS else None
    if isinstance(value, float):
        return int(value) if value.is_integer() and abs(value) < 10**_MAX_DIGITS else None
    if isinstance(value, str):
        text = value.strip().removesuffix(".0")
        digits = text.removeprefix("-")
        return int(text) if digits.isascii() and digits.isdigit() and len(digits) <= _MAX_DIGITS else None
    return None


def _id_keys(value: Any) -> tuple[_Id, ...]:
    """Return the keys under which an id is looked up: as it is written, and as a whole number."""
    if value is None:
        return ()
    number = whole_number(value)
    if isinstance(value, str):
        text = value.strip()
        return () if not text else (text,) if number is None else (text, number)
    return () if number is None else (number,)


def _label(annotation: dict[str, Any], index: int) -> str:
    return f"annotation {str(annotation.get('id', f'number {index}'))[:40]}"


def _no_image(annotation: dict[str, Any], index: int) -> str:
    return f"{_label(annotation, index)}: no image with id {repr(annotation.get('image_id'))[:60]}"


def _no_id(noun: str, item: Any) -> str:
    return f"{noun} without an id: {str(item)[:60]}"


def _is_crowd(value: Any) -> bool:
    return value is True or whole_number(value) == 1


def _file_name(value: Any) -> str:
    return str(PurePosixPath(value.replace("\\", "/"))) if isinstance(value, str) and value.strip() else ""


def _video_names(videos: Any) -> dict[_Id, str]:
    """Return the names of videos by their ids, as files for tracking have them."""
    names = {}
    for video in videos if isinstance(videos, list) else ():
        if isinstance(video, dict):
            name = _file_name(video.get("name") or video.get("file_name"))
            names.update(dict.fromkeys(_id_keys(video.get("id")), name))
    return names


def _example_class(others: Mapping[_Id, str]) -> str:
    return next(iter(others.values()), "NAME")


def _load(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise DataError(f"{path}: no such file; masks coco:FILE needs a COCO JSON file", parameter="masks")
    try:
        data = read_json(path)
    except DataError as err:
        raise DataError(str(err).replace(": not JSON (", ": not a JSON file (", 1), parameter="masks") from None
    if isinstance(data, list):
        if all(isinstance(a, dict) and "image_id" in a for a in data[:100]):
            return {"annotations": data}
    elif isinstance(data, dict):
        images = data.get("images")
        if isinstance(data.get("annotations"), list) and (images is None or isinstance(images, list)):
            return data
    raise DataError(
        f'{path}: JSON, but not COCO; expected an object with lists "images" and "annotations"', parameter="masks"
    )
