"""Speed errors of every variant, from exact masks of replayed traffic in real scenes.

    python -m tools.studies.speed_variants measure SESSION... --out FOLDER [--duration 300] [--fps 50]
    python -m tools.studies.speed_variants write FOLDER docs/studies/speed-variants.md

The recorded traffic of a session is driven again by rendered vehicles (`labelgen synth session --scene --replay`), but
only their masks are made, frame by frame, and nothing is drawn or encoded. Each variant turns the same masks into
detections, tracks and speeds by the code of `labelgen speed`, and the public protocol scores them against the speeds
that were driven.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from tqdm import tqdm

from detector.evaluation.brnocompspeed import score_recording
from detector.speed.contact_point import MaskExtent
from detector.speed.detections import Detections
from detector.speed.mask_detections import MaskPlacer
from detector.speed.meter import SpeedMeter
from detector.speed.track_fit import TrackFitter
from detector.speed.track_speed import MeasuredVehicle
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from detector.tracking.tracks import Tracks
from labelgen.atomic_files import make_folder, write_json
from labelgen.datasets.brnocompspeed import GroundTruth, parse_ground_truth
from labelgen.datasets.manifest import load_manifest
from labelgen.errors import DataError, LabelgenError, RectificationError
from labelgen.geometry import Camera, Pair, RoadMask, Rule, parse_size
from labelgen.geometry.homography import Array
from labelgen.masks import InstanceMasks
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.renderer.vehicle_masks import DrawnVehicle
from labelgen.synth.scene.scene import RoadScene
from labelgen.synth.scene.traffic import Trip
from labelgen.synth.shading.lighting import Weather
from labelgen.synth.truth.replay import load_scene, replayed_traffic
from labelgen.synth.truth.session import ground_truth, place

__all__ = ["app", "format_tables", "measure_session"]

app = typer.Typer(no_args_is_help=True, add_completion=False)

_TWIN = {Variant.TRANSFORM2D: Variant.TRANSFORM3D, Variant.PREVIOUS2D: Variant.PREVIOUS3D}
"""2D variants whose boxes are those of a 3D variant, so that masks are rectified once for both."""
_OFFSETS_EVERY = 10
_NEAR_M = (6.0, 1.7)
"""Farther away than this along and across the road a true point belongs to another vehicle."""
_ORDER = (
    Variant.FITTED3D,
    Variant.TRANSFORM3D,
    Variant.MASKRCNN3D,
    Variant.PREVIOUS3D,
    Variant.TRANSFORM2D,
    Variant.PREVIOUS2D,
    Variant.ORIG2D,
)


@dataclass
class _VariantRun:
    """One variant with its tracks and offsets so far."""

    name: str
    view: MeasurementView
    placer: MaskPlacer
    meter: SpeedMeter
    cars: list[dict[str, Any]]
    offsets_m: list[Any]

    def add(self, detections: Detections, trips: Sequence[Trip]) -> None:
        """Track the detections of a frame, and note now and then how far their points are from the true ones."""
        _, vehicles = self.meter.add(detections)
        self._keep(vehicles, trips)
        if self.view.variant is not Variant.FITTED3D and detections.frame % _OFFSETS_EVERY == 0:
            points_px = detections.contact_points_px[detections.contact_visible]
            self.offsets_m += _offsets(self.view.camera, points_px, trips, detections.time_s)

    def finish(self, trips: Sequence[Trip]) -> None:
        """End all tracks."""
        self._keep(self.meter.finish(), trips)

    def _keep(self, vehicles: Sequence[MeasuredVehicle], trips: Sequence[Trip]) -> None:
        self.cars += [vehicle.to_car() for vehicle in vehicles]
        if self.view.variant is not Variant.FITTED3D:
            return
        for vehicle in vehicles:
            for i in np.flatnonzero(vehicle.frames % _OFFSETS_EVERY == 0).tolist():
                time_s = float(vehicle.times_s[i])
                self.offsets_m += _offsets(self.view.camera, vehicle.points_px[i : i + 1], trips, time_s)


def _masks(drawn: Sequence[DrawnVehicle], frame_wh: tuple[int, int]) -> InstanceMasks:
    """Return exact masks in the form of a mask source."""
    count = len(drawn)
    return InstanceMasks(
        frame_wh,
        np.array([d.origin_px for d in drawn], dtype=np.int64).reshape(-1, 2),
        tuple(d.mask for d in drawn),
        np.zeros(count, dtype=np.uint8),
        np.ones(count, dtype=np.float32),
    )


def truth_masks(
    scene: RoadScene, trips: Sequence[Trip], renderer: Renderer, count: int, fps: float
) -> Iterator[tuple[int, float, InstanceMasks]]:
    """Yield frame number, time in seconds and exact masks of each frame."""
    spans = {trip.track_id: trip.span_s(scene.x_range) for trip in trips}
    vehicles: dict[int, Any] = {}
    for number in range(count):
        time_s = number / fps
        here = [trip for trip in trips if spans[trip.track_id][0] <= time_s <= spans[trip.track_id][1]]
        vehicles = {t.track_id: vehicles.get(t.track_id) or t.vehicle(lamps=False) for t in here}
        drawn = renderer.truth([place(t, vehicles[t.track_id], time_s) for t in here])
        yield number, time_s, _masks(drawn, renderer.size_wh)


def _steady(trip: Trip) -> Trip:
    """Return the same trip at one speed from its first to its last recorded crossing.

    Recorded crossings are rounded to frames, so that the speed differs from one line to the next. The median of the
    protocol then differs from the mean speed by half a km/h even on true points, which would hide the errors of the
    variants.
    """
    return replace(trip, knots_s=trip.knots_s[[0, -1]], knots_x=trip.knots_x[[0, -1]])


def _variant_runs(
    camera: Camera, road: RoadMask, fps: float, rule: Rule, outlines: bool
) -> tuple[list[_VariantRun], dict[str, str]]:
    """Return all variants with both pairs, and by name why others are not possible in this scene."""
    runs, impossible = [], {}
    mask_extent = MaskExtent.BODY if outlines else None
    sizes = load_manifest("brnocompspeed")["sizes"]
    for pair in Pair:
        for variant in _ORDER:
            if variant is Variant.ORIG2D and pair is not Pair.VP2_VP3:
                continue  # it does not depend on the pair
            name = str(variant) if variant is Variant.ORIG2D else f"{variant} {pair}"
            try:
                view = MeasurementView.create(
                    variant, camera, road, pair, parse_size(sizes[str(pair)]), mask_extent=mask_extent
                )
            except RectificationError as err:
                impossible[name] = str(err)
                continue
            fitter = TrackFitter(view) if variant is Variant.FITTED3D else None
            meter = SpeedMeter(camera, fps=fps, fitter=fitter)
            runs.append(_VariantRun(name, view, MaskPlacer(view, road, pair, rule), meter, [], []))
    return runs, impossible


def measure_session(
    session: Path,
    duration_s: float,
    fps: float,
    *,
    seed: int = 0,
    start_s: float | None = None,
    rule: Rule = Rule.WIDER,
    kinds: Sequence[str] | None = None,
    outlines: bool = False,
) -> dict[str, Any]:
    """Replay the traffic of a session and score every variant.

    `outlines` moves measured points from the lowest line of the masks to the contact points, as `labelgen speed`
    does.

    Returns:
        rows by variant and pair: the row of the public protocol, the absolute and the signed errors in km/h.
    """
    begin = perf_counter()
    scene, light, surveyed = load_scene(session, Weather.OVERCAST, np.random.default_rng([seed, 1]))
    replayed = replayed_traffic(scene, surveyed, duration_s, seed, start_s=start_s, kinds=kinds)
    trips = [_steady(trip) for trip in replayed]
    assert scene.background is not None
    renderer = Renderer(scene.camera, scene.background, light, seed=seed)
    runs, impossible = _variant_runs(scene.camera, RoadMask(scene.road_mask), fps, rule, outlines)
    count = round(duration_s * fps)
    exact: dict[int, dict[str, Any]] = {}
    for number, time_s, masks in tqdm(
        truth_masks(scene, trips, renderer, count, fps), total=count, desc=scene.name, unit="frame", mininterval=10
    ):
        _exact(exact, scene, trips, number, time_s)
        detections_of: dict[str, Detections] = {}
        for run in runs:
            twin = _TWIN.get(run.view.variant)
            source = detections_of.get(run.name.replace(str(run.view.variant), str(twin))) if twin else None
            if source is None:
                detections = run.placer.place(number, time_s, masks)
            else:
                boxes = (source.boxes_xyxy, None, source.scores, source.class_ids)
                detections, _ = run.view.place(number, time_s, *boxes)
            detections_of[run.name] = detections
            run.add(detections, trips)
    truth = parse_ground_truth(ground_truth(scene, trips, duration_s, fps, surveyed))
    rows = {"true points": _score(scene, truth, list(exact.values()))}
    for run in runs:
        run.finish(trips)
        rows[run.name] = _score(scene, truth, run.cars)
        offsets = np.array(run.offsets_m).reshape(-1, 2)
        rows[run.name] |= {"rejects": dict(run.placer.rejects), "along_m": offsets[:, 0].tolist()}
        rows[run.name]["across_m"] = offsets[:, 1].tolist()
    return {
        "session": scene.name,
        "duration_s": duration_s,
        "fps": fps,
        "seed": seed,
        "rule": str(rule),
        "vehicles": len(trips),
        "seconds": round(perf_counter() - begin, 1),
        "impossible": impossible,
        "rows": rows,
    }


def _offsets(camera: Camera, points_px: Array, trips: Sequence[Trip], time_s: float) -> list[Any]:
    """Return measured minus true points, metres along and across the road."""
    measured = camera.road_points(points_px, invalid="nan")
    true = np.array([trip.near_point(time_s) for trip in trips])
    apart = measured[:, None] - true
    nearest = np.hypot(apart[..., 0], 2 * apart[..., 1]).argmin(axis=1) if len(measured) else np.empty(0, dtype=int)
    offsets = apart[np.arange(len(measured)), nearest]
    return [pair for pair in offsets.round(3).tolist() if abs(pair[0]) < _NEAR_M[0] and abs(pair[1]) < _NEAR_M[1]]


def _exact(
    tracks: dict[int, dict[str, Any]], scene: RoadScene, trips: Sequence[Trip], number: int, time_s: float
) -> None:
    """Add the true contact points of a frame to tracks, which the protocol then scores as tracks without error."""
    size = np.asarray(scene.camera.image_wh)
    for trip in trips:
        point = scene.camera.project(trip.near_point(time_s))
        if np.isfinite(point).all() and (point > 0).all() and (point < size).all():
            car = tracks.setdefault(trip.track_id, {"id": trip.track_id, "frames": [], "posX": [], "posY": []})
            car["frames"].append(number)
            car["posX"].append(float(point[0]))
            car["posY"].append(float(point[1]))


def _score(scene: RoadScene, truth: GroundTruth, cars: list[dict[str, Any]]) -> dict[str, Any]:
    score = score_recording(truth, Tracks.from_cars(cars), scene.camera)
    # NaN, in JSON null, for vehicles that were not found.
    errors = np.where(score.counted, score.speeds_kmh - score.truth_kmh, np.nan)[score.valid]
    return {
        "false_positives": score.false_positives,
        "errors": [error if np.isfinite(error) else None for error in errors.tolist()],
    }


def format_tables(parts: Sequence[dict[str, Any]]) -> str:
    """Return Markdown: tables over all sessions, of all vehicles and of the common ones; and one table per session."""
    names = list(dict.fromkeys(name for part in parts for name in part["rows"]))
    out = [_table(parts, names)]
    everywhere = [name for name in names if all(name in part["rows"] for part in parts)]
    out += ["### Vehicles that all of these found\n", _table(parts, everywhere, common=True)]
    for part in parts:
        minutes = part["duration_s"] / 60
        valid = len(part["rows"]["true points"]["errors"])
        out.append(f"### {part['session']}\n\n{minutes:g} min, {part['fps']:g} frames per second, {valid} vehicles\n")
        out.append(_table([part], names))
        out += [f"{name}: not possible here ({reason})\n" for name, reason in part["impossible"].items()]
    return "\n".join(out)


_HEAD = (
    "variant", "pair", "vehicles", "recall", "precision", "mean", "median", "p95", "worst", "signed mean", "along, m",
    "across, m",
)  # fmt: skip


def _table(parts: Sequence[dict[str, Any]], names: Sequence[str], *, common: bool = False) -> str:
    lines = ["| " + " | ".join(_HEAD) + " |", "| --- | --- |" + " ---: |" * (len(_HEAD) - 2)]
    rows_of = [
        np.isfinite([_errors(part["rows"][name]) for name in names]).all(axis=0) if common else slice(None)
        for part in parts
    ]
    for name in names:
        rows = [
            (part["rows"][name], common_rows)
            for part, common_rows in zip(parts, rows_of, strict=True)
            if name in part["rows"]
        ]
        if rows:
            lines.append("| " + " | ".join(_cells(name, rows)) + " |")
    return "\n".join(lines) + "\n"


def _errors(row: dict[str, Any]) -> NDArray[np.float64]:
    return np.array([np.nan if error is None else error for error in row["errors"]], dtype=np.float64)


def _cells(name: str, rows: Sequence[tuple[dict[str, Any], Any]]) -> list[str]:
    errors = np.concatenate([_errors(row)[common_rows] for row, common_rows in rows])
    wrong = sum(row["false_positives"] for row, _ in rows)
    variant, pair = (name, "-") if " VP" not in name else name.split(" ")
    known = errors[np.isfinite(errors)]
    cells = [variant, pair, str(len(errors)), f"{len(known) / max(len(errors), 1):.3f}"]
    cells.append(f"{len(known) / max(len(known) + wrong, 1):.3f}")
    if not len(known):
        return [*cells, *["-"] * 7]
    size = np.abs(known)
    figures = (size.mean(), np.median(size), np.percentile(size, 95), size.max(), known.mean())
    offsets = [np.concatenate([row.get(key, []) for row, _ in rows]) for key in ("along_m", "across_m")]
    places = [f"{np.median(np.abs(values)):.2f}" if len(values) else "-" for values in offsets]
    return [*cells, *(f"{value:.2f}" for value in figures), *places]


@app.command("measure")
def measure(
    sessions: Annotated[list[Path], typer.Argument(help="Session folders, ROOT/dataset/NAME.")],
    out: Annotated[Path, typer.Option(help="Folder for one JSON file per session.")],
    duration: Annotated[float, typer.Option(min=1, help="Seconds of traffic.")] = 300.0,
    fps: Annotated[float, typer.Option(min=1, help="Frames per second.")] = 50.0,
    seed: Annotated[int, typer.Option(help="What the vehicles look like.")] = 0,
    start: Annotated[float | None, typer.Option(help="Second of the recording to begin at.")] = None,
    rule: Annotated[str, typer.Option(help="wider or conditioned.")] = "wider",
    kind: Annotated[str | None, typer.Option(help="Only this kind of vehicle; box: solid cuboids.")] = None,
    outlines: Annotated[
        bool, typer.Option(help="Measure at contact points, as `labelgen speed` does from masks.")
    ] = False,
) -> None:
    """Measure sessions and write their figures."""
    make_folder(out)
    for session in sessions:
        part = measure_session(
            session, duration, fps, seed=seed, start_s=start, rule=Rule.parse(rule), kinds=kind and [kind],
            outlines=outlines,
        )  # fmt: skip
        write_json(out / f"{part['session']}.json", part)
        typer.echo(format_tables([part]))
        typer.echo(f"{part['seconds']} s")


@app.command("write")
def write(
    folder: Annotated[Path, typer.Argument(help="Folder that `measure` wrote.")],
    page: Annotated[Path, typer.Argument(help="Markdown page; what stands above its line '## Result' is kept.")],
    cuboids: Annotated[Path | None, typer.Option(help="Folder that `measure --kind box` wrote.")] = None,
) -> None:
    """Put the tables into a page."""
    above = page.read_text(encoding="utf-8").split("## Result\n")[0] if page.exists() else ""
    text = f"{above}## Result\n\n{format_tables(_read(folder))}"
    if cuboids is not None:
        text += f"\n## Solid cuboids in place of vehicles\n\n{format_tables(_read(cuboids))}"
    page.write_text(text, encoding="utf-8")


def _read(folder: Path) -> list[dict[str, Any]]:
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise DataError(f"{folder}: no figures there; run `measure` first")
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths]


if __name__ == "__main__":
    try:
        app(standalone_mode=False)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
