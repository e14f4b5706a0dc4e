"""BoxCars116k: vehicle crops with 3D boxes in full-frame pixels.

Layout, checked on the data set itself: dataset.pkl and json_data/dataset.json hold the same
`{cameras: {name: {vp1, vp2, vp3, pp}}, samples: [{camera, to_camera, annotation, instances: [...]}]}`. Crops are image
files in images/, or JPEG bytes in `atlas.pkl[vehicle][instance]`. Crop pixels are frame pixels minus `3DBB_offset`.

Source: Sochor, Spanhel, Herout, "BoxCars: Improving Fine-Grained Recognition of Vehicles Using 3-D Bounding Boxes in
Traffic Surveillance", IEEE T-ITS 2019.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.datasets.safe_pickle import load_pickle
from labelgen.errors import CalibrationError, DataError
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array
from labelgen.json_file import read_json
from labelgen.labels import Split
from labelgen.media.image_file import decode_image, read_image

__all__ = ["BoxCars", "Instance"]

_SPLITS = {"train": Split.TRAIN, "validation": Split.VALIDATION, "test": Split.TEST}


@dataclass(frozen=True)
class Instance:
    """One crop of one vehicle.

    Args:
        vehicle: index of the vehicle in the data set and in the atlas.
        number: index of the crop among those of its vehicle.
        path: path of the crop below images/.
        camera: name of the camera.
        to_camera: whether the vehicle drives towards the camera.
        vertices_px: (8, 2) vertices of the 3D box, frame px; NaN where the entry is damaged.
        offset_px: (2,) frame px (x, y) of the crop's first pixel; NaN where the entry is damaged.
        problem: what is wrong with the entry; empty where nothing is.
    """

    vehicle: int
    number: int
    path: str
    camera: str
    to_camera: bool
    vertices_px: Array
    offset_px: Array
    problem: str = ""


class BoxCars:
    """An opened BoxCars116k tree.

    Args:
        root: folder of the tree.
        layout: `layout` of the data manifest.
        split: name of the classification split to look up; None takes the default.
        default_split: the classification split to look up without `split`, where the data set has it.

    Attributes:
        annotations: path of the annotations.
        atlas: path of the atlas; None where crops are image files.
        split_name: name of the classification split; None where none is used.
        splits: path of the file of splits; None where none is used.
        cameras: cameras by name.
        bad_cameras: problem of each camera without a usable calibration, by name.
        vanishing_points: (3, 2) vanishing points VP1, VP2, VP3, px, by camera.

    Raises:
        DataError: wrong layout, damaged files, or an unknown split.
    """

    def __init__(
        self, root: Path, layout: Mapping[str, Any], split: str | None = None, *, default_split: str = ""
    ) -> None:
        self.root = root
        present = [root / name for name in layout["annotations"] if (root / name).is_file()]
        if not present:
            raise DataError(
                f"{root}: not a BoxCars116k tree, neither {' nor '.join(layout['annotations'])} is in it; "
                "give the folder that holds them",
                parameter="root",
            )
        self.annotations = present[0]
        self.images = root / layout["images"]
        self.atlas = None if self.images.is_dir() else root / layout["atlas"]
        if self.atlas is not None and not self.atlas.is_file():
            raise DataError(
                f"{root}: no pictures, neither {layout['images']}/ nor {layout['atlas']} is in it", parameter="root"
            )
        self._atlas: Any = load_pickle(self.atlas) if self.atlas is not None else []
        data = _load_annotations(self.annotations)
        self._samples: list[Any] = data["samples"]
        self.cameras: dict[str, Camera] = {}
        self.vanishing_points: dict[str, Array] = {}
        self.bad_cameras: dict[str, str] = {}
        for key, entry in data["cameras"].items():
            name = _text(key)
            try:
                camera = Camera.from_dict(entry, name=name)
                self.vanishing_points[name] = _vanishing_points(entry, camera)
                self.cameras[name] = camera
            except CalibrationError as err:
                self.bad_cameras[name] = str(err)
        path = root / layout["splits"]
        self.split_name, self._splits = _load_splits(path, split, default_split)
        self.splits = None if self.split_name is None else path

    def __getstate__(self) -> dict[str, Any]:
        # Worker processes get their instances with their work; they only read crops.
        return {**self.__dict__, "_samples": [], "_splits": {}}

    @property
    def from_atlas(self) -> bool:
        """Whether crops come from the atlas, which the process holds in memory as a whole."""
        return self.atlas is not None

    def instances(self) -> Iterator[Instance]:
        """Yield all instances in the order of the data set; a damaged entry is one instance with a `problem`."""
        for vehicle, sample in enumerate(self._samples):
            instances = _listed(sample.get("instances")) if isinstance(sample, Mapping) else None
            if instances is None:
                yield _damaged(vehicle, 0, "its vehicle has no list of instances")
                continue
            for number, entry in enumerate(instances):
                yield _instance(vehicle, number, sample, entry)

    def split_of(self, vehicle: int) -> Split:
        """Return the part of the classification split that a vehicle is in; NONE where it is in none."""
        return self._splits.get(vehicle, Split.NONE)

    def read_crop(self, instance: Instance) -> NDArray[np.uint8]:
        """Read a crop, (H, W, 3) uint8 BGR.

        Raises:
            DataError: the crop is missing or not an image.
        """
        # The messages become part of the shards, which must not depend on where the data set lies.
        if self.atlas is None:
            return read_image(self.images / instance.path, label=f"{self.images.name}/{instance.path}")
        label = f"{self.atlas.name}[{instance.vehicle}][{instance.number}]"
        try:
            encoded = self._atlas[instance.vehicle][instance.number]
        except (LookupError, TypeError):
            raise DataError(f"{label}: not there") from None
        try:
            return decode_image(np.frombuffer(encoded, dtype=np.uint8), label)
        except (TypeError, ValueError, BufferError):
            raise DataError(f"{label}: not an image") from None


def _load_annotations(path: Path) -> dict[str, Any]:
    """Load `cameras` and `samples` from the pickle or the JSON file."""
    data: Any
    if path.suffix == ".pkl":
        data = load_pickle(path)
    else:
        data = read_json(path, hint="; get the file from its publisher again")
    samples = _listed(data.get("samples")) if isinstance(data, dict) else None
    if samples is None or not isinstance(data.get("cameras"), dict):
        raise DataError(f"{path}: not BoxCars116k annotations; expected 'cameras' and 'samples' in it")
    return {"cameras": data["cameras"], "samples": samples}


def _listed(value: Any) -> list[Any] | None:
    """Return the items of a list, tuple or 1D array; None for anything else."""
    is_list = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim == 1)
    return list(value) if is_list else None


def _text(value: Any) -> str:
    """Return a name as text that can be written to any file: names may be numbers or hold lone surrogates."""
    return str(value).encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")


def _points(value: Any, shape: tuple[int, ...]) -> Array | None:
    """Return finite coordinates of this shape; None for anything else."""
    try:
        points = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return points if points.shape == shape and np.isfinite(points).all() else None


def _vanishing_points(entry: Mapping[str, Any], camera: Camera) -> Array:
    """Return (3, 2) vanishing points, px. The annotated boxes follow the data set's own VP3, not the derived one.

    Raises:
        CalibrationError: the data set's VP3 is damaged.
    """
    given = entry.get("vp3")
    vp3 = camera.vp3 if given is None else _points(given, (2,))
    if vp3 is None:
        raise CalibrationError(f"camera {camera.name}: its vp3 is not two finite numbers")
    return np.stack([camera.vp1, camera.vp2, vp3])


def _load_splits(path: Path, split: str | None, default: str) -> tuple[str | None, dict[int, Split]]:
    """Return the name of the split in use and the part of each vehicle; None and nothing where there is none."""
    if not path.is_file():
        if split:
            raise DataError(f"split {split}: there is no {path}", parameter="split")
        return None, {}
    data = load_pickle(path)
    known = data if isinstance(data, dict) else {}
    name = split or default
    if name not in known:
        if split:
            names = ", ".join(map(_text, known)) or "none"
            raise DataError(f"split {split}: not in {path}; it has {names}", parameter="split")
        return None, {}
    try:
        return name, {int(vehicle): part for key, part in _SPLITS.items() for vehicle, _ in known[name][key]}
    except (LookupError, TypeError, ValueError, OverflowError):
        raise DataError(f"{path}: split {name!r} is not of the form train, validation, test") from None


def _damaged(vehicle: int, number: int, problem: str) -> Instance:
    """Return an instance that only states a problem."""
    vertices = np.full((8, 2), np.nan)
    return Instance(vehicle, number, "", "", False, vertices, vertices[0], problem)


def _instance(vehicle: int, number: int, sample: Mapping[str, Any], entry: Any) -> Instance:
    """Read one entry of the annotations; a damaged one gives an instance with a `problem`."""
    try:
        path, camera, to_camera = str(entry["path"]), _text(sample["camera"]), bool(sample["to_camera"])
        vertices, offset = _points(entry["3DBB"], (8, 2)), _points(entry["3DBB_offset"], (2,))
    except KeyError as err:
        return _damaged(vehicle, number, f"its entry lacks {err}")
    except (IndexError, TypeError, ValueError, OverflowError, RecursionError):
        return _damaged(vehicle, number, "its entry is not of the expected form")
    name = _text(path)
    if name != path:
        problem = "its path is no file's name"
    elif Path(path).is_absolute() or ".." in Path(path).parts:
        problem = f"its path {path!r} leads out of the data set"
    elif vertices is None:
        problem = "its 3D box is not 8 finite points"
    elif offset is None:
        problem = "its 3DBB_offset is not 2 finite numbers"
    else:
        return Instance(vehicle, number, path, camera, to_camera, vertices, offset)
    return replace(_damaged(vehicle, number, problem), path=name, camera=camera, to_camera=to_camera)
