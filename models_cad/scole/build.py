"""Builds the laboratory apparatus of the Spacecraft Control Laboratory Experiment (SCOLE).

Run `python models_cad/scole/build.py [FOLDER] [--no-picture]`.

Target frame, metres: the shuttle's body axes, X towards the nose, Y to starboard, Z down,
the frame of yaw, pitch and roll in [W] eq. 3; the mast hangs along +Z. Origin at the
shuttle's centre of mass, placed in the middle of the plate's thickness.

Sources of the dimensions:
    [W] Welch, Montgomery and Barsky, "The SCOLE Optical Attitude Measurement System",
        NASA TM 102624 (1991): six infrared LEDs on the shuttle, which lie in one plane.
        It prints no coordinates; the positions below are this project's own.
    [D] Williams and Rallo, "Description of the SCOLE Facility", NASA TM 89057 (1987):
        plate 83.8 × 54.0 in and 13/16 in thick‡, centre of mass 26.8 in from the tail
        edge‡, suspended 3.4 in above it‡, mast 120 in‡, reflector's centre 12.0 in (x) and
        20.8 in (y) from the mast's end‡.
Figures marked ‡ are quoted without the document at hand. The outline of the plate between
its published length and width, and the equipment on it, are this project's own.
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
    BLACK, DARK, FOIL, GREY, RED, SILVER, WHITE, YELLOW, Array, Part, box, cylinder, frustum,
    joined, prism, revolve, tube, turn,
)  # fmt: skip
from models_cad.picture import View  # noqa: E402
# isort: on

INCH = 0.0254
PLATE_LENGTH, PLATE_WIDTH = 83.8 * INCH, 54.0 * INCH  # [D]
PLATE_THICKNESS = 13.0 / 16.0 * INCH  # [D]
TAIL = -26.8 * INCH  # [D] tail edge, from the centre of mass
NOSE = TAIL + PLATE_LENGTH
SUSPENSION = -3.4 * INCH  # [D] above the centre of mass: Z is down
MAST_LENGTH, MAST_RADIUS = 120.0 * INCH, 1.0 * INCH  # [D]
REFLECTOR_OFFSET = np.array([12.0, 20.8]) * INCH  # [D] the mast ends at a corner of the hexagon
REFLECTOR_RADIUS = float(np.hypot(*REFLECTOR_OFFSET))
TOP, BOTTOM = -0.5 * PLATE_THICKNESS, 0.5 * PLATE_THICKNESS
MAST_END = BOTTOM + MAST_LENGTH

DOWN = np.array([0.0, 0.0, 1.0])
LED_HEIGHT = 0.012  # the diodes' fronts stand this far off the plate, all in one plane [W]
# (x, y) of the six LEDs: wide apart, on no common line, alike under no mirror or turn.
LED_SITES = (
    (1.34, 0.0), (0.75, -0.17), (0.30, 0.22), (-0.50, -0.60), (-0.60, 0.02), (-0.40, 0.58),
)  # fmt: skip


def outline() -> Array:
    """Shuttle-like planform, (n, 2) in x and y, counter-clockwise seen along −Z."""
    half = 0.5 * PLATE_WIDTH
    nose = [(NOSE - 0.16 * (1.0 - np.sin(a)), 0.14 * np.cos(a)) for a in np.linspace(0, np.pi, 9)]
    side = [(0.95, 0.20), (0.35, 0.26), (-0.10, 0.44), (-0.42, half), (TAIL + 0.03, half)]
    tail = [(TAIL + 0.03, 0.30), (TAIL, 0.27)]
    right = [*side, *tail]
    left = [(x, -y) for x, y in reversed(right)]
    return np.array([*reversed(right), *nose, *reversed(left)])


def platform_parts() -> list[Part]:
    """The plate and the experiment's equipment on and under it."""
    plate = prism(outline(), TOP, BOTTOM, (0.0, 0.0))
    gimbal = [
        box((0.16, 0.16, 0.03), (0.0, 0.0, TOP - 0.01)),
        cylinder((0.0, 0.0, TOP), (0.0, 0.0, SUSPENSION - 0.02), 0.03, 16),
        tube((0.0, 0.0, SUSPENSION), (1.0, 0.0, 0.0), (-0.014, 0.014), (0.045, 0.07), 28),
        cylinder((0.0, -0.08, SUSPENSION), (0.0, 0.08, SUSPENSION), 0.012, 10),
        cylinder((0.0, 0.0, SUSPENSION - 0.04), (0.0, 0.0, SUSPENSION - 0.34), 0.012, 10),
    ]
    cage = box((0.30, 0.18, 0.16), (-0.33, 0.24, TOP - 0.075))
    supply = box((0.22, 0.26, 0.11), (-0.36, -0.30, TOP - 0.05))
    rates = box((0.12, 0.10, 0.08), (0.86, 0.03, TOP - 0.035))
    bottle = joined(
        cylinder((0.25, -0.12, BOTTOM + 0.09), (0.85, -0.06, BOTTOM + 0.09), 0.075, 24),
        revolve([(0.0, 0.0), (0.0, 0.075), (0.05, 0.05), (0.07, 0.0)],
                (0.85, -0.06, BOTTOM + 0.09), (0.6, 0.06, 0.0), 24),
        box((0.03, 0.12, 0.10), (0.38, -0.107, BOTTOM + 0.04)),
        box((0.03, 0.12, 0.10), (0.72, -0.073, BOTTOM + 0.04)),
    )  # fmt: skip
    gyros: list[Part] = []  # two control-moment gyroscopes under the wings
    for name, y, height in (("starboard", 0.40, 0.17), ("port", -0.44, 0.13)):
        centre = np.array([-0.42, y, BOTTOM + height])
        across = turn((0, 0, 1), np.radians(30.0 if y > 0 else -75.0)) @ np.array([1.0, 0.0, 0.0])
        wheel = joined(
            cylinder(centre - 0.035 * across, centre + 0.035 * across, 0.10, 28),
            cylinder(centre - 0.08 * across, centre + 0.08 * across, 0.02, 10),
        )
        bracket = box((0.07, 0.07, height), (*centre[:2], BOTTOM + 0.5 * height - 0.005))
        gyros += [Part(f"gyro-{name}", wheel, DARK), Part(f"gyro-{name}-bracket", bracket, GREY)]
    fins = joined(
        box((0.20, 0.03, 0.13), (TAIL + 0.13, 0.20, TOP - 0.06)),
        box((0.12, 0.03, 0.08), (TAIL + 0.09, -0.20, TOP - 0.035)),
    )
    return [
        Part("platform", plate, WHITE),
        Part("gimbal", joined(*gimbal), GREY),
        Part("card-cage", cage, SILVER),
        Part("power-supply", supply, DARK),
        Part("rate-sensors", rates, FOIL),
        Part("gas-bottle", bottle, YELLOW),
        Part("tail-brackets", fins, GREY),
        *gyros,
    ]


