"""Synthetic videos for lookalike sheets: made-up roads seen as a real camera sees its own, in like light.

    python -m tools.lookalike_video motorway --out motorway.avi --seed 3

The places are described by a handful of numbers: frame size, where the camera stands, which way traffic drives, where
the sun is, how worn the road and how good the camera. Everything else is made up as for any other road.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.errors import DataError, LabelgenError
from labelgen.synth.sensor import PLAIN, Sensor

__all__ = ["PLACES", "Place", "main", "render_place"]


@dataclass(frozen=True)
class Place:
    """Where a camera stands and what it sees.

    Args:
        size_wh: frame size.
        height_m: above the road.
        target_xy: metres, the point of the road in the picture's middle.
        focal: px.
        middle_m: how far left of the camera the middle of the carriageway lies.
        heading: +1 traffic drives away, -1 it comes closer.
        weather: kind of light.
        sun: direction to it, where it shines; unit length is not needed.
        light: fields of `Light` that differ from the usual.
        cast: (R, G, B) factors on all light.
        sky: factor on the light of the sky; shadows are deeper with less.
        tone: factor on the usual albedo of the road, most of which is free of the cast.
        sensor: the camera's faults.
    """

    size_wh: tuple[int, int]
    height_m: float
    target_xy: tuple[float, float]
    focal: float
    middle_m: float
    heading: int
    weather: str
    sun: tuple[float, float, float]
    light: dict[str, float]
    tone: float = 1.0
    cast: tuple[float, float, float] = (1.0, 1.0, 1.0)
    sky: float = 1.0
    sensor: Sensor = PLAIN


PLACES: dict[str, Place] = {
    "city": Place(
        (640, 360), 7.0, (22.0, 0.3), 620.0, -0.5, 1, "overcast", (0.2, 0.3, 0.9),
        {"contrast": 1.15, "saturation": 1.25, "noise": 1.0}, 0.85, (1.01, 1.0, 1.0), 1.0,
        Sensor(sharpen=0.9, crf=25),
    ),
    "motorway": Place(
        (848, 478), 7.4, (26.7, 0.4), 900.0, 0.5, -1, "day", (0.6, -0.35, 0.75),
        {"contrast": 1.1, "saturation": 1.3, "exposure": 1.75, "noise": 1.8, "lift": 0.06}, 0.9, (1.02, 1.0, 0.97), 0.7,
        Sensor(sharpen=1.1, crf=21, arms=0.012),
    ),
    "freeway": Place(
        (320, 240), 12.5, (31.0, 4.7), 480.0, 5.0, 1, "day", (0.2, 0.55, 0.8),
        {"contrast": 1.15, "saturation": 1.4, "noise": 5.5, "exposure": 0.72, "lift": 0.03},
        2.0, (0.88, 1.03, 1.07), 0.55, Sensor(smear=0.007, sharpen=2.0, peaking=1.2, crf=20),
    ),
}  # fmt: skip


def render_place(place: Place, out: Path, seed: int, duration_s: float, per_minute: float) -> int:
    """Write a video of a made-up road as a place's camera sees it; returns the number of frames."""
    import numpy as np

    from labelgen.synth.light import Weather, make_light
    from labelgen.synth.render import Renderer
    from labelgen.synth.road import draw_scene
    from labelgen.synth.scenes import look_at_road, procedural_scene
    from labelgen.synth.session import place as placed_at
    from labelgen.synth.traffic import random_traffic
    from labelgen.synth.video import VideoWriter

    rng = np.random.default_rng([seed, 1])
    camera = look_at_road(place.height_m, place.target_xy, place.focal, place.size_wh)
    scene = procedural_scene(rng, place.size_wh, heading=place.heading, seen_from=(camera, place.middle_m))
    light = make_light(Weather.parse(place.weather), rng)
    sun = np.array(place.sun) + rng.normal(0, 0.06, 3)
    given: dict[str, Any] = {
        **place.light,
        "road": place.tone * light.road / np.array(place.cast) ** 0.55,
        "sun_direction": sun / np.linalg.norm(sun),
    }
    given |= {part: getattr(light, part) * place.cast for part in ("sun", "horizon")}
    given |= {part: getattr(light, part) * place.cast * place.sky for part in ("sky_low", "sky_high")}
    light = replace(light, **given)
    background, still = draw_scene(scene, light, rng)
    # The other carriageway stays empty: sheets are to show what the camera is aimed at.
    trips = [t for t in random_traffic(scene, duration_s, seed, per_minute=per_minute) if t.lane.index is not None]
    renderer = Renderer(camera, background, light, seed=seed, still=still, sensor=place.sensor)
    spans = {t.track_id: t.span_s(scene.x_range) for t in trips}
    bodies: dict[int, Any] = {}
    count = round(25 * duration_s)
    with VideoWriter(out, 25, place.size_wh, place.sensor.crf) as writer:
        for number in range(count):
            time_s = number / 25
            here = [t for t in trips if spans[t.track_id][0] <= time_s <= spans[t.track_id][1]]
            renderer.forget(bodies.keys() - {t.track_id for t in here})
            bodies = {t.track_id: bodies.get(t.track_id) or t.vehicle(lamps=light.lamps) for t in here}
            image, _ = renderer.frame([placed_at(t, bodies[t.track_id], time_s) for t in here], number=number)
            writer.write(image)
    return count


def main(
    name: Annotated[str, typer.Argument(help="city, motorway or freeway.")],
    out: Annotated[Path, typer.Option("--out", help="The video, an AVI file.")],
    seed: Annotated[int, typer.Option(help="Road, traffic and noise.")] = 0,
    duration: Annotated[float, typer.Option(min=2.0, help="Length in seconds.")] = 24.0,
    per_minute: Annotated[float, typer.Option("--traffic", min=1.0, help="Vehicles per lane and minute.")] = 14.0,
) -> None:
    """Render a made-up road for a lookalike sheet."""
    if name not in PLACES:
        raise DataError(f"{name}: no such place; use one of {', '.join(PLACES)}")
    frames = render_place(PLACES[name], out, seed, duration, per_minute)
    typer.echo(f"{out}: {frames} frames")


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
