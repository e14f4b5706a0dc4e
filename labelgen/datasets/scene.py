"""Scenes: a video, image or session folder together with its calibration, road mask and lanes.

`find_scene` looks for the files, `SceneFiles.open` opens them once, and the `Scene` is handed down.

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

from labelgen.datasets.brnocompspeed import read_ground_truth
from labelgen.datasets.manifest import load_manifest
from labelgen.errors import DataError, RectificationError
from labelgen.geometry.camera import Camera
from labelgen.geometry.frame_size import size_text
from labelgen.geometry.homography import Array
from labelgen.geometry.road_mask import RoadMask, binary_mask, fit_mask
from labelgen.labels import Split
from labelgen.media.frames import FrameSource
from labelgen.media.image_file import read_image
from labelgen.media.open_frames import open_frames
from labelgen.media.stream import VideoStream
from labelgen.output_names import folder_name

__all__ = [
    "Scene",
    "SceneFiles",
    "find_scene",
    "input_name",
    "is_session",
    "open_stream",
    "read_lane_lines",
    "read_mask",
    "size_notes",
]


@dataclass(frozen=True)
class SceneFiles:
    """Where a camera's frames, calibration and road mask are.

    Args:
        name: of the session or the file, for messages and shards.
        frames_path: video file, image file or folder of images; None for a session whose video is not there.
        calibration_path: public JSON.
        mask_path: road mask image.
        picture_path: a picture of the scene, where there is one.
        session: name of the BrnoCompSpeed session, or "".
        fps: frame rate that the data set states; None where it states none.
        ground_truth_path: of a session, where it is there.
        missing: which of "calibration" and "road mask" were found nowhere; their paths mean nothing.
        given_fps: frame rate that the user gives, for frames without time stamps that can be trusted.
        stream: number of the video stream to use, from 0; None takes the largest.
        deinterlace: whether each frame of a video is deinterlaced.
    """

    name: str
    frames_path: Path | None
    calibration_path: Path
    mask_path: Path
    picture_path: Path | None = None
    session: str = ""
    fps: float | None = None
    ground_truth_path: Path | None = None
    missing: frozenset[str] = frozenset()
    given_fps: float | None = None
    stream: int | None = None
    deinterlace: bool = False

    def open_frames(self) -> FrameSource:
        """Open the frames alone.

        Raises:
            DataError: the video is not there, or cannot be read.
        """
        if self.frames_path is None:
            raise DataError(f"{self.name}: its video is not there")
        return open_frames(self.frames_path, fps=self.given_fps, stream=self.stream, deinterlace=self.deinterlace)

    def check_times(self) -> None:
        """Find out whether frames have times.

        Raises:
            DataError: they have none, and neither the user nor the data set gives their rate; or see `open_frames`.
        """
        if not (self.given_fps or self.fps) and (untimed := self.open_frames().untimed):
            raise DataError(f"{self.frames_path}: {untimed}, so there are no speeds; give fps", parameter="fps")

    def camera(self, image_wh: tuple[int, int]) -> Camera:
        """Return the calibration under the scene's name, for frames of `image_wh` px (width, height)."""
        return replace(Camera.load(self.calibration_path, image_wh=image_wh), name=self.name)

    def road(self, image_wh: tuple[int, int] | None = None) -> RoadMask:
        """Return the road mask, for frames of `image_wh` px (width, height); None leaves it at its own size."""
        return RoadMask(read_mask(self.mask_path, image_wh=image_wh))

    def size_notes(self, image_wh: tuple[int, int]) -> tuple[str, ...]:
        """Return what is scaled to frames of `image_wh` px, and what may be of another size, one line each."""
        return size_notes(self.calibration_path, self.mask_path, image_wh)

    def open(self, *, fps: float | None = None) -> Scene:
        """Open the frames, the calibration, the road mask and, for a session, the lanes of its ground truth.

        Args:
            fps: frames per second to use instead of `given_fps`.

        Raises:
            DataError: a file is missing or damaged, or the video is not there.
            CalibrationError: the calibration describes no camera above a road.
        """
        files = self if fps is None else replace(self, given_fps=fps)
        frames = files.open_frames()
        size = frames.size_wh
        lane_lines, notes = read_lane_lines(files)
        notes = (*files.size_notes(size), *notes)
        rate = files.given_fps or files.fps
        return Scene(self, self.name, frames, files.camera(size), files.road(size), rate, lane_lines, notes)

    def split_of(self, frame: int) -> Split:
        """Return the part of the published split C that a frame belongs to; NONE outside the data set."""
        if not self.session:
            return Split.NONE
        rules = load_manifest("brnocompspeed")["splits"]["C"]
        group = self.session.split("_")[0]
        if group in rules["test"]:
            return Split.TEST
        if group in rules["train"]:
            return Split.VALIDATION if frame < rules["validation_frames"] else Split.TRAIN
        return Split.NONE


