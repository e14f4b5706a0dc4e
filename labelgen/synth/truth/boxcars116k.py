"""A synthetic data set in the layout of BoxCars116k.

dataset.pkl, json_data/dataset.json   cameras and samples, the same content
images/CAMERA/N/VEHICLE_INSTANCE.png  crops
atlas.pkl                             the same crops, JPEG-encoded: [vehicle][instance]
classification_splits.pkl             which vehicle serves for what
"""

from __future__ import annotations

import json
import pickle
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import make_folder, write_atomic
from labelgen.geometry import Camera, road_cuboids
from labelgen.progress import progress_bar
from labelgen.staged_output import StagedOutput
from labelgen.synth.renderer.placed_vehicle import PlacedVehicle
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.scene.road_image import draw_scene
from labelgen.synth.scene.scene import RoadScene, procedural_scene
from labelgen.synth.scene.traffic import Trip, random_traffic
from labelgen.synth.shading.lighting import Light, Weather, make_light, varied_light
from labelgen.synth.truth.session import place
from labelgen.synth.truth.writer import own_front_first
from labelgen.synth.vehicle.vehicle import VehicleModel, check_kinds

__all__ = ["CAMERAS", "write_boxcars_tree"]

CAMERAS = ("botanicka", "uvoz", "tesnohlidka", "svratka", "konecneho", "prahaVinohradska", "stefanikova", "videnska")
"""Camera names of the data set, in the order they are used."""

_WEATHERS = (Weather.DAY, Weather.OVERCAST, Weather.OVERCAST, Weather.RAIN)
"""Light of the cameras, in turn."""


@dataclass(frozen=True)
class _Settings:
    """What a tree's crops are like."""

    frame_wh: tuple[int, int] = (1920, 1080)
    """Frame size of the data set's cameras, px."""
    instances: int = 4
    """Crops per vehicle at most; the data set has about as many."""
    min_height_px: float = 60.0
    """Height of a 3D box in the frame below which a vehicle is too small to be labelled."""
    min_visible: float = 0.6
    """Share of a vehicle's pixels below which others hide too much of it for its crop to serve as an example."""
    border_px: float = 12.0
    """Distance a 3D box keeps from the frame's border, so that crops have a margin on every side."""
    per_minute: float = 14.0
    """Vehicles per lane and minute: sparse enough that few hide each other."""
    duration_s: float = 12.0
    """Least length of the traffic to choose from; more of it gives more choice and takes longer."""
    seconds_per_vehicle: float = 6.0
    """Length of the traffic per vehicle to choose."""
    shadow_reach: float = 2.0
    """Vehicles farther from all that a crop shows than so many times their height are not drawn: the sun stands higher
    than 30 degrees, so that their shadows do not reach it."""


_SETTINGS = _Settings()


@dataclass(frozen=True, eq=False)
class _View:
    """One vehicle at one time, as its camera sees it, and the crop around it."""

    trip: Trip
    time_s: float
    vertices_px: NDArray[np.float64]
    crop_xyxy: NDArray[np.int64]


