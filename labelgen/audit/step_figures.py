"""Figures of single steps: from the frame to its rectification, and from a mask to its label."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.choices import Rule
from labelgen.drawing import (
    CYAN,
    GREEN,
    MAGENTA,
    RED,
    WHITE,
    YELLOW,
    crop_around,
    draw_box3d,
    draw_polyline,
    draw_text,
    fit_into,
    tile_pictures,
)
from labelgen.geometry.box_codec import decode_boxes
from labelgen.geometry.boxes import iou_matrix
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array, apply_homography
from labelgen.geometry.outline_label import RectifiedOutline, label_outlines, rectified_outline
from labelgen.geometry.rectification import Rectification
from labelgen.labels import Labels

__all__ = ["mask_label_figure", "rectification_figure"]

_PANEL = 420
_LEAST_OVERLAP = 0.2
"""IoU of a mask's box and a label's from which on they show the same vehicle."""


def rectification_figure(
    picture: NDArray[np.uint8],
    rectification: Rectification,
    camera: Camera,
    window_xyxy: ArrayLike,
    road: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
    """Draw the steps of a rectification in three panels.

    They show the region with its bounding tangents, the vanishing directions, and the rectified image.

    Args:
        picture: (H, W, 3) uint8 BGR, the original image of the window.
        rectification: of the frame.
        camera: of the frame.
        window_xyxy: (4,) frame px, the part of the frame that the picture shows.
        road: (H, W) bool road mask of the frame, where known.

    Returns:
        (h, w, 3) uint8 BGR.
    """
    offset = np.nan_to_num(np.asarray(window_xyxy, dtype=np.float64)[:2])
    corners = rectification.corners_px - offset
    region = picture.copy()
    if road is not None and road.shape == picture.shape[:2]:
        region[road] = (0.6 * region[road] + 0.4 * np.array(CYAN)).astype(np.uint8)
    thick = max(1, picture.shape[1] // 400)
    for i, colour in enumerate((GREEN, MAGENTA, GREEN, MAGENTA)):
        a, b = corners[i], corners[(i + 1) % 4]
        draw_polyline(region, [a - 4 * (b - a), b + 4 * (b - a)], colour, thick)
    directions = picture.copy()
    for number, colour in ((1, RED), (2, GREEN), (3, YELLOW)):
        _draw_directions(directions, camera.vanishing_point(number) - offset, colour, thick)
    rectified = rectification.warp_image(picture, origin_px=(float(offset[0]), float(offset[1])))
    panels = [fit_into(panel, (int(_PANEL * 1.5), _PANEL)) for panel in (region, directions, rectified)]
    texts = (
        f"1 region and its tangents through the {rectification.pair} vanishing points",
        "2 vanishing directions: VP1 red, VP2 green, VP3 yellow",
        f"3 rectified, {rectification.size_wh[0]}x{rectification.size_wh[1]}, towards VPU magenta",
    )
    w, h = rectification.size_wh
    gain = min(panels[2].shape[1] / w, panels[2].shape[0] / h)
    shift = np.array([(panels[2].shape[1] - w * gain) / 2, (panels[2].shape[0] - h * gain) / 2])
    for x in np.linspace(0.1, 0.9, 5) * w:
        for y in np.linspace(0.1, 0.9, 5) * h:
            start = np.array([x, y])
            step = rectification.vpu - start
            step *= 0.08 * min(w, h) / np.linalg.norm(step)
            draw_polyline(panels[2], np.stack([start, start + step]) * gain + shift, MAGENTA)
    for panel, text in zip(panels, texts, strict=True):
        draw_text(panel, text, (8, 18), 0.45)
    return tile_pictures(panels, 3)


def _draw_directions(picture: NDArray[np.uint8], towards: NDArray[np.float64], colour: Any, thick: int) -> None:
    height, width = picture.shape[:2]
    for x in np.linspace(0.1, 0.9, 6) * width:
        for y in np.linspace(0.15, 0.9, 5) * height:
            step = towards - np.array([x, y])
            step *= 0.05 * width / max(float(np.linalg.norm(step)), 1e-9)
            draw_polyline(picture, [[x, y], [x + step[0], y + step[1]]], colour, thick)


def mask_label_figure(
    picture: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    origin_px: tuple[int, int],
    rectification: Rectification,
    rule: Rule,
    labels: Labels | None = None,
) -> NDArray[np.uint8] | None:
    """Draw the steps from a mask to its label in four panels.

    They show the mask in the frame, the rectified mask with its box, the tangents with both candidates for c_c or the
    fitted cuboid over the mask, and the label with its 3D box.

    Args:
        picture: (H, W, 3) uint8 BGR, the frame.
        mask: (h, w) bool, the part of the instance mask that starts at `origin_px`.
        origin_px: frame px of the mask's first pixel.
        rectification: of the frame.
        rule: of the label.
        labels: of the frame, which say the label where it does not come from this mask alone.

    Returns:
        (h, w, 3) uint8 BGR; None where the mask gives no label.
    """
    outline = rectified_outline(rectification, mask, origin_px)
    if outline is None:
        return None
    if rule.is_of_tangents:
        label = label_outlines([outline], rectification.vpu, rule)
        if not label.valid[0]:
            return None
        box, cc = label.boxes_xyxy[0], float(label.cc[0])
    else:
        found = _label_of(outline, labels)
        if found is None:
            return None
        box, cc = found
    vertices, valid = decode_boxes(box, [cc], rectification.vpu)
    if not valid[0]:
        return None
    x, y = origin_px
    coloured = picture.copy()
    part = coloured[y : y + mask.shape[0], x : x + mask.shape[1]]
    part[mask] = (0.5 * part[mask] + 0.5 * np.array(CYAN)).astype(np.uint8)
    frame_panel, _ = crop_around(coloured, [x, y, x + mask.shape[1], y + mask.shape[0]], 0.4, _PANEL)

    whole = np.zeros(picture.shape[:2], dtype=np.bool_)
    whole[y : y + mask.shape[0], x : x + mask.shape[1]] = mask
    flat = rectification.warp_image(picture)
    tinted = flat.copy()
    inside = rectification.warp_mask(whole)
    tinted[inside] = (0.5 * tinted[inside] + 0.5 * np.array(CYAN)).astype(np.uint8)
    mask_panel, to_panel = crop_around(tinted, box, 0.4, _PANEL)
    corners = apply_homography(to_panel, box[[0, 1, 2, 1, 2, 3, 0, 3]].reshape(4, 2))
    draw_polyline(mask_panel, apply_homography(to_panel, outline.hull), WHITE, closed=True)
    third_panel = mask_panel.copy()
    draw_polyline(mask_panel, corners, GREEN, closed=True)
    if rule.is_of_tangents:
        third_panel, third_text = _tangents(mask_panel, to_panel, rectification, outline, label.candidates[0], corners)
    else:
        draw_box3d(third_panel, apply_homography(to_panel, vertices[0]))
        third_text = "3 cuboid of the fitted body"

    label_panel, _ = crop_around(flat, box, 0.4, _PANEL)
    draw_box3d(label_panel, apply_homography(to_panel, vertices[0]))
    draw_polyline(label_panel, corners, GREEN, closed=True)
    panels = [frame_panel, mask_panel, third_panel, label_panel]
    texts = ("1 mask in the frame", "2 rectified: box and hull", third_text, f"4 label: c_c {cc:.3f} ({rule})")
    for panel, text in zip(panels, texts, strict=True):
        draw_text(panel, text, (8, 18), 0.45)
    return tile_pictures(panels, 4)


def _label_of(outline: RectifiedOutline, labels: Labels | None) -> tuple[Array, float] | None:
    """Return box and c_c of the label that lies around an outline best; None where none does."""
    if labels is None or not len(labels):
        return None
    overlaps = iou_matrix(outline.box_xyxy[None], labels.boxes_xyxy)[0]
    best = int(overlaps.argmax())
    return (labels.boxes_xyxy[best], float(labels.cc[best])) if overlaps[best] > _LEAST_OVERLAP else None


def _tangents(
    mask_panel: NDArray[np.uint8],
    to_panel: Array,
    rectification: Rectification,
    outline: RectifiedOutline,
    candidates: Array,
    corners: Array,
) -> tuple[NDArray[np.uint8], str]:
    """Return the panel of the tangents with both candidates for c_c, and its text."""
    tangent_panel = mask_panel.copy()
    vpu = apply_homography(to_panel, rectification.vpu[None])[0]
    hull = apply_homography(to_panel, outline.hull)
    slope = (hull[:, 0] - vpu[0]) / (hull[:, 1] - vpu[1])
    for touch in (int(slope.argmin()), int(slope.argmax())):
        draw_polyline(tangent_panel, [vpu, vpu + 3 * (hull[touch] - vpu)], MAGENTA)
        cv2.circle(tangent_panel, tuple(int(v) for v in hull[touch]), 4, MAGENTA, -1, cv2.LINE_AA)
    for candidate in candidates:
        level = corners[0, 1] + candidate * (corners[2, 1] - corners[0, 1])
        draw_polyline(tangent_panel, [[corners[0, 0], level], [corners[1, 0], level]], YELLOW)
    return tangent_panel, f"3 tangents; candidates {candidates[0]:.3f}, {candidates[1]:.3f}"
