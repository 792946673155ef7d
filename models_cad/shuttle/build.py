"""Builds a Space Shuttle orbiter whose payload-bay doors are open, as in flight.

Run `python models_cad/shuttle/build.py [FOLDER] [--no-picture]`.

Target frame, metres: the orbiter's body axes, X towards the nose, Y to starboard, Z down
(the keel). Origin in the middle of the payload bay, on its centreline.

Sources of the dimensions:
    [N] NASA, "National Space Transportation System Reference" (1988), vol. 1: length 37.24 m,
        span 23.79 m; payload bay 60 ft long and 15 ft wide; doors open by 175.5°‡; main engines'
        nozzles 90.7 in wide at the exit‡; manipulator 50 ft 3 in long, 15 in thick‡.
    [S] Structural reference frame of the orbiter (JSC 07700, vol. XIV)‡: nose at X = 236 in, bay
        from 582 to 1302 in, its centreline at Z = 400 in, the doors' hinges 20 in above it, the
        fin's tip at Z = 816 in.
Figures marked ‡ are quoted without the document at hand. Cross-sections of the fuselage, the wing's
profile, the pods and what is in the bay are this project's own.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[1]))

# isort: off
from models_cad import files  # noqa: E402
from models_cad.parts import (  # noqa: E402
    BLACK, DARK, FOIL, GREY, SILVER, WHITE, Array, Part, box, cylinder, frustum, joined, loft,
    moved, patch, prism, tube, turn,
)  # fmt: skip
from models_cad.picture import View  # noqa: E402
# isort: on

INCH, FOOT = 0.0254, 0.3048
BAY_HALF, BAY_RADIUS = 30.0 * FOOT, 7.5 * FOOT  # [N]
NOSE, TAIL_TIP = (942.0 - 236.0) * INCH, (942.0 - 236.0) * INCH - 37.24  # [S], [N]
HALF_SPAN = 0.5 * 23.79  # [N]
FIN_TOP = -(816.0 - 400.0) * INCH  # [S]
HINGE_Z = -20.0 * INCH  # [S]
DOOR_RADIUS = 2.62  # outside
HINGE_Y = float(np.sqrt(DOOR_RADIUS**2 - HINGE_Z**2))
OPEN = np.radians(175.5)  # [N]
SIDE, KEEL = 2.65, 2.95  # half width of the fuselage, and its belly
CORNERS = 28  # of a cross-section
SIDES = (("starboard", 1.0), ("port", -1.0))


def section(x: float, half: float, top: float, bottom: float, power: float) -> Array:
    """(CORNERS, 3) cross-section at x: |y / half|^power + |z / height|^power = 1 (superellipse)."""
    angles = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    y, z = np.cos(angles), np.sin(angles)
    y, z = (np.sign(v) * np.abs(v) ** (2.0 / power) for v in (y, z))
    middle, height = 0.5 * (top + bottom), 0.5 * (bottom - top)
    return np.column_stack([np.full(CORNERS, x), half * y, middle + height * z])


def underside(ring: Array) -> Array:
    """The lower part of a cross-section, a little proud of it."""
    middle = ring.mean(axis=0)
    proud = middle + 1.012 * (ring - middle)
    lowest = middle[2] + 0.2 * np.ptp(ring[:, 2])
    proud[:, 2] = np.maximum(proud[:, 2], lowest)
    return np.asarray(proud)


def fuselage_parts() -> list[Part]:
    """Nose and cabin, the trough of the bay, and the engine section."""
    front, back = BAY_HALF, -BAY_HALF
    cabin = [
        section(front - 0.1, SIDE, -DOOR_RADIUS, KEEL, 3.4),
        section(11.6, 2.62, -2.58, 2.95, 3.2),
        section(12.9, 2.50, -1.95, 2.93, 2.9),
        section(13.9, 2.28, -0.95, 2.88, 2.6),
        section(15.4, 1.80, -0.25, 2.72, 2.4),
        section(16.8, 1.16, 0.42, 2.42, 2.2),
        section(17.6, 0.62, 0.90, 2.05, 2.0),
        section(NOSE, 0.12, 1.35, 1.60, 2.0),
    ]
    wall = (2.0 * BAY_HALF + 0.2, SIDE - BAY_RADIUS, 3.2)
    walls = [box(wall, (0.0, sign * 0.5 * (SIDE + BAY_RADIUS), HINGE_Z + 1.6)) for _, sign in SIDES]
    belly = loft([section(x, SIDE, 2.3, KEEL, 4.0) for x in (front + 0.1, back - 0.1)])
    liner = patch((back, front), (-0.05, np.pi + 0.05), (BAY_RADIUS - 0.02, BAY_RADIUS + 0.06), 16)
    frames = [patch((x - 0.08, x + 0.08), (0.0, np.pi), (BAY_RADIUS - 0.12, BAY_RADIUS + 0.02), 12)
              for x in np.linspace(back, front, 13)[1:-1]]  # fmt: skip
    aft = [
        section(back + 0.1, SIDE, -DOOR_RADIUS, KEEL, 3.4),
        section(-11.5, 2.85, -2.75, 2.95, 3.2),
        section(-15.4, 3.05, -2.85, 2.75, 3.0),
    ]
    windows = [box((0.5, 0.62, 0.06), (13.3, y, -1.57 + 0.12 * y * y),
                   turn((1, 0, 0), 0.35 * y) @ turn((0, 1, 0), -0.82))
               for y in (-1.4, -0.7, 0.0, 0.7, 1.4)]  # fmt: skip
    cap, inside = cabin[-2].mean(axis=0), np.array([0.03, 0.0, 0.0])
    hatch = cylinder((12.2, -2.45, 0.1), (12.2, -2.66, 0.1), 0.55, 24)
    return [
        Part("cabin", loft(cabin), WHITE),
        Part("nose-cap", loft([1.01 * (ring - cap) + cap for ring in cabin[-2:]]), DARK),
        Part("nose-tiles", loft([underside(ring) for ring in cabin[:-1]]), BLACK),
        Part("windows", joined(*windows), BLACK),
        Part("hatch", hatch, GREY),
        Part("bay-walls", joined(*walls), WHITE),
        Part("belly", belly, BLACK),
        Part("bay-liner", liner, WHITE),
        Part("bay-frames", joined(*frames), GREY),
        Part("engine-section", loft(aft), WHITE),
        Part("tail-tiles", loft([underside(ring) + inside for ring in aft]), BLACK),
    ]


def wing_parts() -> list[Part]:
    """Double-delta wings: white above, black tiles below; and the body flap."""
    # Y, leading edge, trailing edge, thickness above and below the chord, chord's Z.
    stations = ((2.3, 8.2, -14.3, 0.55, 0.45, 2.45), (3.3, 2.2, -14.3, 0.55, 0.45, 2.42),
                (4.6, -2.4, -14.2, 0.50, 0.40, 2.36),
                (HALF_SPAN, -9.6, -12.9, 0.12, 0.10, 1.92))  # fmt: skip
    parts = []
    for name, sign in SIDES:
        upper, lower = [], []
        for y, lead, trail, above, below, z in stations:
            chord = lead - trail
            along = (lead, lead - 0.06 * chord, lead - 0.35 * chord, trail)
            rise, fall = (0.0, 0.62 * above, above, 0.03), (0.0, 0.62 * below, below, 0.03)
            rim = [(x, sign * y, z) for x in (along[3], along[2], along[1])]
            upper.append([(x, sign * y, z - r) for x, r in zip(along, rise, strict=True)] + rim)
            lower.append([(x, sign * y, z + f) for x, f in zip(along, fall, strict=True)] + rim)
        parts += [Part(f"wing-{name}", loft(upper), WHITE),
                  Part(f"wing-tiles-{name}", loft(lower), BLACK)]  # fmt: skip
    flap = box((2.2, 6.1, 0.35), (-15.9, 0.0, 2.55), turn((0, 1, 0), -0.08))
    return [*parts, Part("body-flap", flap, BLACK)]


def fin_parts() -> list[Part]:
    """The vertical tail; its rudder reaches farthest aft."""
    outline = [(-8.3, 2.2), (-10.2, 3.0), (-16.4, -FIN_TOP), (TAIL_TIP, -FIN_TOP), (-16.6, 2.6)]
    flat = prism(outline, -0.28, 0.28, (-14.0, 4.5))  # outline's second axis points up
    up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    edge = cylinder((-10.2, 0.0, -3.0), (-16.4, 0.0, FIN_TOP), 0.16, 10)
    return [Part("fin", moved(flat, up), WHITE), Part("fin-edge", edge, GREY)]


def engine_parts() -> list[Part]:
    """Manoeuvring pods and three main engines."""
    parts = []
    for name, sign in SIDES:
        rings, aside = [], np.array([0.0, sign * 1.95, 0.0])
        for x, half, z in ((-8.2, 0.15, -2.6), (-9.5, 0.85, -2.75), (-11.5, 1.25, -2.9),
                           (-14.5, 1.35, -2.9), (-16.0, 1.1, -2.75)):  # fmt: skip
            ring = section(x, half, z - half, z + half, 2.4)
            rings.append(ring + aside)
        parts.append(Part(f"pod-{name}", loft(rings), WHITE))
        bell = frustum((-15.9, sign * 2.3, -2.7), (-17.3, sign * 2.5, -2.9), 0.22, 0.55, 28)
        parts.append(Part(f"pod-engine-{name}", bell, DARK))
    bells = []
    for y, z, drop in ((0.0, -1.1, -0.28), (1.35, 1.15, 0.17), (-1.35, 1.15, 0.17)):
        start = np.array([-15.2, y, z])
        axis = np.array([-1.0, 0.06 * np.sign(y), drop])
        axis /= np.linalg.norm(axis)
        middle, end = start + 1.0 * axis, start + 3.0 * axis
        bells += [frustum(start, middle, 0.35, 0.75, 32),
                  frustum(middle, end, 0.75, 0.5 * 90.7 * INCH, 32)]  # fmt: skip
    return [*parts, Part("main-engines", joined(*bells), DARK)]


def bay_parts() -> list[Part]:
    """Docking system, a carrier with its experiments, and the manipulator on the port sill."""
    dock = joined(
        cylinder((6.9, 0.0, 1.9), (6.9, 0.0, -1.2), 0.95, 32),
        tube((6.9, 0.0, -1.2), (0.0, 0.0, -1.0), (0.0, 0.55), (0.62, 0.78), 40),
        cylinder((7.8, 0.0, 0.5), (BAY_HALF + 0.05, 0.0, 0.5), 0.8, 28),
    )
    truss = joined(box((0.9, 4.2, 0.25), (-3.2, 0.0, 0.35)), box((0.9, 0.4, 1.7), (-3.2, 0.0, 1.2)))
    boxes = joined(box((0.8, 1.0, 0.9), (-3.2, 1.1, -0.2)), box((0.7, 0.8, 0.5), (-3.2, -0.7, 0.0)))
    drum = cylinder((-7.4, 0.25, 0.7), (-5.2, 0.25, 0.7), 1.05, 32)
    arm = joined(
        cylinder((8.2, -2.1, -0.72), (8.2 - 603.0 * INCH, -2.1, -0.72), 7.5 * INCH, 16),
        *(cylinder((x, -2.1, -0.72), (x + 0.5, -2.1, -0.72), 0.27, 16) for x in (7.9, 1.1, -5.9)),
    )
    return [
        Part("docking-system", dock, SILVER),
        Part("carrier", truss, GREY),
        Part("experiments", boxes, FOIL),
        Part("payload", drum, SILVER),
        Part("manipulator", arm, WHITE),
    ]


def door_parts() -> list[Part]:
    """Both doors with the radiators on their inner sides, open."""
    parts = []
    low = float(np.arcsin(-HINGE_Z / DOOR_RADIUS))
    for name, sign in SIDES:
        angles = (-0.5 * np.pi, -low) if sign > 0.0 else (-np.pi + low, -0.5 * np.pi)
        shell = patch((-BAY_HALF, BAY_HALF), angles, (DOOR_RADIUS - 0.08, DOOR_RADIUS), 14)
        inner = (angles[0] + 0.06, angles[1] - 0.1) if sign > 0.0 else (angles[0] + 0.1,
                                                                      angles[1] - 0.06)  # fmt: skip
        panels = [
            patch((start + 0.08, start + 4.4), inner, (DOOR_RADIUS - 0.14, DOOR_RADIUS - 0.07), 12)
            for start in BAY_HALF - 4.5 * np.arange(1, 5)
        ]
        hinge = np.array([0.0, sign * HINGE_Y, HINGE_Z])
        rotation = turn((sign, 0.0, 0.0), OPEN)
        for what, mesh, colour in (("door", shell, WHITE), ("radiator", joined(*panels), SILVER)):
            opened = moved(mesh, rotation, hinge - rotation @ hinge)
            parts.append(Part(f"{what}-{name}", opened, colour))
    return parts


def build() -> list[Part]:
    """All parts of the vehicle in its target frame, metres."""
    return [*fuselage_parts(), *wing_parts(), *fin_parts(), *engine_parts(), *bay_parts(),
            *door_parts()]  # fmt: skip


FRAME = """
Target frame of the Space Shuttle orbiter, metres (its body axes):
  +X towards the nose, +Y to starboard, +Z down, out of the keel
Origin in the middle of the payload bay, on its centreline.
The payload-bay doors are open by 175.5 degrees; doors.toml has them at any angle.
Written by build.py: change that and run it again.
"""
DESCRIPTION = "Space Shuttle orbiter, payload bay open: docking system, carrier, manipulator"
VIEW = View(eye=(24.0, 27.0, -34.0), look_at=(-0.8, 0.4, -0.8), up=(0.0, 0.0, -1.0),
            sun=(0.55, 0.35, -0.8), focal_px=720.0)  # fmt: skip

if __name__ == "__main__":
    files.main("shuttle", build(), files.target_text("shuttle", DESCRIPTION, FRAME), VIEW, HERE)
