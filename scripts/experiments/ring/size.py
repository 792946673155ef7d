"""`calibrate ring` on drawn fly-arounds: pictures, a beam on the mesh, R and D_f from them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from experiments.frame import nees, show, table_of, two
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.sequences.frame import Frame
from rendezview.io.sequences.images import write_png
from rendezview.sensors.observation import Status
from rendezview.sensors.ring.rectangle import Beam
from rendezview.sensors.ring.ring_pass import PassSize
from rendezview.sensors.ring.size_run import Echo, SizeResult, SizeSensor, size_of_frames
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.ranger import echo
from rendezview_ground.simulate.scene import SceneOptions, render_frame
from rendezview_ground.simulate.trajectories import looking_at

RADIUS_M, PANEL_M = 0.597, (8.0, 2.4)  # the method knows neither
SIDES = 360  # of a drawn circle: a polygon within 0.003 % of it
CAMERA = Camera.from_fov(1024, 1024, math.radians(42.0))
BEAM_M, RANGE_SIGMA_M = (0.15, 0.1, 0.0), 0.005
POINTING_RAD = math.radians(0.4)
NEAR, FAR = ((-50.0, -25.0), (25.0, 50.0)), ((-58.0, -36.0), (36.0, 58.0))  # two arcs, degrees
CASES = {
    "plain": "ring of 0.25 before a panel of 0.6, 12 m",
    "varied": "any width, shades, range and Sun",
    "hole": "the same, a disc of any shade in it",
    "plate": "varied, a plate of any shade behind it",
    "no outer": "a plate of its shade touches it: R shows in its shadow at most",
    "no inner": "a disc of its shade in it",
}
MOST_NEES = 25.0  # of R and D_f in a right answer: noise exceeds it once in 270,000


@dataclass(frozen=True, slots=True, kw_only=True)
class Craft:
    """A ring before a panel, and how it is flown round. Shades are albedos."""

    width_m: float = 0.12
    distance_m: float = 1.68
    offset_m: tuple[float, float] = (0.0, 0.0)
    panel: float = 0.6
    ring: float = 0.25
    disc: tuple[float, float, float] | None = None  # shade, radius, depth behind the ring
    plate: tuple[float, float] | None = None  # shade, depth behind the ring
    range_m: float = 12.0
    sun_rad: tuple[float, float] = (0.5, 0.0)  # from the line of sight, and about it
    sun_fixed: bool = False  # to the craft instead of the camera
    arcs_deg: tuple[tuple[float, float], ...] = NEAR

    def mesh(self) -> Mesh:
        """Panel in the plane x = 0, the ring's front at x = D_f."""
        panel = trimesh.creation.box((0.002, *PANEL_M))
        panel.apply_translation([-0.001, 0.0, 0.0])
        hole = RADIUS_M - self.width_m
        ring = trimesh.creation.annulus(hole, RADIUS_M, 0.002, sections=SIDES)
        parts = [(panel, self.panel), (self._placed(ring, 0.0), self.ring)]
        if self.disc is not None:
            shade, radius_m, depth_m = self.disc
            disc = trimesh.creation.cylinder(radius_m, 0.002, sections=SIDES)
            parts.append((self._placed(disc, depth_m), shade))
        if self.plate is not None:
            plate = trimesh.creation.box((1.3, 1.3, 0.002))
            parts.append((self._placed(plate, self.plate[1]), self.plate[0]))
        starts = np.cumsum([0, *(len(part.vertices) for part, _ in parts)])
        faces = np.vstack([p.faces + n for (p, _), n in zip(parts, starts, strict=False)])
        grey = np.repeat([shade for _, shade in parts], [len(part.faces) for part, _ in parts])
        vertices = np.vstack([part.vertices for part, _ in parts])
        colours = np.repeat(grey[:, None], 3, axis=1).astype(np.float32)
        return Mesh(vertices, faces.astype(np.int32), colours, ())

    def _placed(self, part: trimesh.Trimesh, depth_m: float) -> trimesh.Trimesh:
        part.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
        part.apply_translation([self.distance_m - 0.001 - depth_m, *self.offset_m])
        return part


def craft(case: str, rng: np.random.Generator) -> Craft:
    """A random one of a case."""
    draw = rng.uniform
    sun = math.radians(draw(20.0, 40.0)), draw(0.0, math.tau)
    one = Craft(sun_rad=sun, offset_m=(draw(-0.08, 0.08), draw(-0.08, 0.08)))
    if case == "plain":
        return one
    width_m, panel, ring = draw(0.04, 0.15), draw(0.2, 0.7), draw(0.05, 0.7)
    range_m, phase = math.exp(draw(math.log(11.0), math.log(20.0))), math.radians(draw(10.0, 60.0))
    distance_m, fixed = draw(1.5, 2.0), bool(draw() < 0.5)
    one = replace(
        one, width_m=width_m, panel=panel, ring=ring, range_m=range_m, sun_rad=(phase, sun[1]),
        distance_m=distance_m, sun_fixed=fixed,
    )  # fmt: skip
    middle_m, shade = RADIUS_M - 0.5 * width_m, draw(0.05, 0.7) if case != "varied" else 0.0
    changes: dict[str, dict[str, object]] = {
        "varied": {},
        "hole": {"disc": (shade, middle_m, 0.01)},
        "plate": {"plate": (shade, 0.3), "arcs_deg": FAR},
        "no outer": {
            "disc": (shade, RADIUS_M - width_m, 0.0), "plate": (ring, 0.006), "arcs_deg": FAR,
        },
        "no inner": {"disc": (ring, middle_m, 0.01)},
    }  # fmt: skip
    return replace(one, **changes[case])  # type: ignore[arg-type]


