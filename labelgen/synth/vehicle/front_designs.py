"""Designs of car fronts: combinations of lamps, grilles and bumpers.

Points are (y, t): y in shares of the half-width from the middle outwards, t in shares of the face's height, from the
foot of the bumper to the bonnet's edge. Each describes one half; the other mirrors it. None is of a particular make.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CAR_DESIGNS", "VAN_DESIGNS", "FrontDesign", "Opening"]

Points = tuple[tuple[float, float], ...]
Discs = tuple[tuple[float, float, float], ...]
"""y, t and the radius in metres."""


@dataclass(frozen=True)
class Opening:
    """A grille or an intake.

    Args:
        half: its outline from the middle of its foot outwards and back to the middle of its top; or all of it, when
            there is one on either side.
        inside: "slats", "mesh", "fins" or "plain".
        rim: width of a bright frame, metres; 0 without.
        paired: one on either side.
    """

    half: Points
    inside: str = "slats"
    rim: float = 0.0
    paired: bool = False


@dataclass(frozen=True)
class FrontDesign:
    """One front.

    Args:
        name: what it is called here.
        lamp: outline of a head lamp.
        sweep: metres by which its outer end reaches back over the wing.
        bowls: reflectors or projectors in it.
        strips: bright lines in it, of light-emitting diodes or trim.
        amber: the indicator, where it is of another colour.
        dark: how often the lamp's inside is black rather than silver.
        openings: grilles and intakes.
        bright: lines of chrome, and their widths in metres.
        painted: bars in the body's colour across openings, likewise.
        badge: t, radius in metres, and "disc", "ring", "bolt" or "none".
        plate: t of the number plate's middle.
        hollow: the bumper's dark corner; empty without.
        fog: fog lamps, in that corner or in an opening.
        lip: t below which the bumper is unpainted.
        skid: t of the lower and upper edge of a silver plate in the middle; equal without.
        share: how common it is.
    """

    name: str
    lamp: Points
    sweep: float
    bowls: Discs
    strips: tuple[Points, ...]
    amber: Points
    dark: float
    openings: tuple[Opening, ...]
    bright: tuple[tuple[Points, float], ...]
    painted: tuple[tuple[Points, float], ...]
    badge: tuple[float, float, str]
    plate: float
    hollow: Points
    fog: Discs
    lip: float = 0.0
    skid: tuple[float, float] = (0.0, 0.0)
    share: float = 1.0


CAR_DESIGNS: tuple[FrontDesign, ...] = (
    FrontDesign(
        "crossover",
        lamp=((0.46, 0.80), (0.52, 0.70), (0.70, 0.68), (0.92, 0.78), (1.0, 0.96), (0.98, 1.06), (0.74, 0.94)),
        sweep=0.24, bowls=((0.66, 0.79, 0.045), (0.81, 0.85, 0.034)),
        strips=(((0.52, 0.72), (0.70, 0.71), (0.90, 0.80), (0.96, 0.94)),), amber=(), dark=0.8,
        openings=(
            Opening(((0, 0.60), (0.26, 0.60), (0.44, 0.80), (0.42, 0.92), (0, 0.92)), "mesh"),
            Opening(((0, 0.10), (0.50, 0.10), (0.66, 0.22), (0.48, 0.36), (0, 0.36)), "slats"),
        ),
        bright=((((0.40, 0.93), (0.19, 0.61), (0.0, 0.59)), 0.030),), painted=(), badge=(0.77, 0.055, "ring"),
        plate=0.46,
        hollow=((0.72, 0.20), (0.96, 0.20), (0.98, 0.46), (0.88, 0.44)), fog=((0.86, 0.30, 0.036),), lip=0.14,
        skid=(0.0, 0.09), share=1.2,
    ),
    FrontDesign(
        "round-eyed",
        lamp=((0.55, 0.66), (0.74, 0.58), (0.94, 0.68), (0.99, 0.98), (0.90, 1.08), (0.66, 0.98), (0.56, 0.84)),
        sweep=0.22, bowls=((0.74, 0.78, 0.044), (0.87, 0.92, 0.036)), strips=(), amber=(), dark=0.15,
        openings=(
            Opening(((0, 0.80), (0.40, 0.82), (0.44, 0.90), (0, 0.90)), "plain"),
            Opening(((0, 0.06), (0.52, 0.06), (0.60, 0.20), (0.52, 0.34), (0, 0.34)), "mesh"),
        ),
        bright=((((0.52, 0.78), (0.16, 0.80), (0.0, 0.90)), 0.022), (((0.52, 0.87), (0.18, 0.88),
        (0.0, 0.98)), 0.022)),
        painted=(), badge=(0.9, 0.03, "none"), plate=0.48,
        hollow=((0.70, 0.12), (0.92, 0.14), (0.96, 0.38), (0.76, 0.40)), fog=((0.83, 0.27, 0.036),), lip=0.05,
        share=0.5,
    ),
    FrontDesign(
        "smooth",
        lamp=((0.58, 0.62), (0.78, 0.60), (0.99, 0.82), (1.0, 1.02), (0.86, 1.06), (0.66, 0.84)),
        sweep=0.34, bowls=((0.73, 0.73, 0.05), (0.87, 0.86, 0.036)),
        strips=(((0.62, 0.64), (0.78, 0.63), (0.96, 0.82)),),
        amber=(), dark=0.2,
        openings=(
            Opening(((0, 0.83), (0.26, 0.84), (0.34, 0.91), (0, 0.90)), "plain"),
            Opening(((0, 0.06), (0.56, 0.06), (0.50, 0.44), (0, 0.44)), "slats"),
        ),
        bright=(), painted=(), badge=(0.95, 0.05, "ring"), plate=0.33,
        hollow=((0.76, 0.10), (0.95, 0.10), (0.97, 0.44), (0.84, 0.46)),
        fog=((0.88, 0.22, 0.034), (0.90, 0.36, 0.03)),
    ),
    FrontDesign(
        "wide-mouthed",
        lamp=((0.52, 0.80), (0.66, 0.70), (0.92, 0.80), (1.0, 0.95), (0.97, 1.02), (0.72, 0.94)),
        sweep=0.36, bowls=((0.70, 0.81, 0.036), (0.82, 0.86, 0.034)),
        strips=(((0.56, 0.80), (0.68, 0.74), (0.94, 0.84)),),
        amber=(), dark=0.65,
        openings=(
            Opening(((0, 0.44), (0.48, 0.44), (0.54, 0.60), (0.40, 0.90), (0, 0.90)), "slats", 0.012),
            Opening(((0, 0.06), (0.60, 0.06), (0.54, 0.22), (0, 0.22)), "mesh"),
        ),
        bright=(), painted=(), badge=(0.98, 0.036, "disc"), plate=0.33,
        hollow=((0.70, 0.12), (0.97, 0.12), (0.98, 0.32), (0.74, 0.28)), fog=((0.86, 0.17, 0.022),), share=1.3,
    ),
    FrontDesign(
        "single-frame",
        lamp=((0.48, 0.78), (0.54, 0.70), (0.80, 0.68), (0.99, 0.80), (0.99, 0.98), (0.74, 0.96)),
        sweep=0.26, bowls=((0.66, 0.81, 0.045), (0.80, 0.84, 0.04)),
        strips=(((0.52, 0.73), (0.78, 0.71), (0.95, 0.80)), ((0.94, 0.80), (0.95, 0.95))), amber=(), dark=0.6,
        openings=(
            Opening(((0, 0.16), (0.30, 0.16), (0.42, 0.56), (0.38, 0.92), (0, 0.92)), "slats", 0.012),
            Opening(((0.52, 0.12), (0.90, 0.12), (0.93, 0.36), (0.56, 0.40)), "fins", 0.0, True),
        ),
        bright=(), painted=(), badge=(0.80, 0.04, "ring"), plate=0.42, hollow=(), fog=((0.80, 0.25, 0.03),),
        share=1.1,
    ),
    FrontDesign(
        "two-nostrils",
        lamp=((0.47, 0.86), (0.50, 0.68), (0.80, 0.66), (0.98, 0.76), (0.99, 0.94), (0.72, 0.97)),
        sweep=0.20, bowls=((0.62, 0.82, 0.052), (0.80, 0.82, 0.052)),
        strips=(((0.53, 0.86), (0.72, 0.94), (0.94, 0.92)),),
        amber=((0.90, 0.74), (0.98, 0.78), (0.98, 0.92), (0.91, 0.92)), dark=0.5,
        openings=(
            Opening(((0.04, 0.66), (0.30, 0.66), (0.36, 0.80), (0.32, 0.93), (0.06, 0.93)), "fins", 0.014, True),
            Opening(((0, 0.08), (0.46, 0.08), (0.54, 0.30), (0, 0.30)), "mesh"),
        ),
        bright=(), painted=(), badge=(1.0, 0.03, "disc"), plate=0.46,
        hollow=((0.62, 0.10), (0.93, 0.12), (0.95, 0.32), (0.66, 0.32)), fog=((0.80, 0.22, 0.044),), share=0.7,
    ),
    FrontDesign(
        "horizontal",
        lamp=((0.56, 0.92), (0.55, 0.70), (0.78, 0.64), (0.98, 0.72), (0.99, 0.96), (0.78, 0.97)),
        sweep=0.17, bowls=((0.68, 0.80, 0.055), (0.85, 0.82, 0.046)),
        strips=(((0.58, 0.69), (0.78, 0.67), (0.95, 0.74)),),
        amber=(), dark=0.45,
        openings=(
            Opening(((0, 0.70), (0.53, 0.70), (0.54, 0.92), (0, 0.92)), "plain"),
            Opening(((0, 0.08), (0.52, 0.08), (0.58, 0.30), (0, 0.30)), "slats"),
        ),
        bright=((((0.53, 0.885), (0.0, 0.885)), 0.014), (((0.53, 0.75), (0.0, 0.75)), 0.014)), painted=(),
        badge=(0.81, 0.062, "ring"), plate=0.44,
        hollow=((0.66, 0.10), (0.95, 0.12), (0.96, 0.30), (0.66, 0.28)), fog=((0.76, 0.20, 0.042),), share=1.6,
    ),
    FrontDesign(
        "shield",
        lamp=((0.52, 0.74), (0.66, 0.62), (0.90, 0.68), (0.99, 0.86), (0.97, 1.04), (0.66, 0.96)),
        sweep=0.22, bowls=((0.67, 0.80, 0.052), (0.83, 0.85, 0.056)),
        strips=(((0.56, 0.73), (0.68, 0.65), (0.90, 0.72)),),
        amber=((0.92, 0.74), (0.98, 0.86), (0.97, 0.98), (0.92, 0.98)), dark=0.25,
        openings=(
            Opening(((0, 0.60), (0.34, 0.62), (0.48, 0.84), (0.44, 0.94), (0, 0.95)), "mesh", 0.012),
            Opening(((0, 0.08), (0.58, 0.10), (0.50, 0.32), (0, 0.32)), "slats"),
        ),
        bright=((((0.46, 0.83), (0.0, 0.80)), 0.022), (((0.40, 0.72), (0.0, 0.69)), 0.022)), painted=(),
        badge=(0.78, 0.075, "ring"), plate=0.44,
        hollow=((0.66, 0.12), (0.92, 0.14), (0.94, 0.32), (0.68, 0.34)), fog=(), share=0.7,
    ),
    FrontDesign(
        "nineties",
        lamp=((0.54, 0.88), (0.54, 0.68), (0.80, 0.64), (0.96, 0.70), (0.98, 0.90), (0.80, 0.94)),
        sweep=0.10, bowls=((0.68, 0.79, 0.055),), strips=(),
        amber=((0.84, 0.66), (0.96, 0.71), (0.97, 0.89), (0.85, 0.92)), dark=0.0,
        openings=(
            Opening(((0, 0.74), (0.36, 0.74), (0.42, 0.84), (0.36, 0.90), (0, 0.90)), "slats"),
            Opening(((0, 0.10), (0.50, 0.10), (0.54, 0.22), (0.50, 0.30), (0, 0.30)), "slats"),
        ),
        bright=(), painted=(), badge=(0.82, 0.042, "disc"), plate=0.40, hollow=(), fog=((0.74, 0.22, 0.042),),
        lip=0.10,
    ),
    FrontDesign(
        "long-lamped",
        lamp=((0.50, 0.72), (0.62, 0.60), (0.84, 0.68), (1.0, 0.92), (0.97, 1.08), (0.84, 1.04), (0.62, 0.86)),
        sweep=0.42, bowls=((0.68, 0.74, 0.048), (0.82, 0.86, 0.046)),
        strips=(((0.54, 0.71), (0.63, 0.64), (0.84, 0.72)),),
        amber=(), dark=0.3,
        openings=(
            Opening(((0, 0.12), (0.48, 0.12), (0.58, 0.34), (0.44, 0.60), (0, 0.60)), "slats", 0.012),
        ),
        bright=((((0.10, 0.64), (0.44, 0.70)), 0.016),), painted=((((0.56, 0.33), (0.0, 0.33)), 0.10),),
        badge=(0.82, 0.066, "bolt"), plate=0.34,
        hollow=((0.70, 0.12), (0.92, 0.14), (0.96, 0.36), (0.76, 0.34)), fog=((0.84, 0.24, 0.044),), share=1.2,
    ),
    FrontDesign(
        "diagonal",
        lamp=((0.48, 0.90), (0.50, 0.72), (0.72, 0.66), (0.97, 0.72), (0.99, 0.98), (0.74, 0.98)),
        sweep=0.16, bowls=((0.62, 0.81, 0.05), (0.80, 0.83, 0.05)), strips=(((0.54, 0.82), (0.92, 0.84)),), amber=(),
        dark=0.5,
        openings=(
            Opening(((0, 0.60), (0.38, 0.60), (0.43, 0.76), (0.40, 0.94), (0, 0.94)), "fins", 0.012),
            Opening(((0, 0.08), (0.56, 0.08), (0.50, 0.28), (0, 0.28)), "mesh"),
        ),
        bright=(), painted=(), badge=(0.77, 0.055, "disc"), plate=0.44,
        hollow=((0.64, 0.10), (0.94, 0.12), (0.96, 0.34), (0.86, 0.36)), fog=(), lip=0.06, skid=(0.0, 0.06),
        share=0.8,
    ),
    FrontDesign(
        "winged",
        lamp=((0.50, 0.86), (0.58, 0.74), (0.82, 0.72), (0.99, 0.84), (1.0, 0.98), (0.78, 0.97)),
        sweep=0.30, bowls=((0.69, 0.83, 0.040), (0.82, 0.86, 0.036)),
        strips=(((0.54, 0.79), (0.80, 0.76), (0.96, 0.86)),),
        amber=(), dark=0.7,
        openings=(
            Opening(((0, 0.82), (0.46, 0.86), (0.48, 0.92), (0, 0.94)), "plain"),
            Opening(((0, 0.10), (0.44, 0.10), (0.60, 0.46), (0.52, 0.62), (0, 0.62)), "mesh", 0.012),
        ),
        bright=((((0.50, 0.90), (0.20, 0.84), (0.0, 0.84)), 0.020),), painted=(), badge=(0.91, 0.05, "ring"),
        plate=0.36,
        hollow=((0.72, 0.16), (0.96, 0.16), (0.97, 0.46), (0.80, 0.50)), fog=((0.88, 0.26, 0.034),), share=1.2,
    ),
)  # fmt: skip

VAN_DESIGNS: tuple[FrontDesign, ...] = (
    FrontDesign(
        "upright",
        lamp=((0.62, 0.66), (0.92, 0.60), (0.98, 0.96), (0.92, 1.10), (0.70, 0.96)),
        sweep=0.14, bowls=((0.80, 0.76, 0.07), (0.86, 0.94, 0.05)), strips=(), amber=(), dark=0.2,
        openings=(
            Opening(((0, 0.58), (0.56, 0.58), (0.62, 0.88), (0, 0.90)), "slats", 0.012),
            Opening(((0, 0.12), (0.56, 0.12), (0.60, 0.28), (0, 0.28)), "slats"),
        ),
        bright=(), painted=(), badge=(0.76, 0.07, "ring"), plate=0.40,
        hollow=((0.68, 0.14), (0.94, 0.14), (0.96, 0.36), (0.70, 0.36)), fog=((0.82, 0.25, 0.05),), lip=0.30,
    ),
    FrontDesign(
        "black-bumper",
        lamp=((0.58, 0.70), (0.94, 0.64), (0.99, 0.92), (0.90, 1.0), (0.60, 0.94)),
        sweep=0.10, bowls=((0.72, 0.80, 0.07), (0.88, 0.80, 0.05)), strips=(),
        amber=((0.86, 0.88), (0.96, 0.90), (0.92, 0.98), (0.86, 0.97)), dark=0.1,
        openings=(
            Opening(((0, 0.66), (0.54, 0.66), (0.56, 0.90), (0, 0.90)), "slats"),
            Opening(((0, 0.12), (0.50, 0.12), (0.50, 0.26), (0, 0.26)), "slats"),
        ),
        bright=(), painted=(), badge=(0.80, 0.07, "disc"), plate=0.42, hollow=(), fog=(), lip=0.56,
    ),
    FrontDesign(
        "tall-lamped",
        lamp=((0.64, 0.60), (0.88, 0.54), (0.99, 0.90), (0.96, 1.16), (0.86, 1.12), (0.70, 0.84)),
        sweep=0.30, bowls=((0.80, 0.70, 0.065), (0.88, 0.92, 0.06)), strips=(), amber=(), dark=0.3,
        openings=(
            Opening(((0, 0.62), (0.56, 0.66), (0.60, 0.80), (0, 0.80)), "plain"),
            Opening(((0, 0.16), (0.58, 0.16), (0.54, 0.48), (0, 0.48)), "slats"),
        ),
        bright=((((0.58, 0.73), (0.0, 0.71)), 0.020),), painted=(), badge=(0.90, 0.07, "bolt"), plate=0.34,
        hollow=((0.70, 0.18), (0.94, 0.20), (0.96, 0.44), (0.74, 0.40)), fog=((0.84, 0.30, 0.05),), lip=0.14,
    ),
)  # fmt: skip
