"""Synthetic recordings in the layout of BrnoCompSpeed, with their exact truth."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import write_atomic, write_json
from labelgen.datasets.scene import find_scene, is_session
from labelgen.errors import OutputError
from labelgen.interruption import defer_interrupt
from labelgen.output_names import check_name
from labelgen.progress import progress_bar
from labelgen.staged_output import StagedOutput
from labelgen.synth.renderer.placed_vehicle import PlacedVehicle
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.renderer.vehicle_masks import DrawnVehicle
from labelgen.synth.scene.road_image import draw_scene
from labelgen.synth.scene.scene import RoadScene, procedural_scene, visible_range
from labelgen.synth.scene.static_layer import StaticLayer
from labelgen.synth.scene.traffic import Trip, near_path_x, random_traffic
from labelgen.synth.sensor.sensor import PLAIN, Sensor, make_sensor
from labelgen.synth.shading.lighting import Light, Weather, make_light, varied_light
from labelgen.synth.truth.writer import TruthWriter
from labelgen.synth.vehicle.vehicle import VehicleModel, check_kinds, check_plates

__all__ = ["SessionSummary", "place", "write_session"]


@dataclass(frozen=True)
class SessionSummary:
    """What `write_session` wrote.

    Args:
        name: of the session.
        frames: number of rendered frames.
        vehicles: number of vehicles.
        masks: number of masks in all frames together.
        signal: number of the signal that ended it early, so that it is shorter; 0 where none did.
        files: name -> path.
        measured: what was measured in the video that the scene was taken from, in words; empty without one.
    """

    name: str
    frames: int
    vehicles: int
    masks: int
    signal: int
    files: dict[str, str]
    measured: dict[str, str]

    @property
    def complete(self) -> bool:
        """Whether it has its whole length."""
        return self.signal == 0


def place(trip: Trip, vehicle: VehicleModel, time_s: float) -> PlacedVehicle:
    """Return a vehicle with its place on the road at a time."""
    near = trip.near_point(time_s)
    centre = near + np.array([trip.size_lwh[0] / 2, 0.0])
    return PlacedVehicle(trip.track_id, vehicle, centre, trip.lane.heading, trip.speed_ms(time_s))


def write_session(
    out: Path,
    *,
    duration_s: float = 20.0,
    fps: float | None = None,
    size_wh: tuple[int, int] = (1920, 1080),
    seed: int = 0,
    name: str | None = None,
    weather: Weather | None = None,
    per_minute: float = 18.0,
    kinds: Sequence[str] | None = None,
    plates: str | None = None,
    heading: int | None = None,
    scene: Path | None = None,
    replay: bool = False,
    start_s: float | None = None,
    calibration: Path | None = None,
    road_mask: Path | None = None,
    sun: tuple[float, float] | None = None,
    deinterlace: bool = False,
    video: bool = True,
    overwrite: bool = False,
) -> SessionSummary:
    """Render traffic and write `out/dataset/NAME`, `out/results/NAME` and `out/truth/NAME`, all of it or nothing.

    Args:
        out: root of the tree.
        duration_s: length of the recording.
        fps: frames per second; when None 25, or those of the video that `scene` names.
        size_wh: frame size, px; with `scene` that of its picture.
        seed: everything that varies comes from it.
        name: of the session; when None session0_center, or with `scene` that of the real one or of the video.
        weather: light; when None at random, overcast in a real session, as it looks in a video.
        per_minute: vehicles per lane and minute.
        kinds: body types to use; by their shares in traffic when None.
        plates: one of `labelgen.synth.vehicle.parts.PLATES`; of all kinds when None.
        heading: +1 traffic drives away, -1 it comes closer; when None at random, or as seen in a video. Not with a
            real session.
        scene: folder of a real session, `ROOT/dataset/sessionN_x`, or a video of a fixed camera above a road.
        replay: re-enact the scene's recorded traffic.
        start_s: with `replay`, where in the recording to begin; shortly before the first recorded crossing when None.
        calibration, road_mask: of the video that `scene` names; looked for beside it, or made from it, when None.
        sun: with such a video, degrees: the sun's height and how far right of straight ahead it stands; by the shadows
            of its vehicles when None.
        deinterlace: whether each frame of such a video is deinterlaced.
        video: whether to render; without, only boxes and tracks are written.
        overwrite: whether an existing session may be replaced.

    Raises:
        OutputError: the session exists, or cannot be written.
        DataError: the scene cannot be read, its traffic is not recorded, or there is no such body type or plate.
        CalibrationError: the video that `scene` names has no calibration and cannot carry one.
    """
    check_kinds(kinds or [])
    check_plates(plates)
    _check_replay(scene, replay)
    name = _name(name, scene, calibration, road_mask)
    with _staged(out, name, overwrite) as output:
        if scene is None:
            setting = _made_up(seed, size_wh, heading, name, weather)
        elif is_session(scene):
            setting = _real(scene, weather, seed)
        else:
            setting = _own(
                scene, weather, seed, out, calibration=calibration, road_mask=road_mask, heading=heading, sun=sun,
                plates=plates, deinterlace=deinterlace, overwrite=overwrite,
            )  # fmt: skip
        setting = replace(setting, scene=_renamed(setting.scene, name))
        fps = fps or setting.fps
        trips = _trips(setting, replay, duration_s, seed, start_s, per_minute, kinds)
        folders = {part: output.stage(f"{part}/{name}/file").parent for part in _PARTS}
        rendered = _render(folders, setting, trips, round(duration_s * fps), fps, seed, plates=plates, video=video)
        _write_beside(folders, setting, trips, rendered, fps)
        output.publish()
    files = {key: out / part / name / file for key, (part, file) in _FILES.items()}
    return SessionSummary(
        name, rendered.frames, len(rendered.cars), rendered.masks, rendered.signal,
        {key: str(path) for key, path in files.items() if path.exists()}, setting.measured,
    )  # fmt: skip


_PARTS = ("dataset", "results", "truth")
_FILES = {
    "video": ("dataset", "video.avi"),
    "calibration": ("results", "system_optimal_calibration.json"),
    "tracks": ("results", "system_truth.json"),
    "masks": ("truth", "masks.json"),
    "boxes": ("truth", "boxes.jsonl"),
}
_OTHER_FILES = (
    ("dataset", "gt_data.pkl"),
    ("dataset", "video_mask.png"),
    ("dataset", "screen.png"),
    ("truth", "tracks.json"),
)


def _name(given: str | None, scene: Path | None, calibration: Path | None, road_mask: Path | None) -> str:
    """Return the name of the session."""
    if given is not None:
        return check_name(given, "name")
    if scene is None:
        return "session0_center"
    return find_scene(scene, calibration=calibration, road_mask=road_mask, need_frames=False, may_lack=True).name


def _staged(out: Path, name: str, overwrite: bool) -> StagedOutput:
    """Return what makes the files of a session."""
    names = [f"{part}/{name}/{file}" for part, file in (*_OTHER_FILES, *_FILES.values())]
    return StagedOutput(out, f"synth-{name}", names, overwrite=overwrite)


def _renamed(scene: RoadScene, name: str) -> RoadScene:
    return replace(scene, name=name, camera=replace(scene.camera, name=name))


def _trips(
    setting: _Setting, replay: bool, duration_s: float, seed: int, start_s: float | None, per_minute: float,
    kinds: Sequence[str] | None,
) -> list[Trip]:  # fmt: skip
    """Return the recorded or random traffic of a place."""
    if replay and setting.surveyed is not None:
        from labelgen.synth.truth.replay import replayed_traffic

        return replayed_traffic(setting.scene, setting.surveyed, duration_s, seed, start_s=start_s, kinds=kinds)
    return random_traffic(setting.scene, duration_s, seed, per_minute=per_minute, kinds=kinds)


def _check_replay(scene: Path | None, replay: bool) -> None:
    """Raise OutputError when there is no recorded traffic to replay."""
    if replay and scene is None:
        raise OutputError(
            "there is no recorded traffic to re-enact; name a real session as the scene", parameter=("replay", "scene")
        )
    if replay and scene is not None and not is_session(scene):
        raise OutputError(
            f"{scene}: it has no recorded traffic (gt_data.pkl) to re-enact", parameter=("replay", "scene")
        )


@dataclass(frozen=True, eq=False)
class _Setting:
    """A place, its light and its camera.

    `surveyed` is a real session's gt_data.pkl; for `measured` see `OwnCamera`.
    """

    scene: RoadScene
    light: Light
    static_layer: StaticLayer | None
    sensor: Sensor
    surveyed: dict[str, Any] | None = None
    fps: float = 25.0
    measured: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Rendered:
    """How much was rendered; `cars` are the tracks as the public result files hold them."""

    signal: int
    frames: int
    masks: int
    cars: list[dict[str, Any]]


def _made_up(seed: int, size_wh: tuple[int, int], heading: int | None, name: str, weather: Weather | None) -> _Setting:
    """Make up a road and draw its picture."""
    rng = np.random.default_rng([seed, 1])
    scene = procedural_scene(rng, size_wh, heading=heading, name=name)
    light = make_light(weather or list(Weather)[int(rng.choice(4, p=[0.52, 0.30, 0.06, 0.12]))], rng)
    light = varied_light(light, rng)
    background, static_layer = draw_scene(scene, light, rng)
    return _Setting(replace(scene, background=background), light, static_layer, make_sensor(rng))


def _real(folder: Path, weather: Weather | None, seed: int) -> _Setting:
    """Open a real session's place."""
    from labelgen.synth.truth.replay import load_scene

    scene, light, surveyed = load_scene(folder, weather or Weather.OVERCAST, np.random.default_rng([seed, 1]))
    return _Setting(scene, light, None, PLAIN, surveyed)


