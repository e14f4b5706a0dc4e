"""Links: which sighting is the next one of the vehicle of another.

Convention:
    A link (i, j) says that sighting j is the next one of the vehicle of sighting i. Scores are logarithms of likelihood
    ratios.

Links are scored by size, drift across the road and class; pairs of successive links by how constant the velocity is;
each link by the speeds of the other vehicles of its lane. A link is taken where the best row of links through it is
better than the best one through each other link of its two sightings by a margin. What stays ambiguous is not linked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labelgen.geometry.homography import Array, IntArray
from labelgen.labeling.fitted.sightings import BoolArray, PassageSettings, Sightings

__all__ = ["link_sightings"]

_NONE = -1
_SPEED_RANGE = 120.0
"""Range of the speeds of false links, m/s: from -60 to 60."""


@dataclass(frozen=True)
class _Links:
    """Candidate links, and the pairs (first, second) of them in which the second begins where the first ends."""

    source: IntArray
    target: IntArray
    looks: IntArray
    score: Array
    first: IntArray
    second: IntArray
    prediction: Array


def link_sightings(sightings: Sightings, settings: PassageSettings) -> IntArray:
    """Return the links (2, L) of sightings, source and target, of which nothing outside of them is known."""
    links = _candidates(sightings, settings)
    links = replace(links, score=links.score + _lane_support(links, sightings, settings))
    n = len(sightings)
    after, before = np.full(n, _NONE), np.full(n, _NONE)  # link that leaves, and that reaches, each sighting
    live = np.ones(len(links.source), dtype=np.bool_)
    for margin in settings.margins:
        total, gain, lead = _totals(links, live, n, settings.rounds)
        taken = live & (gain >= settings.min_score) & (lead >= margin) & (after[links.source] == _NONE)
        new = np.flatnonzero(taken)
        after[links.source[new]], before[links.target[new]] = new, new
        follows, leads = _fitting(links, after, before)
        first = before[links.source[new]]
        clash = (first != _NONE) & ~follows[new]
        weaker = np.where(total[new] <= total[first], new, first)[clash]
        after[links.source[weaker]], before[links.target[weaker]] = _NONE, _NONE
        follows, leads = _fitting(links, after, before)
        own = np.arange(len(live))
        live &= (after[links.source] == _NONE) | (after[links.source] == own)
        live &= (before[links.target] == _NONE) | (before[links.target] == own)
        live &= (before[links.source] == _NONE) | follows
        live &= (after[links.target] == _NONE) | leads
    taken = np.sort(after[after != _NONE])
    chains = np.stack([links.source[taken], links.target[taken]])
    return np.concatenate([chains, _bridges(sightings, chains, settings)], axis=1)


def _ranges(starts: IntArray, ends: IntArray) -> tuple[IntArray, IntArray]:
    """Return all pairs (row, number) with a number in the range [start, end) of the row."""
    counts = np.maximum(ends - starts, 0)
    rows = np.repeat(np.arange(len(starts)), counts)
    steps = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, starts[rows] + steps


def _noise_m(sightings: Sightings, settings: PassageSettings) -> Array:
    """Return the standard deviations (N, 2) of the points along and across the road, metres."""
    per_px = np.asarray(sightings.m_per_px)
    noise = np.hypot(settings.noise_m, settings.noise_px * per_px)
    return np.where(sightings.cut[:, None], np.hypot(noise, settings.cut_noise_m), noise)


def _singles(sightings: Sightings, looks: IntArray, settings: PassageSettings) -> BoolArray:
    """Return which sightings (N,) can be placed and are no second mask of a vehicle."""
    sizes = np.stack([sightings.widths_m, sightings.heights_m])
    area = sizes.prod(axis=0)
    i, j = _ranges(np.arange(len(looks)) + 1, np.searchsorted(looks, looks, side="right"))
    near = (np.abs(sightings.points_m[i] - sightings.points_m[j]) < settings.double_m).all(axis=1)
    worse = np.where(area[j] <= area[i], j, i)[near]
    usable = np.isfinite(sightings.points_m).all(axis=1) & (sizes > 0).all(axis=0) & np.isfinite(area)
    usable[worse] = False
    return np.asarray(usable)


def _pair_scores(sightings: Sightings, i: IntArray, j: IntArray, settings: PassageSettings) -> Array:
    """Return the scores (P,) of pairs of sightings by size, class and drift across the road."""
    dx, dy = (sightings.points_m[j] - sightings.points_m[i]).T
    dt = sightings.times_s[j] - sightings.times_s[i]
    along, across = np.hypot(*(_noise_m(sightings, settings)[k] for k in (i, j))).T
    spread = across**2 + (settings.drift_ms * dt) ** 2 + (settings.heading * dx) ** 2
    whole = ~(sightings.cut[i] | sightings.cut[j])
    cost = dy**2 / spread / 2
    pixel = settings.noise_px * np.asarray(sightings.m_per_px)[:, 1]
    for size in (sightings.widths_m, sightings.heights_m):
        # A pixel at each end, in both masks.
        variance = settings.size_ratio**2 + 2 * ((pixel[i] / size[i]) ** 2 + (pixel[j] / size[j]) ** 2)
        cost += whole * np.minimum(np.log(size[j] / size[i]) ** 2 / variance / 2, settings.link_gain)
    known = (sightings.class_ids[i] != 0) & (sightings.class_ids[j] != 0)
    cost += settings.class_cost * (known & (sightings.class_ids[i] != sightings.class_ids[j]))
    speed = np.maximum(np.abs(dx) - 2 * along, 0) / dt
    excess = np.maximum(speed - settings.usual_speed_ms, 0)
    cost += (excess / (settings.max_speed_ms - settings.usual_speed_ms) * 2) ** 2
    return np.asarray(settings.link_gain - cost)


def _candidates(sightings: Sightings, settings: PassageSettings) -> _Links:
    """Return the links that speed, size and place allow."""
    looks = sightings.frames // sightings.every_frame
    usable = _singles(sightings, looks, settings)
    next_looks = np.searchsorted(looks, looks, side="right")
    i, j = _ranges(next_looks, np.searchsorted(looks, looks + settings.max_missed + 1, side="right"))
    dt = sightings.times_s[j] - sightings.times_s[i]
    noise = _noise_m(sightings, settings)
    reach = settings.max_speed_ms * dt + 3 * np.hypot(noise[i, 0], noise[j, 0])
    near = np.abs(sightings.points_m[j, 0] - sightings.points_m[i, 0]) < reach
    # Of a vehicle that the border cuts and that is not there in the next frame, nothing more is to come.
    stays = (j < np.searchsorted(looks, looks[i] + 2)) | ~(sightings.cut[i] | sightings.cut[j])
    keep = np.flatnonzero(usable[i] & usable[j] & near & stays & (dt > 0) & (dt <= settings.max_gap_s))
    i, j = i[keep], j[keep]
    score = _pair_scores(sightings, i, j, settings) - settings.missed_cost * (looks[j] - looks[i] - 1)
    keep = np.flatnonzero(score > 0)
    i, j, score = i[keep], j[keep], score[keep]
    return _predicted(sightings, i, j, score, looks[j] - looks[i], settings)


def _predicted(
    sightings: Sightings, i: IntArray, j: IntArray, score: Array, looks: IntArray, settings: PassageSettings
) -> _Links:
    """Return the links (i, j), sorted, with the pairs of them that a nearly constant velocity allows."""
    first, second = _ranges(np.searchsorted(i, j), np.searchsorted(i, j, side="right"))
    a, b, c = i[first], j[first], j[second]
    t1, t2 = sightings.times_s[b] - sightings.times_s[a], sightings.times_s[c] - sightings.times_s[b]
    ratio = (t2 / t1)[:, None]
    points, noise = sightings.points_m, _noise_m(sightings, settings)
    error = points[c] - points[b] - ratio * (points[b] - points[a])

    # A link that passes over a mask on its way is none: that mask shows the vehicle, or hides it.
    on_way = (np.abs(error) / (1 + ratio) < settings.double_m).all(axis=1)
    n = len(sightings)
    keep = ~np.isin(i * n + j, (a * n + c)[on_way])
    number = np.cumsum(keep) - 1

    spread = noise[c] ** 2 + ((1 + ratio) * noise[b]) ** 2 + (ratio * noise[a]) ** 2
    spread[:, 0] += (settings.acceleration_ms2 * t2 * (t1 + t2) / 2) ** 2
    spread[:, 1] += (settings.drift_ms * t2) ** 2
    misfit = error**2 / spread @ [0.5, 0.25]
    # Errors across the road count half: bends and errors of VP1 make them alike in successive links.
    prediction = np.log(settings.false_length_m / np.sqrt(2 * np.pi * spread[:, 0])) - misfit
    pairs = np.flatnonzero((misfit < settings.max_misfit) & keep[first] & keep[second])
    return _Links(
        i[keep], j[keep], looks[keep], score[keep], number[first[pairs]], number[second[pairs]], prediction[pairs]
    )


def _fitting(links: _Links, after: IntArray, before: IntArray) -> tuple[BoolArray, BoolArray]:
    """Return which links continue the link that reaches their source, and lead to the one that leaves their target."""
    follows, leads = np.zeros((2, len(links.source)), dtype=np.bool_)
    follows[links.second[before[links.source[links.second]] == links.first]] = True
    leads[links.first[after[links.target[links.first]] == links.second]] = True
    return follows, leads


def _totals(links: _Links, live: BoolArray, n: int, rounds: int) -> tuple[Array, Array, Array]:
    """Compare rows of links.

    Returns:
        Of each link (L,) the score of the best row through it; what that is more than two rows that end at its source
        and begin at its target; and what it is more than the best row through another link of its sightings.
    """
    score = np.where(live, links.score, -np.inf)
    pairs = np.flatnonzero(live[links.first] & live[links.second])
    first, second, prediction = links.first[pairs], links.second[pairs], links.prediction[pairs]
    # Rows of links that skip frames must not reach further than the others, or they would gain as much.
    ahead, behind = np.zeros((2, rounds + 1, len(score)))
    begins, ends = np.zeros((2, rounds + 1, n))
    left = np.maximum(np.arange(rounds + 1)[:, None] - links.looks, 0)
    for horizon in range(1, rounds + 1):
        best = np.zeros((2, len(score)))
        depth = left[horizon, first]
        np.maximum.at(best[0], first, np.where(depth > 0, ahead[depth, second] + prediction, 0))
        depth = left[horizon, second]
        np.maximum.at(best[1], second, np.where(depth > 0, behind[depth, first] + prediction, 0))
        ahead[horizon], behind[horizon] = score + best
        np.maximum.at(begins[horizon], links.source, ahead[horizon])
        np.maximum.at(ends[horizon], links.target, behind[horizon])
    total = np.where(live, ahead[rounds] + behind[rounds] - links.score, -np.inf)
    apart = ends[left[rounds], links.source] + begins[left[rounds], links.target]
    rival = np.maximum(_rival(total, links.source, n), _rival(total, links.target, n))
    with np.errstate(invalid="ignore"):
        lead = np.where(live, total - rival, -np.inf)
    return total, total - apart, lead


def _rival(total: Array, group: IntArray, n: int) -> Array:
    """Return the best total (L,) among the other links of each link's group."""
    best, second = np.full(n, -np.inf), np.full(n, -np.inf)
    np.maximum.at(best, group, total)
    is_best = total == best[group]
    alone = np.bincount(group[is_best], minlength=n) == 1
    np.maximum.at(second, group[~is_best], total[~is_best])
    return np.where(is_best & alone[group], second[group], best[group])