def poses(one: Craft, frames: int, rng: np.random.Generator) -> Iterator[Pose]:
    """Of a camera that looks at the panel's middle, nearly."""
    counts = (frames // 2, frames - frames // 2)
    arcs = [np.linspace(*arc, n) for arc, n in zip(one.arcs_deg, counts, strict=True)]
    for angle in np.radians(np.concatenate(arcs)):
        out = np.array([math.cos(angle), math.sin(angle), 0.05 * rng.standard_normal()])
        out *= one.range_m / np.linalg.norm(out)
        shaken = np.array([*rng.normal(0.0, POINTING_RAD, 2), rng.normal(0.0, math.radians(2.0))])
        turned = Pose(Rotation.from_rotvec(shaken).as_matrix(), np.zeros(3))
        yield turned @ looking_at(out, np.zeros(3), [0.0, 0.0, 1.0])


def measured(one: Craft, frames: int, rng: np.random.Generator, keep: Path | None) -> SizeResult:
    """Draw a pass and measure it."""
    mesh, sensor, found = one.mesh(), SizeSensor(), []
    (phase, azimuth), origin = one.sun_rad, np.array(BEAM_M)
    side = math.sin(phase) * np.array([math.cos(azimuth), math.sin(azimuth)])
    for k, pose in enumerate(poses(one, frames, rng)):
        sun = np.array([*side, -math.cos(phase)])
        if one.sun_fixed:
            sun = pose.rotation @ np.array([math.cos(phase), *side])
        image = render_frame(mesh, CAMERA, pose, sun, SceneOptions(), rng)
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            write_png(keep / f"{k:03d}.png", image)
        range_m = echo(mesh, pose, BEAM_M, (0.0, 0.0, 1.0))
        noisy = None
        if range_m is not None:
            range_m += RANGE_SIGMA_M * rng.standard_normal()
            noisy = Echo(range_m, RANGE_SIGMA_M, Beam(origin))
        frame = Frame(k, str(k), None, CAMERA, pose, 1, partial(np.copy, image))
        found.append(sensor.measure(frame, noisy))
    return size_of_frames([frame for frame in found if frame.sights], frames)


def errors(size: PassSize, one: Craft) -> tuple[Array, float]:
    """(2,) of R and D_f in per cent, and their NEES."""
    off = np.array([size.radius_m - RADIUS_M, size.distance_m - one.distance_m])
    return 100.0 * off / (RADIUS_M, one.distance_m), nees(off, size.covariance[:2, :2])


def run(
    *, seed: int = 77, passes: Annotated[int, "of each case"] = 30,
    frames: Annotated[int, "of a pass"] = 12, cases: list[str] | None = None,
    keep: Annotated[Path | None, "a folder for the pictures"] = None,
) -> None:  # fmt: skip
    """R and D_f of a ring before a panel, from drawn pictures and a beam that meets the mesh.

    1024 × 1024 px over 42°, two arcs of a fly-around in the panel's long plane, the ring's axis up
    to 8 cm off the panel's middle. Other cases draw the ring's width (4–15 cm), shades (0.05–0.7),
    the range (11–20 m) and the Sun (10–60° off the camera or, in half of the passes, off the
    panel's normal). An answer is right if the NEES of R and D_f is below 25, and R within 3 %.
    """
    title = f"drawn fly-arounds, {passes} passes of {frames} frames a case, seed {seed}"
    columns = "case | what | right | open | wrong | R, % | D_f, % | NEES of two"
    rows = table_of(f"{title}: median / 95 %, NEES mean / largest", columns, left=2)
    for case in cases or CASES:
        counts: Counter[str] = Counter()
        right = []
        for number in range(passes):
            one = craft(case, np.random.default_rng([seed, number]))
            folder = None if keep is None else keep / case.replace(" ", "-") / f"{number:03d}"
            result = measured(one, frames, np.random.default_rng([seed + 1, number]), folder)
            if result.status is not Status.OK or result.size is None:
                counts["open"] += 1
                print(f"{case} {number}: {result.reason}")
                continue
            off, spread = errors(result.size, one)
            if spread > MOST_NEES or abs(off[0]) > 3.0:
                counts["wrong"] += 1
                print(f"{case} {number}: R {off[0]:+.2f} %, D_f {off[1]:+.2f} %, NEES {spread:.0f}")
                continue
            right.append((*np.abs(off), spread))
        table = np.array(right).reshape(-1, 3)
        spreads = f"{table[:, 2].mean():.1f} / {table[:, 2].max():.1f}" if right else "–"
        figures = [two(table[:, k]) if right else "–" for k in (0, 1)]
        found = [str(len(right)), *(str(counts[name]) for name in ("open", "wrong"))]
        rows.add_row(case, CASES[case], *found, *figures, spreads)
    show(rows, width=150)
