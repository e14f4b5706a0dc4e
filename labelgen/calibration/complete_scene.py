"""A scene without calibration or road mask, completed from its video alone; what was made is kept and used again."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from labelgen.atomic_files import as_output_error, make_folder, write_json
from labelgen.calibration.observation.collect import observe
from labelgen.calibration.pipeline import Calibration, calibrate_video
from labelgen.calibration.road_mask import estimate_road_mask, write_mask
from labelgen.calibration.scale.methods import parse_scale_method
from labelgen.datasets.fingerprint import fingerprint
from labelgen.datasets.scene import SceneFiles
from labelgen.errors import CalibrationError, OutputError
from labelgen.geometry import Camera
from labelgen.json_file import parse_json
from labelgen.media.frame_notes import frame_notes
from labelgen.media.frames import FrameSource

__all__ = ["CALIBRATION_NAME", "ROAD_MASK_NAME", "calibrate_with_scale", "complete_scene"]

CALIBRATION_NAME, ROAD_MASK_NAME = "calibration.json", "road_mask.png"
_ORIGINS_NAME = "made_from.json"

_log = logging.getLogger(__name__)


def complete_scene(
    files: SceneFiles, folder: Path, *, scale: str = "auto-models", need_scale: bool = True, overwrite: bool = False
) -> SceneFiles:
    """Calibrate a video and mark its road, where `SceneFiles.missing` says that they are not there.

    Args:
        files: of `labelgen.datasets.scene.find_scene` with `may_lack`.
        folder: where what is made is kept; what an earlier run made there from the same video is used again.
        scale: method of the scale, see `labelgen.calibration.scale.methods`.
        need_scale: whether a video that gives no scale is an error; without one there are no metres.
        overwrite: whether what was made from another video of the same name is made anew.

    Returns:
        the files, none missing.

    Raises:
        DataError: the video cannot be read.
        CalibrationError: the video cannot carry a calibration or a road mask; says why.
        OutputError: what was made cannot be written, or belongs to another video of the same name.
    """
    if not files.missing:
        return files
    made_files = {"calibration": folder / CALIBRATION_NAME, "road mask": folder / ROAD_MASK_NAME}
    foreign = _made_from_another(files, folder, made_files)
    if foreign and not overwrite:
        raise OutputError(
            f"{made_files[min(foreign)]}: it was made from another video of that name; choose another folder, or "
            "overwrite it",
            parameter="overwrite",
        )
    to_make = {what for what in files.missing if what in foreign or not made_files[what].is_file()}
    for what in sorted(files.missing - to_make):
        _log.info("%s: no %s given; using %s of an earlier run", files.name, what, made_files[what])
    scene = replace(
        files,
        calibration_path=made_files["calibration"] if "calibration" in files.missing else files.calibration_path,
        mask_path=made_files["road mask"] if "road mask" in files.missing else files.mask_path,
        missing=frozenset(),
    )
    if to_make:
        them = "it" if len(to_make) == 1 else "them"
        absent = " and no ".join(sorted(to_make))
        _log.info("%s: no %s given; making %s from the video itself", files.name, absent, them)
        _make(scene, to_make, scale, need_scale)
    return scene


def _make(scene: SceneFiles, missing: set[str], scale: str, need_scale: bool) -> None:
    """Make what is missing of a scene, in one pass over its video."""
    frames = scene.open_frames()
    with frame_notes(frames):
        _make_from(frames, scene, missing, scale, need_scale)


def _make_from(frames: FrameSource, scene: SceneFiles, missing: set[str], scale: str, need_scale: bool) -> None:
    if "calibration" in missing:
        calibration = calibrate_with_scale(frames, [scale], need_scale=need_scale)
        camera, observations = calibration.camera, calibration.observations
        _note_origin(scene, scene.calibration_path)
        write_json(scene.calibration_path, calibration.to_dict())
        confidence = calibration.confidence()["overall"]
        _log.info("%s: calibrated, confidence %.2f: %s", scene.name, confidence, scene.calibration_path)
        for doubt in calibration.doubts:
            _log.warning("%s: %s", scene.name, doubt)
    else:
        camera = Camera.load(scene.calibration_path, image_wh=frames.size_wh)
        observations = observe(frames)
    if "road mask" in missing:
        road = estimate_road_mask(camera, observations.tracks)
        _note_origin(scene, scene.mask_path)
        write_mask(scene.mask_path, road.pixels)
        _log.info("%s: road marked, %.0f%% of the picture: %s", scene.name, 100 * road.pixels.mean(), scene.mask_path)


def _origin(files: SceneFiles) -> str:
    """Return the identity of a scene's video."""
    assert files.frames_path is not None
    return fingerprint(files.frames_path) + ("" if files.stream is None else f" stream {files.stream}")


def _origins(folder: Path) -> dict[str, str]:
    """Return of which videos the files of a folder were made, by their names, as far as that is noted."""
    try:
        data = parse_json((folder / _ORIGINS_NAME).read_bytes())
    except (OSError, ValueError):
        return {}
    return {str(name): str(origin) for name, origin in data.items()} if isinstance(data, dict) else {}


def _made_from_another(files: SceneFiles, folder: Path, made_files: Mapping[str, Path]) -> set[str]:
    """Return what is there of the missing files, but was made from another video."""
    origins = _origins(folder)
    there = {what for what in files.missing if made_files[what].is_file() and made_files[what].name in origins}
    return {what for what in there if origins[made_files[what].name] != _origin(files)} if there else set()


def _note_origin(scene: SceneFiles, path: Path) -> None:
    """Note of which video a file is about to be made; one of another video goes first."""
    folder = make_folder(path.absolute().parent)
    with as_output_error(path):
        path.unlink(missing_ok=True)
    write_json(folder / _ORIGINS_NAME, {**_origins(folder), path.name: _origin(scene)})


def calibrate_with_scale(
    frames: FrameSource,
    scale: Sequence[str],
    *,
    need_scale: bool,
    pp: ArrayLike | None = None,
    duration_s: float | None = None,
) -> Calibration:
    """Calibrate a video, scale included.

    Args:
        frames: the video.
        scale: methods of the scale, see `labelgen.calibration.scale.methods`.
        need_scale: whether a video that gives no scale is an error; otherwise a warning is logged.
        pp, duration_s: see `labelgen.calibration.pipeline.calibrate_video`.

    Raises:
        CalibrationError: the video cannot carry a calibration, or no scale where one is needed; says why.
    """
    method = parse_scale_method(scale)
    calibration = calibrate_video(frames, pp=pp, duration_s=duration_s)
    try:
        estimate = method(calibration.camera, calibration.silhouettes)
    except CalibrationError as err:
        if need_scale:
            raise
        _log.warning("%s: no scale, so there are no metres: %s", frames.name, err)
        return calibration
    return replace(calibration, camera=replace(calibration.camera, scale=estimate.scale), scale=estimate)
