"""Labels of the frames of a video, with a body laid over the masks of each passage."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import CalibrationError
from labelgen.geometry.body_forms import load_body_forms
from labelgen.geometry.box_codec import decode_boxes, encode_boxes
from labelgen.geometry.camera import Camera
from labelgen.geometry.cuboid import road_cuboids
from labelgen.geometry.homography import Array, IntArray
from labelgen.geometry.outline_label import mask_polygon
from labelgen.geometry.rectification import Rectification
from labelgen.labeling.fitted.classes import possible_classes
from labelgen.labeling.fitted.fit import FittedBodies, fit_bodies
from labelgen.labeling.fitted.outlines import Outlines, measure_outlines
from labelgen.labeling.fitted.passages import Sightings, join_passages
from labelgen.labeling.fitted.settings import BODY_FIT_SETTINGS, BodyFitSettings, MaskErrors
from labelgen.labeling.screening import (
    LABEL_LIMITS,
    FrameLabels,
    LabelLimits,
    Rejections,
    at_frame_border,
    large_outlines,
    on_road,
    second_masks,
    touching,
    truncated,
)
from labelgen.labels import Flag, Labels, VehicleClass
from labelgen.masks import InstanceMasks

__all__ = ["SeenFrame", "label_passages"]

BoolArray = NDArray[np.bool_]
_AT_ONCE = 200
"""Sightings fitted at once: more take more memory, fewer more time."""
_LANE_M = 1.5
"""Half the width of the strip of road in which all vehicles drive in one direction, metres."""
_FEWEST_IN_LANE = 3
_MAX_STRAIN = 5.0
"""Size of a vehicle, in standard deviations from its family's mean, from which on the mask shows something else."""
_OCCLUDED = 0.15
"""Share of a vehicle that is missing in its mask from which on it is flagged: forms are known to some hundredths."""


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """The masks of one frame.

    Args:
        number: of the frame.
        time_s: seconds.
        masks: of the vehicles.
    """

    number: int
    time_s: float
    masks: InstanceMasks


@dataclass(frozen=True, eq=False)
class _Candidates:
    """N masks that may become labels.

    Args:
        frame: (N,) index of the frame in the list of frames.
        mask: (N,) number of the mask in its frame.
        outlines: of the masks.
        cut: (N,) bool, whether the frame's border cuts the mask.
        touching: (N,) bool, whether it touches another mask.
        class_ids: (N,) `VehicleClass`.
    """

    frame: IntArray
    mask: IntArray
    outlines: Outlines
    cut: BoolArray
    touching: BoolArray
    class_ids: IntArray


def label_passages(
    frames: Sequence[SeenFrame],
    rectification: Rectification,
    camera: Camera,
    road: BoolArray,
    errors: MaskErrors,
    limits: LabelLimits = LABEL_LIMITS,
    *,
    settings: BodyFitSettings = BODY_FIT_SETTINGS,
) -> list[FrameLabels]:
    """Label the vehicles of successive frames of one video.

    Args:
        frames: in the order of time.
        rectification: of the frames.
        camera: of the frames, with a scale.
        road: (H, W) bool road mask of the frames.
        errors: of the masks.
        limits: thresholds.
        settings: of the fit.

    Returns:
        For each frame its labels, a reject for each mask without a label, and the boxes to ignore.

    Raises:
        CalibrationError: the camera has no scale.
    """
    if camera.scale is None:
        raise CalibrationError(
            f"camera {camera.name or '(unnamed)'}: it has no scale, which the fitted labels need; "
            "choose another rule, or add 'scale' to the calibration"
        )
    rejections = [Rejections(rectification.size_wh, limits) for _ in frames]
    seen = _candidates(frames, rectification, camera, road, errors, limits, settings, rejections)
    if not len(seen.frame):
        return [rejected.result(Labels.empty()) for rejected in rejections]
    times = np.array([frame.time_s for frame in frames])[seen.frame]
    # Without times nothing can be joined: every mask is a vehicle of its own.
    timed = np.isfinite(times).all() and (np.diff(times) >= 0).all()
    vehicles = join_passages(_sightings(seen, times, camera)) if timed else np.arange(len(times))
    bodies = _fit(seen, vehicles, times, camera, errors, settings)
    return _labels(frames, seen, bodies, rectification, camera, road, limits, settings, rejections)


