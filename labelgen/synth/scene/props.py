"""Props beside roads: each function makes one kind.

A prop along the road takes (x0, x1, y, side): it runs from x0 to x1 at y, metres, and `side` (+1 or -1) points away
from the road. A prop at one place takes (x, y, side). `rng` decides its size, colours and details.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labelgen.synth.scene.triangles import Triangles, blob_leaves, box, box_leaves, gather, plate, rod

__all__ = ["ALONG", "AT", "gantry"]

Rng = np.random.Generator
Tone = tuple[float, float, float]
_STEEL: Tone = (0.30, 0.31, 0.32)


def _grey(rng: Rng, low: float, high: float) -> Tone:
    level = rng.uniform(low, high)
    red, green, blue = (level * rng.normal(1, 0.04, 3).clip(0.9, 1.1)).tolist()
    return red, green, blue


def _bright(rng: Rng) -> Tone:
    """A sign's, bin's or wall's colour."""
    tones: tuple[Tone, ...] = (
        (0.02, 0.08, 0.35), (0.02, 0.20, 0.06), (0.55, 0.03, 0.03), (0.65, 0.45, 0.03), (0.62, 0.62, 0.60),
        (0.10, 0.28, 0.30), (0.60, 0.22, 0.03),
    )  # fmt: skip
    return tones[int(rng.integers(len(tones)))]


def _green(rng: Rng) -> Tone:
    base = np.array([0.060, 0.090, 0.024]) * rng.uniform(0.6, 1.6)
    red, green, blue = (base * rng.normal(1, 0.15, 3).clip(0.7, 1.4)).tolist()
    return red, green, blue


def _leaf_m(x: float, y: float) -> float:
    """Leaves grow with distance, so that their number stays within bounds and each is a few pixels."""
    return float(np.clip(0.006 * np.hypot(x, y), 0.09, 0.45))


def guard_rail(x0: float, x1: float, y: float, side: int, rng: Rng) -> Triangles:
    """A steel rail on posts, waved as rolled steel is."""
    tone = _grey(rng, 0.22, 0.42)
    parts = []
    wave = ((0.44, 0.0, 0.75), (0.52, 0.05, 0.55), (0.60, 0.05, 1.0), (0.68, 0.0, 0.85))
    for low, out, level in wave:
        shade = tuple(c * level for c in tone)
        parts.append(box((x0, y - 0.02 + side * out, low), (x1, y + 0.02 + side * out, low + 0.08), shade))
    for x in np.arange(x0, x1, rng.choice([2.0, 4.0])).tolist():
        parts.append(box((x, y - 0.05, 0), (x + 0.1, y + 0.05, 0.62), _STEEL))
    return gather(parts)


def concrete_barrier(x0: float, x1: float, y: float, side: int, rng: Rng) -> Triangles:
    """Segments of concrete, wide at the foot."""
    del side
    parts = []
    for x in np.arange(x0, x1, 4.0).tolist():
        tone = _grey(rng, 0.24, 0.42)
        end = min(x + 3.94, x1)
        parts.append(box((x, y - 0.28, 0), (end, y + 0.28, 0.25), tone))
        parts.append(box((x, y - 0.12, 0.25), (end, y + 0.12, 0.85), tone))
    return gather(parts)


def railing(x0: float, x1: float, y: float, side: int, rng: Rng) -> Triangles:
    """A town's railing: posts, two or three rails, upright bars."""
    del side
    tone = ((0.62, 0.62, 0.60), (0.05, 0.12, 0.06), (0.30, 0.31, 0.32), (0.50, 0.38, 0.04))[int(rng.integers(4))]
    high, gap = rng.uniform(0.8, 1.3), rng.uniform(0.14, 0.35)
    parts = [box((x0, y - 0.025, z - 0.03), (x1, y + 0.025, z + 0.03), tone) for z in (0.18, high)]
    reach = min(x1, 55.0)
    for x in np.arange(x0, reach, gap).tolist():
        parts.append(box((x, y - 0.012, 0.18), (x + 0.025, y + 0.012, high), tone))
    for x in np.arange(x0, x1, 2.5).tolist():
        parts.append(box((x - 0.05, y - 0.05, 0), (x + 0.05, y + 0.05, high + 0.12), tone))
    if reach < x1:  # bars that far away are thinner than a pixel: a thin plate shows their mean
        veil = tuple(0.6 * c + 0.06 for c in tone)
        parts.append(box((reach, y, 0.5 * high), (x1, y + 0.01, 0.62 * high), veil))
    return gather(parts)


