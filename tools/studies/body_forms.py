"""Write the forms of vehicle bodies that labels are fitted with, from the synthetic renderer's bodies.

    python -m tools.studies.body_forms

Writes labelgen/geometry/body_forms.npz, because building the meshes takes a minute. A test compares some of them.

The renderer's cars are varied more widely here than it draws them: real bumpers recede below, tails are fuller above
and rounder in plan. Sizes and their spreads are those of published dimensions of the models on European, American and
Chinese roads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import typer

from labelgen.atomic_files import write_atomic
from labelgen.geometry import body_forms
from labelgen.geometry.body_forms import FORMS_FILE, MODES, form_directions
from labelgen.geometry.homography import Array
from labelgen.labels import VehicleClass
from labelgen.synth.vehicle.body_mesh import body_mesh
from labelgen.synth.vehicle.body_types import BODY_TYPES, sample_shape
from labelgen.synth.vehicle.motorcycle import motorcycle_mesh

__all__ = ["FAMILIES", "Family", "family_supports", "main", "reduce_to_modes", "unit_bodies"]

_BODIES = 240
"""Bodies of each family whose forms are averaged."""
_LOWER = 0.5
"""Share of the height below which a body's width is taken: wing mirrors stand above."""


@dataclass(frozen=True)
class Variation:
    """How bodies vary beyond the renderer's: ranges of uniform numbers, metres or factors.

    Args:
        nose: rise of the bonnet's front edge.
        tail: rise of the tail's edge.
        round_nose, round_tail: factors of the roundness in plan.
        tumble: factor of the windows' lean.
        roof_back, window_back, window_up: moves of the roof's and the rear window's ends.
        under_front, under_rear: how far the lowest part of a bumper recedes.
        full_front, full_rear: how far the upper part of an end bulges.
    """

    nose: tuple[float, float] = (-0.02, 0.10)
    tail: tuple[float, float] = (0.0, 0.12)
    round_nose: tuple[float, float] = (1.0, 1.6)
    round_tail: tuple[float, float] = (1.2, 2.1)
    tumble: tuple[float, float] = (0.7, 1.05)
    roof_back: tuple[float, float] = (0.0, 0.3)
    window_back: tuple[float, float] = (-0.05, 0.15)
    window_up: tuple[float, float] = (0.0, 0.1)
    under_front: tuple[float, float] = (0.0, 0.12)
    under_rear: tuple[float, float] = (0.05, 0.35)
    full_front: tuple[float, float] = (0.0, 0.05)
    full_rear: tuple[float, float] = (0.0, 0.10)


_AS_DRAWN = Variation(
    (0, 0), (0, 0), (0.8, 1.4), (0.8, 1.6), (0.9, 1.1), (0, 0), (0, 0), (0, 0), (0, 0.15), (0, 0.2), (0, 0), (0, 0)
)


@dataclass(frozen=True)
class Family:
    """Bodies of one kind.

    Args:
        kinds: body types of the renderer.
        vehicle_class: class in labels.
        size_lwh_m: mean length, width, height, metres.
        spread_lwh: standard deviations of their logarithms.
        correlation: of the logarithms: length with width, length with height, width with height.
        mirrors: how far mirrors stand out, metres, its standard deviation, and where they are: shares of the length
            ahead of the middle and of the height.
        error_m: what is left of the forms' errors, metres.
        variation: beyond the renderer's.
    """

    kinds: tuple[str, ...]
    vehicle_class: VehicleClass
    size_lwh_m: tuple[float, float, float]
    spread_lwh: tuple[float, float, float]
    correlation: tuple[float, float, float] = (0.5, 0.3, 0.4)
    mirrors: tuple[float, float, float, float] = (0.14, 0.05, 0.17, 0.62)
    error_m: float = 0.025
    variation: Variation = Variation()

    @property
    def share(self) -> float:
        """The family's share in traffic."""
        return sum(BODY_TYPES[kind].share for kind in self.kinds)

    def covariance(self) -> Array:
        """Return the covariance (3, 3) of the logarithms of length, width and height."""
        matrix = np.eye(3)
        for (i, j), value in zip(((0, 1), (0, 2), (1, 2)), self.correlation, strict=True):
            matrix[i, j] = matrix[j, i] = value
        return np.asarray(matrix * np.outer(self.spread_lwh, self.spread_lwh))


FAMILIES = {
    "car": Family(
        ("supermini", "hatchback", "saloon", "estate", "suv", "minivan"), VehicleClass.CAR,
        (4.42, 1.80, 1.54), (0.10, 0.055, 0.08), (0.8, 0.25, 0.5),
    ),
    "van": Family(("van",), VehicleClass.CAR, (5.4, 1.98, 2.30), (0.14, 0.04, 0.12), error_m=0.035,
                  mirrors=(0.20, 0.08, 0.25, 0.50), variation=_AS_DRAWN),
    "pickup": Family(("pickup",), VehicleClass.CAR, (5.25, 1.88, 1.80), (0.06, 0.05, 0.05), error_m=0.035,
                     variation=_AS_DRAWN),
    "lorry": Family(("lorry",), VehicleClass.TRUCK, (8.0, 2.45, 3.30), (0.25, 0.05, 0.14), error_m=0.05,
                    mirrors=(0.20, 0.10, 0.44, 0.65), variation=_AS_DRAWN),
    "articulated": Family(("articulated",), VehicleClass.TRUCK, (15.5, 2.52, 3.90), (0.12, 0.03, 0.06), error_m=0.06,
                          mirrors=(0.20, 0.10, 0.46, 0.65), variation=_AS_DRAWN),
    "bus": Family(("bus",), VehicleClass.BUS, (11.5, 2.53, 3.10), (0.15, 0.03, 0.07), error_m=0.05,
                  mirrors=(0.20, 0.10, 0.48, 0.70), variation=_AS_DRAWN),
    "motorcycle": Family(("motorcycle",), VehicleClass.MOTORCYCLE, (2.15, 0.80, 1.62), (0.08, 0.12, 0.07),
                         mirrors=(0.0, 0.01, 0.17, 0.6), variation=_AS_DRAWN),
}  # fmt: skip