# -- which masks --------------------------------------------------------------------------------------------


def _candidates(
    frames: Sequence[SeenFrame],
    rectification: Rectification,
    camera: Camera,
    road: BoolArray,
    errors: MaskErrors,
    limits: LabelLimits,
    settings: BodyFitSettings,
    rejections: Sequence[Rejections],
) -> _Candidates:
    rows: list[tuple[int, int, bool, bool, int]] = []
    polygons: list[Array] = []
    frame_wh = (road.shape[1], road.shape[0])
    for f, frame in enumerate(frames):
        masks = frame.masks
        if not len(masks):
            continue
        doubled, cut = second_masks(masks, limits), at_frame_border(masks, limits)
        outlines = large_outlines(masks, rectification, doubled, limits, rejections[f])
        index = np.array(list(outlines), dtype=np.int64)
        boxes = masks.boxes_xyxy[index].reshape(-1, 4)
        bottoms = np.stack([(boxes[:, 0] + boxes[:, 2]) / 2, boxes[:, 3] - 1], axis=1)
        placed = on_road(masks, index, road, bottoms, limits.min_on_road)
        touch = touching(masks, doubled)
        for i, here in zip(index.tolist(), placed.tolist(), strict=True):
            if not here:
                rejections[f].add_box(i, "off the road", "", outlines[i].box_xyxy, is_cut=bool(cut[i]))
                continue
            polygon = mask_polygon(masks.crops[i], tuple(masks.origins[i].tolist()))
            assert polygon is not None
            polygons.append(polygon)
            rows.append((f, i, bool(cut[i]), bool(touch[i]), int(masks.class_ids[i])))
    table = np.array(rows, dtype=np.int64).reshape(-1, 5)
    measured = measure_outlines(polygons, camera, frame_wh, settings, margin_px=errors.margin_px(frame_wh))
    return _Candidates(
        table[:, 0], table[:, 1], measured, table[:, 2].astype(np.bool_), table[:, 3].astype(np.bool_), table[:, 4]
    )


def _sightings(seen: _Candidates, times: Array, camera: Camera) -> Sightings:
    bottoms, widths, heights = seen.outlines.bottoms_px, seen.outlines.widths_px, seen.outlines.heights_px
    steps = [np.array([-0.5, 0]), np.array([0.5, 0]), np.array([0, -1.0])]
    points = camera.road_points(bottoms, invalid="nan")
    left, right, up = (camera.road_points(bottoms + step, invalid="nan") for step in steps)
    across, along = np.linalg.norm(right - left, axis=1), np.linalg.norm(up - points, axis=1)
    return Sightings(
        times, seen.frame, points, widths * across, heights * across, seen.class_ids, seen.cut,
        np.nan_to_num(np.stack([along, across], axis=1)),
    )  # fmt: skip


# -- the fit ------------------------------------------------------------------------------------------------


