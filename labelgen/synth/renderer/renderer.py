"""Draw vehicles into frames.

A frame is the picture of the empty road, darkened by the vehicles' shadows. The vehicles are drawn over it from far to
near, each in its own window; the sensor's noise comes last. Each vehicle's mask comes from the same samples as its
pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry import Camera
from labelgen.synth.renderer.placed_vehicle import PlacedVehicle, painting_order
from labelgen.synth.renderer.vehicle_masks import DrawnVehicle, Layer, body_mask, covered_by, visible_parts
from labelgen.synth.renderer.vehicle_shadows import GroundShadow, ground_shadow, shadow_colours
from labelgen.synth.scene.static_layer import NO_SHADE, StaticLayer
from labelgen.synth.sensor.compression_artifacts import add_block_artifacts
from labelgen.synth.sensor.glints import Glints
from labelgen.synth.sensor.sensor import PLAIN, Sensor
from labelgen.synth.shading.lighting import Light
from labelgen.synth.shading.rasterizer import darken, lay_over, shade, visible_triangles

__all__ = ["Renderer"]

_MIN_DEPTH = 1.0
"""Depth of a vertex, metres, below which its vehicle is not drawn: it is beside or behind the camera."""
_MARGIN = 8
"""Pixels around a vehicle that are drawn with it, for its blur."""
_SMALL_SHADOW_PX = 60
"""Size of a shadow in the frame below which it is drawn at full resolution."""
_FINE_PX, _FINE_IN_PICTURE_PX, _ROUGH_PX = 110, 260, 500
"""Size of a vehicle's window, px, below which a pixel takes nine samples, the same in a real picture, and the size from
which it takes one; four between. More samples cost time, fewer show steps along edges."""
_SUNNY = 0.3
"""Irradiance of the sun above which vehicles have glints."""
_NOTHING = np.zeros((0, 0), dtype=np.uint8)


class Renderer:
    """Renderer of the frames of one camera in one light.

    Args:
        camera: with scale and image size.
        background: (H, W, 3) uint8 BGR, the empty road.
        light: sun, sky and sensor.
        seed: of the noise.
        static_layer: what stands in the background and may hide vehicles.
        sensor: what the camera does to the whole frame.
    """

    def __init__(
        self, camera: Camera, background: NDArray[np.uint8], light: Light, *, seed: int,
        static_layer: StaticLayer | None = None, sensor: Sensor = PLAIN,
    ) -> None:  # fmt: skip
        self.sensor = sensor
        self.static_layer = static_layer
        self._shade = NO_SHADE if static_layer is None else static_layer.shade
        self.camera, self.background, self.light = camera, background, light
        self._road = sensor.unsharpened(background) if sensor.in_picture else background
        self._packed = light.packed()
        self._shadows: dict[int, GroundShadow] = {}
        self._shadow_colours = shadow_colours(light)
        self._rng = np.random.default_rng([seed, 77])
        height, width = background.shape[:2]
        self.size_wh = (width, height)
        noise_model = sensor.noise_model
        self._noise: NDArray[Any] = (
            self._noise_tile() if noise_model is None else noise_model.tile(self.size_wh, self._rng)
        )
        arms = sensor.arms * width if light.sun.max() > _SUNNY else 0.0
        self._stars = Glints(arms, np.random.default_rng([seed, 78]))

    def _noise_tile(self) -> NDArray[np.uint8]:
        """Return a tile of noise around 128, larger than the frame so that every frame takes another part of it."""
        width, height = self.size_wh
        shape = (height + 128, width + 128)
        grey: Any = self._rng.normal(0, self.light.noise, shape).astype(np.float32)
        colour: Any = self._rng.normal(0, 0.6 * self.light.noise, (*shape, 3)).astype(np.float32)
        colour = cv2.GaussianBlur(colour, (0, 0), 0.8) * 1.6
        grey = cv2.GaussianBlur(grey, (0, 0), 0.5) * 1.3
        return np.asarray(np.clip(128 + grey[..., None] + colour, 0, 255).round(), dtype=np.uint8)

    def frame(
        self, vehicles: Sequence[PlacedVehicle], *, number: int = 0, time_s: float = 0.0
    ) -> tuple[NDArray[np.uint8], list[DrawnVehicle]]:
        """Draw one frame, and return the masks of the vehicles that show in it.

        Args:
            vehicles: those that may show.
            number: of the frame; picks the noise.
            time_s: since the first frame, for burnt-in clocks.

        Returns:
            (H, W, 3) uint8 BGR, and one `DrawnVehicle` per vehicle with at least one visible pixel.
        """
        image = self._road.copy()
        ordered = [vehicles[i] for i in painting_order(vehicles)]
        for placed in ordered:
            self._cast_shadow(image, placed)
        layers = [layer for layer in (self._draw(image, placed) for placed in ordered) if layer is not None]
        drawn = visible_parts(layers)
        image = self._into_picture(image) if self.sensor.in_picture else self.sensor.before_noise(image)
        self._add_noise(image, number, drawn)
        self.sensor.write(image, time_s)
        return image, drawn

    def truth(self, vehicles: Sequence[PlacedVehicle]) -> list[DrawnVehicle]:
        """Return the masks that `frame` returns, without drawing."""
        ordered = [vehicles[i] for i in painting_order(vehicles)]
        return visible_parts([x for x in (self._draw(None, placed) for placed in ordered) if x is not None])

    def forget(self, track_ids: set[int]) -> None:
        """Drop the shadows of vehicles that have left the scene."""
        for track_id in track_ids:
            self._shadows.pop(track_id, None)

    def prepare(self, placed: PlacedVehicle) -> None:
        """Make a vehicle's shadow before its first frame."""
        self._shadow_of(placed)

    def _shadow_of(self, placed: PlacedVehicle) -> GroundShadow:
        shadow = self._shadows.get(placed.track_id)
        if shadow is None:
            shadow = ground_shadow(placed.vehicle, placed.heading, self.light)
            self._shadows[placed.track_id] = shadow
        return shadow

    def _cast_shadow(self, image: NDArray[np.uint8], placed: PlacedVehicle) -> None:
        shadow = self._shadow_of(placed)
        h, w = shadow.left.shape
        corners_map = np.array([[0, 0, 1], [w - 1, 0, 1], [w - 1, h - 1, 1], [0, h - 1, 1]], dtype=np.float64)
        corners = (corners_map @ shadow.to_body.T)[:, :2] + placed.centre_xy
        pixels = self.camera.project(corners)
        if not np.isfinite(pixels).all():
            return
        window = self._window(pixels)
        if window is None:
            return
        x0, y0, x1, y1 = window
        # Shadows are soft: half the resolution does, save for small ones, and beside real ones.
        part = 1 if self.sensor.in_picture or min(x1 - x0, y1 - y0) < _SMALL_SHADOW_PX else 2
        half = (max((x1 - x0) // part, 1), max((y1 - y0) // part, 1))
        to_half = np.array(half) / (x1 - x0, y1 - y0)
        # Far away a pixel spans many cells; the map's columns run along the road, which is upright in the picture.
        few = (min(w, 2 * half[1] + 2), min(h, 2 * half[0] + 2))
        shrunk = shadow.left if few == (w, h) else cv2.resize(shadow.left, few, interpolation=cv2.INTER_AREA)
        corners_few = (corners_map[:, :2] + 0.5) * np.array(few) / (w, h) - 0.5
        matrix = cv2.getPerspectiveTransform(
            corners_few.astype(np.float32), ((pixels - [x0, y0]) * to_half - 0.5).astype(np.float32)
        )
        left = cv2.warpPerspective(
            shrunk, matrix, half, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255
        )
        clear = self._clear(placed)
        if clear < 0.97:  # air fills shadows up
            left = cv2.addWeighted(left, clear, left, 0.0, 255 * (1 - clear))
        # The shadow lies on the road, behind what stands before it.
        cover = _NOTHING if self.static_layer is None else self.static_layer.cover[y0:y1, x0:x1]
        darken(image[y0:y1, x0:x1], left, cover, self._shadow_colours)

    def _clear(self, placed: PlacedVehicle) -> float:
        """Return the share of light that passes the air between a vehicle and the camera."""
        return float(np.exp(-self.light.haze_per_m * np.hypot(np.hypot(*placed.centre_xy), self.camera.height_m)))

    def _window(self, pixels: NDArray[Any], margin: int = 0) -> tuple[int, int, int, int] | None:
        low = np.floor(pixels.min(axis=0)).astype(int) - margin
        high = np.ceil(pixels.max(axis=0)).astype(int) + margin
        x0, y0 = max(int(low[0]), 0), max(int(low[1]), 0)
        x1, y1 = min(int(high[0]), self.size_wh[0]), min(int(high[1]), self.size_wh[1])
        return None if x0 >= x1 or y0 >= y1 else (x0, y0, x1, y1)

    def _draw(self, image: NDArray[np.uint8] | None, placed: PlacedVehicle) -> Layer | None:
        camera, mesh = self.camera, placed.vehicle.mesh
        world = placed.world()
        depth = (world - np.array([0.0, 0.0, camera.height_m])) @ camera.axes[:, 2]
        if (depth < _MIN_DEPTH).any():
            return None
        pixels = camera.project(world)
        window = self._window(pixels, _MARGIN)
        if window is None:
            return None
        x0, y0, x1, y1 = window
        size, origin = (x1 - x0, y1 - y0), (float(x0), float(y0))
        screen = np.concatenate([pixels, depth[:, None]], axis=1)
        # A pixel belongs to the mask if the vehicle covers its centre.
        centres = visible_triangles(screen, mesh.triangles, size, origin, 1, True)
        hidden = None if self.static_layer is None else self.static_layer.in_front(window, placed.bounds)
        if image is not None:
            self._paint(image, placed, screen, centres, window, hidden)
        mask = body_mask(centres, screen, mesh, origin)
        alone = int(np.count_nonzero(mask))
        if hidden is not None:
            mask &= hidden < 128
        body = pixels[mesh.body_vertices]
        outline = np.concatenate([body.min(axis=0), body.max(axis=0)])
        return Layer(placed.track_id, mask, alone, (x0, y0), outline)

    def _paint(
        self, image: NDArray[np.uint8], placed: PlacedVehicle, screen: NDArray[np.float64], centres: NDArray[np.int32],
        window: tuple[int, int, int, int], hidden: NDArray[np.uint8] | None,
    ) -> None:  # fmt: skip
        """Shade a vehicle and lay it over its window of the frame, except where props hide it."""
        x0, y0, x1, y1 = window
        size, origin = (x1 - x0, y1 - y0), (float(x0), float(y0))
        mesh, camera = placed.vehicle.mesh, self.camera
        fine = _FINE_IN_PICTURE_PX if self.sensor.in_picture else _FINE_PX
        ss = 3 if max(size) < fine else 2 if max(size) < _ROUGH_PX else 1
        ids = centres if ss == 1 else visible_triangles(screen, mesh.triangles, size, origin, ss, True)
        pose = np.array([placed.heading, *placed.centre_xy, camera.height_m, self._clear(placed)])
        # Of nine samples five are lit: drawings twice as fine do not flicker yet.
        texture, maps = placed.vehicle.texture.level(
            float(np.median(screen[:, 2])) / camera.focal / (2 if ss == 3 else 1)
        )
        layer: Any = shade(
            ids, screen, mesh.triangles, mesh.vertices, mesh.normals, mesh.charts, maps, texture, placed.vehicle.paint,
            self._packed, self.light.around, pose, self._shade.sun, self._shade.grid, self.light.exposure,
            self.light.curve, origin, ss,
        )  # fmt: skip
        layer = self._soften(layer, placed)
        before = _NOTHING if hidden is None else hidden
        lay_over(image[y0:y1, x0:x1], layer, before)
        self._stars.add(image, layer, (x0, y0), before)

    def _soften(self, layer: Any, placed: PlacedVehicle) -> Any:
        """Blur a vehicle's layer as its lens and its motion along its path do."""
        layer = cv2.GaussianBlur(layer, (0, 0), self.sensor.blur_px)
        x, y = placed.centre_xy
        step = placed.speed_ms * self.light.shutter_s
        ends = self.camera.project(np.array([[x, y, 0.5], [x + step, y, 0.5]]))
        move = ends[1] - ends[0]
        length = float(np.hypot(*move))
        if not length > 0.7:
            return layer
        # Averaging copies half a way apart, then a quarter, and so on, spreads every pixel evenly along the way.
        for k in range(1, 2 + int(np.ceil(np.log2(length)))):
            dx, dy = move / 2 ** (k + 1)
            shape = (layer.shape[1], layer.shape[0])
            ahead, behind = (
                cv2.warpAffine(layer, np.array([[1, 0, s * dx], [0, 1, s * dy]]), shape, borderMode=cv2.BORDER_CONSTANT)
                for s in (1.0, -1.0)
            )
            layer = cv2.addWeighted(ahead, 0.5, behind, 0.5, 0.0)
        return layer

    def _into_picture(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Transfer what was drawn on the road without the camera's faults into the picture, which has them."""
        out = self.background.copy()
        rows = np.flatnonzero((image != self._road).any(axis=(1, 2)))
        if len(rows):
            band = slice(max(0, int(rows[0]) - _MARGIN), int(rows[-1]) + _MARGIN)
            coded = image[band]
            if self.sensor.block_step:
                coded = add_block_artifacts(coded, (coded != self._road[band]).any(axis=2), self.sensor.block_step)
            change: Any = cv2.subtract(coded, self._road[band], dtype=cv2.CV_32F)
            change = self.sensor.sharpened(change, self.size_wh[0])
            cv2.add(out[band], change, dst=out[band], dtype=cv2.CV_8U)
        return out

    def _add_noise(self, image: NDArray[np.uint8], number: int, drawn: Sequence[DrawnVehicle]) -> None:
        if self.sensor.noise_model is not None:
            self.sensor.noise_model.add(image, self._noise, number, covered_by(drawn, image.shape[:2]))
            return
        width, height = self.size_wh
        rng = np.random.default_rng([number, 5])
        dx, dy = rng.integers(0, 128, 2).tolist()
        cv2.addWeighted(image, 1.0, self._noise[dy : dy + height, dx : dx + width], 1.0, -128.0, dst=image)
