"""A camera above a road, known by its vanishing points.

Convention:
    Pixels are areas: pixel (column j, row i) covers [j, j + 1) x [i, i + 1), so (0, 0) is the outer corner
    of the first pixel and its centre is (0.5, 0.5). x points right, y points down.
    VP1 is the direction of travel, VP2 lies across the road, VP3 is vertical.
    Road frame, in metres, right-handed: origin on the road under the camera, X towards VP1, Z up, so Y
    points to the left of somebody who looks towards VP1.

Source: Dubska et al., BMVC 2014; the distance convention of the BrnoCompSpeed result files (Sochor et al.,
IEEE T-ITS 2018), whose plane offset of 10 and ray origin (pp_x, pp_y, 0) belong to what `scale` means.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from labelgen.errors import CalibrationError
from labelgen.geometry.homography import Array

__all__ = ["PLANE_OFFSET", "Camera", "look_at_road"]

PLANE_OFFSET = 10.0
"""Offset of the road plane in the public result files; every published `scale` assumes it."""

# Cosine between a ray and the road's normal under which a pixel counts as on the horizon: a camera at
# 10 m sees such a point 1000 km away.
_HORIZON_COS = 1e-5


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
    """A value in a message: one line, not longer than it helps."""
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
    """Intrinsics and orientation from two orthogonal vanishing points; scale from one number.

    Args:
        vp1: (2,) px, vanishing point of the direction of travel.
        vp2: (2,) px, vanishing point across the road.
        pp: (2,) px, principal point.
        scale: metres per unit of the public road-plane convention; None where distances are not known.
        image_wh: frame size in px, where known.
        name: what to call this camera in messages and shards.

    Raises:
        CalibrationError: all problems at once (not finite, not orthogonal, scale <= 0, ...).
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
        """Camera from the public result format, `{"camera_calibration": {vp1, vp2, pp, scale}, ...}`.

        The inner object alone is accepted too. `scale` may be missing; everything else must be there.
        """
        where = f"calibration {name}" if name else "calibration"
        inner = data.get("camera_calibration", data) if isinstance(data, Mapping) else None
        if not isinstance(inner, Mapping):
            raise CalibrationError(f"{where}: no camera in it; expected an object 'camera_calibration'")
        missing = [key for key in ("vp1", "vp2", "pp") if key not in inner]
        if missing:
            raise CalibrationError(f"{where}: no camera in it; missing {', '.join(missing)} in 'camera_calibration'")
        return cls(inner["vp1"], inner["vp2"], inner["pp"], inner.get("scale"), image_wh=image_wh, name=name)

    @classmethod
    def load(cls, path: str | Path, *, image_wh: tuple[int, int] | None = None) -> Camera:
        """Camera from a public JSON file (a calibration alone, or a result file with cars)."""
        path = Path(path)
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise CalibrationError(f"calibration {path}: no such file") from None
        except OSError as err:
            raise CalibrationError(f"calibration {path}: {err.strerror or err}") from None
        except (ValueError, RecursionError) as err:
            raise CalibrationError(f"calibration {path}: not JSON ({err})") from None
        return replace(cls.from_dict(data, name=str(path), image_wh=image_wh), name=path.stem)

    def to_dict(self) -> dict[str, Any]:
        """The public result format, without cars."""
        calibration: dict[str, Any] = {key: getattr(self, key).tolist() for key in ("vp1", "vp2", "pp")}
        if self.scale is not None:
            calibration["scale"] = self.scale
        return {"camera_calibration": calibration, "cars": []}

    # -- derived geometry ---------------------------------------------------------------------------

    def vanishing_point(self, index: int) -> Array:
        """VP1, VP2 or VP3 by its number."""
        return {1: self.vp1, 2: self.vp2, 3: self.vp3}[index]

    @cached_property
    def plane_normal(self) -> Array:
        """(3,) unit normal of the road along VP3's direction, in camera axes (x right, y down, z ahead)."""
        normal = np.array([*(self.vp3 - self.pp), self.focal])
        unit: Array = normal / np.linalg.norm(normal)
        return unit

    @cached_property
    def axes(self) -> Array:
        """(3, 3) rotation whose rows are the road frame's X, Y, Z in camera axes."""
        ahead = np.array([*(self.vp1 - self.pp), self.focal])
        ahead /= np.linalg.norm(ahead)
        # The plane's normal points down unless the camera looks above the horizon.
        up = -self.plane_normal if self.plane_normal[1] > 0 else self.plane_normal
        return np.stack([ahead, np.cross(up, ahead), up])

    @cached_property
    def height_m(self) -> float:
        """Height of the camera above the road, metres.

        Raises:
            CalibrationError: without a scale.
        """
        if self.scale is None:
            raise CalibrationError(
                f"camera {self.name or '(unnamed)'}: it has no scale, so there are no metres; "
                "add 'scale' to the calibration"
            )
        return self.scale * abs(float(self.plane_normal[:2] @ self.pp) + PLANE_OFFSET)

    def rays(self, points_px: ArrayLike) -> Array:
        """(..., 3) directions, in the axes of the road frame and of any length, in which pixels (..., 2) look."""
        points = np.asarray(points_px, dtype=np.float64)
        ahead = np.full((*points.shape[:-1], 1), self.focal)
        out: Array = np.concatenate([points - self.pp, ahead], axis=-1) @ self.axes.T
        return out

    def road_points(self, points_px: ArrayLike, *, invalid: Literal["raise", "nan"] = "raise") -> Array:
        """Points of the road seen at pixels, in metres.

        Args:
            points_px: (..., 2) px.
            invalid: what to do with pixels on or above the horizon.

        Returns:
            (..., 2) X, Y in the road frame. Distances between them are those of the public convention.

        Raises:
            CalibrationError: no scale, or a pixel on or above the horizon with invalid="raise".
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
        """Pixels of points in the road frame.

        Args:
            points_m: (..., 3) metres; or (..., 2) for points on the road.

        Returns:
            (..., 2) px; NaN for points that are not in front of the camera.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.shape[-1] == 2:
            points = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
        seen = (points - np.array([0.0, 0.0, self.height_m])) @ self.axes
        depth = seen[..., 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            out: Array = self.pp + self.focal * seen[..., :2] / np.where(depth > 0, depth, np.nan)
        return out

    def resized(self, factor: float) -> Camera:
        """The same camera for frames scaled by `factor` > 0; distances in metres stay as they are."""
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


def look_at_road(
    height_m: float, target_xy: tuple[float, float], focal: float, size_wh: tuple[int, int], roll_deg: float = 0.0,
    name: str = "",
) -> Camera:  # fmt: skip
    """Camera `height_m` above the road frame's origin that looks at a point of the road.

    Args:
        height_m: metres.
        target_xy: metres in the road frame.
        focal: px.
        size_wh: frame size; the principal point lies in its middle.
        roll_deg: turn around the optical axis.
        name: of the camera.
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