def _fit(
    seen: _Candidates, vehicles: IntArray, times: Array, camera: Camera, errors: MaskErrors, settings: BodyFitSettings
) -> FittedBodies:
    """Fit all passages. Those that do not tell their direction of travel take it from their lane."""
    count = int(vehicles.max()) + 1
    places = camera.road_points(seen.outlines.bottoms_px, invalid="nan")
    first, last = np.full(count, -1), np.full(count, -1)
    last[vehicles] = np.arange(len(vehicles))
    first[vehicles[::-1]] = np.arange(len(vehicles))[::-1]
    moved = places[last, 0] - places[first, 0]
    known = np.abs(moved) >= settings.moved_m
    signs: list[int | None] = [int(np.sign(m)) if k else None for m, k in zip(moved, known, strict=True)]
    for v in np.flatnonzero(~known).tolist():
        lane = known & (np.abs(places[first, 1] - places[first[v], 1]) < _LANE_M)
        if lane.sum() >= _FEWEST_IN_LANE and abs(np.sign(moved[lane]).mean()) > 0.8:
            signs[v] = int(np.sign(moved[lane].sum()))
    classes = [possible_classes(seen.class_ids[vehicles == v].tolist()) for v in range(count)]
    parts = []
    for chosen in _batches(np.bincount(vehicles, minlength=count)):
        rows = np.flatnonzero(np.isin(vehicles, chosen))
        local = np.searchsorted(chosen, vehicles[rows])
        fitted = fit_bodies(
            seen.outlines.select(rows), local, times[rows], camera, errors,
            signs=[signs[v] for v in chosen], classes=[classes[v] for v in chosen], settings=settings,
        )  # fmt: skip
        parts.append((rows, fitted))
    return FittedBodies.scattered(parts, len(vehicles))


def _batches(counts: IntArray) -> Iterator[IntArray]:
    """Yield numbers of vehicles, few enough sightings together."""
    start, total = 0, 0
    for v, count in enumerate(counts.tolist()):
        if total and total + count > _AT_ONCE:
            yield np.arange(start, v)
            start, total = v, 0
        total += count
    yield np.arange(start, len(counts))


# -- labels -------------------------------------------------------------------------------------------------


def _encoded(bodies: FittedBodies, camera: Camera, rectification: Rectification) -> tuple[Array, Array, BoolArray]:
    """Return 2D boxes, c_c and validity of bodies that follow the road."""
    with np.errstate(invalid="ignore"):
        vertices = rectification.points(camera.project(road_cuboids(bodies.near_xy, bodies.size_lwh)))
        encoded = encode_boxes(vertices, rectification.vpu)
    return encoded.boxes_xyxy, encoded.cc, np.asarray(np.isfinite(vertices).all(axis=(1, 2)))


def _sigmas(bodies: FittedBodies, camera: Camera, rectification: Rectification, scale: float) -> Array:
    """Return standard deviations (N, 5) of boxes and c_c, by linear propagation of the fit's covariance."""
    step = 0.01
    boxes, cc, _ = _encoded(bodies, camera, rectification)
    slopes = []
    for k in range(5):
        place, size = bodies.place.copy(), bodies.size_lwh.copy()
        if k < 2:
            place[:, k] += step
        else:
            size[:, k - 2] *= np.exp(step)
        moved_boxes, moved_cc, _ = _encoded(replace(bodies, place=place, size_lwh=size), camera, rectification)
        slopes.append(np.concatenate([moved_boxes - boxes, (moved_cc - cc)[:, None]], axis=1) / step)
    jacobian = np.stack(slopes, axis=-1)
    kept = [0, 1, 3, 4, 5]
    covariance = bodies.covariance[:, kept][:, :, kept]
    variance = np.einsum("nij,njk,nik->ni", jacobian, covariance, jacobian)
    return np.asarray(scale * np.sqrt(np.maximum(variance, 0)))


def _hidden(seen: _Candidates, bodies: FittedBodies, frame_wh: tuple[int, int], settings: BodyFitSettings) -> Array:
    """Return the share (N,) of each body inside the frame that lies outside its mask's hull."""
    wide, high = frame_wh
    frame = np.array([[0, 0], [wide, 0], [wide, high], [0, high]], dtype=np.float32)
    out = np.zeros(len(seen.mask))
    expected, measured = (_support_polygons(reach, settings) for reach in (bodies.reach_px, seen.outlines.reach_px))
    for k in np.flatnonzero(bodies.found).tolist():
        area, inside = cv2.intersectConvexConvex(cv2.convexHull(expected[k]), frame)
        if area > 0:
            common, _ = cv2.intersectConvexConvex(cv2.convexHull(inside), cv2.convexHull(measured[k]))
            out[k] = 1 - common / area
    return out.clip(0, 1)


