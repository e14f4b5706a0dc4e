"""Measure how fast frames are rendered, and what takes the time.

    python -m tools.benchmarks.render --vehicles 8 --size 1920x1080

One core: every library is told to use one thread, and times are those the processor spent on this process.
Compiling is not counted; it is cached after the first run.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.errors import DataError, LabelgenError
from labelgen.synth.sensor.sensor import PLAIN, Sensor

__all__ = ["main", "measure"]


_FAULTY = Sensor(lines=0.8, smear=0.004, sharpen=0.8, peaking=0.8)


class _Stages:
    """Processor time per stage, without the time of nested stages."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}
        self._nested: list[float] = []

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            self._nested.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                took = time.process_time() - start
                self.spent[name] = self.spent.get(name, 0.0) + took - self._nested.pop()
                if self._nested:
                    self._nested[-1] += took

        return run


def measure(
    vehicles: int, size_wh: tuple[int, int], frames: int, seed: int, folder: Path, *, faults: bool = False
) -> dict[str, Any]:
    """Render `frames` frames that show `vehicles` vehicles each; with `faults` the camera has every fault.

    Returns:
        fps, ms per frame, ms per frame by stage, and ms once per vehicle for its texture and shadow.
    """
    import numpy as np

    from labelgen.media.video_writer import VideoWriter
    from labelgen.synth.renderer import renderer as render
    from labelgen.synth.scene.road_image import draw_scene
    from labelgen.synth.scene.scene import procedural_scene
    from labelgen.synth.scene.traffic import random_traffic
    from labelgen.synth.shading.lighting import Weather, make_light
    from labelgen.synth.vehicle.vehicle import make_vehicle

    rng = np.random.default_rng([seed, 1])
    scene = procedural_scene(rng, size_wh)
    light = make_light(Weather.DAY, rng)
    background, static_layer = draw_scene(scene, light, rng)
    trips = random_traffic(scene, 600.0, seed, per_minute=60)
    renderer = render.Renderer(
        scene.camera,
        background,
        light,
        seed=seed,
        static_layer=static_layer,
        sensor=_FAULTY if faults else PLAIN,
    )
    batches = _busy_moments(renderer, trips, scene, vehicles, frames)
    count = len(batches)
    if not count:
        raise DataError(f"vehicles {vehicles}: this scene never shows so many; use fewer or another seed")
    start = time.process_time()
    bodies = {p.track_id: p for placed in batches for p in placed}
    for p in bodies.values():
        make_vehicle(p.vehicle.kind, np.random.default_rng(p.track_id))
        renderer.prepare(p)
    prepare = 1000 * (time.process_time() - start) / len(bodies)
    for placed in batches[:3]:
        renderer.frame(placed)
    stages = _time_stages(render, renderer)
    start = time.process_time()
    pixels = 0
    with VideoWriter(folder / "benchmark.avi", 25, size_wh) as writer:
        encode = stages.timed("encode", writer.write)
        for number, placed in enumerate(batches):
            image, drawn = renderer.frame(placed, number=number)
            encode(image)
            pixels += sum(int(d.mask.sum()) for d in drawn)
        total = time.process_time() - start
    return {
        "frames": count,
        "vehicles": vehicles,
        "vehicle_pixels_per_frame": pixels // count,
        "fps": count / total,
        "ms_per_frame": 1000 * total / count,
        "ms_per_vehicle": prepare,
        "stages_ms": {k: 1000 * v / count for k, v in sorted(stages.spent.items(), key=lambda kv: -kv[1])},
    }


def _time_stages(module: Any, renderer: Any) -> _Stages:
    """Replace the stages of a renderer, and the functions of its module that it calls, by timed ones."""
    stages = _Stages()
    for owner, names in (
        (module, ("visible_triangles", "shade", "visible_parts", "painting_order")),
        (renderer, ("_cast_shadow", "_draw", "_paint", "_soften", "_add_noise", "frame")),
    ):
        for name in names:
            setattr(owner, name, stages.timed(name.strip("_"), getattr(owner, name)))
    return stages


def _busy_moments(renderer: Any, trips: Any, scene: Any, vehicles: int, frames: int) -> list[Any]:
    """Choose moments at which at least so many vehicles show; returns the largest of them, placed, per moment."""
    from labelgen.synth.truth.session import place

    spans = {t.track_id: t.span_s(scene.x_range) for t in trips}
    bodies: dict[int, Any] = {}
    batches: list[Any] = []
    time_s = 5.0
    while len(batches) < frames and time_s < 600:
        # Runs of consecutive frames, as in a video, at busy moments.
        time_s += 0.04 if batches and len(batches) % 20 else 2.0
        here = [t for t in trips if spans[t.track_id][0] <= time_s <= spans[t.track_id][1]]
        for trip in here:
            if trip.track_id not in bodies:
                bodies[trip.track_id] = trip.vehicle(lamps=False)
        placed = [place(t, bodies[t.track_id], time_s) for t in here]
        areas_px = {d.track_id: int(d.mask.sum()) for d in renderer.truth(placed)}
        if len(areas_px) >= vehicles:
            largest = sorted(areas_px, key=lambda k: -areas_px[k])[:vehicles]
            batches.append([p for p in placed if p.track_id in largest])
    return batches


def main(
    vehicles: Annotated[int, typer.Option(help="Vehicles per frame.")] = 8,
    size: Annotated[str, typer.Option(help="Frame size.")] = "1920x1080",
    frames: Annotated[int, typer.Option(help="Frames to render.")] = 60,
    seed: Annotated[int, typer.Option(help="Scene and traffic.")] = 0,
    faults: Annotated[bool, typer.Option("--faults", help="Few lines, smeared colours, halos.")] = False,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here, too.")] = None,
) -> None:
    """Measure rendering on one core."""
    import tempfile

    import cv2

    from labelgen.geometry import parse_size

    cv2.setNumThreads(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    with tempfile.TemporaryDirectory() as folder:
        report = measure(vehicles, parse_size(size), frames, seed, Path(folder), faults=faults)
    typer.echo(
        f"{report['fps']:.1f} frames/s ({report['ms_per_frame']:.1f} ms per frame), "
        f"{size}, {report['vehicles']} vehicles"
    )
    typer.echo(f"{report['vehicle_pixels_per_frame']} vehicle pixels per frame, {report['frames']} frames, one core")
    typer.echo(f"{report['ms_per_vehicle']:.0f} ms once per vehicle for its texture and shadow, not counted above")
    for name, ms in report["stages_ms"].items():
        typer.echo(f"{name:>20} {ms:7.2f} ms")
    if json_file is not None:
        json_file.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
