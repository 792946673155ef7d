"""Builds a servicing client: a geostationary satellite of no particular make.

Run `python models_cad/client/build.py [FOLDER] [--no-picture]`.

Target frame, metres: X along the bus, the launch-adapter ring on the −X face, the
Earth-side antennas on +X; Y along the solar wings; Z completes the right-handed frame.
Origin at the centre of the box-shaped bus.

Sources of the dimensions:
    [A] Launch adapters of the 1194 mm class: "Proton Launch System Mission Planner's
        Guide", rev. 7 (2009), appendix D.2, adapter 1194VX; the satellite's side of the
        clamp band, 1194 mm across‡.
    [B] Book, Bryan, Howard and Dabney, "Autoguidance Video Sensor for Docking",
        N93-11954: three retro-reflectors, 14.5 in wide, middle one on a 4 in pole; a
        second target of another size for the other end of the range.
    [E] ArianeGroup, data sheet of the 400 N apogee engine S400-12: 244 mm nozzle‡.
Figures marked ‡ are quoted without the document at hand. The bus, wings and antennas are
this project's own, of a size usual for such satellites.
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
    BLACK, DARK, FOIL, GREY, RETRO, SILVER, WHITE, Array, Part, Vector, box, cylinder, dish,
    frame, frustum, joined, revolve, solar_panel, tube, turn, unit,
)  # fmt: skip
from models_cad.picture import View  # noqa: E402
# isort: on

INCH = 0.0254
BUS = np.array([2.8, 2.2, 2.4])
RING_RADIUS = 0.597  # [A] half of 1194 mm, the end frame's outer edge
RING_STANDOFF = 0.28  # end frame's distance from the −X face
NOZZLE_RADIUS = 0.5 * 0.244  # [E]
FAR_WIDTH, FAR_POLE = 14.5 * INCH, 4.0 * INCH  # [B]
NEAR_SCALE = 0.4  # the near target, of the same shape, fills the image at 0.4 × the range
REFLECTOR_DIAMETER = {"far": 0.025, "near": 0.012}
TARGET_STANDOFF = 0.14  # pedestals keep the reflectors clear of the foil
# Circles about the ring's axis that pictures show beside its outer edge: height over its plane,
# radius. Foot, cone where it leaves the foot, heat shield, end frame's inner edge, nozzle's mouth.
CIRCLES = ((-0.25, 0.71), (-0.25, 0.6466), (-0.25, 0.44), (0.0, 0.557), (0.07, 0.142))
TARGETS = {"far": (0.0, 0.94), "near": (-0.80, -0.86)}  # (y, z) of the poles, own choice
WING_ANGLES = {"plus-y": np.radians(-22.0), "minus-y": np.radians(-48.0)}
PANEL = (2.1, 1.9)  # (across, along the wing)
PANELS = 3

BACK = -0.5 * BUS[0]
RING_X = BACK - RING_STANDOFF
AFT = np.array([-1.0, 0.0, 0.0])


def bus_parts() -> list[Part]:
    """The box, its radiators, and the things on its faces."""
    half = 0.5 * BUS
    parts = [Part("bus", box(BUS, (0.0, 0.0, 0.0)), FOIL)]
    for name, sign in (("plus-y", 1.0), ("minus-y", -1.0)):
        centre = (0.15, sign * half[1], 0.1)
        parts.append(Part(f"radiator-{name}", box((2.0, 0.06, 1.9), centre), WHITE))
    deck = box((0.08, 2.3, 2.5), (half[0], 0.0, 0.0))
    tower = box((0.7, 0.9, 0.8), (half[0] + 0.3, -0.45, -0.5))
    parts += [Part("earth-deck", deck, WHITE), Part("feed-tower", tower, SILVER)]
    parts.append(Part("electronics", joined(
        box((0.6, 0.5, 0.24), (-0.5, 0.45, half[2] + 0.08)),
        box((0.4, 0.3, 0.16), (0.3, -0.65, half[2] + 0.05))), SILVER))  # fmt: skip
    parts.append(Part("star-trackers", joined(*(
        frustum((-0.9, y, -half[2] + 0.05), (-1.05, 1.2 * y, -half[2] - 0.4), 0.09, 0.16, 20)
        for y in (-0.35, -0.75))), DARK))  # fmt: skip
    parts.append(Part("battery-box", box((0.9, 0.8, 0.2), (0.5, 0.45, -half[2] - 0.06)), SILVER))
    thrusters = [
        frustum((BACK + 0.02, sy * 0.98, sz * 1.08), (BACK - 0.14, sy * 1.03, sz * 1.13),
                0.03, 0.06, 14)
        for sy, sz in ((1, 1), (-1, 1), (1, -1), (-1, -1))
    ]  # fmt: skip
    parts.append(Part("thrusters", joined(*thrusters), DARK))
    helix = cylinder((0.9, 0.75, half[2] - 0.05), (0.9, 0.75, half[2] + 0.95), 0.07, 14)
    parts.append(
        Part(
            "telemetry-antenna",
            joined(
                helix, frustum((0.9, 0.75, half[2]), (0.9, 0.75, half[2] + 0.12), 0.2, 0.16, 20)
            ),
            WHITE,
        )
    )
    return parts  # fmt: skip


def adapter_parts() -> list[Part]:
    """The conical adapter with its end frame, and the apogee engine inside it."""
    face, length = (BACK + 0.02, 0.0, 0.0), RING_STANDOFF + 0.02
    cone = revolve(
        [(0.0, 0.63), (0.0, 0.66), (length - 0.02, 0.585), (length - 0.02, 0.555)], face, AFT, 72
    )
    rim = tube((RING_X, 0, 0), AFT, (-0.035, 0.0), (RING_RADIUS - 0.04, RING_RADIUS), 72)
    foot = tube((BACK, 0, 0), AFT, (-0.02, 0.03), (0.62, 0.71), 72)
    shield = frustum((BACK + 0.02, 0, 0), (BACK - 0.03, 0, 0), 0.46, 0.44, 36)
    stations = np.linspace(0.0, 1.0, 8)
    outer = NOZZLE_RADIUS * (0.28 + 0.72 * np.sqrt(stations)) + 0.02  # bell, 2 cm wall
    along = 0.03 + 0.30 * stations
    bell = np.vstack(
        [np.column_stack([along, outer]), np.column_stack([along, outer - 0.02])[::-1]]
    )
    chamber = cylinder((BACK + 0.02, 0, 0), (BACK - 0.06, 0, 0), 0.075, 20)
    return [
        Part("adapter-cone", cone, GREY),
        Part("docking-ring", rim, SILVER),
        Part("adapter-foot", foot, GREY),
        Part("engine-heat-shield", shield, SILVER),
        Part("engine-chamber", chamber, DARK),
        Part("engine-nozzle", revolve(bell, (BACK - 0.02, 0, 0), AFT, 36), DARK),
    ]


def reflector_positions(group: str) -> dict[str, Array]:
    """Centres of a target's three reflector faces: left and right seen from −X, Z up."""
    scale = 1.0 if group == "far" else NEAR_SCALE
    y, z = TARGETS[group]
    foot = np.array([BACK - TARGET_STANDOFF, y, z])
    half = np.array([0.0, 0.5 * FAR_WIDTH * scale, 0.0])
    return {
        f"{group}-left": foot + half,  # looking along +X with Z up, +Y is on the left
        f"{group}-middle": foot + FAR_POLE * scale * AFT,
        f"{group}-right": foot - half,
    }


