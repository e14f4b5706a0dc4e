"""Compare calibrations from the video alone with published and with true cameras.

    python -m tools.studies.calibration tracks BRNOCOMPSPEED_ROOT
    python -m tools.studies.calibration videos SESSION... [--json FILE]

`tracks` takes the vehicle tracks of the published 2014 system and compares VP1 with the published one. It also measures
which VP1 explains the surveyed distances better: for either, with the tilt of the best known calibration, the focal
length with the least error in the ratios of distances is searched, and that error is printed.

`videos` calibrates from the videos of rendered sessions, ROOT/dataset/NAME, and compares with the camera they were
rendered with; "true" distances are those that this camera gives for the surveyed segments' ends.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from detector.evaluation.brnocompspeed import score_recording
from detector.tracking.tracks import Tracks
from labelgen.atomic_files import write_json
from labelgen.calibration.complete_scene import calibrate_with_scale
from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.pipeline import Calibration
from labelgen.calibration.vanishing.orientation import camera_from_angles
from labelgen.calibration.vanishing.track_lines import track_lines
from labelgen.calibration.vanishing.vp1 import estimate_vp1
from labelgen.datasets.brnocompspeed import GroundTruth, read_ground_truth
from labelgen.datasets.manifest import load_manifest
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array
from labelgen.media.open_frames import open_frames

__all__ = ["app", "compare_video", "ratio_error", "vp1_from_cars"]

app = typer.Typer(no_args_is_help=True, add_completion=False)

_UNIT = 1.2 * 1920
"""Normalised unit of the full-size recordings, px."""
_MIN_LENGTH = 0.12
"""Shortest track used, units: the published tracks are long, and short ones cross or turn."""
_SYSTEM = "system_dubska_bmvc14.json"
_BEST = "system_optimal_calibration.json"


def vp1_from_cars(path: Path, pp: Array) -> Array:
    """Return VP1 (2,) px of the tracks of a result file."""
    fps = load_manifest("brnocompspeed")["rates"]["default"]
    cars = [c for c in json.loads(path.read_text())["cars"] if isinstance(c.get("posX"), list) and len(c["posX"]) > 5]
    tracks = [Track(np.array(c["frames"]) / fps, np.stack([c["posX"], c["posY"]], axis=1)) for c in cars]
    lines = track_lines(tracks, pp, _UNIT)
    direction = estimate_vp1(lines[lines.length > _MIN_LENGTH]).direction
    out: Array = pp + _UNIT * direction[:2] / direction[2]
    return out


def ratio_error(camera: Camera, truth: GroundTruth) -> float:
    """Return the mean error of the ratios of all pairs of surveyed distances, percent, by the public protocol."""
    scored = score_recording(truth, Tracks.from_cars([]), replace(camera, scale=camera.scale or 1.0))
    return float(scored.ratio_errors_relative.mean())


def angle_deg(vp_a: Array, vp_b: Array, camera: Camera) -> float:
    """Return the angle at the camera between two vanishing points (2,) px, degrees."""
    a, b = (np.array([*(vp - camera.pp), camera.focal]) for vp in (vp_a, vp_b))
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def tilt_deg(camera: Camera) -> float:
    """Return the tilt of the horizon, degrees, -90 to 90."""
    horizon = camera.vp2 - camera.vp1
    return float(np.degrees(np.arctan(horizon[1] / horizon[0])))


def best_fit(vp1: Array, best: Camera, truth: GroundTruth) -> tuple[float, float]:
    """Return the least ratio error, percent, over focal lengths with a VP1 and the best calibration's tilt; and its
    focal length, px.
    """
    tilt = np.radians(tilt_deg(best))
    direction = np.array([*(vp1 - best.pp) / _UNIT, 1.0])
    errors = []
    for focal in np.geomspace(0.4, 3.0, 80):
        camera = camera_from_angles(direction, tilt, focal, best.pp, _UNIT, (1920, 1080))
        errors.append((ratio_error(camera, truth), focal * _UNIT))
    return min(errors)


def compare_video(calibration: Calibration, true: Camera, truth: GroundTruth) -> dict[str, Any]:
    """Return the errors of a calibration against the camera that a session was rendered with."""
    known = true.road_points(truth.segments_px.reshape(-1, 2)).reshape(-1, 2, 2)
    lengths = np.linalg.norm(known[:, 0] - known[:, 1], axis=-1)
    camera = calibration.camera
    row = {
        "vp1_deg": angle_deg(camera.vp1, true.vp1, true),
        "tilt_deg": tilt_deg(camera) - tilt_deg(true),
        "focal_percent": 100 * (camera.focal / true.focal - 1),
        "ratio_percent": ratio_error(camera, replace(truth, segments_m=lengths)),
        "seconds": calibration.observations.duration_s,
        "confidence": calibration.confidence(),
    }
    if camera.scale is not None:
        # The scale's own error, apart from that of the angles: over all surveyed segments.
        measured = camera.road_points(truth.segments_px.reshape(-1, 2), invalid="nan").reshape(-1, 2, 2)
        share = np.linalg.norm(measured[:, 0] - measured[:, 1], axis=-1) / lengths
        row["scale_percent"] = 100 * (float(np.median(share)) - 1)
    return row


@app.command("tracks")
def tracks_table(root: Annotated[Path, typer.Argument(help="BrnoCompSpeed root with dataset/ and results/.")]) -> None:
    """VP1 from the published systems' tracks."""
    paths = sorted((root / "results").glob(f"*/{_SYSTEM}"))
    if not paths:
        raise DataError(f"{root}: no results/*/{_SYSTEM} there")
    typer.echo("| recording | VP1 | published | angle, deg | ratio error, % | with the published VP1, % |")
    typer.echo("| --- | ---: | ---: | ---: | ---: | ---: |")
    angles = []
    for path in paths:
        name = path.parent.name
        best = Camera.load(path.with_name(_BEST), image_wh=(1920, 1080))
        published = np.array(json.loads(path.read_text())["camera_calibration"]["vp1"])
        vp1 = vp1_from_cars(path, best.pp)
        angles.append(angle_deg(vp1, published, best))
        truth = read_ground_truth(root / "dataset" / name / "gt_data.pkl")
        errors = [best_fit(vp, best, truth) for vp in (vp1, published)]
        places = (f"{vp[0]:.0f}, {vp[1]:.0f}" for vp in (vp1, published))
        shown = " | ".join(f"{error:.2f} (f {focal:.0f})" for error, focal in errors)
        typer.echo(f"| {name} | {' | '.join(places)} | {angles[-1]:.2f} | {shown} |")
    typer.echo(f"\nmedian {np.median(angles):.2f}, within 1 degree: {sum(a <= 1 for a in angles)} of {len(angles)}")


