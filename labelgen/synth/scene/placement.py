"""Place props beside a made-up road.

A scene is a motorway, a country road or a street in a town; its props are chosen accordingly. No prop is a vehicle,
and none stands on a lane.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from labelgen.synth.scene.props import ALONG, AT, gantry
from labelgen.synth.scene.scene import RoadScene, carriageways
from labelgen.synth.scene.triangles import Triangles

__all__ = ["Prop", "place_props"]

# Per setting: the probability of each barrier at the road's edge and of each row behind it, none with what is missing
# to 1; and the relative frequency of single props.
_SETTINGS: dict[str, dict[str, dict[str, float]]] = {
    "motorway": {
        "edge": {"guard rail": 0.7, "concrete barrier": 0.2},
        "row": {"hedge": 0.3, "wall": 0.2, "mesh fence": 0.2, "post fence": 0.1},
        "single": {"sign post": 2, "lamp post": 1, "bush": 6, "tree": 6, "bollards": 1, "cabinet": 0.5},
    },
    "country": {
        "edge": {"guard rail": 0.25, "post fence": 0.15},
        "row": {"hedge": 0.35, "post fence": 0.25, "mesh fence": 0.1, "wall": 0.05},
        "single": {"tree": 8, "bush": 7, "sign post": 1.5, "utility pole": 2, "bollards": 1.5, "building": 0.8},
    },
    "town": {
        "edge": {"kerb": 0.9},
        "row": {"railing": 0.35, "hedge": 0.2, "wall": 0.15, "mesh fence": 0.12, "post fence": 0.08},
        "single": {
            "lamp post": 3, "sign post": 3, "tree": 4, "bush": 2, "bus stop": 1.2, "pedestrian": 4, "cabinet": 3,
            "bollards": 1.5, "building": 3.5, "utility pole": 0.7,
        },
    },
}  # fmt: skip
_FAR_M = 130.0
"""X up to which rows run, metres."""
_FREE_M = 4.8
"""Height above the lanes that stays free, metres."""
_TALL = ("tree", "building", "bus stop", "utility pole", "wall")


@dataclass(frozen=True, eq=False)
class Prop:
    """One prop.

    Args:
        kind: a key of `ALONG` or `AT` of `labelgen.synth.scene.props`, or "gantry".
        triangles: its triangles, road frame.
    """

    kind: str
    triangles: Triangles


def _one_of(shares: dict[str, float], rng: np.random.Generator) -> str | None:
    """Return a name, each with its probability; None with what is missing to 1."""
    names, values = list(shares), np.array(list(shares.values()))
    at = int(np.searchsorted(np.cumsum(values), rng.random()))
    return names[at] if at < len(names) else None


def place_props(scene: RoadScene, shoulder_m: float, rng: np.random.Generator) -> list[Prop]:
    """Place props beside, between and over the carriageways.

    Args:
        scene: from `procedural_scene`.
        shoulder_m: paved width beside the lanes.
        rng: decides everything.
    """
    ways = sorted(carriageways(scene))
    setting = _SETTINGS[str(rng.choice(list(_SETTINGS), p=[0.35, 0.25, 0.4]))]
    density = rng.uniform(0.4, 2.2)
    out = []
    for side in (-1, 1):
        edge = ways[0][0] if side < 0 else ways[-1][1]
        out += list(_verge(edge, side, shoulder_m, setting, density, rng))
    if len(ways) == 2 and ways[1][0] - ways[0][1] > 0.7:
        out += list(_median(ways[0][1], ways[1][0], rng))
    if rng.random() < 0.22:
        x = rng.uniform(22, 90)
        low, high = ways[0][0] - shoulder_m - 1.2, ways[-1][1] + shoulder_m + 1.2
        out.append(Prop("gantry", gantry(x, low, high, rng)))
    return out


def _stretch(rng: np.random.Generator) -> tuple[float, float]:
    """Return from where to where a row runs along the road, metres: mostly all of it."""
    start = 3.0 if rng.random() < 0.7 else rng.uniform(8, 40)
    return start, min(start + rng.uniform(25, 200), _FAR_M)


def _verge(
    edge: float, side: int, shoulder_m: float, setting: dict[str, dict[str, float]], density: float,
    rng: np.random.Generator,
) -> Iterator[Prop]:  # fmt: skip
    """Place props on one side of the road, from the edge outwards."""
    at = shoulder_m + rng.uniform(0.3, 0.9)
    barrier = _one_of(setting["edge"], rng)
    if barrier is not None:
        yield Prop(barrier, ALONG[barrier](*_stretch(rng), edge + side * at, side, rng))
    at += rng.uniform(0.5, 1.2) if barrier != "kerb" else 0.0
    depth = at + (rng.uniform(1.0, 6.0) if barrier != "kerb" else rng.uniform(0.3, 3.5))
    row = _one_of(setting["row"], rng)
    if row is not None:
        yield Prop(row, ALONG[row](*_stretch(rng), edge + side * depth, side, rng))
    names = list(setting["single"])
    shares = np.array([setting["single"][n] for n in names])
    for kind in rng.choice(names, int(rng.integers(4, 22) * density), p=shares / shares.sum()).tolist():
        x = float(rng.uniform(6, 110))
        y = {
            "tree": depth + rng.uniform(1.5, 22), "bush": at + rng.exponential(4.0) + 0.8,
            "building": depth + rng.uniform(5, 22), "utility pole": at + rng.uniform(0.5, 5),
        }.get(kind, at + rng.uniform(0.4, 2.2))  # fmt: skip
        near = 16.0 if kind in _TALL else 9.0
        if np.hypot(x, edge + side * y) > near:
            yield Prop(kind, _clear_of_road(AT[kind](x, edge + side * y, side, rng), edge, side))


def _clear_of_road(triangles: Triangles, edge: float, side: int) -> Triangles:
    """Move triangles away from the road as far as needed to keep the space above the lanes free."""
    low = triangles.corners[triangles.corners[..., 2] < _FREE_M]
    if not len(low):
        return triangles
    inside = edge + side * 0.3 - (low[:, 1].min() if side > 0 else low[:, 1].max())
    return triangles.moved((0.0, side * max(0.0, side * inside), 0.0))


def _median(low: float, high: float, rng: np.random.Generator) -> Iterator[Prop]:
    """Place props between two carriageways."""
    middle, wide = (low + high) / 2, high - low
    kinds = {"guard rail": 0.35, "concrete barrier": 0.2, "railing": 0.2}
    if wide > 2.2:
        kinds |= {"hedge": 0.25}
    kind = _one_of(kinds, rng)
    if kind == "hedge":
        triangles = ALONG[kind](*_stretch(rng), low + 0.3, 1, rng)
        out = triangles.corners[..., 1].max()
        if out < high - 0.2:
            yield Prop(kind, triangles)
    elif kind is not None:
        yield Prop(kind, ALONG[kind](*_stretch(rng), middle, 1, rng))
    if wide > 1.5 and rng.random() < 0.4:
        for x in np.arange(rng.uniform(8, 25), 110, rng.uniform(18, 35)).tolist():
            yield Prop("lamp post", AT["lamp post"](x, middle, 1, rng))
