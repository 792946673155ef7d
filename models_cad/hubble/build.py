"""Builds the Hubble Space Telescope as it flew after servicing mission 3B.

Run `python models_cad/hubble/build.py [FOLDER] [--no-picture]`.

Target frame, metres: X = V1 along the telescope towards the aperture, Y = V2 parallel
to the solar-array masts, Z = V3 parallel to the antenna masts [G]; origin on the axis,
half-way along the 13.2 m tube.

Sources of the dimensions:
    [G] NASA Goddard, "Hubble Space Telescope Systems", fact sheet (axes V1, V2, V3).
    [M] NASA, "Hubble Space Telescope Servicing Mission 3A / 4 Media Reference Guide",
        chapter "HST systems" (SSM sections, door, length 13.2 m, arrays 7.1 × 2.6 m).
    [R] RocketSTEM 11 (2015), page 9 (4 ft array masts on the forward shell).
    [S] SeeSat-L, 13 Feb 2002 (NICMOS radiator 4.0 × 0.9 m).
    [T] Moon Society, "Trunnion notes" (pin 3 in across and 9.5 in long, scuff plate 22 in).
Figures marked ‡ are quoted without the document at hand. Figures without a source are
this project's reading of public photographs.
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
    BLACK, DARK, FOIL, GREY, SILVER, WHITE, YELLOW, Array, Part, box, cylinder, dish, frame,
    frustum, handrail, joined, moved, patch, revolve, solar_panel, tube, turn, unit,
)  # fmt: skip
from models_cad.picture import View  # noqa: E402
# isort: on

LENGTH = 13.2  # [M]‡ 43.5 ft
AFT = -0.5 * LENGTH
SHROUD_LENGTH, SHROUD_RADIUS = 3.5, 0.5 * 4.27  # [M]‡ 11.5 ft long, 14 ft in diameter
EQUIPMENT_LENGTH, EQUIPMENT_RADIUS = 1.55, 1.98  # ten bays around a doughnut [M]‡
TAPER_LENGTH = 0.15
SHELL_LENGTH, SHELL_RADIUS = 4.0, 1.56  # [M]‡ 13 ft long; 3.1 m class
SHIELD_LENGTH, SHIELD_RADIUS = 4.0, 1.53  # [M]‡ 13 ft long, 10 ft in diameter
DOOR_RADIUS, DOOR_OPENING = 1.53, np.radians(105.0)  # [M]‡ 10 ft across, opens 105° at most
ARRAY_LENGTH, ARRAY_WIDTH = 7.1, 2.6  # [M]‡
ARRAY_MAST = 4 * 0.3048  # [R]
# In flight both wings face the sun together; unequal angles distinguish the two sides.
ARRAY_ANGLES = {"plus-v2": np.radians(24.0), "minus-v2": np.radians(-38.0)}
ANTENNA_DIAMETER = 1.3  # class of the steerable dishes
PIN_RADIUS, PIN_LENGTH, SCUFF_RADIUS = 0.5 * 0.0762, 0.2413, 0.5 * 0.5588  # [T]

EQUIPMENT = AFT + SHROUD_LENGTH
TAPER = EQUIPMENT + EQUIPMENT_LENGTH
SHELL = TAPER + TAPER_LENGTH
SHIELD = SHELL + SHELL_LENGTH
FRONT = SHIELD + SHIELD_LENGTH
AXIS, Y_AXIS = np.eye(3)[0], np.eye(3)[1]


def radial(angle_deg: float) -> Array:
    """Outward unit vector at a clock angle about V1: 0° is +V2, 90° is +V3."""
    angle = np.radians(angle_deg)
    return np.array([0.0, np.cos(angle), np.sin(angle)])


def at(x: float, radius: float, angle_deg: float) -> Array:
    """Point at station x, `radius` off the axis, at a clock angle."""
    return np.array([x, 0.0, 0.0]) + radius * radial(angle_deg)


def tube_parts() -> list[Part]:
    """The four cans of the support systems module, the baffled inside and the door."""
    shell = frustum((SHELL, 0, 0), (SHIELD + 0.05, 0, 0), SHELL_RADIUS, SHELL_RADIUS, 64)
    taper = frustum((TAPER, 0, 0), (SHELL, 0, 0), EQUIPMENT_RADIUS - 0.1, SHELL_RADIUS, 64)
    equipment = frustum((EQUIPMENT, 0, 0), (TAPER, 0, 0), EQUIPMENT_RADIUS, EQUIPMENT_RADIUS, 48)
    shroud = revolve(
        [(0.08, 0.0), (0.08, 1.5), (0.0, 1.55), (0.0, SHROUD_RADIUS - 0.06), (0.06, SHROUD_RADIUS),
         (SHROUD_LENGTH - 0.06, SHROUD_RADIUS), (SHROUD_LENGTH, SHROUD_RADIUS - 0.06),
         (SHROUD_LENGTH, 0.0)],
        (AFT, 0, 0), AXIS, 64,
    )  # fmt: skip
    inner = SHIELD_RADIUS - 0.06
    liner = [tube((SHIELD, 0, 0), AXIS, (0.0, 3.9), (inner - 0.03, inner + 0.01), 64)]
    for x in (0.9, 1.8, 2.7, 3.4):
        liner.append(tube((SHIELD, 0, 0), AXIS, (x, x + 0.03), (inner - 0.14, inner), 64))
    hinge = at(FRONT, SHIELD_RADIUS + 0.02, 90.0)
    across = np.array([np.sin(DOOR_OPENING), 0.0, -np.cos(DOOR_OPENING)])  # closed: −Z
    facing = np.array([across[2], 0.0, -across[0]])  # the door's inner, black side
    middle = hinge + (DOOR_RADIUS + 0.04) * across
    door = frustum(middle - 0.04 * facing, middle, DOOR_RADIUS, DOOR_RADIUS, 64)
    lining = frustum(middle - 0.01 * facing, middle + 0.012 * facing, 1.46, 1.46, 64)
    ribs = [
        box((2.6, 0.06, 0.05), middle - 0.06 * facing + y * np.array([0.0, 1.0, 0.0]),
            np.column_stack([across, [0.0, 1.0, 0.0], facing]))
        for y in (-0.5, 0.5)
    ]  # fmt: skip
    knuckles = [box((0.22, 0.28, 0.2), hinge + np.array([-0.03, y, 0.0])) for y in (-0.5, 0.5)]
    rings = [tube((x, 0, 0), AXIS, (-0.03, 0.03), (r - 0.02, r + 0.035), 64)
             for x, r in ((SHELL + 0.06, SHELL_RADIUS), (SHELL + 2.1, SHELL_RADIUS),
                          (SHIELD, SHELL_RADIUS), (SHIELD + 2.0, SHIELD_RADIUS),
                          (FRONT - 0.03, SHIELD_RADIUS))]  # fmt: skip
    return [
        Part("aft-shroud", shroud, SILVER),
        Part("equipment-section", equipment, WHITE),
        Part("taper", taper, GREY),
        Part("forward-shell", shell, SILVER),
        Part("light-shield", tube((SHIELD, 0, 0), AXIS, (0.0, SHIELD_LENGTH),
                                  (inner, SHIELD_RADIUS), 64), SILVER),
        Part("light-shield-baffles", joined(*liner), BLACK),
        Part("shell-rings", joined(*rings), GREY),
        Part("aperture-door", door, SILVER),
        Part("aperture-door-lining", lining, BLACK),
        Part("aperture-door-ribs", joined(*ribs), GREY),
        Part("aperture-door-hinge", joined(*knuckles), DARK),
    ]  # fmt: skip


def array_parts(side: str, sign: float) -> list[Part]:
    """One third-generation array: mast, drive, spar and eight rigid panels."""
    x = SHELL + 1.9
    rotation = turn((0, 1, 0), ARRAY_ANGLES[side])
    root = SHELL_RADIUS + ARRAY_MAST
    middle = np.array([x, sign * (root + 0.5 * ARRAY_WIDTH), 0.0])
    drive = cylinder((x, sign * 1.4, 0), (x, sign * 1.86, 0), 0.2, 20)
    mast = cylinder((x, sign * 1.5, 0), middle + sign * 1.2 * Y_AXIS, 0.065, 12)
    frame_bars = [
        box((ARRAY_LENGTH, 0.06, 0.06), middle + rotation @ [0.0, y, -0.04], rotation)
        for y in (-0.64, 0.64)
    ] + [box((0.1, 2.5, 0.09), middle + rotation @ [0.0, 0.0, -0.04], rotation)]  # fmt: skip
    parts = [
        Part(f"array-{side}-drive", drive, DARK),
        Part(f"array-{side}-mast", mast, GREY),
        Part(f"array-{side}-frame", joined(*frame_bars), GREY),
    ]
    size = ((ARRAY_LENGTH - 3 * 0.06) / 4, (ARRAY_WIDTH - 0.06) / 2)
    for i in range(4):
        for j in range(2):
            offset = [(i - 1.5) * (size[0] + 0.06), (j - 0.5) * (size[1] + 0.06), 0.0]
            parts += solar_panel(
                f"array-{side}-{i}{j}", middle + rotation @ offset, rotation, size, (5, 3)
            )
    return parts


def antenna_parts(
    name: str, x: float, angle_deg: float, reach: float, pointing: tuple[float, float, float]
) -> list[Part]:
    """One high-gain antenna on its deployed boom, with gimbal, dish and feed."""
    tip = at(x, reach, angle_deg)
    look = unit(pointing)
    vertex = tip + 0.16 * look
    boom = cylinder(at(x, 1.45, angle_deg), tip, 0.06, 12)
    feed = [
        vertex + 0.46 * look,
        *(vertex + 0.14 * look + frame(look) @ (0.45 * radial(a)) for a in (90, 210, 330)),
    ]
    struts = [cylinder(foot, feed[0], 0.015, 6) for foot in feed[1:]]
    return [
        Part(f"antenna-{name}-boom", boom, GREY),
        Part(f"antenna-{name}-hinge", box((0.3, 0.3, 0.3), at(x, SHELL_RADIUS, angle_deg)), DARK),
        Part(f"antenna-{name}-gimbal", box((0.28, 0.24, 0.24), tip, frame(look)), DARK),
        Part(f"antenna-{name}-dish", dish(vertex, look, ANTENNA_DIAMETER, 0.24), WHITE),
        Part(f"antenna-{name}-feed", joined(
            cylinder(vertex + 0.4 * look, vertex + 0.52 * look, 0.07, 12), *struts), GREY),
    ]  # fmt: skip


def trunnion(x: float, radius: float, angle_deg: float) -> list[Part]:
    """Shuttle payload-bay pin with its scuff plate, standing out of the hull."""
    out = radial(angle_deg)
    foot = at(x, radius + 0.12, angle_deg)
    name = f"trunnion-{angle_deg:.0f}-{'aft' if x < -1.6 else 'forward'}"
    fairing = frustum(foot - 0.3 * out, foot, 0.36, SCUFF_RADIUS, 20)
    pin = cylinder(foot - 0.02 * out, foot + PIN_LENGTH * out, PIN_RADIUS, 12)
    return [Part(name, fairing, GREY), Part(f"{name}-pin", pin, FOIL)]


def fittings() -> list[Part]:
    """Pins, grapple fixture, trackers, radiator, bay doors, torquers, rails, antennas."""
    parts: list[Part] = []
    for k, angle in enumerate((90.0, 210.0, 330.0)):  # the three pins of the service cradle
        foot = at(AFT, 1.8, angle)
        side = np.cross(radial(angle), AXIS)
        post = cylinder(foot + 0.05 * AXIS, foot - 0.3 * AXIS, 0.05, 12)
        head = foot - 0.27 * AXIS
        bar = cylinder(head - 0.2 * side, head + 0.2 * side, 0.04, 10)
        base = box((0.1, 0.4, 0.5), foot, frame(AXIS, up=side))
        parts.append(Part(f"berthing-pin-{k + 1}", joined(post, bar, base), GREY))
    umbilical = box((0.16, 0.5, 0.34), (AFT + 0.02, 0.75, -0.55))
    parts.append(Part("umbilical-panel", umbilical, DARK))
    parts.append(Part("aft-low-gain-antenna", frustum(
        (AFT + 0.1, -0.7, 0.5), (AFT - 0.38, -0.7, 0.5), 0.09, 0.03, 16), WHITE))  # fmt: skip
    for x, radius, angle in ((-2.6, EQUIPMENT_RADIUS, 0.0), (-2.6, EQUIPMENT_RADIUS, 180.0),
                             (-2.6, EQUIPMENT_RADIUS, 270.0), (-0.9, SHELL_RADIUS, 15.0),
                             (-0.9, SHELL_RADIUS, 165.0)):  # fmt: skip
        parts += trunnion(x, radius, angle)

    out = radial(222.0)  # grapple fixture: base plate, shaft and three cam arms
    foot = at(0.35, SHELL_RADIUS, 222.0)
    axes = frame(out)
    arms = [
        cylinder(foot + 0.08 * out, foot + 0.1 * out + axes @ (0.28 * radial(a)), 0.03, 8)
        for a in (90, 210, 330)
    ]
    parts.append(Part("grapple-fixture", joined(
        frustum(foot - 0.1 * out, foot + 0.07 * out, 0.36, 0.3, 24),
        cylinder(foot, foot + 0.42 * out, 0.03, 10), *arms), GREY))  # fmt: skip

    for k, (angle, lean) in enumerate(((256.0, -0.5), (284.0, -0.5), (300.0, -0.3))):
        look = unit(radial(angle) + lean * AXIS)  # star-tracker light shades
        foot = at(EQUIPMENT - 0.25, SHROUD_RADIUS - 0.25, angle)
        parts.append(
            Part(f"star-tracker-{k + 1}", frustum(foot, foot + 0.75 * look, 0.12, 0.24, 20), DARK)
        )

    deg = np.radians
    for k in range(10):  # [M]‡ ten equipment bays
        if k in (2, 7):  # these two stay flush, as doors under the antennas' masts
            continue
        span = (deg(36 * k + 4), deg(36 * k + 32))
        proud = 0.06 + (0.09 if k in (1, 5, 8) else 0.0)
        door = patch((EQUIPMENT + 0.12, TAPER - 0.12), span,
                     (EQUIPMENT_RADIUS - 0.1, EQUIPMENT_RADIUS + proud), 6)  # fmt: skip
        parts.append(Part(f"bay-door-{k + 1}", door, FOIL if k in (1, 5, 8) else SILVER))
    radiator = patch((AFT + 0.1, AFT + 4.1), (deg(20), deg(44)), (2.16, 2.2), 6)  # [S]
    parts.append(Part("nicmos-radiator", radiator, WHITE))
    for k, angle in enumerate((60.0, 150.0, 240.0)):  # fine-guidance and camera radiators
        span = (deg(angle - 17.0), deg(angle + 17.0))
        cover = patch((AFT + 1.1, AFT + 2.9), span, (2.0, SHROUD_RADIUS + 0.07), 8)
        parts.append(Part(f"instrument-cover-{k + 1}", cover, WHITE))
    camera = moved(box((0.8, 2.0, 0.3), (AFT + 1.9, 0.0, 0.0)), turn(AXIS, deg(35.0)),
                   2.1 * radial(305.0))  # fmt: skip
    parts.append(Part("wide-field-camera-radiator", camera, WHITE))

    for k, angle in enumerate((45.0, 135.0, 225.0, 315.0)):  # magnetic torquers
        ends = (SHELL + 0.7, SHELL + 3.2) if k % 2 else (SHELL + 0.9, SHELL + 3.4)
        bar = cylinder(at(ends[0], 1.68, angle), at(ends[1], 1.68, angle), 0.06, 12)
        feet = [box((0.1, 0.12, 0.24), at(x, 1.61, angle), turn(AXIS, deg(angle - 90.0)))
                for x in (ends[0] + 0.2, ends[1] - 0.2)]  # fmt: skip
        parts.append(Part(f"torquer-{k + 1}", joined(bar, *feet), DARK))
    rails = [
        handrail(at(x0, r, a), at(x1, r, a), radial(a))
        for a in (8.0, 80.0, 112.0, 188.0, 262.0, 335.0)
        for x0, x1, r in ((AFT + 0.3, AFT + 1.7, SHROUD_RADIUS), (AFT + 1.9, AFT + 3.3,
                          SHROUD_RADIUS), (SHELL + 0.3, SHELL + 1.5, SHELL_RADIUS))
    ]  # fmt: skip
    rails += [
        handrail(at(SHIELD + 0.5, SHIELD_RADIUS, a), at(SHIELD + 1.8, SHIELD_RADIUS, a), radial(a))
        for a in (30.0, 200.0, 290.0)
    ]
    parts.append(Part("handrails", joined(*rails), YELLOW))
    sensor = joined(
        box((0.5, 0.36, 0.3), at(FRONT - 0.5, SHIELD_RADIUS + 0.06, 0.0)),
        cylinder(at(FRONT - 0.4, 1.6, 0.0), at(FRONT - 0.4, 2.0, 0.0), 0.07, 12),
    )
    parts.append(Part("magnetometer-and-sun-sensor", sensor, GREY))
    parts.append(
        Part(
            "forward-low-gain-antenna",
            frustum(at(FRONT - 0.7, 1.45, 232.0), at(FRONT - 0.7, 2.1, 232.0), 0.1, 0.03, 16),
            WHITE,
        )
    )
    return parts  # fmt: skip


def build() -> list[Part]:
    """All parts of the vehicle in its target frame, metres."""
    return [
        *tube_parts(),
        *array_parts("plus-v2", 1.0),
        *array_parts("minus-v2", -1.0),
        *antenna_parts("plus-v3", SHELL + 0.7, 90.0, 3.55, (0.25, 0.55, 0.8)),
        *antenna_parts("minus-v3", SHELL + 0.7, 270.0, 3.05, (-0.75, -0.35, -0.55)),
        *fittings(),
    ]


FRAME = """
Target frame of the Hubble Space Telescope, metres:
  +X = V1, along the telescope towards the aperture
  +Y = V2, parallel to the solar-array masts
  +Z = V3, parallel to the antenna masts; this model puts the door's hinge on this side
Origin on the telescope's axis, half-way along the 13.2 m tube (aft bulkhead at x = -6.6).
Written by build.py: change that and run it again.
"""
DESCRIPTION = "Hubble Space Telescope, door open, third-generation arrays at unequal angles"
VIEW = View(
    eye=(19.5, 18.5, 10.0), look_at=(1.3, 0.5, 0.35), sun=(0.75, 0.2, 0.75), focal_px=1000.0
)

if __name__ == "__main__":
    files.main("hubble", build(), files.target_text("hubble", DESCRIPTION, FRAME), VIEW, HERE)