@app.command("videos")
def videos_table(
    sessions: Annotated[list[Path], typer.Argument(help="Rendered session folders, ROOT/dataset/NAME.")],
    duration: Annotated[float | None, typer.Option(min=1, help="Seconds of each video at most.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures as JSON as well.")] = None,
) -> None:
    """Calibrations of rendered sessions."""
    typer.echo("| session | VP1, deg | tilt, deg | focal, % | ratios, % | scale, % | looked at, s | confidence |")
    typer.echo("| --- |" + " ---: |" * 7)
    rows = {}
    for session in sessions:
        name = session.resolve().name
        results = session.resolve().parent.parent / "results" / name
        frames = open_frames(session / "video.avi")
        calibration = calibrate_with_scale(frames, ["auto-models"], need_scale=False, duration_s=duration)
        true = Camera.load(results / _BEST)
        row = compare_video(calibration, true, read_ground_truth(session / "gt_data.pkl"))
        rows[name] = row
        figures = [
            row["vp1_deg"],
            row["tilt_deg"],
            row["focal_percent"],
            row["ratio_percent"],
            row.get("scale_percent"),
        ]
        shown = " | ".join("-" if figure is None else f"{figure:.2f}" for figure in figures)
        typer.echo(f"| {name} | {shown} | {row['seconds']:.0f} | {row['confidence']['overall']:.2f} |")
    ratios = [row["ratio_percent"] for row in rows.values()]
    typer.echo(f"\nratios: median {np.median(ratios):.2f} %, worst {max(ratios):.2f} %")
    if json_file is not None:
        write_json(json_file, rows)


if __name__ == "__main__":
    try:
        app(standalone_mode=False)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
