"""The variants of the published comparison: ways from the box of a vehicle to its measured point on the road.

    transform3d   rectified 2D box and c_c -> 3D box -> middle of its bottom front edge
    transform2d   middle of the lower side of the rectified 2D box
    orig2d        middle of the lower side of the 2D box in the frame
    maskrcnn3d    3D box around each instance mask, built in a window of the frame of its own
    previous3d    as transform3d, with the whole frame rectified in place of the road
    previous2d    as transform2d, with the whole frame rectified in place of the road
    dubska        as maskrcnn3d, around the silhouettes of a background model
    sochor        as dubska, around those silhouettes that detections confirm as vehicles
    fitted3d      a body laid over all outlines of a vehicle's track at once -> middle of its bottom front edge; from
                  masks tracked as by maskrcnn3d, from a detector's 3D boxes as by transform3d

Source: Kocur & Ftacnik 2020, section 4; Kocur 2019 (the whole frame); Dubska et al. 2014; Sochor et al. 2017.
This module imports nothing that takes time to load.
"""

from __future__ import annotations

from labelgen.choices import Choice, Region

__all__ = ["Variant"]


class Variant(Choice):
    """How the measured point of a vehicle is found."""

    TRANSFORM3D = "transform3d"
    TRANSFORM2D = "transform2d"
    ORIG2D = "orig2d"
    MASKRCNN3D = "maskrcnn3d"
    PREVIOUS3D = "previous3d"
    PREVIOUS2D = "previous2d"
    DUBSKA = "dubska"
    SOCHOR = "sochor"
    FITTED3D = "fitted3d"

    @property
    def in_frame(self) -> bool:
        """Whether boxes of masks lie in the frame, which is then not rectified as a whole."""
        return self is Variant.ORIG2D or self.from_tangents

    @property
    def is_3d(self) -> bool:
        """Whether it makes 3D boxes."""
        return self in (Variant.TRANSFORM3D, Variant.PREVIOUS3D) or self.from_tangents

    @property
    def from_tangents(self) -> bool:
        """Whether its 3D boxes are built around outlines in the frame, where these are of masks."""
        return self in (Variant.MASKRCNN3D, Variant.DUBSKA, Variant.SOCHOR, Variant.FITTED3D)

    @property
    def region(self) -> Region:
        """Part of the frame that is rectified."""
        if self.in_frame:
            return Region.NONE
        return Region.FRAME if self in (Variant.PREVIOUS3D, Variant.PREVIOUS2D) else Region.ROAD
