"""Small drawn videos of boxes with windows that drive where they are told: straight, in a bend, across."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np

from labelgen.geometry import Camera
from labelgen.geometry.camera import look_at_road
from labelgen.media.frames import Frame, always

SIZE = (640, 360)
FPS = 15.0
Pose = tuple[float, float, float]
"""X, Y in metres and heading in rad, of a vehicle's middle."""

_FACES = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def make_camera(
    height_m: float = 9.0, target: tuple[float, float] = (30.0, 6.0), focal: float = 620.0, roll_deg: float = 1.0
) -> Camera:
    return look_at_road(height_m, target, focal, SIZE, roll_deg)


@dataclass(frozen=True)
class Mover:
    """Something that moves: where it is at a time, how large it is, and whether it is a box or a ball."""

    pose: Callable[[float], Pose]
    size_lwh: tuple[float, float, float] = (4.4, 1.8, 1.5)
    seed: int = 0
    ball: bool = False


def straight(start_s: float, y: float, speed_ms: float, *, far_m: float = 75.0) -> Callable[[float], Pose]:
    """Along X: away with a positive speed, from far to near with a negative one."""
    x0 = 3.0 if speed_ms > 0 else far_m
    return lambda t: (x0 + speed_ms * (t - start_s), y, 0.0)


def bend(start_s: float, offset: float, speed_ms: float, radius_m: float) -> Callable[[float], Pose]:
    """Round a bend to the right that begins under the camera."""

    def pose(t: float) -> Pose:
        angle = (75.0 - speed_ms * (t - start_s)) / radius_m
        return (radius_m - offset) * np.sin(angle), (radius_m - offset) * (np.cos(angle) - 1) + offset, -angle

    return pose


def crossing(start_s: float, x: float, speed_ms: float) -> Callable[[float], Pose]:
    """From right to left through the picture."""
    return lambda t: (x, -25.0 + speed_ms * (t - start_s), np.pi / 2)


def traffic(seconds: float, lanes: Sequence[tuple[float, float]], every_s: float = 1.6, **looks: bool) -> list[Mover]:
    """Vehicles at intervals on lanes (Y, signed speed in m/s)."""
    rng = np.random.default_rng(4)
    out = []
    for lane, (y, speed) in enumerate(lanes):
        for k, start in enumerate(np.arange(-4.0 + 0.5 * lane, seconds, every_s)):
            size = tuple(np.array([4.4, 1.8, 1.5]) * rng.uniform(0.93, 1.07, 3))
            out.append(Mover(straight(float(start), y + rng.normal(0, 0.1), speed), size, 31 * lane + k, **looks))
    return out