def led_positions() -> list[Array]:
    """Centres of the six LEDs' fronts, on the plate's upper (−Z) face."""
    return [np.array([x, y, TOP - LED_HEIGHT]) for x, y in LED_SITES]


def led_parts() -> list[Part]:
    """The six LEDs: 30 mm black mounts around 16 mm diodes."""
    parts = []
    for k, front in enumerate(led_positions()):
        back = front + (LED_HEIGHT + 0.004) * DOWN
        mount = tube(back, (0.0, 0.0, -1.0), (0.0, 0.014), (0.006, 0.015), 20)
        diode = cylinder(back, front, 0.008, 16)
        parts += [Part(f"led-{k + 1}-mount", mount, BLACK), Part(f"led-{k + 1}", diode, RED)]
    return parts


def mast_parts() -> list[Part]:
    """The flexible mast with its manifolds and the reaction wheels at its tip."""
    mast = cylinder((0, 0, BOTTOM - 0.005), (0, 0, MAST_END), MAST_RADIUS, 20)
    root = joined(
        box((0.16, 0.16, INCH), (0.0, 0.0, BOTTOM + 0.5 * INCH - 0.002)),
        frustum((0, 0, BOTTOM + 0.02), (0, 0, BOTTOM + 0.12), 0.06, 0.03, 20),
    )
    tip = box((0.14, 0.12, INCH), (0.0, 0.0, MAST_END - 0.5 * INCH))
    hub = np.array([0.0, 0.0, MAST_END - 0.14])
    wheels = []
    for axis, offset in (
        ((1, 0, 0), (-0.11, 0.0, 0.03)),
        ((0, 1, 0), (0.0, -0.12, 0.02)),
        ((0, 0, 1), (0.0, 0.0, -0.12)),
    ):
        centre, along = hub + offset, np.array(axis, float)
        wheels.append(cylinder(centre - 0.025 * along, centre + 0.025 * along, 0.085, 28))
    wheels.append(box((0.16, 0.14, 0.07), hub + np.array([-0.03, -0.04, 0.02])))
    return [
        Part("mast", mast, GREY),
        Part("mast-root", root, DARK),
        Part("mast-tip", tip, DARK),
        Part("reaction-wheels", joined(*wheels), FOIL),
    ]