def post_fence(x0: float, x1: float, y: float, side: int, rng: Rng) -> Triangles:
    """Wooden posts with two to four planks, or wires."""
    del side
    tone = ((0.16, 0.11, 0.07), (0.22, 0.19, 0.15), (0.55, 0.54, 0.50))[int(rng.integers(3))]
    high, count, thick = rng.uniform(0.9, 1.6), int(rng.integers(2, 5)), float(rng.choice([0.012, 0.06]))
    parts = []
    for z in np.linspace(0.35, high - 0.06, count).tolist():
        parts.append(box((x0, y - 0.02, z - thick), (x1, y + 0.02, z + thick), tone))
    for x in np.arange(x0, x1, rng.uniform(1.8, 3.2)).tolist():
        parts.append(box((x - 0.06, y - 0.06, 0), (x + 0.06, y + 0.06, high), tone))
    return gather(parts)


def mesh_fence(x0: float, x1: float, y: float, side: int, rng: Rng) -> Triangles:
    """Wire mesh between steel posts; the wires are drawn where they can be told apart."""
    del side
    tone = ((0.05, 0.13, 0.07), (0.33, 0.34, 0.35), (0.10, 0.10, 0.10))[int(rng.integers(3))]
    high, gap = rng.uniform(1.2, 2.2), rng.uniform(0.18, 0.3)
    parts = []
    for z in np.arange(0.1, high, gap).tolist():
        parts.append(box((x0, y - 0.006, z), (x1, y + 0.006, z + 0.018), tone))
    for x in np.arange(x0, min(x1, 50.0), gap).tolist():
        parts.append(box((x, y - 0.006, 0.05), (x + 0.018, y + 0.006, high), tone))
    for x in np.arange(x0, x1, 2.5).tolist():
        parts.append(rod((x, y, 0), (x, y, high + 0.1), 0.035, tone))
    return gather(parts)


def wall(x0: float, x1: float, y: float, side: int, rng: Rng) -> Triangles:
    """A wall or noise barrier of panels that differ a little, some with a band of paint."""
    high, panel = rng.uniform(1.2, 4.5), rng.uniform(2.0, 5.0)
    tones: tuple[Tone, ...] = ((0.30, 0.29, 0.27), (0.25, 0.13, 0.09), (0.10, 0.16, 0.10), (0.42, 0.40, 0.36))
    base = np.array(tones[int(rng.integers(len(tones)))])
    parts = []
    rows = np.linspace(0, high, int(rng.integers(2, 7)))
    for x in np.arange(x0, x1, panel).tolist():
        for low, top in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
            tone = (base * rng.normal(1, 0.07)).clip(0.01, 0.8).tolist()
            parts.append(box((x, y, low), (min(x + panel, x1), y + side * 0.2, top), tone))
        parts.append(box((x - 0.1, y - 0.1, 0), (x + 0.1, y + 0.1, high + 0.05), (0.7 * base).tolist()))
    return gather(parts)


def hedge(x0: float, x1: float, y: float, side: int, rng: Rng) -> Triangles:
    """A hedge, trimmed or not, with gaps."""
    tone, high, wide = _green(rng), rng.uniform(0.7, 3.2), rng.uniform(0.6, 2.2)
    trimmed = rng.random() < 0.6
    parts = []
    x = x0
    while x < x1:
        end = min(x + 4.0, x1)
        if rng.random() < 0.93:
            low, top = sorted((y, y + side * wide))
            lump = high if trimmed else high * rng.uniform(0.6, 1.25)
            leaf = _leaf_m(x, y)
            parts.append(box_leaves((x, low, 0), (end, top, lump), leaf, tone, rng))
            inside = tuple(0.25 * c for c in tone)
            parts.append(box((x + 0.1, low + 0.15, 0), (end - 0.1, top - 0.15, lump - 0.12), inside))
        x = end
    return gather(parts) if parts else box((x0, y, 0), (x0 + 0.2, y + 0.2, 0.2), tone)