def write_boxcars_tree(
    out: Path,
    vehicles: int = 60,
    seed: int = 0,
    *,
    cameras: int | None = None,
    kinds: Sequence[str] | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write a BoxCars116k tree.

    Args:
        out: folder.
        vehicles: number of samples (tracks), with up to four instances each.
        seed: everything that varies comes from it.
        cameras: number of cameras, 1 to 8; one for every two vehicles when None.
        kinds: body types, which then share the vehicles as evenly as the traffic allows; by their shares in traffic
            when None.
        overwrite: whether an existing tree may be replaced.

    Returns:
        Summary: samples, instances, cameras, the root folder.

    Raises:
        OutputError: the tree exists, or cannot be written.
        DataError: no such body type.
    """
    check_kinds(kinds or [])
    kind = f"{out}: it holds a data set already"
    with StagedOutput(out, "synth", _FILES, overwrite=overwrite, patterns=_CROPS, kind=kind) as output:
        summary = _write_tree(output.path, vehicles, seed, cameras, kinds)
        output.publish()
    return {**summary, "root": str(out)}


_FILES = ("dataset.pkl", "atlas.pkl", "classification_splits.pkl", "json_data/dataset.json")
_CROPS = ("images/*/1/[0-9]*_[0-9]*.png",)


def _write_tree(
    out: Path, vehicles: int, seed: int, cameras: int | None, kinds: Sequence[str] | None
) -> dict[str, Any]:
    """Write a tree into a folder; see `write_boxcars_tree`."""
    make_folder(out / "json_data")
    names = CAMERAS[: max(1, min(len(CAMERAS), vehicles // 2 if cameras is None else cameras))]
    entries: dict[str, Any] = {}
    samples: list[dict[str, Any]] = []
    atlas: list[list[NDArray[np.uint8]]] = []
    used: Counter[str] = Counter()
    with progress_bar(vehicles, "vehicle") as advance:
        for number, name in enumerate(names):
            site = _Site(name, number, seed)
            entries[name] = _camera_entry(site.scene.camera)
            views_of_vehicles = site.choose(len(range(number, vehicles, len(names))), kinds, used)
            for sample, crops in site.samples(views_of_vehicles, len(samples), out / "images"):
                samples.append(sample)
                atlas.append(crops)
                advance(1)
    dataset = {"cameras": entries, "samples": samples}
    for path, content in (
        (out / "dataset.pkl", dataset),
        (out / "atlas.pkl", atlas),
        (out / "classification_splits.pkl", _splits(samples, seed)),
    ):
        write_atomic(path, pickle.dumps(content, protocol=2))
    write_atomic(out / "json_data" / "dataset.json", json.dumps(dataset).encode())
    instances = sum(len(s["instances"]) for s in samples)
    return {"samples": len(samples), "instances": instances, "cameras": len(entries)}


def _camera_entry(camera: Camera) -> dict[str, Any]:
    return {key: getattr(camera, key).tolist() for key in ("vp1", "vp2", "vp3", "pp")}


class _Site:
    """One camera of the tree: its road, light and traffic.

    Args:
        name: of the camera.
        number: of the camera; picks its place and light.
        seed: of the tree.
    """

    def __init__(self, name: str, number: int, seed: int) -> None:
        self._seed = seed * 1009 + number
        self._scene_rng = np.random.default_rng([seed, 21, number])
        self._rng = np.random.default_rng([seed, 22, number])
        self.scene: RoadScene = procedural_scene(self._scene_rng, _SETTINGS.frame_wh, name=name, both_ways=True)
        light = make_light(_WEATHERS[number % len(_WEATHERS)], self._scene_rng)
        self.light: Light = varied_light(light, self._scene_rng)
        self._trips: list[Trip] = []
        self._vehicles: dict[int, VehicleModel] = {}

    def choose(self, count: int, kinds: Sequence[str] | None, used: Counter[str]) -> list[list[_View]]:
        """Choose `count` vehicles, half of them driving away where there are such; returns their views.

        Args:
            count: number of vehicles.
            kinds: see `write_boxcars_tree`.
            used: how often each body type was chosen before; brought up to date.
        """
        duration = max(_SETTINGS.duration_s, _SETTINGS.seconds_per_vehicle * count)
        self._trips = random_traffic(self.scene, duration, self._seed, per_minute=_SETTINGS.per_minute, kinds=kinds)
        candidates = [views for trip in self._trips if (views := self._views(trip))]
        self._rng.shuffle(candidates)
        ways = [[c for c in candidates if c[0].trip.lane.heading == heading] for heading in (-1, 1)]
        views_of_vehicles: list[list[_View]] = []
        while len(views_of_vehicles) < count and any(ways):
            for way in [way for way in ways if way][: count - len(views_of_vehicles)]:
                views = min(way, key=lambda v: used[v[0].trip.kind]) if kinds else way[0]
                way[:] = [other for other in way if other is not views]
                used[views[0].trip.kind] += 1
                views_of_vehicles.append(views)
        return views_of_vehicles

    def _views(self, trip: Trip) -> list[_View]:
        """Return up to four times at which the whole vehicle is in the frame and large enough, evenly spread."""
        start, end = trip.span_s(self.scene.x_range)
        times = np.arange(max(start, 0.0), end, 0.08)
        if not len(times):
            return []
        near = np.stack([trip.near_point(t) for t in times])
        pixels = self.scene.camera.project(road_cuboids(near, np.tile(trip.size_lwh, (len(times), 1))))
        border, size = _SETTINGS.border_px, np.array(_SETTINGS.frame_wh)
        with np.errstate(invalid="ignore"):
            usable = ((pixels > border) & (pixels < size - border)).all(axis=(1, 2))
            usable &= np.ptp(pixels[..., 1], axis=1) > _SETTINGS.min_height_px
        indices = np.flatnonzero(usable)
        if len(indices) < 2:
            return []
        spread = np.linspace(0, len(indices) - 1, min(_SETTINGS.instances, len(indices))).astype(int)
        return [_View(trip, float(times[k]), pixels[k], self._crop(pixels[k])) for k in np.unique(indices[spread])]

    def _crop(self, vertices_px: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return (4,) px, x0, y0, x1, y1: a box's outline with a margin."""
        low, high = vertices_px.min(axis=0), vertices_px.max(axis=0)
        margin = self._rng.uniform(0.02, 0.10, 4) * np.tile(high - low, 2) + 3
        first = np.maximum(np.floor(low - margin[:2]), 0)
        last = np.minimum(np.ceil(high + margin[2:]), _SETTINGS.frame_wh)
        return np.concatenate([first, last]).astype(np.int64)

    def samples(
        self, views_of_vehicles: Sequence[list[_View]], first_id: int, images: Path
    ) -> Iterator[tuple[dict[str, Any], list[NDArray[np.uint8]]]]:
        """Render the views_of_vehicles vehicles and write their crops; yields each one's entry and its crops as JPEGs.

        Args:
            views_of_vehicles: what `choose` returned.
            first_id: number of the first vehicle in the tree.
            images: folder of the tree's crops.
        """
        if not views_of_vehicles:
            return
        crops_xyxy = np.array([view.crop_xyxy for views in views_of_vehicles for view in views])
        background, static_layer = draw_scene(self.scene, self.light, self._scene_rng, crops_xyxy)
        renderer = Renderer(self.scene.camera, background, self.light, seed=self._seed, static_layer=static_layer)
        vehicle_id = first_id
        for views in views_of_vehicles:
            instances: list[dict[str, Any]] = []
            crops: list[NDArray[np.uint8]] = []
            for view in views:
                instance = len(instances)
                image, drawn = renderer.frame(self._placed(view), number=vehicle_id * 10 + instance)
                visible = next((d.visible for d in drawn if d.track_id == view.trip.track_id), 0.0)
                if visible < _SETTINGS.min_visible:
                    continue
                x0, y0, x1, y1 = view.crop_xyxy.tolist()
                crop = np.ascontiguousarray(image[y0:y1, x0:x1])
                entry = self._entry(view, vehicle_id, instance)
                path = images / entry["path"]
                make_folder(path.parent)
                write_atomic(path, bytes(cv2.imencode(".png", crop)[1]))
                crops.append(cv2.imencode(".jpg", crop, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].reshape(-1))
                instances.append(entry)
            if not instances:
                continue
            trip = views[0].trip
            sample = {
                "camera": self.scene.name,
                "to_camera": trip.lane.heading < 0,
                "annotation": f"synthetic {trip.kind}",
                "instances": instances,
            }
            yield sample, crops
            vehicle_id += 1

    def _placed(self, view: _View) -> list[PlacedVehicle]:
        """Return the vehicles that a view's crop shows, or whose shadows it may show."""
        placed = []
        for trip in self._trips:
            start, end = trip.span_s(self.scene.x_range)
            if start <= view.time_s <= end and self._reaches(trip, view):
                if trip.track_id not in self._vehicles:
                    self._vehicles[trip.track_id] = trip.vehicle(lamps=self.light.lamps)
                placed.append(place(trip, self._vehicles[trip.track_id], view.time_s))
        return placed

    def _reaches(self, trip: Trip, view: _View) -> bool:
        """Whether a vehicle, or the ground around it that its shadow may reach, lies in a view's crop."""
        reach = _SETTINGS.shadow_reach * float(trip.size_lwh[2])
        near = trip.near_point(view.time_s) - [reach, 0.0]
        size = trip.size_lwh + np.array([2 * reach, 2 * reach, 0.0])
        pixels = self.scene.camera.project(road_cuboids(near[None], size[None])[0])
        if not np.isfinite(pixels).all():  # partly behind the camera
            return trip is view.trip
        x0, y0, x1, y1 = view.crop_xyxy.tolist()
        (left, top), (right, bottom) = pixels.min(axis=0), pixels.max(axis=0)
        return bool(left < x1 and right > x0 and top < y1 and bottom > y0)

    def _entry(self, view: _View, vehicle_id: int, instance: int) -> dict[str, Any]:
        """Return the instance's entry in `dataset.pkl`."""
        low, high = view.vertices_px.min(axis=0), view.vertices_px.max(axis=0)
        return {
            "2DBB": [float(v) for v in (*low, *(high - low))],
            "3DBB": own_front_first(view.vertices_px, view.trip.lane.heading).tolist(),
            "3DBB_offset": [float(v) for v in view.crop_xyxy[:2]],
            "instance_id": instance,
            "path": f"{self.scene.name}/1/{vehicle_id:06d}_{instance:03d}.png",
        }


def _splits(samples: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """One split by body type: of every ten vehicles seven train, one validates, two test."""
    kinds = sorted({s["annotation"] for s in samples})
    order = np.random.default_rng([seed, 23]).permutation(len(samples)).tolist()
    parts: dict[str, Any] = {"train": [], "validation": [], "test": []}
    for rank, vehicle_id in enumerate(order):
        part = "train" if rank % 10 < 7 else "validation" if rank % 10 == 7 else "test"
        parts[part].append((vehicle_id, kinds.index(samples[vehicle_id]["annotation"])))
    return {"body": {**parts, "types_mapping": {kind: k for k, kind in enumerate(kinds)}}}
