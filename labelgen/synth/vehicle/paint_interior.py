"""Paint what is visible through a windscreen or rear window: dashboard, seats, people, light of other windows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.synth.shading.materials import GLASS
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.texture import Colour, Texture, dim

__all__ = ["draw_behind_rear_window", "draw_behind_windscreen", "screen_coordinates"]

_DRIVER = 0.46
"""Position of the driver, as a share of the screen's half-width, on the left."""

ScreenMap = Callable[[Any], NDArray[np.float64]]


def screen_coordinates(foot: Any, head: Any) -> ScreenMap:
    """Return the map from coordinates on a screen to a drawing's points.

    Args:
        foot, head: (N, 2) points of the screen's lower and upper edge, from across = -1 to +1.

    Returns:
        Function of (M, 2) (across, up): -1 to 1 across, 0 to 1 from the foot to the head; it returns (M, 2) metres.
    """
    low, high = np.asarray(foot, dtype=np.float64), np.asarray(head, dtype=np.float64)
    across = np.linspace(-1, 1, len(low))

    def placed(points: Any) -> NDArray[np.float64]:
        at = np.asarray(points, dtype=np.float64)
        a, b = (np.stack([np.interp(at[:, 0], across, edge[:, k]) for k in (0, 1)], axis=1) for edge in (low, high))
        return np.asarray(a + at[:, 1:] * (b - a))

    return placed


def _superellipse(across: float, up: float, wide: float, tall: float, power: float = 2.5) -> NDArray[np.float64]:
    """Return a rounded box, a superellipse of 20 points (20, 2)."""
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    ring = np.stack([np.sign(c) * np.abs(c) ** (2 / power), np.sign(s) * np.abs(s) ** (2 / power)], axis=1)
    return np.asarray([across, up] + ring * [wide, tall])


def _grey(rng: np.random.Generator, low: float, high: float, tint: float = 1.0) -> Colour:
    level = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return level, level * tint, level * (2 * tint - 1 if tint > 1 else 1.03)


def _light_beyond(
    texture: Texture, chart: Chart, placed: ScreenMap, level: float, heights: tuple[float, float]
) -> None:
    """Paint the light of the windows at the cabin's far end and in its doors."""
    tint: Colour = (0.82 * level, level, 0.94 * level)
    low, high = heights
    texture.polygon(chart, placed([(-0.56, low), (0.56, low), (0.5, high), (-0.5, high)]), tint, GLASS)
    for side in (-1, 1):
        door = [(0.74, low - 0.06), (0.93, low - 0.12), (0.90, high), (0.72, high - 0.02)]
        texture.polygon(chart, placed([(side * y, z) for y, z in door]), dim(tint, 0.75), GLASS)


def _mirrored_patches(texture: Texture, chart: Chart, placed: ScreenMap, rng: np.random.Generator) -> None:
    """Paint soft reflections of sky on the glass, each in several faint layers."""
    for _ in range(int(rng.integers(2, 7))):
        at, up, level = rng.uniform(-0.9, 0.9), rng.uniform(0.1, 0.95), rng.uniform(0.02, 0.11)
        wide, tall = rng.uniform(0.08, 0.35), rng.uniform(0.06, 0.25)
        for size in (1.0, 0.75, 0.5):
            ring = placed(_superellipse(at, up, size * wide, size * tall, 2).clip([-0.98, 0.0], [0.98, 1.0]))
            texture.fade(chart, ring, (level, 1.15 * level, 1.15 * level), (0.35, 0.35))


def draw_behind_windscreen(
    texture: Texture, chart: Chart, placed: ScreenMap, glass: Colour, clear: float, rng: np.random.Generator
) -> None:
    """Paint dashboard, seats, driver, passenger, rear-view mirror and visors behind a windscreen.

    Args:
        texture: of the vehicle.
        chart: TOP or FRONT.
        placed: from `screen_coordinates`.
        glass: albedo of the dark behind the glass.
        clear: 0 to 1, how much light enters through the windows beyond.
        rng: gives people and things.
    """
    shelf = rng.uniform(0.14, 0.24)
    _light_beyond(texture, chart, placed, glass[1] + 0.13 * clear, (rng.uniform(0.50, 0.58), rng.uniform(0.76, 0.86)))
    beside = rng.random() < 0.35
    for side in (-1, 1):
        seat, at = _grey(rng, 0.008, 0.03), side * _DRIVER
        texture.polygon(chart, placed(_superellipse(at, 0.36, 0.25, 0.26)), seat, GLASS)
        texture.polygon(chart, placed(_superellipse(at, 0.68, 0.105, 0.085)), dim(seat, 0.85), GLASS)
        if side > 0 or beside:
            _person(texture, chart, placed, at, rng)
    tone = _grey(rng, 0.014, 0.06)
    hood = _DRIVER + rng.uniform(-0.03, 0.03)
    top = [(1, shelf), (hood + 0.26, shelf), (hood + 0.14, shelf + 0.07), (hood - 0.14, shelf + 0.07)]
    ring = [(-1, 0), (1, 0), *top, (hood - 0.26, shelf), (-1, shelf)]
    texture.polygon(chart, placed(ring), tone, GLASS)
    # The glass reflects what lies on the dashboard.
    texture.polygon(chart, placed([(-1, 0), (1, 0), (1, 0.5 * shelf), (-1, 0.5 * shelf)]), dim(tone, 1.5), GLASS)
    angle = np.linspace(0.4, np.pi - 0.4, 8)
    wheel = np.stack([_DRIVER + 0.16 * np.cos(angle), shelf - 0.02 + 0.16 * np.sin(angle)], axis=1)
    texture.line(chart, placed(wheel), dim(tone, 0.5), GLASS, 0.03)
    texture.polygon(chart, placed(_superellipse(0.0, 0.86, 0.10, 0.045)), (0.006, 0.006, 0.007), GLASS)
    if rng.random() < 0.6:  # sun visors, or a tinted edge
        edge = [(-0.96, 0.92), (0.96, 0.92), (0.96, 1.0), (-0.96, 1.0)]
        texture.polygon(chart, placed(edge), _grey(rng, 0.01, 0.05, 1.06), GLASS)
    if rng.random() < 0.4:
        texture.polygon(
            chart, placed(_superellipse(rng.uniform(-0.8, 0.8), 0.08, 0.06, 0.04, 6)), (0.22, 0.22, 0.2), GLASS
        )
    _mirrored_patches(texture, chart, placed, rng)


