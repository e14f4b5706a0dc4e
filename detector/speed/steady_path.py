"""The steady path of a vehicle through its measured places: a smoothing spline in time, robust against single places.

The acceleration of a vehicle changes little within half a second, while single places err by decimetres. The spline
minimises

    sum (place_i - path_i)^2 / sd_i^2 + mean (acceleration / usual)^2 + integral jerk^2 / change

where jerk is the derivative of the acceleration, `change` the variance that the acceleration gains per second and
`usual` its standard deviation in traffic. The second term counts once for a track, however long: it decides where a
short track does not tell whether the vehicle brakes or its places err in the distance. Places of neighbouring frames
err alike, so that many of them tell less than as many independent ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labelgen.geometry.homography import Array

__all__ = ["SmoothingRules", "smooth_path"]


_FEWEST = 4


@dataclass(frozen=True)
class SmoothingRules:
    """How places are smoothed.

    Args:
        change_m2_s5: (along, across) m^2/s^5, see above. More follows single places, less smears changes of speed.
        usual_ms2: m/s^2, see above.
        shared_error_power: the variance of the places grows with this power of their number, see above.
        robust: distance from the path, in standard deviations, at which a place has half its weight.
        rounds: of the robust weights.
    """

    change_m2_s5: tuple[float, float] = (0.3, 0.3)
    usual_ms2: float = 0.6
    shared_error_power: float = 0.7
    robust: float = 2.0
    rounds: int = 4


def smooth_path(places_m: Array, times_s: Array, sd_m: Array, rules: SmoothingRules | None = None) -> Array:
    """Return the smoothed places of one vehicle.

    Args:
        places_m: (K, 2) metres, along and across the road.
        times_s: (K,) seconds, rising.
        sd_m: (K, 2) standard deviations of the places' errors, metres.
        rules: thresholds.

    Returns:
        (K, 2) metres; the places themselves where there are fewer than four.
    """
    rules = rules or SmoothingRules()
    if len(places_m) < _FEWEST:
        return places_m
    # Velocities, accelerations and their changes, each in the middle between two of those before.
    changes, at = np.eye(len(places_m)), times_s
    stiff = []
    for _ in range(3):
        steps, at = np.diff(at), (at[1:] + at[:-1]) / 2
        changes = np.diff(changes, axis=0) / steps[:, None]
        stiff.append(changes.T @ (changes * steps[:, None]))
    usual = stiff[1] / (rules.usual_ms2**2 * (times_s[-1] - times_s[0]))
    precision = len(places_m) ** -rules.shared_error_power / sd_m**2
    weight = np.ones(len(places_m))
    path = places_m
    for _ in range(rules.rounds):
        weighted = precision * weight[:, None]
        axes = []
        for w, change, place in zip(weighted.T, rules.change_m2_s5, places_m.T, strict=True):
            axes.append(np.linalg.solve(np.diag(w) + usual + stiff[2] / change, w * place))
        path = np.stack(axes, axis=1)
        weight = 1 / (1 + ((places_m - path) ** 2 * precision).sum(axis=1) / rules.robust**2)
    return path
