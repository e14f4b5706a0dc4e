"""The exact truth of a synthetic recording, on disk.

    truth/SESSION/masks.json     COCO: instance masks as RLE, visible pixels only
    truth/SESSION/boxes.jsonl    one line per frame: 3D boxes in frame px and road metres
    truth/SESSION/tracks.json    one entry per vehicle: body type, size, lane, speed, frames

Each frame is written at once. A rendering that is ended early has the truth of the frames it made.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import as_output_error, make_folder
from labelgen.geometry import Camera, road_cuboids
from labelgen.labels import VehicleClass
from labelgen.synth.renderer.vehicle_masks import DrawnVehicle
from labelgen.synth.scene.traffic import Trip
from labelgen.synth.vehicle.body_types import BODY_TYPES

__all__ = ["TruthWriter", "encode_mask", "own_front_first"]

# COCO's own category numbers, so that masks can be mixed with those of other tools.
_CATEGORIES = {
    VehicleClass.CAR: 3,
    VehicleClass.MOTORCYCLE: 4,
    VehicleClass.BUS: 6,
    VehicleClass.TRUCK: 8,
    VehicleClass.VEHICLE: 3,
}
_NAMES = {3: "car", 4: "motorcycle", 6: "bus", 8: "truck"}


def encode_mask(mask: NDArray[np.bool_], origin_px: tuple[int, int], size_wh: tuple[int, int]) -> dict[str, Any]:
    """Encode a part of a frame's mask as COCO run-length encoding.

    Args:
        mask: (h, w) bool, not empty.
        origin_px: (x, y) frame px of its first pixel.
        size_wh: of the frame, px.
    """
    from pycocotools import mask as coco

    width, height = size_wh
    columns = np.ascontiguousarray(mask.T)
    change = np.diff(columns.astype(np.int8), axis=1, prepend=0, append=0)
    column, row = np.nonzero(change)
    # Positions in the frame read column by column; starts and ends of runs alternate, and a run that reaches the
    # frame's bottom goes on at the top of the next column, which leaves two equal positions that cancel out.
    at = (column + origin_px[0]) * height + row + origin_px[1]
    keep = np.ones(len(at), dtype=np.bool_)
    touching = np.flatnonzero(np.diff(at) == 0)
    keep[touching] = keep[touching + 1] = False
    at = at[keep]
    # The last run is not written when it is empty.
    ends = at if len(at) and at[-1] == width * height else np.append(at, width * height)
    counts = np.diff(ends, prepend=0)
    rle = coco.frPyObjects({"counts": counts.tolist(), "size": [height, width]}, height, width)
    return {"counts": rle["counts"].decode("ascii"), "size": [height, width]}


def own_front_first(vertices: NDArray[Any], heading: int) -> NDArray[Any]:
    """Return a cuboid's vertices (8, D) in the order of BoxCars: 0, 1 the vehicle's own front, 1, 2 its visible side.

    `vertices` are in the order of `road_cuboids`; `heading` is +1 away from the camera, -1 towards it.
    """
    return vertices if heading < 0 else vertices[[3, 2, 1, 0, 7, 6, 5, 4]]


def _short(values: Any, digits: int) -> list[Any]:
    out: list[Any] = np.round(np.asarray(values, dtype=np.float64), digits).tolist()
    return out


class TruthWriter:
    """Context manager that writes the truth frame by frame.

    Args:
        folder: where the three files go.
        camera: of the recording.
        fps: frames per second.
        video_name: what COCO's `file_name` says.

    Raises:
        OutputError: a file cannot be written.
    """

    def __init__(self, folder: Path, camera: Camera, fps: float, video_name: str = "video.avi") -> None:
        make_folder(folder)
        self._folder, self._camera, self._fps, self._video = folder, camera, fps, video_name
        self._open = ExitStack()
        self._boxes = self._open.enter_context((folder / "boxes.jsonl").open("w", encoding="utf-8"))
        self._images = self._open.enter_context(tempfile.TemporaryFile("w+", encoding="utf-8", dir=folder))  # noqa: SIM115
        self._annotations = self._open.enter_context(tempfile.TemporaryFile("w+", encoding="utf-8", dir=folder))  # noqa: SIM115
        self._count = self._frames = 0
        self._tracks: dict[int, dict[str, Any]] = {}
        self._places: dict[int, tuple[list[int], list[float], list[float]]] = {}

    def add(self, frame: int, trips: Sequence[Trip], drawn: Sequence[DrawnVehicle] | None) -> None:
        """Write the truth of one frame.

        Args:
            frame: number from 0.
            trips: vehicles that may show in it.
            drawn: their masks; None when no frames are rendered: then only boxes and tracks are written.
        """
        size = self._camera.image_wh
        assert size is not None
        time_s = frame / self._fps
        shown = None if drawn is None else {d.track_id: d for d in drawn}
        vehicles = []
        for trip in trips:
            near = trip.near_point(time_s)
            world = road_cuboids(near[None], trip.size_lwh[None])[0]
            pixels = self._camera.project(world)
            drawn_vehicle = shown.get(trip.track_id) if shown is not None else None
            if not np.isfinite(pixels).all() or (shown is not None and drawn_vehicle is None):
                continue
            if shown is None and not ((pixels.max(axis=0) > 0).all() and (pixels.min(axis=0) < size).all()):
                continue
            vehicles.append(self._vehicle(trip, time_s, near, world, pixels, drawn_vehicle))
            self._track(trip, frame, near, pixels)
            if drawn_vehicle is not None:
                self._annotate(trip, drawn_vehicle, size)
        image = {"id": frame, "file_name": self._video, "frame": frame, "width": size[0], "height": size[1]}
        with as_output_error(self._folder):
            self._boxes.write(json.dumps({"frame": frame, "vehicles": vehicles}) + "\n")
            self._images.write(("," if self._frames else "") + json.dumps(image))
        self._frames += 1

    def _vehicle(
        self, trip: Trip, time_s: float, near: NDArray[Any], world: NDArray[Any], pixels: NDArray[Any],
        drawn_vehicle: DrawnVehicle | None,
    ) -> dict[str, Any]:  # fmt: skip
        entry = {
            "track_id": trip.track_id,
            "kind": trip.kind,
            "heading": trip.lane.heading,
            "speed_kmh": round(trip.speed_ms(time_s) * 3.6, 6),
            "near_xy_m": _short(near, 5),
            "size_lwh_m": _short(trip.size_lwh, 5),
            "vertices_m": _short(world, 5),
            "vertices_px": _short(pixels, 4),
        }
        if drawn_vehicle is not None:
            entry["visible"] = round(drawn_vehicle.visible, 4)
            entry["outline_xyxy_px"] = _short(drawn_vehicle.outline_xyxy, 3)
        return entry

    def _track(self, trip: Trip, frame: int, near: NDArray[Any], pixels: NDArray[Any]) -> None:
        point = self._camera.project(near)
        frames, xs, ys = self._places.setdefault(trip.track_id, ([], [], []))
        frames.append(frame)
        xs.append(round(float(point[0]), 5))
        ys.append(round(float(point[1]), 5))

    def _annotate(self, trip: Trip, drawn_vehicle: DrawnVehicle, size: tuple[int, int]) -> None:
        rows, columns = np.flatnonzero(drawn_vehicle.mask.any(axis=1)), np.flatnonzero(drawn_vehicle.mask.any(axis=0))
        x, y = drawn_vehicle.origin_px
        box = [x + columns[0], y + rows[0], columns[-1] + 1 - columns[0], rows[-1] + 1 - rows[0]]
        shape = BODY_TYPES.get(trip.kind)
        self._count += 1
        annotation = {
            "id": self._count,
            "image_id": self._frames,
            "category_id": _CATEGORIES[shape.vehicle_class if shape else VehicleClass.VEHICLE],
            "iscrowd": 0,
            "bbox": [int(v) for v in box],
            "area": int(np.count_nonzero(drawn_vehicle.mask)),
            "segmentation": encode_mask(drawn_vehicle.mask, drawn_vehicle.origin_px, size),
            "track_id": trip.track_id,
            "visible": round(drawn_vehicle.visible, 4),
        }
        with as_output_error(self._folder):
            self._annotations.write(("," if self._count > 1 else "") + json.dumps(annotation))

    def describe(self, trips: Sequence[Trip]) -> None:
        """Keep what tracks.json says of each vehicle."""
        for trip in trips:
            middle = (trip.knots_s[0] + trip.knots_s[-1]) / 2
            self._tracks[trip.track_id] = {
                "track_id": trip.track_id,
                "car_id": trip.car_id,
                "kind": trip.kind,
                "lane": trip.lane.index,
                "heading": trip.lane.heading,
                "size_lwh_m": _short(trip.size_lwh, 5),
                "speed_kmh": round(trip.speed_ms(float(middle)) * 3.6, 6),
            }

    def result_cars(self) -> list[dict[str, Any]]:
        """Return the tracks as the public result files hold them."""
        return [
            {"id": track, "frames": frames, "posX": xs, "posY": ys}
            for track, (frames, xs, ys) in sorted(self._places.items())
        ]

    def __enter__(self) -> TruthWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            with contextlib.suppress(OSError):  # the error that ended the block is the cause
                self._open.close()
            return
        with as_output_error(self._folder):
            self._finish()

    def _finish(self) -> None:
        """Write what is known only at the end, and close the files."""
        categories = [{"id": number, "name": name} for number, name in _NAMES.items()]
        with (self._folder / "masks.json").open("w", encoding="utf-8") as out:
            out.write('{"info": {"description": "exact masks of a synthetic recording"}, "images": [')
            _copy(self._images, out)
            out.write('], "annotations": [')
            _copy(self._annotations, out)
            out.write(f'], "categories": {json.dumps(categories)}}}\n')
        self._open.close()
        tracks = [
            {**entry, "frames": [self._places[track][0][0], self._places[track][0][-1]]}
            for track, entry in sorted(self._tracks.items())
            if track in self._places
        ]
        text = json.dumps({"fps": self._fps, "frames": self._frames, "tracks": tracks}, indent=1)
        (self._folder / "tracks.json").write_text(text + "\n", encoding="utf-8")


def _copy(spool: Any, out: Any) -> None:
    spool.seek(0)
    shutil.copyfileobj(spool, out)
