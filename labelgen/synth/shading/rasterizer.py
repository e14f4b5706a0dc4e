"""Rasterisation with a z-buffer, and shading of each sample; compiled by Numba.

Convention:
    Sample (row r, column c) of a grid with `ss` samples per pixel and side lies at frame px
    (x0 + (c + 0.5) / ss, y0 + (r + 0.5) / ss). Colours are linear RGB, float32. Depth is metres along the optical axis.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.shading.materials import CHROME, GLASS, LAMP, LIT, PAINT

__all__ = ["darken", "lay_over", "shade", "visible_triangles"]

_F = NDArray[Any]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def visible_triangles(
    screen: _F, triangles: _F, size_wh: tuple[int, int], origin: tuple[float, float], ss: int, cull: bool
) -> _F:
    """Return which triangle is visible at each sample.

    Args:
        screen: (V, 3) frame px x, y and depth; triangles with a vertex of depth <= 0 are skipped.
        triangles: (T, 3) vertex indices, anticlockwise as seen from outside.
        size_wh: grid size in px.
        origin: frame px of the grid's corner.
        ss: samples per pixel and side.
        cull: drop triangles seen from behind.

    Returns:
        (H * ss, W * ss) int32, index of the triangle, -1 for none.
    """
    w, h = size_wh[0] * ss, size_wh[1] * ss
    ids = np.full((h, w), -1, dtype=np.int32)
    depth = np.zeros((h, w), dtype=np.float32)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if screen[a, 2] <= 0 or screen[b, 2] <= 0 or screen[c, 2] <= 0:
            continue
        ax, ay = (screen[a, 0] - origin[0]) * ss, (screen[a, 1] - origin[1]) * ss
        bx, by = (screen[b, 0] - origin[0]) * ss, (screen[b, 1] - origin[1]) * ss
        cx, cy = (screen[c, 0] - origin[0]) * ss, (screen[c, 1] - origin[1]) * ss
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        # y points down, so outward faces run clockwise in the sense of this sum: negative area.
        if area == 0 or (cull and area > 0):
            continue
        left = max(0, math.ceil(min(ax, bx, cx) - 0.5))
        right = min(w - 1, math.floor(max(ax, bx, cx) - 0.5))
        top = max(0, math.ceil(min(ay, by, cy) - 0.5))
        bottom = min(h - 1, math.floor(max(ay, by, cy) - 0.5))
        if left > right or top > bottom:
            continue
        za, zb, zc = 1.0 / screen[a, 2], 1.0 / screen[b, 2], 1.0 / screen[c, 2]
        inv = 1.0 / area
        dwa, dwb = (by - cy) * inv, (cy - ay) * inv
        for r in range(top, bottom + 1):
            y, x = r + 0.5, left + 0.5
            wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) * inv
            wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) * inv
            for col in range(left, right + 1):
                wc = 1.0 - wa - wb
                if wa >= 0 and wb >= 0 and wc >= 0:
                    z = wa * za + wb * zb + wc * zc
                    if z > depth[r, col]:
                        depth[r, col] = z
                        ids[r, col] = t
                wa += dwa
                wb += dwb
    return ids


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _environment(x: float, y: float, z: float, around: _F) -> tuple[float, float, float]:
    """Return the radiance that arrives from a direction in the road frame."""
    side = around.shape[0]
    scale = 1.0 / (abs(x) + abs(y) + abs(z) + 1e-9)
    u, v = x * scale, y * scale
    if z < 0:
        u, v = (1 - abs(v)) * (1.0 if u >= 0 else -1.0), (1 - abs(u)) * (1.0 if v >= 0 else -1.0)
    column = min(int((0.5 * u + 0.5) * side), side - 1)
    row = min(int((0.5 * v + 0.5) * side), side - 1)
    return around[row, column, 0], around[row, column, 1], around[row, column, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _curve(value: float, curve: _F, colour: int) -> float:
    at = min(max(value, 0.0), 4.0) * 1024
    low = int(at)
    return float(curve[colour, low] + (at - low) * (curve[colour, low + 1] - curve[colour, low]))


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _surface(
    x: float, y: float, t: int, screen: _F, triangles: _F, body: _F, normals: _F
) -> tuple[float, float, float, float, float, float]:
    """Return body-frame point and unit normal of triangle t at frame px x, y, interpolated perspectively."""
    a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    ax, ay, bx, by = screen[a, 0] - x, screen[a, 1] - y, screen[b, 0] - x, screen[b, 1] - y
    cx, cy = screen[c, 0] - x, screen[c, 1] - y
    wa = (bx * cy - by * cx) / screen[a, 2]
    wb = (cx * ay - cy * ax) / screen[b, 2]
    wc = (ax * by - ay * bx) / screen[c, 2]
    total = wa + wb + wc
    wa, wb, wc = wa / total, wb / total, wc / total
    px = wa * body[a, 0] + wb * body[b, 0] + wc * body[c, 0]
    py = wa * body[a, 1] + wb * body[b, 1] + wc * body[c, 1]
    pz = wa * body[a, 2] + wb * body[b, 2] + wc * body[c, 2]
    nx = wa * normals[t, 0, 0] + wb * normals[t, 1, 0] + wc * normals[t, 2, 0]
    ny = wa * normals[t, 0, 1] + wb * normals[t, 1, 1] + wc * normals[t, 2, 1]
    nz = wa * normals[t, 0, 2] + wb * normals[t, 1, 2] + wc * normals[t, 2, 2]
    norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-12)
    return px, py, pz, nx * norm, ny * norm, nz * norm


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _on_texture(px: float, py: float, pz: float, m: int, chart_maps: _F, texture: _F) -> tuple[float, float]:
    """Return the texture px of a body-frame point, clamped to the texture."""
    u = chart_maps[m, 0, 0] * px + chart_maps[m, 0, 1] * py + chart_maps[m, 0, 2] * pz + chart_maps[m, 0, 3]
    v = chart_maps[m, 1, 0] * px + chart_maps[m, 1, 1] * py + chart_maps[m, 1, 2] * pz + chart_maps[m, 1, 3]
    return min(max(u, 0.0), texture.shape[1] - 1.001), min(max(v, 0.0), texture.shape[0] - 1.001)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _texel(u: float, v: float, texture: _F) -> tuple[float, float, float, float, float]:
    """Return albedo and slopes at a point of the texture, interpolated bilinearly."""
    u, v = max(u - 0.5, 0.0), max(v - 0.5, 0.0)
    iu, iv = int(u), int(v)
    fu, fv = u - iu, v - iv
    w00, w10, w01, w11 = (1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv
    iu1, iv1 = min(iu + 1, texture.shape[1] - 1), min(iv + 1, texture.shape[0] - 1)
    red, green, blue, along, down = 0.0, 0.0, 0.0, -1.28, -1.28
    for tu, tv, share in ((iu, iv, w00), (iu1, iv, w10), (iu, iv1, w01), (iu1, iv1, w11)):
        red += share * texture[tv, tu, 0]
        green += share * texture[tv, tu, 1]
        blue += share * texture[tv, tu, 2]
        along += 0.01 * share * texture[tv, tu, 4]
        down += 0.01 * share * texture[tv, tu, 5]
    return red * red / 65025.0, green * green / 65025.0, blue * blue / 65025.0, along, down


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _tilted(
    nx: float, ny: float, nz: float, along: float, down: float, m: int, chart_maps: _F
) -> tuple[float, float, float]:
    """Return a unit normal tilted by slopes `along` and `down`, m per m, in the chart's two directions."""
    a0, a1, a2 = chart_maps[m, 0, 0], chart_maps[m, 0, 1], chart_maps[m, 0, 2]
    b0, b1, b2 = chart_maps[m, 1, 0], chart_maps[m, 1, 1], chart_maps[m, 1, 2]
    scale = 1.0 / (abs(a0) + abs(a1) + abs(a2) + 1e-9)
    nx -= scale * (along * a0 + down * b0)
    ny -= scale * (along * a1 + down * b1)
    nz -= scale * (along * a2 + down * b2)
    norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-12)
    return nx * norm, ny * norm, nz * norm


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _gloss(material: int, paint: _F, toward_sun: float, away: float) -> tuple[float, float, float, float]:
    """Return reflected share, sun highlight, its wide part on metal flakes, and share of sunlight that is scattered."""
    sharp = toward_sun > 0.8
    fifth = away * away * away * away * away
    gleam = 0.0
    if material == PAINT:
        squared = toward_sun * toward_sun * toward_sun
        if sharp:
            wide = toward_sun**120
            gleam = paint[1] * (5.0 * wide + 110.0 * wide**12)
        # Limited along outlines, where a pixel has too few samples for a continuous line.
        rim = min(away, 0.7)
        mirrored = (0.05 + 0.80 * rim * rim * rim) * paint[1]
        return mirrored, gleam, paint[0] * 0.8 * squared * squared * squared * squared, 1.0
    if material == GLASS:
        if sharp:
            gleam = 25.0 * toward_sun**600
        return 0.065 + 0.935 * fifth, gleam, 0.0, 0.5
    if material == LAMP:
        if sharp:
            gleam = 10.0 * toward_sun**200
        return 0.055 + 0.9 * fifth, gleam, 0.0, 1.0
    if material == CHROME:
        if sharp:
            gleam = 6.0 * toward_sun**80
        return 0.55, gleam, 0.0, 0.4
    return 0.25 * (0.055 + 0.945 * fifth), 0.0, 0.0, 1.0


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sunlit(px: float, py: float, pz: float, light: _F, pose: _F, sun_map: _F, grid: _F) -> float:
    """Return the share of sunlight at a body-frame point: that of the road where its shadow falls."""
    if sun_map.shape[0] == 1:
        return 1.0
    reach = pz / max(light[2], 0.15)
    column = int((pose[0] * px + pose[1] - light[0] * reach - grid[0]) * grid[2])
    row = int((pose[0] * py + pose[2] - light[1] * reach - grid[1]) * grid[2])
    if column < 0 or row < 0 or column >= sun_map.shape[1] or row >= sun_map.shape[0]:
        return 1.0
    return float(sun_map[row, column]) / 255.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _light_on(
    x: float, y: float, t: int, screen: _F, triangles: _F, body: _F, normals: _F, charts: _F, chart_maps: _F,
    texture: _F, paint: _F, light: _F, around: _F, pose: _F, sun_map: _F, grid: _F,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the radiance of triangle t at frame px x, y; arguments as in `shade`."""
    px, py, pz, nx, ny, nz = _surface(x, y, t, screen, triangles, body, normals)
    u, v = _on_texture(px, py, pz, charts[t], chart_maps, texture)
    red, green, blue, along, down = _texel(u, v, texture)
    material = texture[int(v), int(u), 3]
    if material == LIT:
        return red * light[18], green * light[18], blue * light[18]
    if abs(along) + abs(down) > 0.004:
        nx, ny, nz = _tilted(nx, ny, nz, along, down, charts[t], chart_maps)
    heading = pose[0]
    sun_x, sun_y, sun_z = light[0] * heading, light[1] * heading, light[2]
    ex, ey, ez = -pose[1] * heading - px, -pose[2] * heading - py, pose[3] - pz
    norm = 1.0 / math.sqrt(ex * ex + ey * ey + ez * ez)
    ex, ey, ez = ex * norm, ey * norm, ez * norm
    facing = max(0.02, nx * ex + ny * ey + nz * ez)
    lambert = max(0.0, nx * sun_x + ny * sun_y + nz * sun_z)
    # Light of the sky from above and of the road from below, both occluded near the ground.
    up = 0.5 + 0.5 * nz
    open_sky = min(1.0, 0.36 + 0.64 * pz / paint[2])
    # The road in front of a face that is turned away from the sun lies in the vehicle's shadow.
    ground = 1.0
    if light[6] > 0.3:
        ground -= 0.35 * min(1.0, max(0.0, -1.6 * (nx * sun_x + ny * sun_y)))
    below = (1 - up) * ground
    amb_r = (up * (0.35 * light[12] + 0.65 * light[15]) + below * light[3]) * open_sky
    amb_g = (up * (0.35 * light[13] + 0.65 * light[16]) + below * light[4]) * open_sky
    amb_b = (up * (0.35 * light[14] + 0.65 * light[17]) + below * light[5]) * open_sky

    rx, ry, rz = 2 * facing * nx - ex, 2 * facing * ny - ey, 2 * facing * nz - ez
    er, eg, eb = _environment(rx * heading, ry * heading, rz, around)
    if rz < 0:
        mirrored = ground * ground
        er, eg, eb = er * mirrored, eg * mirrored, eb * mirrored
    toward_sun = max(0.0, rx * sun_x + ry * sun_y + rz * sun_z)
    fresnel, gleam, spread, scattered = _gloss(material, paint, toward_sun, 1 - facing)
    if material == PAINT:
        grime = paint[4] * max(0.0, 1.0 - pz / 0.7)
        red += (0.16 - red) * grime
        green += (0.15 - green) * grime
        blue += (0.13 - blue) * grime
        fresnel *= 1 - grime
        # Metal flakes reflect the surroundings, tinted by the paint.
        flakes = 0.5 * paint[0]
        amb_r += flakes * (er - amb_r)
        amb_g += flakes * (eg - amb_g)
        amb_b += flakes * (eb - amb_b)
    sun = _sunlit(px, py, pz, light, pose, sun_map, grid)
    direct = (lambert * scattered + spread) * sun
    gleam *= 0.04 * sun
    through = 1 - fresnel
    red = red * (direct * light[6] + amb_r) * through + fresnel * er + gleam * light[6]
    green = green * (direct * light[7] + amb_g) * through + fresnel * eg + gleam * light[7]
    blue = blue * (direct * light[8] + amb_b) * through + fresnel * eb + gleam * light[8]
    return red, green, blue


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shade(
    ids: _F, screen: _F, triangles: _F, body: _F, normals: _F, charts: _F, chart_maps: _F, texture: _F, paint: _F,
    light: _F, around: _F, pose: _F, sun_map: _F, grid: _F, exposure: float, curve: _F, origin: tuple[float, float],
    ss: int,
) -> _F:  # fmt: skip
    """Return the colour of every pixel: one sample per chart is shaded in each; with 9 samples, every other one.

    Args:
        ids: from `visible_triangles`.
        screen, triangles: (V, 3) and (T, 3), as there.
        body: (V, 3) metres, vertices in the body frame (x ahead, y left, z up).
        normals: (T, 3, 3) unit normals at the corners, body frame.
        charts: (T,) uint8, which row of `chart_maps` maps a triangle to the texture.
        chart_maps: (C, 2, 4) body (x, y, z, 1) -> texture px.
        texture: (h, w, 6) uint8, `Texture.image`.
        paint: (5,) metalness, gloss, height below which ambient light is occluded (m), unused, dirt.
        light: (23,) `Light.packed`.
        around: (S, S, 3) float32, `Light.around`.
        pose: (5,) heading (+1 or -1), position x, y of the body's origin in the road frame, camera height, share of
            the light that passes the air between.
        sun_map: (h, w) uint8, `Shade.sun`; one cell where nothing stands in the sun.
        grid: (3,) `Shade.grid`.
        exposure: factor before the tone curve.
        curve: `Light.curve`.
        origin, ss: as there.

    Returns:
        (H, W, 4) float32: premultiplied BGR in 0 to 255 after the tone curve, and coverage in [0, 1].
    """
    h, w = ids.shape[0] // ss, ids.shape[1] // ss
    out = np.zeros((h, w, 4), dtype=np.float32)
    share = 1.0 / (ss * ss)
    for r in range(h):
        for col in range(w):
            n, last = 0, -1
            red, green, blue = 0.0, 0.0, 0.0
            red1, green1, blue1 = 0.0, 0.0, 0.0
            for i in range(ss):
                for j in range(ss):
                    t = ids[r * ss + i, col * ss + j]
                    if t < 0:
                        continue
                    n += 1
                    if charts[t] != last or (ss > 2 and (i + j) % 2 == 0):
                        x, y = origin[0] + col + (j + 0.5) / ss, origin[1] + r + (i + 0.5) / ss
                        red1, green1, blue1 = _light_on(
                            x, y, t, screen, triangles, body, normals, charts, chart_maps, texture, paint, light,
                            around, pose, sun_map, grid,
                        )  # fmt: skip
                        last = charts[t]
                    # Clipped, so that one sample of a lamp or highlight does not decide the whole pixel.
                    red += min(red1 * exposure, 2.2)
                    green += min(green1 * exposure, 2.2)
                    blue += min(blue1 * exposure, 2.2)
            if n == 0:
                continue
            alpha = n * share
            red = red * pose[4] + (1 - pose[4]) * n * light[19] * exposure
            green = green * pose[4] + (1 - pose[4]) * n * light[20] * exposure
            blue = blue * pose[4] + (1 - pose[4]) * n * light[21] * exposure
            grey, colourful = 0.30 * red + 0.59 * green + 0.11 * blue, light[22]
            out[r, col, 0] = _curve((grey + colourful * (blue - grey)) / n, curve, 2) * alpha
            out[r, col, 1] = _curve((grey + colourful * (green - grey)) / n, curve, 1) * alpha
            out[r, col, 2] = _curve((grey + colourful * (red - grey)) / n, curve, 0) * alpha
            out[r, col, 3] = alpha
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def lay_over(part: _F, layer: _F, hidden: _F) -> None:
    """Composite a shaded layer over a part of a frame, in place.

    Args:
        part: (H, W, 3) uint8 BGR.
        layer: (H, W, 4) float32 as `shade` returns it.
        hidden: (H, W) uint8, 255 where something stands in front of the layer; (0, 0) for nowhere.
    """
    for r in range(part.shape[0]):
        for col in range(part.shape[1]):
            alpha = layer[r, col, 3]
            if alpha <= 0.002:
                continue
            shown = 1.0
            if hidden.shape[0] > 0:
                shown = 1.0 - hidden[r, col] / 255.0
            left = 1.0 - alpha * shown
            for k in range(3):
                part[r, col, k] = min(255.0, part[r, col, k] * left + layer[r, col, k] * shown + 0.5)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def darken(part: _F, left: _F, cover: _F, colours: _F) -> None:
    """Multiply a part of a frame by a shadow map, which is resampled to its size, in place.

    Args:
        part: (H, W, 3) uint8 BGR.
        left: (h, w) uint8, share of the grey levels that the shadow leaves, 255 for all.
        cover: (H, W) uint8, 255 where something stands in front of the shadow; (0, 0) for nowhere.
        colours: (256, 3) float32, share of each BGR channel, by the share of the grey levels.
    """
    height, width = part.shape[0], part.shape[1]
    step_r, step_c = left.shape[0] / height, left.shape[1] / width
    for r in range(height):
        at = min(max((r + 0.5) * step_r - 0.5, 0.0), left.shape[0] - 1.001) if left.shape[0] > 1 else 0.0
        r0 = int(at)
        fr, r1 = at - r0, min(r0 + 1, left.shape[0] - 1)
        for col in range(width):
            at = min(max((col + 0.5) * step_c - 0.5, 0.0), left.shape[1] - 1.001) if left.shape[1] > 1 else 0.0
            c0 = int(at)
            if left[r0, c0] == 255 and left[r1, c0] == 255:
                continue
            fc, c1 = at - c0, min(c0 + 1, left.shape[1] - 1)
            top = left[r0, c0] * (1 - fc) + left[r0, c1] * fc
            value = top * (1 - fr) + (left[r1, c0] * (1 - fc) + left[r1, c1] * fc) * fr
            if cover.shape[0] > 0:
                value = max(value, cover[r, col])
            step = int(value + 0.5)
            for k in range(3):
                part[r, col, k] = part[r, col, k] * colours[step, k] + 0.5