def _lane_support(links: _Links, sightings: Sightings, settings: PassageSettings) -> Array:
    """Return by how much the speeds of other vehicles of the lane speak for each link (L,)."""
    dt = sightings.times_s[links.target] - sightings.times_s[links.source]
    told = np.flatnonzero(dt >= settings.min_speed_dt_s)
    support = np.zeros(len(dt))
    if not len(told):
        return support
    _, gain, lead = _totals(links, np.ones(len(dt), dtype=np.bool_), len(sightings), settings.rounds)
    weight = ((lead > settings.margins[-1]) & (gain > settings.min_score))[told].astype(np.float64)
    begin, end = sightings.points_m[links.source[told]], sightings.points_m[links.target[told]]
    edge = settings.max_speed_ms + 20
    column = np.clip(np.rint((end - begin)[:, 0] / dt[told] + edge), 0, 2 * edge).astype(np.int64)
    places, row = np.unique(np.rint(begin[:, 1] * 2) / 2, return_inverse=True)
    counts = np.zeros((len(places), int(2 * edge) + 1))
    np.add.at(counts, (row, column), weight)
    speeds = np.arange(counts.shape[1])
    near = np.exp(-(((places[:, None] - places) / settings.lane_m) ** 2) / 2)
    alike = np.exp(-(((speeds[:, None] - speeds) / settings.lane_speed_ms) ** 2) / 2)
    density = 1 / (settings.lane_speed_ms * np.sqrt(2 * np.pi))
    others = (near @ counts.sum(axis=1))[row] - weight
    like = density * ((near @ counts @ alike)[row, column] - weight)
    support[told] = np.log((1 + _SPEED_RANGE * np.maximum(like, 0)) / (1 + np.maximum(others, 0)))
    return np.clip(support, *settings.lane_support)