def _person(texture: Texture, chart: Chart, placed: ScreenMap, at: float, rng: np.random.Generator) -> None:
    level = float(np.exp(rng.uniform(np.log(0.010), np.log(0.14))))
    red, green, blue = (level * rng.normal(1, 0.25, 3).clip(0.6, 1.4)).tolist()
    tall = rng.uniform(-0.03, 0.03)
    texture.polygon(chart, placed(_superellipse(at, 0.36, 0.20, 0.20 + tall)), (red, green, blue), GLASS)
    face = dim((0.085, 0.056, 0.044), rng.uniform(0.5, 1.2))
    texture.polygon(chart, placed(_superellipse(at, 0.63 + tall, 0.075, 0.085, 2)), face, GLASS)
    hair = dim((0.012, 0.010, 0.009), rng.uniform(0.6, 4.0))
    texture.polygon(chart, placed(_superellipse(at, 0.70 + tall, 0.075, 0.04, 2)), hair, GLASS)


def draw_behind_rear_window(
    texture: Texture, chart: Chart, placed: ScreenMap, glass: Colour, clear: float, rng: np.random.Generator
) -> None:
    """Paint parcel shelf, head rests and the windscreen's light; arguments as for `draw_behind_windscreen`."""
    low = rng.uniform(0.36, 0.48)
    kind = int(rng.choice(3, p=[0.45, 0.47, 0.08]))  # film; clear; a blind or curtain
    clear *= (0.15, 1.0, 0.4)[kind]
    _light_beyond(texture, chart, placed, glass[1] + rng.uniform(0.08, 0.26) * clear, (low, rng.uniform(0.76, 0.88)))
    lit = 0.25 + 0.75 * clear
    # Covers of seats and what lies on shelves are pale in some.
    seat = dim(_grey(rng, 0.008, 0.14, 1.05), lit)
    for at in (-0.42, 0.42):  # in front
        texture.polygon(chart, placed(_superellipse(at, low + 0.05, 0.12, 0.17)), dim(seat, 0.8), GLASS)
    if rng.random() < 0.7:
        texture.polygon(chart, placed(_superellipse(-0.42, low + 0.16, 0.09, 0.11, 2)), dim(seat, 0.7), GLASS)
    texture.polygon(chart, placed([(-0.9, 0), (0.9, 0), (0.86, low - 0.08), (-0.86, low - 0.08)]), seat, GLASS)
    rests = rng.uniform(0.03, 0.14)
    for at in (-0.5, 0.5) if rng.random() < 0.6 else (-0.5, 0.0, 0.5):
        texture.polygon(chart, placed(_superellipse(at, low - 0.10 + rests, 0.11, 0.10, 4)), dim(seat, 1.2), GLASS)
    shelf = rng.uniform(0.08, 0.2)
    tone = dim(_grey(rng, 0.02, 0.22), lit)
    texture.polygon(chart, placed([(-0.97, 0), (0.97, 0), (0.92, shelf), (-0.92, shelf)]), tone, GLASS)
    if kind == 2:
        level = rng.uniform(0.04, 0.2)
        foot, head = rng.uniform(0.0, 0.25), rng.uniform(0.5, 0.95)
        edge = [(-0.85, foot), (0.85, foot), (0.80, head), (-0.80, head)]
        texture.polygon(chart, placed(edge), (0.9 * level, level, 0.95 * level), GLASS)
    for _ in range(int(rng.integers(0, 3))):  # luggage, toys, papers, covers
        level = rng.uniform(0.02, 0.22) * lit
        thing: Colour = (level, level * rng.uniform(0.7, 1.0), level * rng.uniform(0.5, 1.0))
        at, wide = rng.uniform(-0.6, 0.6), rng.uniform(0.06, 0.18)
        texture.polygon(chart, placed(_superellipse(at, shelf, wide, rng.uniform(0.05, 0.12), 4)), thing, GLASS)
    _mirrored_patches(texture, chart, placed, rng)