def reflector_parts() -> list[Part]:
    """The hexagonal antenna frame, offset from the mast, with the thrusters at its centre."""
    centre = np.array([*REFLECTOR_OFFSET, MAST_END])
    first = np.arctan2(-REFLECTOR_OFFSET[1], -REFLECTOR_OFFSET[0])  # corner at the mast
    angles = first + np.arange(6) * np.pi / 3.0
    corners = [centre + REFLECTOR_RADIUS * np.array([np.cos(a), np.sin(a), 0.0]) for a in angles]
    rim = [
        cylinder(a, b, 0.018, 14) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    spokes = [cylinder(centre, corner, 0.014, 12) for corner in corners]
    knots = [cylinder(c - 0.024 * DOWN, c + 0.024 * DOWN, 0.026, 14) for c in corners]
    manifold = frustum(centre - 0.05 * DOWN, centre + 0.06 * DOWN, 0.10, 0.07, 24)
    jets = [
        frustum(centre + 0.05 * d, centre + 0.20 * d, 0.02, 0.035, 14)
        for d in (
            np.array([np.cos(a), np.sin(a), 0.0])
            for a in angles[0] + np.radians([30, 120, 210, 300])
        )
    ]
    return [
        Part("antenna-rim", joined(*rim), SILVER),
        Part("antenna-spokes", joined(*spokes), SILVER),
        Part("antenna-corners", joined(*knots), GREY),
        Part("antenna-manifold", manifold, GREY),
        Part("antenna-thrusters", joined(*jets), DARK),
    ]


def build() -> list[Part]:
    """All parts of the apparatus in its target frame, metres."""
    return [*platform_parts(), *led_parts(), *mast_parts(), *reflector_parts()]


FRAME = """
Target frame of the SCOLE laboratory apparatus, metres (the shuttle's body axes):
  +X towards the nose, +Y to starboard, +Z down; the mast hangs along +Z
Origin at the shuttle's centre of mass, in the middle of the plate's thickness,
26.8 in forward of the tail edge.
The six LEDs are on the upper face, in one plane, and look along -Z. Their places are
this project's choice: NASA TM 102624 prints none.
Written by build.py: change that and run it again.
"""
DESCRIPTION = "SCOLE laboratory apparatus: shuttle-like plate, mast and offset hexagonal antenna"
VIEW = View(eye=(4.4, 3.2, -2.9), look_at=(0.12, 0.12, 1.30), up=(0.0, 0.0, -1.0),
            sun=(0.5, 0.75, -0.75), focal_px=740.0)  # fmt: skip

if __name__ == "__main__":
    leds = [
        files.feature("[[leds]]", name=f"led-{k + 1}", position_m=front, normal=(0.0, 0.0, -1.0))
        for k, front in enumerate(led_positions())
    ]
    target = files.target_text("scole", DESCRIPTION, FRAME, leds)
    files.main("scole", build(), target, VIEW, HERE)
