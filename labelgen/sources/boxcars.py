"""BoxCars116k: vehicle crops with 3D boxes in full-frame pixels.

Layout (facts checked on the data set): dataset.pkl and json_data/dataset.json hold the same
`{cameras: {name: {vp1, vp2, vp3, pp}}, samples: [{camera, to_camera, annotation, instances: [...]}]}`; crops are
in images/ or, JPEG-encoded, in atlas.pkl[vehicle][instance]. Crop pixels are frame pixels minus 3DBB_offset.

Source: Sochor et al., IEEE T-ITS 2019.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import CalibrationError, DataError
from labelgen.geometry.camera import Camera
from labelgen.geometry.projective import Array
from labelgen.labels import Split
from labelgen.sources.pickles import load_pickle

__all__ = ["BoxCars", "Instance"]

_SPLITS = {"train": Split.TRAIN, "validation": Split.VALIDATION, "test": Split.TEST}


@dataclass(frozen=True)
class Instance:
    """One crop of one vehicle.

    Args:
        vehicle, number: its place in the data set and in the atlas.
        path: of its crop below images/.
        camera: name of its camera.
        to_camera: whether the vehicle drives towards the camera.
        vertices_px: (8, 2) the 3D box, frame px; None where it is damaged.
        offset_px: (2,) frame px of the crop's first pixel.
        problem: what is wrong with the entry, or "".
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
        root: its folder.
        layout: from the data manifest.
        split: name of the classification split to look up; None for none.
        default_split: the one to look up without `split`, where the data set has it.

    Raises:
        DataError: wrong layout or damaged files.
    """

    def __init__(
        self, root: Path, layout: Mapping[str, Any], split: str | None = None, *, default_split: str = ""
    ) -> None:
        self.root = root
        present = [root / name for name in layout["annotations"] if (root / name).is_file()]
        if not present:
            raise DataError(
                f"{root}: not a BoxCars116k tree, neither {' nor '.join(layout['annotations'])} is in it; "
                "give the folder that holds them as --root"
            )
        self.annotations = present[0]
        self.images = root / layout["images"]
        self._atlas_path = root / layout["atlas"]
        if self.from_atlas and not self._atlas_path.is_file():
            raise DataError(f"{root}: no pictures, neither {layout['images']}/ nor {layout['atlas']} is in it")
        self._atlas: Any = load_pickle(self._atlas_path) if self.from_atlas else []
        data = _load_annotations(self.annotations)
        self._samples: list[Any] = data["samples"]
        self.cameras, self.bad_cameras = _cameras(data["cameras"])
        self.vanishing_points = {name: _vps(data["cameras"][name], camera) for name, camera in self.cameras.items()}
        self._splits = _load_splits(root / layout["splits"], split, default_split)

    def __getstate__(self) -> dict[str, Any]:
        # Worker processes get their instances with the work and need only what reads crops.
        return {**self.__dict__, "_samples": [], "_splits": {}}

    @property
    def from_atlas(self) -> bool:
        """Whether crops come from the atlas, which one process has to hold in memory."""
        return not self.images.is_dir()

    def instances(self) -> Iterator[Instance]:
        """All instances, in the order of the data set."""
        for vehicle, sample in enumerate(self._samples):
            instances = sample.get("instances") if isinstance(sample, Mapping) else None
            if not isinstance(instances, list | tuple):
                yield _damaged(vehicle, 0, "its vehicle has no list of instances")
                continue
            for number, entry in enumerate(instances):
                yield _instance(vehicle, number, sample, entry)

    def split_of(self, vehicle: int) -> Split:
        """Classification split of a vehicle; NONE where it is in none."""
        return self._splits.get(vehicle, Split.NONE)

    def read_crop(self, instance: Instance) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 BGR crop.

        Raises:
            DataError: missing or no picture.
        """
        if self.from_atlas:
            encoded = self._from_atlas(instance)
        else:
            path = self.images / instance.path
            try:
                encoded = np.fromfile(path, dtype=np.uint8)
            except OSError as err:
                raise DataError(f"{path}: {err.strerror or err}") from None
        image = cv2.imdecode(encoded, cv2.IMREAD_COLOR) if encoded.size else None
        if image is None:
            raise DataError("its picture cannot be decoded")
        return image  # type: ignore[return-value]

    def _from_atlas(self, instance: Instance) -> NDArray[np.uint8]:
        try:
            encoded = self._atlas[instance.vehicle][instance.number]
            return np.frombuffer(encoded, dtype=np.uint8)
        except (LookupError, TypeError, ValueError) as err:
            raise DataError(f"not in {self._atlas_path.name} ({err})") from None


