"""Ground truth of the Luvizon data set: one folder per video with vehicles.xml, lanes.xml and matrix.txt.

Source: Luvizon, Nassu, Minetto, "A Video-Based System for Vehicle Speed Measurement in Urban Roadways",
IEEE T-ITS 2017.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
import shapely
from numpy.typing import NDArray

from labelgen.datasets.manifest import load_manifest
from labelgen.errors import DataError
from labelgen.geometry.homography import Array, IntArray

__all__ = ["LANES", "LuvizonVideo", "is_luvizon", "read_luvizon_video", "select_videos"]

LANES = 3
"""Number of lanes in every video."""

_MEASURED_AREA = "measure"


@dataclass(frozen=True, eq=False)
class LuvizonVideo:
    """V scored vehicles, in file order, and the lanes of one video.

    Args:
        name: the folder's parent and the folder, "subset01/video01".
        lanes: (V,) lane numbers, 1 to 3.
        frames: (V, 2) first and last frame of the speed measurement, both included.
        speeds_kmh: (V,) true speeds.
        left_out: number of vehicles that are not scored, by reason.
        lane_areas: polygon of each lane, frame px, by lane number.
        homographies: (3, 3, 3) the publisher's homographies from frame px to the road plane, one per lane.
    """

    name: str
    lanes: IntArray
    frames: IntArray
    speeds_kmh: Array
    left_out: Mapping[str, int]
    lane_areas: Mapping[int, shapely.Polygon]
    homographies: Array

    def __len__(self) -> int:
        return len(self.speeds_kmh)


def read_luvizon_video(folder: str | Path) -> LuvizonVideo:
    """Read the ground truth of one video.

    Args:
        folder: folder of the video.

    Raises:
        DataError: a file is missing or not of its layout, or its XML declares a document type.
    """
    folder = Path(folder)
    layout = load_manifest("luvizon")["layout"]
    vehicles, left_out = _vehicles(folder / layout["ground_truth"])
    return LuvizonVideo(
        name=f"{folder.resolve().parent.name}/{folder.resolve().name}",
        lanes=np.array([lane for lane, *_ in vehicles], dtype=np.int64),
        frames=np.array([frames for _, frames, _ in vehicles], dtype=np.int64).reshape(-1, 2),
        speeds_kmh=np.array([speed for *_, speed in vehicles], dtype=np.float64),
        left_out=dict(left_out),
        lane_areas=_lane_areas(folder / layout["lanes"]),
        homographies=_homographies(folder / layout["homographies"]),
    )


def _videos(dataset: Path) -> list[str]:
    layout = load_manifest("luvizon")["layout"]
    files = dataset.glob(f"{layout['videos']}/{layout['ground_truth']}")
    return sorted(f"{path.parts[-3]}/{path.parts[-2]}" for path in files)


def is_luvizon(dataset: str | Path) -> bool:
    """Return whether a folder has the layout of the Luvizon data set."""
    return bool(_videos(Path(dataset)))


def select_videos(dataset: str | Path, choice: str) -> list[str]:
    """Return the names of the chosen videos, such as "subset01/video01".

    Args:
        dataset: folder of the subsets.
        choice: "all"; "test", the first half of each subset, rounded up; "training", the others; or names separated by
            commas. Only videos in the folder are taken.

    Raises:
        DataError: unknown video, or no video is left.
    """
    present = _videos(Path(dataset))
    names = present
    if choice in ("test", "training"):
        totals: dict[str, int] = load_manifest("luvizon")["splits"]["test"]
        test = {
            f"{subset}/video{number:02d}"
            for subset, total in totals.items()
            for number in range(1, (total + 1) // 2 + 1)
        }
        names = [name for name in present if (name in test) == (choice == "test")]
    elif choice != "all":
        names = list(dict.fromkeys(name.strip() for name in choice.split(",") if name.strip()))
    unknown = [name for name in names if name not in present]
    if unknown or not names:
        missing, available = ", ".join(unknown) or repr(choice), ", ".join(present) or "none"
        raise DataError(f"data set {dataset}: no video {missing}; there are {available}")
    return names


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; a Luvizon video's folder has one") from None
    except OSError as err:
        raise DataError(f"{path}: {err.strerror or err}") from None


def _parse_xml(path: Path) -> ElementTree.Element:
    """Parse an XML file; refuse a document type, whose entities could fill the memory or read other files."""
    data = _read(path)

    def refuse(*_: Any) -> None:
        raise DataError(f"{path}: it declares a document type, which no ground truth needs; nothing of it was read")

    checker = expat.ParserCreate()
    checker.StartDoctypeDeclHandler = refuse
    try:
        checker.Parse(data, True)
        return ElementTree.fromstring(data)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError, OverflowError) as err:
        raise DataError(f"{path}: not XML ({err})") from None


def _is_true(element: ElementTree.Element, name: str) -> bool:
    return element.get(name, "").strip().lower() in ("true", "1")


def _vehicles(path: Path) -> tuple[list[tuple[int, tuple[int, int], float]], Counter[str]]:
    """Read lane, frames and speed of the scored vehicles; count the others by reason."""
    root = _parse_xml(path)
    vehicles, left_out = [], Counter[str]()
    if not len(root):
        raise DataError(f"{path}: expected a list of vehicles under the root's first child, it has none")
    for number, vehicle in enumerate(root[0], start=1):
        radar = vehicle.find("radar")
        if radar is None:
            left_out["without radar"] += 1
        elif _is_true(vehicle, "moto"):
            left_out["motorcycle"] += 1
        elif not _is_true(vehicle, "plate"):
            left_out["without plate"] += 1
        elif _is_true(vehicle, "sema"):
            left_out["sema"] += 1
        else:
            vehicles.append(_vehicle(vehicle, radar, f"{path}: vehicle {number}"))
    return vehicles, left_out


def _vehicle(
    vehicle: ElementTree.Element, radar: ElementTree.Element, where: str
) -> tuple[int, tuple[int, int], float]:
    try:
        lane = int(vehicle.attrib["lane"])
        first, last = (int(radar.attrib[name]) for name in ("frame_start", "frame_end"))
        speed = float(radar.attrib["speed"])
    except KeyError as err:
        raise DataError(f"{where}: attribute {err} is missing") from None
    except ValueError as err:
        raise DataError(f"{where}: {err}") from None
    if not 1 <= lane <= LANES or first > last or not (math.isfinite(speed) and speed > 0):
        raise DataError(f"{where}: expected lane 1 to {LANES}, frame_start <= frame_end and a positive speed")
    return lane, (first, last), speed


def _lane_areas(path: Path) -> dict[int, shapely.Polygon]:
    """Read the polygon of each lane; that of its measurement area where a file has no others."""
    corners_by_lane: dict[bool, dict[int, list[tuple[float, float]]]] = {True: {}, False: {}}
    for element in _parse_xml(path).iter():
        corners = [child for child in element if "x" in child.attrib and "y" in child.attrib]
        name = element.get("id", element.get("lane"))
        if len(corners) < 3 or name is None:
            continue
        try:
            polygon = [(float(corner.attrib["x"]), float(corner.attrib["y"])) for corner in corners]
            lane = int(name)
        except ValueError as err:
            raise DataError(f"{path}: {err}") from None
        corners_by_lane[_MEASURED_AREA not in element.tag.lower()].setdefault(lane, []).extend(polygon)
    by_lane = corners_by_lane[True] or corners_by_lane[False]
    # A file lists the corners of a lane in any order; lanes are convex.
    areas = {lane: shapely.MultiPoint(corners).convex_hull for lane, corners in by_lane.items() if 1 <= lane <= LANES}
    if not areas or not all(isinstance(area, shapely.Polygon) for area in areas.values()):
        raise DataError(f"{path}: expected polygons of points with x and y, each in an element with a lane's id")
    return areas


def _homographies(path: Path) -> Array:
    """Read (3, 3, 3) homographies, one per lane."""
    try:
        rows = np.array([line.replace(",", " ").split() for line in _read(path).decode().splitlines() if line.strip()])
        matrices: NDArray[np.float64] = rows.astype(np.float64).reshape(LANES, 3, 3)
    except ValueError as err:
        raise DataError(f"{path}: expected {LANES * 3} rows of three numbers ({err})") from None
    if not np.isfinite(matrices).all() or not np.linalg.det(matrices).all():
        raise DataError(f"{path}: a homography is not finite or not invertible")
    return matrices
