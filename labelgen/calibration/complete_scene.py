"""A scene without calibration or road mask, completed from its video alone; what was made is kept and used again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from labelgen.atomic_files import make_folder, write_json
from labelgen.calibration.observation.collect import observe
from labelgen.calibration.pipeline import Calibration, calibrate_video
from labelgen.calibration.road_mask import road_mask, write_mask
from labelgen.calibration.scale.methods import scale_way
from labelgen.datasets.scene import Scene, find_scene_parts
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.media.frames import FrameSource
from labelgen.media.open_frames import open_frames

__all__ = ["CALIBRATION_NAME", "ROAD_MASK_NAME", "calibrate_with_scale", "complete_scene"]

CALIBRATION_NAME, ROAD_MASK_NAME = "calibration.json", "road_mask.png"


def complete_scene(
    path: Path,
    folder_of: Callable[[str], Path],
    say: Callable[[str], object],
    *,
    calibration: Path | None = None,
    road_mask_file: Path | None = None,
    scale: str = "auto-models",
    need_scale: bool = True,
) -> Scene:
    """Find what belongs to a video; calibrate it and mark its road where nothing is found.

    Args:
        path: video file, folder of images, or session folder.
        folder_of: from the scene's name to the folder where what is made is kept.
        say: is told, in a line, what was made or used again.
        calibration, road_mask_file: use these.
        scale: way to the scale, see `labelgen.calibration.scale.methods`.
        need_scale: whether a video that gives no scale is an error; without one there are no metres.

    Raises:
        DataError: no such video, or a file that was given is not there.
        CalibrationError: the video cannot carry a calibration or a road mask; says why.
        OutputError: what was made cannot be written.
    """
    scene, missing = find_scene_parts(path, calibration=calibration, road_mask=road_mask_file)
    if not missing:
        return scene
    folder = folder_of(scene.name)
    kept = {"calibration": folder / CALIBRATION_NAME, "road mask": folder / ROAD_MASK_NAME}
    for what in sorted(missing):
        if kept[what].is_file():
            say(f"{scene.name}: no {what} given; using {kept[what]} of an earlier run")
    to_make = {what for what in missing if not kept[what].is_file()}
    scene = replace(
        scene,
        calibration_path=kept["calibration"] if "calibration" in missing else scene.calibration_path,
        mask_path=kept["road mask"] if "road mask" in missing else scene.mask_path,
    )
    if to_make:
        them = "it" if len(to_make) == 1 else "them"
        say(f"{scene.name}: no {' and no '.join(sorted(to_make))} given; making {them} from the video itself")
        _make(scene, to_make, scale, need_scale, say)
    return scene


def _make(scene: Scene, what: set[str], scale: str, need_scale: bool, say: Callable[[str], object]) -> None:
    assert scene.frames_path is not None
    frames = open_frames(scene.frames_path)
    if "calibration" in what:
        done = calibrate_with_scale(frames, [scale], need_scale=need_scale, say=say)
        camera, seen = done.camera, done.seen
        make_folder(scene.calibration_path.absolute().parent)
        write_json(scene.calibration_path, done.to_dict())
        say(f"{scene.name}: calibrated, confidence {done.confidence()['overall']:.2f}: {scene.calibration_path}")
        for doubt in done.doubts:
            say(f"{scene.name}: {doubt}")
    else:
        camera = Camera.load(scene.calibration_path, image_wh=frames.size_wh)
        seen = observe(frames)
    if "road mask" in what:
        found = road_mask(camera, seen.tracks)
        write_mask(scene.mask_path, found.pixels)
        say(f"{scene.name}: road marked, {found.pixels.mean():.0%} of the picture: {scene.mask_path}")


def calibrate_with_scale(
    frames: FrameSource,
    scale: Sequence[str],
    *,
    need_scale: bool,
    say: Callable[[str], object],
    pp: ArrayLike | None = None,
    duration_s: float | None = None,
) -> Calibration:
    """Calibrate a video, scale included.

    Args:
        frames: the video.
        scale: way to the scale, see `labelgen.calibration.scale.methods`.
        need_scale: whether a video that gives no scale is an error; it is told otherwise.
        say: is told.
        pp, duration_s: see `labelgen.calibration.pipeline.calibrate_video`.

    Raises:
        CalibrationError: the video cannot carry a calibration, or no scale where one is needed; says why.
    """
    way = scale_way(scale)
    done = calibrate_video(frames, pp=pp, duration_s=duration_s)
    try:
        found = way(done.camera, done.blobs)
    except CalibrationError as err:
        if need_scale:
            raise
        say(f"{frames.name}: no scale, so there are no metres: {err}")
        return done
    return replace(done, camera=replace(done.camera, scale=found.scale), scale=found)
