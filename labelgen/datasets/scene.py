"""Scenes: a video, image or session folder together with its calibration and road mask.

A session is a folder of the BrnoCompSpeed layout (see data_manifests/brnocompspeed.toml). Beside any other
video NAME.ext lie NAME.calibration.json and NAME.mask.png.

Source: Sochor et al., IEEE T-ITS 2018 (layout, split C).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.datasets.manifest import load_manifest
from labelgen.errors import DataError
from labelgen.geometry.camera import Camera
from labelgen.geometry.road_mask import RoadMask, binary_mask
from labelgen.labels import Split
from labelgen.media.image_file import read_image

__all__ = ["Scene", "find_scene", "find_scene_parts", "is_session", "read_mask"]


@dataclass(frozen=True)
class Scene:
    """Where a camera's frames, calibration and road mask are.

    Args:
        name: of the session or the file, for messages and shards.
        frames_path: video file, image file or folder of images; None for a session whose video is not there.
        calibration_path: public JSON.
        mask_path: road mask image.
        picture_path: a picture of the scene, where there is one.
        session: name of the BrnoCompSpeed session, or "".
        fps: frame rate that the data set states; None where it states none.
    """

    name: str
    frames_path: Path | None
    calibration_path: Path
    mask_path: Path
    picture_path: Path | None = None
    session: str = ""
    fps: float | None = None

    def camera(self, image_wh: tuple[int, int]) -> Camera:
        """The calibration, for frames of this size, under the scene's name."""
        return replace(Camera.load(self.calibration_path, image_wh=image_wh), name=self.name)

    def road(self) -> RoadMask:
        """The road mask."""
        return RoadMask(read_mask(self.mask_path))

    def split_of(self, frame: int) -> Split:
        """Part of the published split C; NONE outside the data set."""
        if not self.session:
            return Split.NONE
        rules = load_manifest("brnocompspeed")["splits"]["C"]
        group = self.session.split("_")[0]
        if group in rules["test"]:
            return Split.TEST
        if group in rules["train"]:
            return Split.VALIDATION if frame < rules["validation_frames"] else Split.TRAIN
        return Split.NONE


def is_session(folder: Path) -> bool:
    """Whether a folder is a session's of the BrnoCompSpeed layout."""
    layout = load_manifest("brnocompspeed")["layout"]
    return any((folder / layout[part]).is_file() for part in ("road_mask", "ground_truth"))


def find_scene(
    path: Path, *, calibration: Path | None = None, road_mask: Path | None = None, need_frames: bool = True
) -> Scene:
    """Find what belongs to a video, image or session folder.

    Args:
        path: video file, image file, folder of images, or session folder.
        calibration, road_mask: use these instead of looking beside the input.
        need_frames: whether a session without its video is an error.

    Raises:
        DataError: something is missing; names everything that is, and where it was looked for.
    """
    scene, missing = _find(path, calibration, road_mask, need_frames)
    _complain(path, missing)
    return scene


def find_scene_parts(
    path: Path, *, calibration: Path | None = None, road_mask: Path | None = None
) -> tuple[Scene, set[str]]:
    """As `find_scene`, for those who can do without a calibration or a road mask.

    Returns:
        the scene, and which of "calibration" and "road mask" were found nowhere: their paths mean nothing.

    Raises:
        DataError: no such input, a session without its video, or a file that was given is not there.
    """
    scene, missing = _find(path, calibration, road_mask, True)
    given = {"calibration": calibration, "road mask": road_mask}
    made = {name for name, file in given.items() if file is None and name in missing}
    _complain(path, {name: text for name, text in missing.items() if name not in made})
    return scene, made


def _find(
    path: Path, calibration: Path | None, road_mask: Path | None, need_frames: bool
) -> tuple[Scene, dict[str, str]]:
    """A scene, and what is missing of it, in words."""
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    layout = load_manifest("brnocompspeed")["layout"]
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    if is_session(folder) and (path.is_dir() or path.name in (*layout["videos"], layout["empty_road"])):
        return _session(path, folder, layout, calibration, road_mask, need_frames)
    missing: dict[str, str] = {}
    places = _beside(path, ".calibration.json")
    calibration = _choose("calibration", "--calibration", calibration, places, missing)
    road_mask = _choose("road mask", "--road-mask", road_mask, _beside(path, ".mask.png"), missing)
    name = path.resolve().name if path.is_dir() else path.stem
    return Scene(name, path, calibration, road_mask, path if path.is_file() else None), missing


def _beside(path: Path, suffix: str) -> list[Path]:
    """Where NAME plus suffix may be: beside a folder by its real name, beside a file or what it is a link to."""
    if path.is_dir():
        return [path.resolve().parent / (path.resolve().name + suffix)]
    return [place.parent / (place.stem + suffix) for place in dict.fromkeys([path.absolute(), path.resolve()])]


def _session(
    path: Path,
    folder: Path,
    layout: dict[str, Any],
    calibration: Path | None,
    road_mask: Path | None,
    need_frames: bool,
) -> tuple[Scene, dict[str, str]]:
    manifest = load_manifest("brnocompspeed")
    name = folder.name
    missing: dict[str, str] = {}
    results = (folder / layout["results"] / name).resolve()
    places = [results / file for file in layout["calibrations"]]
    places += [place for place in sorted(results.glob("system_*.json")) if place not in places]
    calibration = _choose("calibration", "--calibration", calibration, places, missing)
    road_mask = _choose("road mask", "--road-mask", road_mask, [folder / layout["road_mask"]], missing)
    videos = [folder / video for video in layout["videos"]]
    frames = path if path.is_file() else next((video for video in videos if video.is_file()), None)
    if frames is None and need_frames:
        missing["video"] = f"no video ({' or '.join(layout['videos'])} in {folder})"
    empty_road = folder / layout["empty_road"]
    known = re.match(layout["session"], name) is not None
    rate = manifest["rates"].get(name, manifest["rates"]["default"]) if known else None
    picture = empty_road if empty_road.is_file() else None
    return Scene(name, frames, calibration, road_mask, picture, name if known else "", rate), missing


def _choose(what: str, option: str, given: Path | None, places: list[Path], missing: dict[str, str]) -> Path:
    if given is not None:
        if not given.is_file():
            missing[what] = f"no {what} at {option} {given}"
        return given
    for place in places:
        if place.is_file():
            return place
    looked = f"looked for {places[0].name} in {places[0].parent}" if places else "none is known"
    missing[what] = f"no {what} ({looked}; give {option} FILE)"
    return places[0] if places else Path()


def _complain(path: Path, missing: dict[str, str]) -> None:
    if missing:
        raise DataError(f"{path}: {'; '.join(missing.values())}")


def read_mask(path: Path) -> NDArray[np.bool_]:
    """(H, W) bool road mask from an image file.

    Raises:
        DataError: missing or no image.
    """
    try:
        return binary_mask(read_image(path, cv2.IMREAD_UNCHANGED))
    except DataError as err:
        raise DataError(f"road mask {err}") from None