def _own(video: Path, weather: Weather | None, seed: int, out: Path, **given: Any) -> _Setting:
    """Open the place that a user's video shows. `given`: see `load_own_camera`."""
    from labelgen.synth.fitting.own_camera import load_own_camera

    rng = np.random.default_rng([seed, 1])
    own = load_own_camera(video, out / "camera", rng, weather=weather, **given)
    return _Setting(own.scene, own.light, None, own.sensor, None, own.fps, own.measured)


def _write_beside(
    folders: dict[str, Path], setting: _Setting, trips: Sequence[Trip], rendered: _Rendered, fps: float
) -> None:
    """Write the files that belong to a rendered video."""
    scene = setting.scene
    assert scene.background is not None
    write_atomic(folders["dataset"] / "video_mask.png", _png(scene.road_mask.astype(np.uint8) * 255))
    empty = scene.background
    if not setting.sensor.in_picture:
        empty = setting.sensor.before_noise(empty)
        setting.sensor.write(empty, 0.0)
    write_atomic(folders["dataset"] / "screen.png", _png(empty))
    calibration = scene.camera.to_dict()
    write_json(folders["results"] / "system_truth.json", {**calibration, "cars": rendered.cars})
    write_json(folders["results"] / "system_optimal_calibration.json", calibration)
    gt = ground_truth(scene, trips, rendered.frames / fps, fps, setting.surveyed)
    write_atomic(folders["dataset"] / "gt_data.pkl", pickle.dumps(gt, protocol=2))