def _load_annotations(path: Path) -> dict[str, Any]:
    data: Any
    if path.suffix == ".pkl":
        data = load_pickle(path)
    else:
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except OSError as err:
            raise DataError(f"{path}: {err.strerror or err}") from None
        except ValueError as err:
            raise DataError(f"{path}: not JSON ({err}); get the file from its publisher again") from None
    wrong = not isinstance(data, dict) or not isinstance(data.get("samples"), list)
    if wrong or not isinstance(data.get("cameras"), dict):
        raise DataError(f"{path}: not BoxCars116k annotations; expected 'cameras' and 'samples' in it")
    return dict(data)


def _cameras(entries: Mapping[str, Any]) -> tuple[dict[str, Camera], dict[str, str]]:
    good: dict[str, Camera] = {}
    bad: dict[str, str] = {}
    for name, entry in entries.items():
        try:
            good[name] = Camera.from_dict(entry, name=str(name))
        except CalibrationError as err:
            bad[name] = str(err)
    return good, bad


def _vps(entry: Mapping[str, Any], camera: Camera) -> Array:
    """(3, 2) vanishing points. The annotated boxes follow the data set's own VP3, not the derived one."""
    vp3 = np.asarray(entry.get("vp3", camera.vp3), dtype=np.float64)
    if vp3.shape != (2,) or not np.isfinite(vp3).all():
        vp3 = camera.vp3
    return np.stack([camera.vp1, camera.vp2, vp3])


def _load_splits(path: Path, asked: str | None, default: str) -> dict[int, Split]:
    if not path.is_file():
        if asked:
            raise DataError(f"--split {asked}: there is no {path}")
        return {}
    data = load_pickle(path)
    known = data if isinstance(data, dict) else {}
    name = asked or default
    if name not in known:
        if asked:
            raise DataError(f"--split {asked}: not in {path}; it has {', '.join(map(str, known)) or 'none'}")
        return {}
    try:
        return {int(vehicle): split for part, split in _SPLITS.items() for vehicle, _ in known[name][part]}
    except (KeyError, TypeError, ValueError):
        raise DataError(f"{path}: split {name!r} is not of the form train, validation, test") from None


def _damaged(vehicle: int, number: int, problem: str) -> Instance:
    nothing = np.full((8, 2), np.nan)
    return Instance(vehicle, number, "", "", False, nothing, nothing[0], problem)


def _instance(vehicle: int, number: int, sample: Mapping[str, Any], entry: Any) -> Instance:
    try:
        path, camera, to_camera = str(entry["path"]), str(sample["camera"]), bool(sample["to_camera"])
        vertices = np.asarray(entry["3DBB"], dtype=np.float64)
        offset = np.asarray(entry["3DBB_offset"], dtype=np.float64)
    except KeyError as err:
        return _damaged(vehicle, number, f"its entry lacks {err}")
    except (TypeError, ValueError):
        return _damaged(vehicle, number, "its entry is not of the expected form")
    problem = ""
    if vertices.shape != (8, 2) or not np.isfinite(vertices).all():
        problem = "its 3D box is not 8 finite points"
    elif offset.shape != (2,) or not np.isfinite(offset).all():
        problem = "its 3DBB_offset is not 2 finite numbers"
    elif Path(path).is_absolute() or ".." in Path(path).parts:
        problem = f"its path {path!r} leads out of the data set"
    if problem:
        vertices, offset = np.full((8, 2), np.nan), np.full(2, np.nan)
    return Instance(vehicle, number, path, camera, to_camera, vertices, offset, problem)
