"""The schema of a checkpoint's metadata: types and ranges, checked before any of it is used."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from detector.model.backbone import NORMS
from detector.model.retinanet import ModelConfig
from labelgen.choices import Pair, Region
from labelgen.errors import LabelgenError

__all__ = ["metadata_problems"]

_SIDE_PX = (16, 8192)
_MAX_PIXELS = 20_000_000
"""Pixels of a picture that a detector takes: more than 5000x4000 need more memory than any training had."""
_MAX_ANCHORS, _MAX_CHANNELS, _MAX_TEXT = 16, 4096, 10_000
_MAX_PARTS, _MAX_DEPTH = 1_000_000, 20


def _number(low: float, high: float, *, whole: bool = False) -> Callable[[Any], bool]:
    kinds: Any = int if whole else (int, float)

    def check(value: Any) -> bool:
        return (
            isinstance(value, kinds) and not isinstance(value, bool) and math.isfinite(value) and low <= value <= high
        )

    return check


def _sequence(check: Callable[[Any], bool], low: int, high: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list | tuple) and low <= len(value) <= high and all(map(check, value))


def _text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _MAX_TEXT


def _pair(value: Any) -> bool:
    try:
        return isinstance(value, str) and Pair.parse(value) is not None
    except LabelgenError:
        return False


_sides = _sequence(_number(*_SIDE_PX, whole=True), 2, 2)
_lengths = _number(0.1, 1e5)
_CONFIG: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "backbone": (
        lambda v: _text(v) and re.fullmatch(r"[a-z0-9_]{1,64}", v) is not None,
        "name of a torchvision network",
    ),
    "levels": (_sequence(_number(2, 7, whole=True), 1, 6), "1 to 6 levels from 2 to 7"),
    "channels": (_number(1, _MAX_CHANNELS, whole=True), f"1 to {_MAX_CHANNELS}"),
    "head_convs": (_number(1, 4, whole=True), "1 to 4"),
    "head_norm": (lambda v: isinstance(v, str) and v in NORMS, f"one of {', '.join(NORMS)}"),
    "trunk_norm": (lambda v: isinstance(v, str) and v in ("batch", "frozen"), "batch or frozen"),
    "anchor_sizes": (_sequence(_sequence(_lengths, 1, _MAX_ANCHORS), 1, 6), "sides in px for each level"),
    "anchor_ratios": (_sequence(_number(1e-3, 1e3), 1, _MAX_ANCHORS), f"1 to {_MAX_ANCHORS} positive numbers"),
    "cc_weight": (_number(0, 1e6), "a number from 0"),
    "beta": (_number(1e-9, 1e6), "a positive number"),
    "size_weight": (_number(0, 1), "a number in [0, 1]"),
    "low_quality_matches": (lambda v: isinstance(v, bool), "true or false"),
}
_TOP: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "preset": (_text, "text"),
    "producer": (_text, "text"),
    "pair": (_pair, "a pair of vanishing points"),
    "size_wh": (lambda v: _sides(v) and v[0] * v[1] <= _MAX_PIXELS, f"two sides from {_SIDE_PX[0]} px"),
    "min_height_px": (_number(0, 1e5), "px from 0"),
    "config": (lambda v: isinstance(v, dict), "an object"),
    "labels": (lambda v: _plain(v) and isinstance(v, list | tuple) and all(map(_source, v)), "a list of label sets"),
    "training": (lambda v: _plain(v) and isinstance(v, dict), "an object of plain values"),
}


def metadata_problems(data: Mapping[Any, Any]) -> list[str]:
    """Return what is wrong with the metadata of a checkpoint of the right format and version.

    Args:
        data: as it stands in the checkpoint.
    """
    problems = [_problem(key, data, check, expected) for key, (check, expected) in _TOP.items()]
    config = data.get("config")
    if isinstance(config, dict):
        known = {field.name for field in fields(ModelConfig)}
        problems += [f"config has the unknown {str(key)[:40]!r}" for key in list(config)[:20] if key not in known]
        problems += [
            _problem(key, config, check, expected) for key, (check, expected) in _CONFIG.items() if key in config
        ]
        if not any(problems):
            sizes = config.get("anchor_sizes", ModelConfig.anchor_sizes)
            if len(sizes) != len(config.get("levels", ModelConfig.levels)) or len({len(level) for level in sizes}) > 1:
                problems.append("anchor_sizes: expected as many sides for each of the levels")
    return [problem for problem in problems if problem]


def _problem(key: str, data: Mapping[Any, Any], check: Callable[[Any], bool], expected: str) -> str:
    if key not in data:
        return f"{key} is missing"
    try:
        good = check(data[key])
    except (OverflowError, RecursionError):
        good = False
    return "" if good else f"{key}: expected {expected}"


def _source(value: Any) -> bool:
    """Tell whether a value describes a set of labels, see `detector.data.dataset.label_provenance`."""
    if not isinstance(value, dict):
        return False
    settings = value.get("settings")
    return isinstance(settings, list | tuple) and all(
        isinstance(one, dict) and one.get("region", Region.ROAD) in list(Region) for one in settings
    )


def _plain(value: Any) -> bool:
    """Tell whether a value is plain: numbers, text, lists and objects with text as keys, not very many nor deep."""
    pending, count = [(value, 0)], 0
    while pending:
        part, depth = pending.pop()
        count += 1
        if count > _MAX_PARTS or depth > _MAX_DEPTH:
            return False
        if isinstance(part, dict):
            if not all(isinstance(key, str) for key in part):
                return False
            pending += [(item, depth + 1) for item in part.values()]
        elif isinstance(part, list | tuple):
            pending += [(item, depth + 1) for item in part]
        elif not isinstance(part, str | int | float | bool | None):
            return False
    return True