def _bridges(sightings: Sightings, chains: IntArray, settings: PassageSettings) -> IntArray:
    """Return further links (2, L), over longer gaps, between rows of links whose speeds are known."""
    n = len(sightings)
    previous, following = np.full(n, _NONE), np.full(n, _NONE)
    previous[chains[1]], following[chains[0]] = chains
    tails = np.flatnonzero((following == _NONE) & (previous != _NONE) & ~sightings.cut)
    heads = np.flatnonzero((previous == _NONE) & (following != _NONE) & ~sightings.cut)
    speed_i, doubt_i = _speeds(sightings, tails, previous, settings)
    speed_j, doubt_j = _speeds(sightings, heads, following, settings)
    gap = sightings.times_s[heads] - sightings.times_s[tails, None]
    a, b = np.nonzero((gap > 0) & (gap <= settings.max_gap_s))
    i, j, dt = tails[a], heads[b], gap[a, b]
    dx = sightings.points_m[j, 0] - sightings.points_m[i, 0]
    noise = _noise_m(sightings, settings)[:, 0]
    doubt = np.hypot(doubt_i[a], doubt_j[b])
    spread = noise[i] ** 2 + noise[j] ** 2 + (doubt * dt / 2) ** 2 + (settings.acceleration_ms2 * dt**2 / 4) ** 2
    error = dx - (speed_i[a] + speed_j[b]) / 2 * dt
    change = speed_j[b] - speed_i[a]
    change_spread = doubt**2 + (settings.acceleration_ms2 * (dt + settings.baseline_s)) ** 2
    score = _pair_scores(sightings, i, j, settings) - error**2 / spread / 2 - change**2 / change_spread / 2
    score += np.log(settings.false_length_m / np.sqrt(2 * np.pi * spread))
    lead = score - np.maximum(_rival(score, i, n), _rival(score, j, n))
    taken = (score >= settings.min_score) & (lead >= settings.margins[-1])
    return np.stack([i[taken], j[taken]])


def _speeds(sightings: Sightings, ends: IntArray, step: IntArray, settings: PassageSettings) -> tuple[Array, Array]:
    """Return the speeds along the road (E,) at the ends of rows of links and their standard deviations, m/s."""
    far = step[ends]
    while len(far):
        further = step[far]
        near = np.abs(sightings.times_s[further] - sightings.times_s[ends]) <= settings.baseline_s
        go_on = (further != _NONE) & near
        if not go_on.any():
            break
        far = np.where(go_on, further, far)
    dt = sightings.times_s[far] - sightings.times_s[ends]
    dx = sightings.points_m[far, 0] - sightings.points_m[ends, 0]
    noise = _noise_m(sightings, settings)[:, 0]
    return dx / dt, np.hypot(noise[far], noise[ends]) / np.abs(dt)