def _support_polygons(reach_px: Array, settings: BodyFitSettings) -> NDArray[np.float32]:
    """Return the corners (N, M, 2) of the polygons whose sides are given by their reach (N, M) in M directions."""
    directions = settings.direction_vectors
    turn = 2 * np.pi / settings.directions
    along = np.stack([-directions[:, 1], directions[:, 0]], axis=1)
    after = np.roll(reach_px, -1, axis=1)
    far = (after - reach_px * np.cos(turn)) / np.sin(turn)
    corners = directions * reach_px[..., None] + along * far[..., None]
    return np.asarray(corners, dtype=np.float32)


def _labels(
    frames: Sequence[SeenFrame],
    seen: _Candidates,
    bodies: FittedBodies,
    rectification: Rectification,
    camera: Camera,
    road: BoolArray,
    limits: LabelLimits,
    settings: BodyFitSettings,
    rejections: Sequence[Rejections],
) -> list[FrameLabels]:
    contact = camera.project(bodies.near_xy)
    boxes, cc, valid = _encoded(bodies, camera, rectification)
    # Shards store float32, so the label is what can be decoded from float32.
    boxes = boxes.astype(np.float32).astype(np.float64)
    cc = np.clip(cc, 0, 1).astype(np.float32).astype(np.float64)
    valid &= bodies.found & decode_boxes(boxes, cc, rectification.vpu)[1]
    sizes = bodies.size_lwh
    with np.errstate(invalid="ignore"):
        plausible = ((sizes >= limits.min_size_lwh_m) & (sizes <= limits.max_size_lwh_m)).all(axis=1)
        plausible &= bodies.strain <= _MAX_STRAIN
        explained = bodies.cost <= settings.max_cost
    cut = truncated(np.nan_to_num(boxes), rectification.size_wh, limits.border_px) | seen.cut
    hidden = _hidden(seen, bodies, (road.shape[1], road.shape[0]), settings)
    hidden = np.where(seen.cut, np.nan, hidden)
    sigmas = _sigmas(bodies, camera, rectification, settings.sigma_scale)
    own_class = np.array([form.vehicle_class for form in load_body_forms().forms])[bodies.family]
    class_ids = np.where(seen.class_ids == VehicleClass.VEHICLE, own_class, seen.class_ids)
    flags = (
        Flag.TRUNCATED * cut + Flag.TOUCHING * seen.touching + Flag.OCCLUDED * (np.nan_to_num(hidden) >= _OCCLUDED)
    ).astype(np.uint16)
    out = []
    for f, frame in enumerate(frames):
        rows = np.flatnonzero(seen.frame == f)
        keep = []
        stands = on_road(frame.masks, seen.mask[rows], road, contact[rows], limits.min_on_road)
        for row, here in zip(rows.tolist(), stands.tolist(), strict=True):
            reason = None
            if not valid[row] or not explained[row]:
                reason = ("no valid 3D box", "no body fits the mask")
            elif not here:
                reason = ("off the road", "")
            elif not plausible[row]:
                reason = ("implausible size", "length x width x height {:.1f} x {:.1f} x {:.1f} m".format(*sizes[row]))
            if reason is None:
                keep.append(row)
                continue
            i = int(seen.mask[row])
            outline = rectification.boxes(frame.masks.boxes_xyxy[i : i + 1])[0]
            rejections[f].add_box(i, *reason, outline, is_cut=bool(cut[row]), is_part=reason[0] == "implausible size")
        k = np.array(keep, dtype=np.int64)
        labels = Labels(
            boxes[k], cc[k], class_ids[k].astype(np.uint8), frame.masks.scores[seen.mask[k]], flags[k],
            sigmas=sigmas[k].astype(np.float32), hidden=hidden[k].astype(np.float32),
        ) if keep else Labels.empty()  # fmt: skip
        out.append(rejections[f].result(labels))
    return out
