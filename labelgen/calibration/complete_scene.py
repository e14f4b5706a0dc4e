"""A scene without calibration or road mask, completed from its video alone; what was made is kept and used again."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from labelgen.atomic_files import make_folder, write_json
from labelgen.calibration.observation.collect import observe
from labelgen.calibration.pipeline import Calibration, calibrate_video
from labelgen.calibration.road_mask import estimate_road_mask, write_mask
from labelgen.calibration.scale.methods import parse_scale_method
from labelgen.datasets.scene import SceneFiles
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.media.frame_notes import frame_notes
from labelgen.media.frames import FrameSource

__all__ = ["CALIBRATION_NAME", "ROAD_MASK_NAME", "calibrate_with_scale", "complete_scene"]

CALIBRATION_NAME, ROAD_MASK_NAME = "calibration.json", "road_mask.png"

_log = logging.getLogger(__name__)


def complete_scene(
    files: SceneFiles, folder: Path, *, scale: str = "auto-models", need_scale: bool = True
) -> SceneFiles:
    """Calibrate a video and mark its road, where `SceneFiles.missing` says that they are not there.

    Args:
        files: of `labelgen.datasets.scene.find_scene` with `may_lack`.
        folder: where what is made is kept; what an earlier run left there is used again.
        scale: method of the scale, see `labelgen.calibration.scale.methods`.
        need_scale: whether a video that gives no scale is an error; without one there are no metres.

    Returns:
        the files, none missing.

    Raises:
        DataError: the video cannot be read.
        CalibrationError: the video cannot carry a calibration or a road mask; says why.
        OutputError: what was made cannot be written.
    """
    if not files.missing:
        return files
    made_files = {"calibration": folder / CALIBRATION_NAME, "road mask": folder / ROAD_MASK_NAME}
    to_make = {what for what in files.missing if not made_files[what].is_file()}
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
        make_folder(scene.calibration_path.absolute().parent)
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
        write_mask(scene.mask_path, road.pixels)
        _log.info("%s: road marked, %.0f%% of the picture: %s", scene.name, 100 * road.pixels.mean(), scene.mask_path)


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