def unit_bodies(family: Family, count: int = _BODIES) -> list[Array]:
    """Return points (V, 3) of bodies of a family, each in shares of its own length, width and height.

    Args:
        family: the family.
        count: how many, spread evenly over its body types.
    """
    each = -(-count // len(family.kinds))
    return [_unit_body(kind, family.variation, k) for kind in family.kinds for k in range(each)]


def _unit_body(kind: str, by: Variation, seed: int) -> Array:
    rng = np.random.default_rng([seed, len(kind), 7])
    shape = sample_shape(kind, rng)
    if kind == "motorcycle":
        # Its handlebar is its width.
        return _unit(np.asarray(motorcycle_mesh(shape).vertices, dtype=np.float64), lower=1.0)
    draw = {name: rng.uniform(*bounds) for name, bounds in vars(by).items()}
    roof_rear, window = shape.roof_rear, shape.rear_window
    last = shape.length if shape.cargo is None else window[0] + 0.13
    shape = replace(
        shape,
        nose=shape.nose + draw["nose"],
        tail=min(shape.tail + draw["tail"], 0.8 * shape.height),
        round_nose=shape.round_nose * draw["round_nose"],
        round_tail=shape.round_tail * draw["round_tail"],
        tumble=shape.tumble * draw["tumble"],
        roof_rear=(min(roof_rear[0] + draw["roof_back"], max(roof_rear[0], last - 0.35)), roof_rear[1]),
        rear_window=(min(window[0] + draw["window_back"], last - 0.13), window[1] + draw["window_up"]),
    )
    points = np.asarray(body_mesh(shape).vertices, dtype=np.float64)
    points[:, 0] -= (points[:, 0].min() + points[:, 0].max()) / 2
    half, height = points[:, 0].max(), points[:, 2].max()
    top = rng.uniform(0.25, 0.40) * height
    for end, name in ((1, "front"), (-1, "rear")):
        ahead = points[:, 0] * end
        near = np.clip((ahead - (half - 0.9)) / 0.9, 0, 1)
        points[:, 0] -= end * near * draw[f"under_{name}"] * np.clip(1 - points[:, 2] / top, 0, 1)
        near = np.clip((ahead - (half - 0.6)) / 0.6, 0, 1)
        upper = np.clip((points[:, 2] / height - 0.3) / 0.25, 0, 1)
        points[:, 0] += end * draw[f"full_{name}"] * 4 * near * (1 - near) * upper
    return _unit(points)


def _unit(points: Array, lower: float = _LOWER) -> Array:
    """Scale points (V, 3) m to x and y in [-1/2, 1/2], z in [0, 1]; what is wider than the lower body is cut off."""
    points = points - [(points[:, 0].min() + points[:, 0].max()) / 2, 0.0, points[:, 2].min()]
    height = points[:, 2].max()
    width = 2 * np.abs(points[points[:, 2] <= lower * height, 1]).max()
    unit = points / [np.ptp(points[:, 0]), width, height]
    unit[:, 1] = unit[:, 1].clip(-0.5, 0.5)
    return np.asarray(unit)


def family_supports(bodies: Sequence[Array]) -> Array:
    """Return how far each of N bodies reaches in the D directions of `form_directions`, (N, D)."""
    directions = form_directions()
    return np.array([(np.concatenate([b, b * [1, -1, 1]]) @ directions.T).max(axis=0) for b in bodies])


def reduce_to_modes(supports: Array) -> Array:
    """Return the mean and the main components of N forms (N, D), the latter for one standard deviation: (1 + K, D)."""
    mean = supports.mean(axis=0)
    _, values, components = np.linalg.svd(supports - mean, full_matrices=False)
    modes = components[:MODES] * (values[:MODES, None] / np.sqrt(len(supports)))
    # The sign of a component is arbitrary: the larger end is the positive one.
    signs = np.sign(modes[np.arange(len(modes)), np.abs(modes).argmax(axis=1)])
    return np.concatenate([mean[None], modes * signs[:, None]])


def main() -> None:
    """Write the file."""
    import io

    arrays: dict[str, Array] = {}
    for name, family in FAMILIES.items():
        arrays[f"{name}/support"] = reduce_to_modes(family_supports(unit_bodies(family))).astype(np.float16)
        arrays[f"{name}/log_size"] = np.concatenate([np.log(family.size_lwh_m)[None], family.covariance()])
        arrays[f"{name}/mirrors"] = np.array(family.mirrors)
        arrays[f"{name}/other"] = np.array([float(family.vehicle_class), family.share, family.error_m])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    path = Path(body_forms.__file__).with_name(FORMS_FILE)
    write_atomic(path, buffer.getvalue())
    typer.echo(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    typer.run(main)