def target_parts(group: str) -> list[Part]:
    """One three-reflector docking target on its pedestal."""
    scale = 1.0 if group == "far" else NEAR_SCALE
    y, z = TARGETS[group]
    spots = reflector_positions(group)
    radius = 0.5 * REFLECTOR_DIAMETER[group]
    plate_x = BACK - TARGET_STANDOFF + 0.004  # reflectors protrude 4 mm from the black plate
    width = FAR_WIDTH * scale
    plate = box((0.024, width + 0.08, 0.36 * width + 0.03), (plate_x + 0.012, y, z))
    pedestal = box((TARGET_STANDOFF, 0.5 * width, 0.09), (BACK - 0.45 * TARGET_STANDOFF, y, z))
    middle = spots[f"{group}-middle"]
    pole = cylinder((plate_x + 0.01, y, z), middle - 0.004 * AFT, max(0.8 * radius, 0.006), 14)
    faces = [cylinder(spot - 0.012 * AFT, spot, radius, 20) for spot in spots.values()]
    return [
        Part(f"target-{group}-plate", plate, BLACK),
        Part(f"target-{group}-pedestal", pedestal, GREY),
        Part(f"target-{group}-pole", pole, DARK),
        Part(f"target-{group}-reflectors", joined(*faces), RETRO),
    ]