@dataclass(frozen=True, eq=False)
class Scene:
    """One opened input: made once, handed down.

    Args:
        files: where everything came from; None for a live stream.
        name: for messages and results.
        frames: ready to iterate.
        camera: calibrated, for frames of this size.
        road: the road mask, of the frames' size.
        fps: frames per second that the user or the data set states; None where nobody does.
        lane_lines: (L, 3) homogeneous lines in frame px between which the lanes lie; None where they are not known.
        notes: what could not be read, is scaled or is doubtful, one line each.
    """

    files: SceneFiles | None
    name: str
    frames: FrameSource
    camera: Camera
    road: RoadMask
    fps: float | None = None
    lane_lines: Array | None = None
    notes: tuple[str, ...] = ()


def open_stream(
    url: str,
    *,
    calibration: Path | None,
    road_mask: Path | None,
    duration_s: float | None = None,
    stall_s: float = 30.0,
    fps: float | None = None,
    stream: int | None = None,
    deinterlace: bool = False,
) -> Scene:
    """Open a live camera.

    Args:
        url: of the stream, in any protocol FFmpeg reads.
        calibration, road_mask: their files; a stream has nothing beside it.
        duration_s: stop after this many seconds; None goes on until the stream ends.
        stall_s: seconds without a frame after which the stream counts as broken.
        fps: frames per second of a stream without time stamps.
        stream: number of the video stream to use, from 0; None takes the largest.
        deinterlace: whether each frame is deinterlaced.

    Raises:
        DataError: a file is missing, or the stream cannot be opened.
        CalibrationError: the calibration describes no camera above a road.
    """
    if calibration is None or road_mask is None:
        raise DataError(
            f"{url}: a stream needs a calibration and a road mask of its own", parameter=("calibration", "road_mask")
        )
    # Find out what is wrong with the files before the camera is connected.
    RoadMask(read_mask(road_mask))
    Camera.load(calibration)
    frames = VideoStream(url, duration_s=duration_s, stall_s=stall_s, fps=fps, stream=stream, deinterlace=deinterlace)
    size = frames.size_wh
    road = RoadMask(read_mask(road_mask, image_wh=size))
    notes = size_notes(calibration, road_mask, size)
    return Scene(None, frames.name, frames, Camera.load(calibration, image_wh=size), road, fps, notes=notes)


def input_name(path: Path) -> str:
    """Return the name of an input for its results: that of a folder, or of a file without its extension."""
    return folder_name(path.resolve().name if path.is_dir() else path.stem)


def is_session(folder: Path) -> bool:
    """Return whether a folder is a session's of the BrnoCompSpeed layout."""
    layout = load_manifest("brnocompspeed")["layout"]
    return any((folder / layout[part]).is_file() for part in ("road_mask", "ground_truth"))


def find_scene(
    path: str | Path,
    *,
    calibration: str | Path | None = None,
    road_mask: str | Path | None = None,
    need_frames: bool = True,
    may_lack: bool = False,
    fps: float | None = None,
    stream: int | None = None,
    deinterlace: bool = False,
) -> SceneFiles:
    """Find what belongs to a video, image or session folder.

    Args:
        path: video file, image file, folder of images, or session folder.
        calibration, road_mask: use these instead of looking beside the input.
        need_frames: whether a session without its video is an error.
        may_lack: whether a calibration or road mask that is found nowhere is named in `SceneFiles.missing` rather
            than being an error.
        fps, stream, deinterlace: `given_fps`, `stream` and `deinterlace` of the `SceneFiles`.

    Raises:
        DataError: no such input, or something is missing; names everything that is, and where it was looked for.
    """
    path = Path(path)
    calibration, road_mask = (None if file is None else Path(file) for file in (calibration, road_mask))
    scene, missing = _find(path, calibration, road_mask, need_frames)
    given = {"calibration": calibration, "road mask": road_mask}
    lacking = {name for name, file in given.items() if may_lack and file is None and name in missing}
    reasons = {name: text for name, text in missing.items() if name not in lacking}
    if reasons:
        parameters = tuple(name.replace(" ", "_") for name in reasons if name in given)
        raise DataError(f"{path}: {'; '.join(reasons.values())}", parameter=parameters)
    return replace(scene, missing=frozenset(lacking), given_fps=fps, stream=stream, deinterlace=deinterlace)


def _find(
    path: Path, calibration: Path | None, road_mask: Path | None, need_frames: bool
) -> tuple[SceneFiles, dict[str, str]]:
    """Return the files of a scene, and in words what is missing of it."""
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    layout = load_manifest("brnocompspeed")["layout"]
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    if is_session(folder) and (path.is_dir() or path.name in (*layout["videos"], layout["empty_road"])):
        return _session(path, folder, layout, calibration, road_mask, need_frames)
    missing: dict[str, str] = {}
    places = _beside(path, ".calibration.json")
    calibration = _choose("calibration", calibration, places, missing)
    road_mask = _choose("road mask", road_mask, _beside(path, ".mask.png"), missing)
    name = input_name(path)
    picture = path if path.is_file() else None
    truth = _ground_truth(folder, layout)
    return SceneFiles(name, path, calibration, road_mask, picture, ground_truth_path=truth), missing