@dataclass
class DrawnVideo:
    """A `labelgen.media.frames.FrameSource` that draws its frames."""

    movers: Sequence[Mover]
    seconds: float
    camera_at: Callable[[float], Camera] = field(default=lambda t: make_camera())
    name: str = "drawn"
    size_wh: tuple[int, int] = SIZE
    fps: float | None = FPS
    count_is_exact: bool = True
    untimed: str = ""
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    failure: Exception | None = None
    is_live: bool = False

    def __post_init__(self) -> None:
        self.path = Path(self.name)
        self.frame_count = round(self.seconds * FPS)
        rng = np.random.default_rng(0)
        tile = cv2.resize(rng.integers(70, 150, (100, 100), dtype=np.uint8), (800, 800), interpolation=cv2.INTER_CUBIC)
        self._ground = tile

    def frames(
        self, wanted: Callable[[int], bool] = always, not_before_s: Callable[[], float] | None = None
    ) -> Iterator[Frame]:
        for number in range(self.frame_count):
            if wanted(number):
                yield Frame(number, number / FPS, self.draw(number / FPS))

    def draw(self, time_s: float) -> np.ndarray:
        camera = self.camera_at(time_s)
        picture = cv2.cvtColor(self._road(camera), cv2.COLOR_GRAY2BGR)
        shown = [(m, m.pose(time_s)) for m in self.movers]
        for mover, pose in sorted(shown, key=lambda s: -np.hypot(*s[1][:2])):
            if -20 < pose[0] < 110 and abs(pose[1]) < 60:
                (_draw_ball if mover.ball else _draw_box)(picture, camera, mover, pose)
        noise = np.random.default_rng(round(time_s * 1000)).integers(-3, 4, picture.shape[:2], dtype=np.int16)
        return np.clip(picture.astype(np.int16) + noise[..., None], 0, 255).astype(np.uint8)

    def _road(self, camera: Camera) -> np.ndarray:
        """Rough ground of 0.5 m grain out to 100 m; sky above."""
        grid = np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            metres = camera.road_points(grid, invalid="nan")
        far = ~(np.hypot(metres[..., 0], metres[..., 1]) < 150)
        at = np.where(far[..., None], 0, metres * 16 % 800).astype(np.float32)
        ground = cv2.remap(self._ground, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        ground[far] = 200
        return ground


def _corners(mover: Mover, pose: Pose) -> np.ndarray:
    """(8, 3) metres: the bottom's four corners, then the top's."""
    half_l, half_w = mover.size_lwh[0] / 2, mover.size_lwh[1] / 2
    base = np.array([[half_l, half_w], [half_l, -half_w], [-half_l, -half_w], [-half_l, half_w]])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    flat = base @ np.array([[cos, sin], [-sin, cos]]) + np.array(pose[:2])
    return np.concatenate([np.c_[flat, np.zeros(4)], np.c_[flat, np.full(4, mover.size_lwh[2])]])


def _draw_box(picture: np.ndarray, camera: Camera, mover: Mover, pose: Pose) -> None:
    corners = _corners(mover, pose)
    px = camera.project(corners)
    if not np.isfinite(px).all():
        return
    eye = np.array([0.0, 0.0, camera.height_m])
    rng = np.random.default_rng(mover.seed)
    colour = rng.integers(20, 230, 3)
    middle = corners.mean(axis=0)
    for face in _FACES[1:]:
        quad = corners[list(face)]
        outward = quad.mean(axis=0) - middle
        shade = rng.uniform(0.55, 1.0)
        if outward @ (eye - quad.mean(axis=0)) <= 0:
            continue
        _fill(picture, px[list(face)], colour * shade)
        # A window and a plate give each face edges of its own.
        for low, high, level in ((0.15, 0.85, 0.3), (0.35, 0.65, 1.2)):
            inner = np.array([[low, low], [high, low], [high, high], [low, high]])
            a, b, d = quad[0], quad[1] - quad[0], quad[3] - quad[0]
            _fill(picture, camera.project(a + inner[:, :1] * b + inner[:, 1:] * d), colour * shade * level)


def _draw_ball(picture: np.ndarray, camera: Camera, mover: Mover, pose: Pose) -> None:
    centre = camera.project(np.array([pose[0], pose[1], 0.8]))
    radius = 0.9 * camera.focal / max(np.hypot(np.hypot(*pose[:2]), camera.height_m), 1.0)
    rng = np.random.default_rng(mover.seed)
    if np.isfinite(centre).all() and radius > 1:
        for _ in range(24):
            spot = centre + rng.normal(0, 0.45, 2) * radius
            _disc(picture, spot, radius * rng.uniform(0.15, 0.4), rng.integers(0, 255, 3))


def _disc(picture: np.ndarray, centre: np.ndarray, radius: float, colour: np.ndarray) -> None:
    if (np.abs(centre) < 4000).all():
        place = tuple(int(v) for v in np.round((centre - 0.5) * 16))
        cv2.circle(picture, place, max(1, round(radius * 16)), colour.tolist(), -1, cv2.LINE_AA, 4)


def _fill(picture: np.ndarray, polygon: np.ndarray, colour: np.ndarray) -> None:
    if np.isfinite(polygon).all() and (np.abs(polygon) < 5000).all():
        points = np.round((polygon - 0.5) * 16).astype(np.int32)
        cv2.fillConvexPoly(picture, points, np.clip(colour, 0, 255).tolist(), cv2.LINE_AA, 4)


def write_video(path: Path, video: DrawnVideo) -> Path:
    """The same as a file."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=round(FPS))
        stream.width, stream.height = SIZE
        stream.bit_rate = 4_000_000
        for frame in video.frames():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image, format="bgr24")))
        container.mux(stream.encode())
    return path
