"""A camera above a road, known by its vanishing points.

Convention:
    All arrays are float64. Points are (..., 2) as x, y in px of the frame, x right, y down.
    Pixels are areas: pixel (column j, row i) covers [j, j + 1) x [i, i + 1), so (0, 0) is the outer corner
    of the first pixel and its centre is (0.5, 0.5).
    VP1 is the direction of travel, VP2 lies across the road, VP3 is vertical.
    Road frame, in metres, right-handed: origin on the road under the camera, X towards VP1, Z up, Y to the left when
    looking towards VP1.
    Camera axes, right-handed: x right, y down, z ahead.

Source: Dubska et al., BMVC 2014. Distances follow the result files of BrnoCompSpeed (Sochor et al., IEEE T-ITS 2018),
whose `scale` includes a plane offset of 10 and a ray origin at (pp_x, pp_y, 0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from labelgen.atomic_files import write_json
from labelgen.errors import CalibrationError
from labelgen.geometry.frame_size import is_off_centre, scale_between, size_of_middle, size_text
from labelgen.geometry.homography import Array
from labelgen.json_file import read_json

__all__ = ["PLANE_OFFSET", "Camera", "look_at_road"]

PLANE_OFFSET = 10.0
"""Offset of the road plane in the public result files; every published `scale` assumes it."""

# Least cosine between a ray and the road's normal for a pixel below the horizon. A camera 10 m above the road sees a
# road point at this angle 1000 km away.
_HORIZON_COS = 1e-5
_SIZE_KEY = "image_wh"


def _point(value: Any, name: str, problems: list[str]) -> Array:
    try:
        point = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        point = np.empty(0)
    if point.shape != (2,) or not np.isfinite(point).all():
        problems.append(f"{name}: expected two finite numbers, got {_shown(value)}")
        return np.zeros(2)
    point.setflags(write=False)
    return point


def _scale(value: Any, problems: list[str]) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        problems.append(f"scale: expected a number, got {_shown(value)}")
        return None
    try:
        scale = float(value)
    except (TypeError, OverflowError):
        scale = math.inf
    if not (math.isfinite(scale) and scale > 0):
        problems.append(f"scale: expected a positive number, got {_shown(value)}")
    return scale


def _shown(value: Any) -> str:
    """Return a value as text for a message: one line of at most about 80 characters."""
    try:
        text = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # a number of more digits than Python prints, a list too deep
        return f"a {type(value).__name__} too long to show"
    return text if len(text) <= 80 else f"{text[:80]}..."


def _size(value: Any, problems: list[str]) -> tuple[int, int] | None:
    if value is None:
        return None
    try:
        width, height = value
        if int(width) == width > 0 and int(height) == height > 0:
            return int(width), int(height)
    except (TypeError, ValueError, OverflowError):
        pass
    problems.append(f"image_wh: expected two positive whole numbers, got {value!r}")
    return None


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: intrinsics and orientation from two orthogonal vanishing points, scale from one number.

    Args:
        vp1: (2,) px, vanishing point of the direction of travel.
        vp2: (2,) px, vanishing point across the road.
        pp: (2,) px, principal point.
        scale: metres per unit of the public road-plane convention; None where distances are not known.
        image_wh: frame size in px, where known.
        name: name of the camera in messages and shards.

    Attributes:
        focal: focal length, px.
        vp3: (2,) px, vertical vanishing point.

    Raises:
        CalibrationError: one message with all problems: values that are not finite, vanishing points that are not
            orthogonal, a scale that is not positive, a size that is not two positive integers.
    """

    vp1: Array
    vp2: Array
    pp: Array
    scale: float | None = None
    image_wh: tuple[int, int] | None = None
    name: str = ""
    focal: float = field(init=False)
    vp3: Array = field(init=False)

    def __post_init__(self) -> None:
        problems: list[str] = []
        vp1 = _point(self.vp1, "vp1", problems)
        vp2 = _point(self.vp2, "vp2", problems)
        pp = _point(self.pp, "pp", problems)
        scale = _scale(self.scale, problems)
        image_wh = _size(self.image_wh, problems)
        focal, vp3 = math.nan, np.zeros(2)
        if not problems:
            with np.errstate(over="ignore", invalid="ignore"):
                dot = float((vp1 - pp) @ (vp2 - pp))
            if dot >= 0:
                problems.append(
                    f"vp1 {vp1.tolist()} and vp2 {vp2.tolist()} cannot be orthogonal: seen from pp "
                    f"{pp.tolist()} they must lie more than 90 degrees apart; check their order and pp"
                )
            else:
                # Coordinates whose squares overflow give no finite focal length; they are refused below.
                focal = math.sqrt(-dot)
                with np.errstate(over="ignore", invalid="ignore"):
                    normal = np.cross([*(vp1 - pp), focal], [*(vp2 - pp), focal])
                if not np.isfinite(normal).all():
                    problems.append(f"vp1 {vp1.tolist()} and vp2 {vp2.tolist()} lie too far away to compute with")
                elif abs(normal[2]) <= 1e-9 * np.linalg.norm(normal):
                    problems.append(
                        "vp1, vp2 and pp lie on one line: the camera looks along the horizon and VP3 is "
                        "at infinity; check pp"
                    )
                else:
                    vp3 = normal[:2] / normal[2] * focal + pp
        if problems:
            label = f"camera {self.name}: " if self.name else "camera: "
            raise CalibrationError(label + "; ".join(problems))
        vp3.setflags(write=False)
        for key, value in {
            "vp1": vp1,
            "vp2": vp2,
            "pp": pp,
            "scale": scale,
            "image_wh": image_wh,
            "focal": focal,
            "vp3": vp3,
        }.items():
            object.__setattr__(self, key, value)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Camera):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return (*self.vp1, *self.vp2, *self.pp, self.scale, self.image_wh, self.name)

    # -- reading and writing ------------------------------------------------------------------------

    @classmethod
    def from_dict(cls, data: Any, *, name: str = "", image_wh: tuple[int, int] | None = None) -> Camera:
        """Return the camera of the public result format, `{"camera_calibration": {vp1, vp2, pp, scale}, ...}`.

        Args:
            data: the parsed JSON object, or its inner object alone; `scale` may be missing. Where it has a key
                `image_wh` beside `camera_calibration`, the calibration is of frames of that size.
            name: name of the camera.
            image_wh: frame size in px, where known; a calibration of another size is scaled, see `fitted_to`.

        Raises:
            CalibrationError: a key is missing, the values describe no camera, or the calibration is of frames of
                another ratio.
        """
        where = f"calibration {name}" if name else "calibration"
        inner = data.get("camera_calibration", data) if isinstance(data, Mapping) else None
        if not isinstance(inner, Mapping):
            raise CalibrationError(f"{where}: no camera in it; expected an object 'camera_calibration'")
        missing = [key for key in ("vp1", "vp2", "pp") if key not in inner]
        if missing:
            raise CalibrationError(f"{where}: no camera in it; missing {', '.join(missing)} in 'camera_calibration'")
        own_wh = data.get(_SIZE_KEY, inner.get(_SIZE_KEY))
        camera = cls(inner["vp1"], inner["vp2"], inner["pp"], inner.get("scale"), image_wh=own_wh, name=name)
        return camera if image_wh is None else camera.fitted_to(image_wh)

    @classmethod
    def load(cls, path: str | Path, *, image_wh: tuple[int, int] | None = None) -> Camera:
        """Read a camera from a JSON file in the public result format, with or without cars.

        Args:
            path: the file; its stem becomes the camera's name.
            image_wh: frame size in px, where known; a calibration of another size is scaled, see `fitted_to`.

        Raises:
            CalibrationError: the file cannot be read, is not JSON, describes no camera, or is of frames of another
                ratio.
        """
        path = Path(path)
        data = read_json(path, f"calibration {path}", error=CalibrationError)
        return replace(cls.from_dict(data, name=str(path), image_wh=image_wh), name=path.stem)

    def to_dict(self) -> dict[str, Any]:
        """Return the camera in the public result format, without cars; the frame size, where known, beside it."""
        calibration: dict[str, Any] = {key: getattr(self, key).tolist() for key in ("vp1", "vp2", "pp")}
        if self.scale is not None:
            calibration["scale"] = self.scale
        size = {} if self.image_wh is None else {_SIZE_KEY: list(self.image_wh)}
        return {"camera_calibration": calibration, **size, "cars": []}

    def save(self, path: str | Path) -> None:
        """Write the camera as a JSON file in the public result format, without cars; `load` reads it.

        Raises:
            OutputError: the file cannot be written.
        """
        write_json(Path(path), self.to_dict())

    # -- derived geometry ---------------------------------------------------------------------------

    def vanishing_point(self, index: int) -> Array:
        """Return VP1, VP2 or VP3, (2,) px, by its number."""
        return {1: self.vp1, 2: self.vp2, 3: self.vp3}[index]

    @cached_property
    def plane_normal(self) -> Array:
        """(3,) unit normal of the road in camera axes, in the direction of VP3."""
        normal = np.array([*(self.vp3 - self.pp), self.focal])
        unit: Array = normal / np.linalg.norm(normal)
        return unit

    @cached_property
    def axes(self) -> Array:
        """(3, 3) rotation from camera axes to the road frame: its rows are X, Y and Z in camera axes."""
        ahead = np.array([*(self.vp1 - self.pp), self.focal])
        ahead /= np.linalg.norm(ahead)
        # The plane's normal points down unless the camera looks above the horizon.
        up = -self.plane_normal if self.plane_normal[1] > 0 else self.plane_normal
        return np.stack([ahead, np.cross(up, ahead), up])

    @cached_property
    def height_m(self) -> float:
        """Height of the camera above the road, metres.

        Raises:
            CalibrationError: the camera has no scale.
        """
        if self.scale is None:
            raise CalibrationError(
                f"camera {self.name or '(unnamed)'}: it has no scale, so there are no metres; "
                "add 'scale' to the calibration"
            )
        return self.scale * abs(float(self.plane_normal[:2] @ self.pp) + PLANE_OFFSET)

    def rays(self, points_px: ArrayLike) -> Array:
        """Return the viewing directions (..., 3) of pixels (..., 2), in the road frame's axes and of any length."""
        points = np.asarray(points_px, dtype=np.float64)
        ahead = np.full((*points.shape[:-1], 1), self.focal)
        out: Array = np.concatenate([points - self.pp, ahead], axis=-1) @ self.axes.T
        return out

    def road_points(self, points_px: ArrayLike, *, invalid: Literal["raise", "nan"] = "raise") -> Array:
        """Project pixels onto the road.

        Args:
            points_px: (..., 2) px.
            invalid: "raise" or "nan" for pixels on or above the horizon.

        Returns:
            (..., 2) X, Y in the road frame, metres. Distances between them are those of the public convention.

        Raises:
            CalibrationError: the camera has no scale, or invalid="raise" and a pixel lies on or above the horizon.
        """
        points = np.asarray(points_px, dtype=np.float64)
        rays = self.rays(points)
        down = -rays[..., 2]
        off = ~(down > _HORIZON_COS * np.linalg.norm(rays, axis=-1))
        if invalid == "raise" and off.any():
            first = points[off].reshape(-1, 2)[0].tolist()
            raise CalibrationError(
                f"camera {self.name or '(unnamed)'}: pixel {first} lies on or above the horizon, not on the road"
            )
        out: Array = rays[..., :2] * (self.height_m / np.where(off, np.nan, down))[..., None]
        return out

    def project(self, points_m: ArrayLike) -> Array:
        """Project points of the road frame into the frame.

        Args:
            points_m: (..., 3) metres, or (..., 2) for points on the road.

        Returns:
            (..., 2) px; NaN for points that do not lie in front of the camera.

        Raises:
            CalibrationError: the camera has no scale.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.shape[-1] == 2:
            points = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
        in_camera = (points - np.array([0.0, 0.0, self.height_m])) @ self.axes
        depth = in_camera[..., 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            out: Array = self.pp + self.focal * in_camera[..., :2] / np.where(depth > 0, depth, np.nan)
        return out

    def resized(self, factor: float) -> Camera:
        """Return the camera of the same view for frames scaled by a factor; distances in metres stay the same.

        Args:
            factor: new width over old width, positive.

        Raises:
            CalibrationError: a factor that is not positive and finite.
        """
        if not (math.isfinite(factor) and factor > 0):
            raise CalibrationError(f"camera {self.name or '(unnamed)'}: expected a positive factor, got {factor}")
        wh = self.image_wh
        camera = replace(
            self,
            vp1=self.vp1 * factor,
            vp2=self.vp2 * factor,
            pp=self.pp * factor,
            image_wh=wh and (round(wh[0] * factor), round(wh[1] * factor)),
        )
        if self.scale is None:
            return camera
        # The plane offset is in pixels, so the published scale changes with the frame size.
        unit = replace(camera, scale=1.0)
        return replace(camera, scale=self.height_m / unit.height_m)

    def own_wh(self, image_wh: tuple[int, int]) -> tuple[int, int] | None:
        """Return the frame size that the camera is of, px: as it states, or as its principal point shows.

        Args:
            image_wh: size of the frames that it shall be used for, px; None is returned where nothing says that the
                camera is of another one.
        """
        return self.image_wh or size_of_middle(self.pp.tolist(), image_wh)

    def fitted_to(self, image_wh: tuple[int, int]) -> Camera:
        """Return the camera for frames of a size (width, height) px: scaled where it is of another size.

        Raises:
            CalibrationError: it is of frames of another ratio; or it states no size, and its principal point is far
                from the middle of such frames.
        """
        own = self.own_wh(image_wh)
        if own is None and is_off_centre(self.pp.tolist(), image_wh):
            raise CalibrationError(
                f"{self._principal_point(image_wh)}: it is of frames of another size; calibrate this video, or, where "
                f'its frames are cropped, state their size in the file as "{_SIZE_KEY}": {list(image_wh)}',
                parameter="calibration",
            )
        if own is None or own == tuple(image_wh):
            return replace(self, image_wh=image_wh)
        factor = scale_between(own, image_wh)
        if factor is None:
            raise CalibrationError(
                f"calibration {self.name}: it is of frames of {size_text(own)} px, but these are "
                f"{size_text(image_wh)}, which is not the same ratio; calibrate this video",
                parameter="calibration",
            )
        return replace(self.resized(factor), image_wh=image_wh)

    def size_doubt(self) -> str | None:
        """Return a line that says why the calibration may be of frames of another size; None where nothing does."""
        if self.image_wh is None or not is_off_centre(self.pp.tolist(), self.image_wh):
            return None
        return f"{self._principal_point(self.image_wh)}: right only where the frames are cropped"

    def _principal_point(self, image_wh: tuple[int, int]) -> str:
        return (
            f"calibration {self.name}: its principal point ({self.pp[0]:g}, {self.pp[1]:g}) is far from the middle "
            f"({image_wh[0] / 2:g}, {image_wh[1] / 2:g}) of the frames of {size_text(image_wh)} px"
        )


def look_at_road(
    height_m: float, target_xy: tuple[float, float], focal: float, size_wh: tuple[int, int], roll_deg: float = 0.0,
    name: str = "",
) -> Camera:  # fmt: skip
    """Return a camera above the road frame's origin that looks at a point of the road.

    Args:
        height_m: height above the road, metres.
        target_xy: the point, metres in the road frame.
        focal: focal length, px.
        size_wh: frame size, px; the principal point lies in its middle.
        roll_deg: rotation around the optical axis, degrees.
        name: name of the camera.

    Raises:
        CalibrationError: the target gives vanishing points at infinity or no view of the road.
    """
    ahead = np.array([*target_xy, -height_m], dtype=np.float64)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    angle = np.radians(roll_deg)
    right, down = np.cos(angle) * right + np.sin(angle) * down, np.cos(angle) * down - np.sin(angle) * right
    # Rows: camera axes in the road frame. Columns then are the road's directions in camera axes.
    axes = np.stack([right, down, ahead])
    pp = np.array(size_wh) / 2
    vp1, vp2 = (pp + focal * axes[:2, k] / axes[2, k] for k in (0, 1))
    unit = Camera(vp1, vp2, pp, 1.0)
    return Camera(vp1, vp2, pp, height_m / unit.height_m, image_wh=size_wh, name=name)