def _render(
    folders: dict[str, Path], setting: _Setting, trips: Sequence[Trip], count: int, fps: float, seed: int,
    plates: str | None, *, video: bool,
) -> _Rendered:  # fmt: skip
    from contextlib import ExitStack

    from labelgen.media.video_writer import VideoWriter

    scene, light = setting.scene, setting.light
    assert scene.background is not None
    frames, masks, signal = 0, 0, 0
    spans = {trip.track_id: trip.span_s(scene.x_range) for trip in trips}
    vehicles: dict[int, VehicleModel] = {}
    with ExitStack() as stack:
        truth = stack.enter_context(TruthWriter(folders["truth"], scene.camera, fps))
        truth.describe(trips)
        renderer = Renderer(
            scene.camera, scene.background, light, seed=seed, static_layer=setting.static_layer, sensor=setting.sensor
        )
        path = folders["dataset"] / "video.avi"
        writer = VideoWriter(path, fps, renderer.size_wh, setting.sensor.crf) if video else None
        if writer is not None:
            stack.enter_context(writer)
        advance = stack.enter_context(progress_bar(count, "frame", scene.name))
        stop = stack.enter_context(defer_interrupt())
        for number in range(count):
            if signal := stop():  # what is written so far is a shorter recording, complete in itself
                break
            time_s = number / fps
            here = [t for t in trips if spans[t.track_id][0] <= time_s <= spans[t.track_id][1]]
            drawn: list[DrawnVehicle] | None = None
            if writer is not None:
                ids = {t.track_id for t in here}
                renderer.forget({k for k in vehicles if k not in ids})
                vehicles = {
                    t.track_id: vehicles.get(t.track_id) or t.vehicle(lamps=light.lamps, plates=plates) for t in here
                }
                placed = [place(t, vehicles[t.track_id], time_s) for t in here]
                image, drawn = renderer.frame(placed, number=number, time_s=time_s)
                writer.write(image)
                masks += len(drawn)
            truth.add(number, here, drawn)
            frames += 1
            advance(1)
        cars = truth.result_cars()
    return _Rendered(signal, frames, masks, cars)


