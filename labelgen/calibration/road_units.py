"""Road units: the lengths on the road plane of a camera whose scale is 1, before its scale is known."""

from __future__ import annotations

from dataclasses import replace

from labelgen.geometry import Camera

__all__ = ["unit_camera"]


def unit_camera(camera: Camera) -> Camera:
    """Return the camera with scale 1: what it reports as metres are road units."""
    return replace(camera, scale=1.0)