def kerb(x0: float, x1: float, y: float, side: int, rng: Rng) -> Triangles:
    """A kerb and the pavement behind it, in slabs."""
    stone, slab = _grey(rng, 0.26, 0.45), np.array(_grey(rng, 0.20, 0.38))
    wide = rng.uniform(1.5, 4.0)
    striped = rng.random() < 0.25
    parts = []
    for k, x in enumerate(np.arange(x0, x1, 2.0).tolist()):
        end = min(x + 2.0, x1)
        tone = ((0.03, 0.03, 0.03), (0.6, 0.6, 0.58))[k % 2] if striped else stone
        parts.append(box((x, y, 0), (end, y + side * 0.15, 0.14), tone))
        for a, b in ((0.15, 0.5 * wide), (0.5 * wide, wide)):
            at = (slab * rng.normal(1, 0.05)).tolist()
            ys = (y + side * a, y + side * b)
            parts.append(plate((x, ys[0], 0.13), (end, ys[0], 0.13), (end, ys[1], 0.13), (x, ys[1], 0.13), at))
    return gather(parts)


def bush(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A bush, or a clump of them."""
    del side
    parts = []
    for _ in range(int(rng.integers(1, 5))):
        r = rng.uniform(0.5, 1.7)
        at = (x + rng.normal(0, 1.5), y + rng.normal(0, 0.4), 0.75 * r)
        parts.append(blob_leaves(at, (r, r, r), _leaf_m(x, y), _green(rng), rng))
    return gather(parts)


def tree(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """Trunk, a few boughs and a crown: round, tall or broad."""
    del side
    high = rng.uniform(4.0, 13.0)
    stem, crown = high * rng.uniform(0.18, 0.4), high * rng.uniform(0.16, 0.34)
    bark = (0.10, 0.08, 0.06)
    parts = [rod((x, y, 0), (x, y, 0.8 * high), 0.012 * high + 0.05, bark)]
    tone, leaf = _green(rng), _leaf_m(x, y) * 1.3
    middle = (stem + high) / 2
    parts.append(blob_leaves((x, y, middle), (crown, crown, (high - stem) / 2), leaf, tone, rng))
    for _ in range(int(rng.integers(1, 4))):
        at = (x + rng.normal(0, 0.5 * crown), y + rng.normal(0, 0.5 * crown), rng.uniform(stem + 0.5, high - 0.5))
        r = crown * rng.uniform(0.4, 0.7)
        parts.append(rod((x, y, 0.6 * stem), at, 0.05, bark))
        parts.append(blob_leaves(at, (r, r, r), leaf, tone, rng))
    return gather(parts)


def sign_post(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A traffic sign or a board on one or two posts."""
    wide, tall, low = rng.uniform(0.5, 2.8), rng.uniform(0.5, 1.8), rng.uniform(1.2, 2.6)
    legs = (0.0,) if wide < 1 else (-0.35 * wide, 0.35 * wide)
    parts = [rod((x, y + leg, 0), (x, y + leg, low + tall), 0.04, _STEEL) for leg in legs]
    front, tone = x - 0.06, _bright(rng)
    a, b = y - wide / 2, y + wide / 2
    rim: Tone = (0.6, 0.6, 0.58)
    parts.append(plate((front, a, low), (front, b, low), (front, b, low + tall), (front, a, low + tall), rim))
    inner = front - 0.01
    a, b, c, d = a + 0.06, b - 0.06, low + 0.06, low + tall - 0.06
    parts.append(plate((inner, a, c), (inner, b, c), (inner, b, d), (inner, a, d), tone))
    for k in range(int(rng.integers(1, 4))):
        z, long = c + (k + 0.5) * (d - c) / 4, rng.uniform(0.3, 0.8) * (b - a)
        left = a + 0.1 * (b - a)
        z1 = z + 0.08 * tall
        ink = inner - 0.01
        parts.append(plate((ink, left, z), (ink, left + long, z), (ink, left + long, z1), (ink, left, z1), rim))
    back = x + 0.01
    parts.append(plate((back, a, c), (back, b, c), (back, b, d), (back, a, d), (0.25, 0.25, 0.26)))
    del side
    return gather(parts)


def lamp_post(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A street lamp with its arm over the road."""
    high, reach, tone = rng.uniform(5.0, 11.0), rng.uniform(0.8, 3.0), _grey(rng, 0.12, 0.55)
    tip = (x, y - side * reach, high + 0.3)
    parts = [rod((x, y, 0), (x, y, high), 0.07, tone), rod((x, y, high), tip, 0.045, tone)]
    parts.append(box((x - 0.14, tip[1] - 0.3, high + 0.2), (x + 0.14, tip[1] + 0.3, high + 0.32), (0.4, 0.4, 0.4)))
    if rng.random() < 0.3:
        banner = _bright(rng)
        y1 = y + side * 0.7
        parts.append(plate((x, y, 3.0), (x, y1, 3.0), (x, y1, 4.6), (x, y, 4.6), banner))
    return gather(parts)


def utility_pole(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A wooden or concrete pole with cross-bars and wires along the road."""
    high, tone = rng.uniform(6.5, 10.0), ((0.14, 0.10, 0.07), (0.33, 0.32, 0.30))[int(rng.integers(2))]
    parts = [rod((x, y, 0), (x, y, high), 0.13, tone)]
    parts.append(rod((x, y - 0.8, high - 0.5), (x, y + 0.8, high - 0.5), 0.05, tone))
    for offset in (-0.7, 0.0, 0.7):
        for start in np.arange(max(x - 24, 1.0), x + 24, 6.0).tolist():
            sag = [0.9 * (((s - x) / 24) ** 2) for s in (start, start + 6)]
            ends = [(s, y + offset, high - 0.4 - d) for s, d in zip((start, start + 6), sag, strict=True)]
            parts.append(rod(ends[0], ends[1], 0.015, (0.02, 0.02, 0.02), sides=3))
    del side
    return gather(parts)


def bus_stop(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A shelter: posts, roof, a back of glass or advertising, a bench, and pedestrians who wait."""
    long, deep, tone = rng.uniform(3, 9), rng.uniform(1.2, 2.0), _grey(rng, 0.05, 0.5)
    back = y + side * deep
    ys = sorted((y - side * 0.3, back + side * 0.2))
    parts = [box((x, ys[0], 2.4), (x + long, ys[1], 2.52), _bright(rng) if rng.random() < 0.4 else tone)]
    for k in np.arange(0, long + 0.1, max(1.5, long / 4)).tolist():
        parts.append(rod((x + k, back, 0), (x + k, back, 2.45), 0.05, tone))
        parts.append(rod((x + k, y, 0), (x + k, y, 2.45), 0.04, tone))
        if k + 1 < long:
            pane = (0.16, 0.19, 0.20) if rng.random() < 0.6 else _bright(rng)
            a, b = x + k + 0.1, x + min(k + max(1.4, long / 4 - 0.1), long)
            parts.append(plate((a, back, 0.3), (b, back, 0.3), (b, back, 2.2), (a, back, 2.2), pane))
    seat = sorted((back, back - side * 0.4))
    parts.append(box((x + 0.5, seat[0], 0.42), (x + long - 0.5, seat[1], 0.48), (0.15, 0.11, 0.08)))
    for _ in range(int(rng.integers(0, 4))):
        parts.append(pedestrian(x + rng.uniform(0, long), y + side * rng.uniform(0.2, 1.0), side, rng))
    return gather(parts)


def pedestrian(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A pedestrian who stands still."""
    del side
    high = rng.uniform(1.5, 1.9)
    coat, legs = _bright(rng) if rng.random() < 0.25 else _grey(rng, 0.02, 0.3), _grey(rng, 0.01, 0.12)
    parts = [rod((x, y + s, 0), (x, y + 0.7 * s, 0.5 * high), 0.08, legs) for s in (-0.1, 0.1)]
    parts.append(box((x - 0.13, y - 0.21, 0.48 * high), (x + 0.13, y + 0.21, 0.83 * high), coat))
    parts += [rod((x, y + s, 0.8 * high), (x, y + 1.15 * s, 0.48 * high), 0.05, coat) for s in (-0.25, 0.25)]
    parts.append(rod((x, y, 0.83 * high), (x, y, high), 0.10, (0.28, 0.18, 0.13)))
    return gather(parts)


def cabinet(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A switch box, a bin, an advertising column or a bench."""
    style = int(rng.integers(4))
    if style == 0:
        wide, high = rng.uniform(0.5, 1.6), rng.uniform(0.9, 1.5)
        return box((x, y - 0.2, 0), (x + wide, y + 0.2, high), _grey(rng, 0.12, 0.5))
    if style == 1:
        return rod((x, y, 0), (x, y, 1.0), 0.26, _bright(rng), sides=10)
    if style == 2:
        column = rod((x, y, 0), (x, y, 3.2), 0.6, _bright(rng), sides=14)
        return gather([column, rod((x, y, 3.2), (x, y, 3.5), 0.7, (0.1, 0.1, 0.1), sides=14)])
    seat, back = sorted((y, y + side * 0.45)), y + side * 0.45
    wood = (0.16, 0.11, 0.07)
    lean = plate((x, back, 0.5), (x + 1.8, back, 0.5), (x + 1.8, back, 0.9), (x, back, 0.9), wood)
    return gather([box((x, seat[0], 0.4), (x + 1.8, seat[1], 0.46), wood), lean])


def bollards(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A row of bollards or delineator posts."""
    del side
    gap, high = rng.uniform(1.2, 6.0), rng.uniform(0.7, 1.1)
    tone = _bright(rng) if rng.random() < 0.4 else (0.62, 0.62, 0.60)
    parts = []
    for k in range(int(rng.integers(4, 14))):
        parts.append(rod((x + k * gap, y, 0), (x + k * gap, y, high), 0.06, tone))
        parts.append(rod((x + k * gap, y, 0.7 * high), (x + k * gap, y, 0.85 * high), 0.065, (0.02, 0.02, 0.02)))
    return gather(parts)


def building(x: float, y: float, side: int, rng: Rng) -> Triangles:
    """A house or block with rows of windows, a door or shop front, and a roof."""
    long, deep, storeys = rng.uniform(7, 26), rng.uniform(7, 12), int(rng.integers(1, 6))
    tones: tuple[Tone, ...] = ((0.42, 0.38, 0.32), (0.24, 0.12, 0.08), (0.34, 0.34, 0.35), (0.5, 0.48, 0.42))
    base = np.array(tones[int(rng.integers(len(tones)))]) * rng.uniform(0.7, 1.2)
    high, far = 3.1 * storeys + 0.4, y + side * deep
    low_y, top_y = sorted((y, far))
    parts = [box((x, low_y, 0), (x + long, top_y, high), base.clip(0, 0.7).tolist())]
    step, wide, tall = rng.uniform(1.8, 3.4), rng.uniform(0.8, 1.5), rng.uniform(1.1, 1.8)
    frame: Tone = (0.55, 0.55, 0.53) if rng.random() < 0.6 else (0.10, 0.08, 0.06)

    def window(corner: tuple[float, float], z: float, along: tuple[float, float]) -> None:
        pane = (np.array([0.05, 0.06, 0.07]) * rng.uniform(0.4, 3.5)).tolist()
        for grow, out, tone in ((0.10, 0.03, frame), (0.0, 0.06, pane)):
            u0, u1 = -grow, wide + grow
            ax, ay = corner[0] + along[0] * u0, corner[1] + along[1] * u0
            bx, by = corner[0] + along[0] * u1, corner[1] + along[1] * u1
            ox, oy = (0.0, -side * out) if along[0] else (-out, 0.0)
            z0, z1 = z - grow, z + tall + grow
            ax, ay, bx, by = ax + ox, ay + oy, bx + ox, by + oy
            parts.append(plate((ax, ay, z0), (bx, by, z0), (bx, by, z1), (ax, ay, z1), tone))

    for storey in range(storeys):
        z = 0.9 + 3.1 * storey
        for u in np.arange(0.8, long - wide - 0.5, step).tolist():
            window((x + u, y), z, (1.0, 0.0))
        for u in np.arange(0.8, deep - wide - 0.5, step).tolist():
            window((x, low_y + u), z, (0.0, 1.0))
    if rng.random() < 0.6:
        ridge, middle, tile = high + rng.uniform(1.5, 3.5), (low_y + top_y) / 2, (0.20, 0.08, 0.05)
        for edge in (low_y - 0.3, top_y + 0.3):
            top = ((x + long, middle, ridge), (x, middle, ridge))
            parts.append(plate((x, edge, high), (x + long, edge, high), *top, tile))
        parts.append(plate((x, low_y, high), (x, top_y, high), (x, middle, ridge), (x, middle, ridge), base.tolist()))
    return gather(parts)


def gantry(x: float, low: float, high: float, rng: Rng) -> Triangles:
    """A beam over the whole road on two legs, with boards, cameras or lamps on it."""
    z, tone = rng.uniform(5.4, 6.6), _grey(rng, 0.15, 0.5)
    parts = [box((x - 0.15, y - 0.15, 0), (x + 0.15, y + 0.15, z + 0.5), tone) for y in (low, high)]
    for y0, y1 in zip(np.linspace(low, high, 9)[:-1].tolist(), np.linspace(low, high, 9)[1:].tolist(), strict=True):
        parts += [box((x - 0.1, y0, z + up), (x + 0.1, y1, z + up + 0.1), tone) for up in (0.0, 0.5)]
        parts.append(rod((x, y0, z + 0.05), (x, y1, z + 0.55), 0.035, tone))
    if rng.random() < 0.8:
        board = ((0.02, 0.08, 0.35), (0.02, 0.18, 0.06), (0.03, 0.03, 0.03))[int(rng.integers(3))]
        for y in np.arange(low + 2, high - 3, rng.uniform(3.6, 7.5)).tolist():
            tall, wide = rng.uniform(0.9, 2.0), rng.uniform(1.2, 3.2)
            parts.append(box((x - 0.25, y, z - 0.2), (x - 0.15, y + wide, z - 0.2 + tall), board))
            for k in range(2):
                row = z + 0.1 + 0.4 * k
                ends = (y + 0.2, y + 0.8 * wide)
                ink = [(x - 0.26, at, z_ink) for z_ink in (row, row + 0.16) for at in ends]
                parts.append(plate(ink[0], ink[1], ink[3], ink[2], (0.6, 0.6, 0.58)))
    return gather(parts)


ALONG: dict[str, Callable[[float, float, float, int, Rng], Triangles]] = {
    "guard rail": guard_rail, "concrete barrier": concrete_barrier, "railing": railing, "post fence": post_fence,
    "mesh fence": mesh_fence, "wall": wall, "hedge": hedge, "kerb": kerb,
}  # fmt: skip
"""Props along the road: (x0, x1, y, side, rng) -> triangles."""

AT: dict[str, Callable[[float, float, int, Rng], Triangles]] = {
    "bush": bush, "tree": tree, "sign post": sign_post, "lamp post": lamp_post, "utility pole": utility_pole,
    "bus stop": bus_stop, "pedestrian": pedestrian, "cabinet": cabinet, "bollards": bollards, "building": building,
}  # fmt: skip
"""Props at one place: (x, y, side, rng) -> triangles."""