def _ground_truth(folder: Path, layout: dict[str, Any]) -> Path | None:
    path = folder / layout["ground_truth"]
    return path if path.is_file() else None


def _beside(path: Path, suffix: str) -> list[Path]:
    """Return where NAME plus suffix may be: beside a folder by its real name, beside a file or its link's target."""
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
) -> tuple[SceneFiles, dict[str, str]]:
    manifest = load_manifest("brnocompspeed")
    name = folder.name
    missing: dict[str, str] = {}
    results = (folder / layout["results"] / name).resolve()
    places = [results / file for file in layout["calibrations"]]
    places += [place for place in sorted(results.glob("system_*.json")) if place not in places]
    calibration = _choose("calibration", calibration, places, missing)
    road_mask = _choose("road mask", road_mask, [folder / layout["road_mask"]], missing)
    videos = [folder / video for video in layout["videos"]]
    frames = path if path.is_file() else next((video for video in videos if video.is_file()), None)
    if frames is None and need_frames:
        missing["video"] = f"no video ({' or '.join(layout['videos'])} in {folder})"
    empty_road = folder / layout["empty_road"]
    known = re.match(layout["session"], name) is not None
    rate = manifest["rates"].get(name, manifest["rates"]["default"]) if known else None
    picture = empty_road if empty_road.is_file() else None
    session, truth = name if known else "", _ground_truth(folder, layout)
    return SceneFiles(name, frames, calibration, road_mask, picture, session, rate, truth), missing


def _choose(what: str, given: Path | None, places: list[Path], missing: dict[str, str]) -> Path:
    if given is not None:
        if not given.is_file():
            missing[what] = f"no {what} at {given}"
        return given
    for place in places:
        if place.is_file():
            return place
    looked = f"looked for {places[0].name} in {places[0].parent}" if places else "none is known"
    missing[what] = f"no {what} ({looked})"
    return places[0] if places else Path()


def read_mask(path: Path, *, image_wh: tuple[int, int] | None = None) -> NDArray[np.bool_]:
    """Read a road mask (H, W) bool from an image file.

    Args:
        path: the file.
        image_wh: size of the frames, px; a mask of another size and the same ratio is resized. None leaves it.

    Raises:
        DataError: missing, no image, or of frames of another ratio.
    """
    try:
        mask = binary_mask(read_image(path, cv2.IMREAD_UNCHANGED))
    except DataError as err:
        raise DataError(f"road mask {err}") from None
    try:
        return mask if image_wh is None else fit_mask(mask, image_wh)
    except RectificationError as err:
        raise DataError(str(err).replace("road mask:", f"road mask {path}:", 1), parameter=err.parameters) from None


def size_notes(calibration: Path, road_mask: Path | None, image_wh: tuple[int, int]) -> tuple[str, ...]:
    """Return what is scaled to frames of `image_wh` px, and what may be of another size, one line each.

    Args:
        calibration, road_mask: their files; None for no road mask.
        image_wh: size of the frames, px.

    Raises:
        DataError, CalibrationError: a file cannot be read, or is of frames of another ratio.
    """
    camera = Camera.load(calibration)
    notes = []
    own = camera.own_wh(image_wh)
    if own is not None and own != tuple(image_wh):
        why = "" if camera.image_wh else ", as its principal point shows"
        notes.append(f"calibration {calibration.name}: of {size_text(own)} px{why}, {_scaled_to(image_wh)}")
    if road_mask is not None and (mask_wh := read_mask(road_mask).shape[::-1]) != tuple(image_wh):
        notes.append(f"road mask {road_mask.name}: of {size_text(mask_wh)} px, {_scaled_to(image_wh)}")
    doubt = camera.fitted_to(image_wh).size_doubt()
    return (*notes, *([doubt] if doubt else []))


def _scaled_to(image_wh: tuple[int, int]) -> str:
    return f"scaled to the frames' {size_text(image_wh)}"


def read_lane_lines(files: SceneFiles) -> tuple[Array | None, tuple[str, ...]]:
    """Read the lines between a session's lanes from its ground truth.

    Returns:
        (L, 3) homogeneous lines in frame px, or None where there is no ground truth; and what is wrong with it.
    """
    if files.ground_truth_path is None:
        return None, ()
    try:
        return read_ground_truth(files.ground_truth_path).lane_lines, ()
    except DataError as err:
        return None, (f"lanes are not known: {err}",)