def wing_parts(side: str, sign: float) -> list[Part]:
    """A solar wing: drive, V-shaped yoke, three panels; turned by its own angle about Y."""
    rotation = turn((0, 1, 0), WING_ANGLES[side])
    root = np.array([0.1, sign * 0.5 * BUS[1], 0.0])
    across, out = rotation @ [1.0, 0.0, 0.0], np.array([0.0, sign, 0.0])
    start, fork, edge = root + 0.0 * out, root + 0.45 * out, root + 1.25 * out
    yoke = [cylinder(start, fork, 0.06, 12)]
    yoke += [cylinder(fork, edge + s * 0.7 * across, 0.035, 10) for s in (-1.0, 1.0)]
    yoke.append(cylinder(edge - 0.95 * across, edge + 0.95 * across, 0.035, 10))
    parts = [
        Part(f"drive-{side}", cylinder(root - 0.1 * out, root + 0.16 * out, 0.16, 24), DARK),
        Part(f"yoke-{side}", joined(*yoke), GREY),
    ]
    hinges = []
    for k in range(PANELS):
        centre = edge + (0.05 + (k + 0.5) * PANEL[1] + 0.06 * k) * out
        parts += solar_panel(f"wing-{side}-{k + 1}", centre, rotation, PANEL, (7, 6))
        for s in (-0.6, 0.6):
            at = centre - (0.5 * PANEL[1] + 0.03) * out + s * across
            hinges.append(box((0.08, 0.16, 0.05), at, rotation))
    return [*parts, Part(f"hinges-{side}", joined(*hinges), DARK)]


def antenna(name: str, mount: Vector, vertex: Vector, axis: Vector, diameter: float) -> list[Part]:
    """Dish on a strut from `mount`, with a feed on three legs if it is small."""
    look, base = unit(axis), np.asarray(vertex, float)
    parts = [
        Part(f"{name}-dish", dish(base, look, diameter, 0.16 * diameter, sections=48), WHITE),
        Part(f"{name}-strut", cylinder(mount, base - 0.01 * look, 0.05, 12), GREY),
    ]
    if diameter < 1.5:
        focus = base + 0.42 * diameter * look
        ends = [base + 0.1 * diameter * look + frame(look) @ [0, 0.38 * diameter * np.cos(a),
                0.38 * diameter * np.sin(a)] for a in (0.5, 2.6, 4.7)]  # fmt: skip
        legs = [cylinder(end, focus, 0.016, 8) for end in ends]
        horn = frustum(focus + 0.08 * look, focus - 0.08 * look, 0.05, 0.08, 16)
        parts.append(Part(f"{name}-feed", joined(horn, *legs), DARK))
    return parts


def build() -> list[Part]:
    """All parts of the vehicle in its target frame, metres."""
    half = 0.5 * BUS
    return [
        *bus_parts(),
        *adapter_parts(),
        *target_parts("far"),
        *target_parts("near"),
        *wing_parts("plus-y", 1.0),
        *wing_parts("minus-y", -1.0),
        *antenna("large", (0.9, -0.2, half[2] - 0.1), (0.75, -0.35, half[2] + 1.15),
                 (0.8, 0.05, -0.35), 2.2),
        *antenna("small", (half[0], 0.55, 0.5), (half[0] + 0.5, 0.6, 0.6), (0.9, 0.3, 0.2), 0.9),
    ]  # fmt: skip


def features() -> list[str]:
    """Docking ring and reflectors for target.toml."""
    tables = [
        files.feature("[docking_ring]", centre_m=(RING_X, 0.0, 0.0), axis=AFT, radius_m=RING_RADIUS)
    ]
    for height, radius in CIRCLES:
        tables.append(files.feature("[[docking_ring.circles]]", height_m=height, radius_m=radius))
    for group, diameter in REFLECTOR_DIAMETER.items():
        for name, position in reflector_positions(group).items():
            tables.append(files.feature("[[reflectors]]", name=name, group=group,
                          position_m=position, normal=AFT, diameter_m=diameter))  # fmt: skip
    return tables


FRAME = """
Target frame of the servicing client, metres:
  X along the bus: the docking (launch-adapter) ring faces -X, the Earth deck +X
  Y along the solar wings: the telemetry antenna is beside the +Y wing
  Z completes the right-handed frame: the large dish is on the +Z side
Origin at the centre of the 2.8 x 2.2 x 2.4 m bus.
Reflectors: 'left' is +Y, which is on the left when looking along +X with Z up.
Written by build.py: change that and run it again.
"""
DESCRIPTION = "geostationary servicing client: 1194 mm ring, two three-reflector targets"
VIEW = View(eye=(-10.5, -12.0, 7.5), look_at=(0.0, -1.15, -0.05), sun=(-0.75, -0.35, 0.7),
            focal_px=710.0)  # fmt: skip

if __name__ == "__main__":
    target = files.target_text("client", DESCRIPTION, FRAME, features())
    files.main("client", build(), target, VIEW, HERE)