def _png(image: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".png", image)[1])


def ground_truth(
    scene: RoadScene, trips: Sequence[Trip], duration_s: float, fps: float, surveyed: dict[str, Any] | None
) -> dict[str, Any]:
    """Return the content of `gt_data.pkl`, with the speeds as rendered.

    A car is listed when it crosses the last line while the recording runs, and valid when all its crossings fall
    into the recording.

    Args:
        scene: lines and lanes.
        trips: all vehicles.
        duration_s: length of the recording.
        fps: frames per second.
        surveyed: a real session's `gt_data.pkl`, whose surveyed distances are kept; None for a made-up scene.
    """
    cars = []
    for trip in trips:
        if trip.car_id is None:
            continue
        times = {}
        for number, line in enumerate(scene.measurement_lines):
            time = trip.time_at(near_path_x(scene, line, trip.lane, trip.offset_y))
            if 0 <= time < duration_s:
                times[number] = time
        if 0 not in times:
            continue
        last = len(scene.measurement_lines) - 1
        valid = len(times) == last + 1
        speed = 0.0
        if valid:
            ends = [trip.near_point(times[k]) for k in (0, last)]
            speed = float(np.linalg.norm(ends[0] - ends[1])) / abs(times[0] - times[last]) * 3.6
        cars.append(
            {
                "carId": trip.car_id,
                "speed": speed,
                "laneIndex": {trip.lane.index},
                "valid": valid,
                "acceleration": 0.0,
                "timeIntersectionLastShifted": times[0],
                "intersections": [{"measurementLineId": k, "videoTime": times[k]} for k in sorted(times, reverse=True)],
            }
        )
    cars.sort(key=lambda car: car["timeIntersectionLastShifted"])  # type: ignore[arg-type, return-value]
    return {
        "fps": float(fps),
        "cars": cars,
        "measurementLines": [np.asarray(line, dtype=np.float64) for line in scene.measurement_lines],
        "laneDivLines": [np.asarray(line, dtype=np.float64) for line in scene.lane_lines],
        "invalidLanes": set() if surveyed is None else set(surveyed["invalidLanes"]),
        "distanceMeasurement": _distances(scene) if surveyed is None else surveyed["distanceMeasurement"],
    }


def _distances(scene: RoadScene) -> list[dict[str, Any]]:
    """Return distances between road points of a made-up scene in the form of BrnoCompSpeed's surveyed ones."""
    measured = [lane for lane in scene.lanes if lane.index is not None]
    low, high = min(lane.y0 for lane in measured) - 1.8, max(lane.y0 for lane in measured) + 1.8
    near, far = visible_range(scene.camera, (low + high) / 2) or (10.0, 40.0)
    marks = np.linspace(near + 4, min(far - 4, near + 45), 4)
    pairs = [((marks[k], y), (marks[k + 1], y), True) for k in range(3) for y in (low, high)]
    pairs += [((x, low), (x, high), False) for x in marks]
    out = []
    for a, b, along in pairs:
        p, q = scene.camera.project(np.array([a, b]))
        distance = float(np.hypot(a[0] - b[0], a[1] - b[1]))
        out.append({"p1": np.append(p, 1.0), "p2": np.append(q, 1.0), "distance": distance, "toVP1": along})
    return out
