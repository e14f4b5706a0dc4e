"""A user's own camera as a scene: its road, light and sensor, all estimated from its video."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.complete_scene import complete_scene
from labelgen.calibration.observation.collect import observe
from labelgen.datasets.scene import find_scene
from labelgen.errors import DataError
from labelgen.geometry import Camera
from labelgen.media.open_frames import open_frames
from labelgen.synth.fitting.footage import Footage, read_footage
from labelgen.synth.fitting.lanes import find_lanes
from labelgen.synth.fitting.lighting import (
    Tones,
    fit_to_details,
    fit_to_road,
    fit_to_shadows,
    fit_to_tones,
    tones_of,
    vehicle_parts,
)
from labelgen.synth.fitting.panel_noise import fit_to_panels
from labelgen.synth.fitting.sensor import fit_sensor
from labelgen.synth.fitting.sun import Shadows, find_shadows
from labelgen.synth.renderer.placed_vehicle import PlacedVehicle
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.renderer.vehicle_masks import covered_by
from labelgen.synth.scene.scene import FARTHEST_M, Lane, RoadScene, line_through, visible_range
from labelgen.synth.scene.traffic import random_traffic
from labelgen.synth.sensor.sensor import Sensor
from labelgen.synth.shading.lighting import Light, Weather, make_light

__all__ = ["OWN_CAMERA", "OwnCamera", "OwnCameraThresholds", "load_own_camera"]


@dataclass(frozen=True)
class OwnCameraThresholds:
    """Thresholds for making a scene of a video.

    Args:
        depth_m: length of the measured stretch of road.
        min_visible_m: length of road that the picture must show.
        trial_frames, trial_interval_s: frames that are rendered to compare vehicles with those of the video, and the
            time between them. More frames give steadier tones, and take time.
        trial_seed: of the traffic in these frames.
        trial_per_minute: vehicles per lane and minute in these frames.
        rounds: how often light and sensor are fitted.
    """

    depth_m: float = 60.0
    min_visible_m: float = 8.0
    trial_frames: int = 40
    trial_interval_s: float = 2.0
    trial_seed: int = 4
    trial_per_minute: float = 20.0
    rounds: int = 3


OWN_CAMERA = OwnCameraThresholds()


@dataclass(frozen=True, eq=False)
class OwnCamera:
    """A camera's road and what was estimated from its video.

    Args:
        scene: with its background image.
        light: of the video.
        sensor: of the camera.
        fps: frames per second.
        measured: name -> value in words, for the user.
    """

    scene: RoadScene
    light: Light
    sensor: Sensor
    fps: float
    measured: dict[str, str]


def load_own_camera(
    video: Path,
    folder: Path,
    rng: np.random.Generator,
    *,
    calibration: Path | None = None,
    road_mask: Path | None = None,
    heading: int | None = None,
    weather: Weather | None = None,
    sun: tuple[float, float] | None = None,
    plates: str | None = None,
    deinterlace: bool = False,
    overwrite: bool = False,
    thresholds: OwnCameraThresholds = OWN_CAMERA,
) -> OwnCamera:
    """Estimate all that rendering traffic into a video needs.

    Args:
        video: of a fixed camera above a straight road, or a folder of images.
        folder: a calibration and a road mask that are made on the way are kept in a folder of the video's name in it.
        rng: gives what the video does not show.
        calibration, road_mask: use these rather than NAME.calibration.json and NAME.mask.png beside the video.
        heading: +1 traffic drives away, -1 it comes closer; from the video's traffic when None.
        weather: kind of light; from the shadows when None.
        sun: degrees, elevation above the horizon and azimuth to the right of straight ahead; from the shadows when
            None.
        plates: family of number plates of the vehicles to which colours are fitted; any when None.
        deinterlace: whether each frame of the video is deinterlaced.
        thresholds: of this stage.

    Raises:
        DataError: the video, its calibration or its road mask is missing, damaged or of another size.
        CalibrationError: there is no calibration, and the video does not allow one.
    """
    files = find_scene(video, calibration=calibration, road_mask=road_mask, may_lack=True, deinterlace=deinterlace)
    parts = complete_scene(files, folder / files.name, overwrite=overwrite)
    footage = read_footage(video, deinterlace=deinterlace)
    height, width = footage.background.shape[:2]
    camera = parts.camera((width, height))
    road = parts.road().pixels
    if abs(road.shape[0] - height) > 1 or abs(road.shape[1] - width) > 1:
        raise DataError(
            f"{parts.mask_path}: {road.shape[1]}x{road.shape[0]}, but the video has {width}x{height}; "
            "make the mask with labelgen road-mask"
        )
    road = road[:height, :width]
    tracks = observe(open_frames(video, deinterlace=deinterlace)).tracks
    lanes, borders = find_lanes(camera, road, footage.background, tracks, heading)
    scene = _scene(parts.name, camera, lanes, borders, road, footage.background, thresholds)
    shadows = find_shadows(footage, camera, road)
    if sun is not None:
        shadows = replace(shadows, sun=_direction(*sun))
    weather = weather or (Weather.DAY if shadows.sunny else Weather.OVERCAST)
    sensor = fit_sensor(footage)
    light = fit_to_shadows(fit_to_road(make_light(weather, rng), footage.background, road), shadows)
    vehicles = list(vehicle_parts(footage, road, shadows))
    assert sensor.noise_model is not None
    sensor = replace(sensor, noise_model=fit_to_panels(sensor.noise_model, vehicles))
    real = tones_of(vehicles)
    if real is not None:
        light, sensor = _fit_to_vehicles(light, sensor, real, scene, shadows, footage, plates, thresholds)
    return OwnCamera(scene, light, sensor, footage.fps, _words(footage, scene, light, sensor, shadows, real))


def _direction(height_deg: float, right_deg: float) -> NDArray[np.float64]:
    """Return the (3,) unit vector towards the sun in the road frame."""
    up, aside = np.radians(height_deg), np.radians(right_deg)
    return np.array([np.cos(up) * np.cos(aside), -np.cos(up) * np.sin(aside), np.sin(up)])


def _scene(
    name: str, camera: Camera, lanes: tuple[Lane, ...], borders: NDArray[np.float64], road: NDArray[np.bool_],
    background: NDArray[np.uint8], thresholds: OwnCameraThresholds,
) -> RoadScene:  # fmt: skip
    """Return the visible road with three measurement lines across, the one crossed last first."""
    measured = [lane for lane in lanes if lane.index is not None]
    middle = float(borders.mean())
    visible = visible_range(camera, middle)
    shortest = thresholds.min_visible_m
    if visible is None or visible[1] - max(visible[0], 2.0) < shortest:
        raise DataError(f"{name}: the picture shows less than {shortest:.0f} m of the road; check its calibration")
    near = max(visible[0], 2.0) + 1.5
    far = min(visible[1] - 1.5, near + thresholds.depth_m)
    marks = np.linspace(near + 1, far - 1, 3)
    if measured[0].heading > 0:
        marks = marks[::-1]
    across = tuple(line_through(camera, (x, borders[0]), (x, borders[-1])) for x in marks)
    along = tuple(line_through(camera, (near, y), (far, y)) for y in borders)
    rows, columns = np.nonzero(road)
    pick = slice(None, None, max(1, len(rows) // 20000))
    x = camera.road_points(np.stack([columns[pick], rows[pick]], axis=1) + 0.5, invalid="nan")[:, 0]
    reach = float(min(np.nanmax(x) + 30.0, FARTHEST_M))
    return RoadScene(name, camera, lanes, along, across, road, background, (-25.0, reach))


def _fit_to_vehicles(
    light: Light, sensor: Sensor, real: Tones, scene: RoadScene, shadows: Shadows, footage: Footage,
    plates: str | None, thresholds: OwnCameraThresholds,
) -> tuple[Light, Sensor]:  # fmt: skip
    """Return light and sensor with which rendered vehicles have the tones and details of real ones."""
    measured = sensor
    traffic = _trial_traffic(scene, light, plates, thresholds)
    for _ in range(thresholds.rounds):
        # Vehicles are cut out as from the video, so that both samples are biased alike.
        frames, masks = _trial_frames(scene, light, sensor, traffic)
        drawn = tones_of(list(vehicle_parts(replace(footage, frames=frames), scene.road_mask, shadows, masks)))
        if drawn is None:
            break
        sensor = fit_to_details(sensor, measured, real, drawn)
        # Tones change how dark shadows come out, so these are fitted again.
        light = fit_to_shadows(fit_to_tones(light, real, drawn), shadows)
    return light, sensor


def _trial_traffic(
    scene: RoadScene, light: Light, plates: str | None, thresholds: OwnCameraThresholds
) -> list[list[PlacedVehicle]]:
    """Return the vehicles in the scene at several times."""
    count, interval = thresholds.trial_frames, thresholds.trial_interval_s
    trips = random_traffic(scene, count * interval, thresholds.trial_seed, per_minute=thresholds.trial_per_minute)
    moments: list[list[PlacedVehicle]] = [[] for _ in range(count)]
    for trip in trips:
        first, last = trip.span_s((0.0, thresholds.depth_m))
        times = [k for k in range(count) if first <= k * interval <= last]
        if times and trip.kind != "motorcycle":
            vehicle = trip.vehicle(lamps=light.lamps, plates=plates)
            for k in times:
                centre = trip.near_point(k * interval) + np.array([trip.size_lwh[0] / 2, 0.0])
                speed = trip.speed_ms(k * interval)
                moments[k].append(PlacedVehicle(trip.track_id, vehicle, centre, trip.lane.heading, speed))
    return moments


def _trial_frames(
    scene: RoadScene, light: Light, sensor: Sensor, traffic: list[list[PlacedVehicle]]
) -> tuple[NDArray[np.uint8], list[NDArray[np.bool_]]]:
    """Render traffic; return (K, H, W, 3) uint8 BGR frames and for each (H, W) where vehicles are."""
    assert scene.background is not None
    renderer = Renderer(scene.camera, scene.background, light, seed=0, sensor=sensor)
    frames, masks = [], []
    for number, placed in enumerate(traffic):
        frame, drawn = renderer.frame(placed, number=number)
        frames.append(frame)
        masks.append(covered_by(drawn, frame.shape[:2]))
    return np.stack(frames), masks


def _words(
    footage: Footage, scene: RoadScene, light: Light, sensor: Sensor, shadows: Shadows, real: Tones | None
) -> dict[str, str]:
    """Return what was estimated, in words."""
    ways = {1: "away", -1: "closer"}
    lanes = ", ".join(f"{lane.y0:.1f} m {ways[lane.heading]}" for lane in scene.lanes)
    shadow = "none stands out" if shadows.left is None else f"{shadows.left:.0%} of the road's brightness"
    sun = light.sun_direction
    height, aside = np.degrees(np.arcsin(sun[2])), np.degrees(np.arctan2(-sun[1], sun[0]))
    where = f"{height:.0f} degrees high, {aside:.0f} right of ahead" if shadows.sunny else "hidden"
    if shadows.sunny and shadows.sun is None:
        where += ", which is a guess, since shadows do not show it; sun can be given"
    assert sensor.noise_model is not None
    noise = sensor.noise_model.grey[len(sensor.noise_model.grey) // 2]
    return {
        "lanes": lanes,
        "picture moved": f"{footage.shake_px:.2f} px",
        "shadows": shadow,
        "sun": where,
        "noise": f"{noise:.1f} grey levels on middle grey",
        "lens": f"blur {sensor.blur_px:.1f} px, sharpening {sensor.sharpen:.1f}, colours smeared {sensor.smear:.4f}",
        "compression": f"as H.264 at crf {sensor.crf}",
        "vehicles looked at": "too few" if real is None else f"{real.vehicles} times",
    }
