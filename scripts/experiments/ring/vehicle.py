"""The ring among the other circles of rendered vehicles: which circle is taken, and how well."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from rendezview.simulation.mitsuba_renderer import MitsubaOptions
from rendezview.simulation.scene import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.shading import ShadingOptions
from rendezview.training.mesh import Mesh, load_mesh
from scipy.spatial.transform import Rotation

from experiments.frame import CLIENT, Log, nees, show, table_of, write_log
from experiments.ring.mesh_circles import MeshCircle, mean_of_polygon, rings_of
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.observation import Status
from rendezview.sensors.ring import RingDetector, RingPrior, RingSensor, tangent_basis
from rendezview.sensors.ring.detector import Detection

CAMERA = Camera.from_fov(640, 480, math.radians(40.0))
RIGHT = 0.005  # of the range
RANGE_M = (3.0, 9.0)  # of the client's ring; rings of other sizes at as many radii
TILT_DEG = 35.0  # at most
SUN_DEG = 40.0  # at most, Sun–target–camera
AXIS_ERROR_DEG = 3.0  # of the axis that is given
GIVEN = {  # share of the range that its σ is, None: no range; known circles or not
    "range to 1 %": (0.01, False),
    "range to 1 %, circles": (0.01, True),
    "range to 5 %": (0.05, False),
    "range to 5 %, circles": (0.05, True),
    "no range": (None, False),
    "no range, circles": (None, True),
}


@dataclass(frozen=True)
class View:
    """One rendered frame and its truth."""

    image: np.ndarray
    ring: MeshCircle
    pose: Pose

    @property
    def centre(self) -> np.ndarray:
        """(3,) of the ring, camera frame."""
        return self.pose.apply(self.ring.centre_m)

    @property
    def axis(self) -> np.ndarray:
        """(3,) camera frame."""
        return self.pose.rotation @ self.ring.axis


def run(
    *,
    seed: int = 22,
    frames: int = 72,
    repeats: Annotated[int, "given ranges a frame, each with its own error"] = 4,
    renderer: Literal["own", "mitsuba"] = "own",
    mesh: Annotated[Path | None, "another vehicle, with circular edges; default: client"] = None,
    unit: Annotated[str | None, "of that mesh"] = None,
    log: Log = None,
) -> None:
    """Which of a vehicle's circles the ring sensor takes, and the errors of its pose.

    The ring is 3 to 9 m away at the client's size (5 to 15 radii), tilted by 0 to 35°; the Sun is
    0 to 40° off the camera. The radius is given, an axis wrong by 3°, and a range with a normal
    error, or none. Of another mesh, every circular edge at the vehicle's outside is a ring. A pose
    is right within 0.5 % of the range. Every frame stands on its own.
    """
    vehicle, rings = _vehicle(mesh, unit)
    views = list(_views(vehicle, rings, seed, frames, renderer))
    detector = RingDetector(CAMERA)
    found = [detector.detect(view.image) for view in views]
    name = mesh.name if mesh else "client"
    rows = table_of(
        f"{name}, {renderer} renderer, {frames} frames, seed {seed}",
        "given | answers | within 0.5 % | ok | wrong and ok | ambiguous | ring among the candidates"
        " | NEES, 5 d.o.f. | NEES of the place, 3",
    )
    lines = []
    for case, (share, known) in GIVEN.items():
        answers = [
            _answer(view, detection, share, known, np.random.default_rng([seed, 1, k, r]))
            for k, (view, detection) in enumerate(zip(views, found, strict=True))
            for r in range(repeats if share else 1)
        ]
        lines += [{"case": case} | answer for answer in answers]
        rows.add_row(case, *_summary(answers))
    show(rows, width=160)
    write_log(log, lines)


def _vehicle(path: Path | None, unit: str | None) -> tuple[Mesh, list[MeshCircle]]:
    if path is not None:
        mesh = load_mesh(path, unit or "m")
        return mesh, rings_of(mesh)
    target = Target.load(CLIENT)
    ring = target.docking_ring
    radius = ring.radius_m * mean_of_polygon(72)  # the mesh's ring has 72 sides
    circle = MeshCircle(ring.centre_m.copy(), ring.axis.copy(), radius, ring.circles)
    return load_mesh(target.mesh_path, target.unit), [circle]


def _views(
    mesh: Mesh, rings: list[MeshCircle], seed: int, count: int, renderer: str
) -> Iterator[View]:
    mitsuba = MitsubaOptions(samples=24) if renderer == "mitsuba" else None
    options = SceneOptions(mitsuba=mitsuba, shading=ShadingOptions(samples=2))
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        ring = rings[k % len(rings)]
        pose = _pose(ring, rng)
        phase = math.radians(rng.uniform(0.0, SUN_DEG))
        sun = sun_at_phase(pose.apply(ring.centre_m), phase, rng.uniform(0.0, math.tau))
        yield View(render_frame(mesh, CAMERA, pose, sun, options, rng), ring, pose)


def _pose(ring: MeshCircle, rng: np.random.Generator) -> Pose:
    """A camera before the ring, rolled at will, the ring up to 5° off the boresight."""
    range_m = rng.uniform(*RANGE_M) * ring.radius_m / 0.597
    turned = Rotation.from_rotvec(
        tangent_basis(ring.axis)
        @ _polar(math.radians(rng.uniform(0.0, TILT_DEG)), rng.uniform(0.0, math.tau))
    )
    back = -turned.apply(ring.axis)  # the line of sight, target frame
    right = tangent_basis(back)[:, 0]
    level = np.stack([right, np.cross(back, right), back])
    aside = _polar(math.radians(rng.uniform(0.0, 5.0)), rng.uniform(0.0, math.tau))
    look = Rotation.from_euler("z", rng.uniform(0.0, math.tau)) * Rotation.from_matrix(level)
    look = Rotation.from_rotvec([*aside, 0.0]) * look
    sight = look.apply(back)
    return Pose(look.as_matrix(), range_m * sight - look.apply(ring.centre_m))


def _polar(length: float, angle: float) -> np.ndarray:
    return length * np.array([math.cos(angle), math.sin(angle)])


class _Given(RingSensor):
    """The sensor on ellipses that are there already: the cases share one detection."""

    def read(self, detection: Detection, prior: RingPrior):
        return self._read(0.0, detection, prior)


def _answer(
    view: View,
    detection: Detection,
    share: float | None,
    known: bool,
    rng: np.random.Generator,
) -> dict:
    far = float(np.linalg.norm(view.centre))
    tilt = tangent_basis(view.axis) @ _polar(
        math.radians(AXIS_ERROR_DEG), rng.uniform(0.0, math.tau)
    )
    axis = Rotation.from_rotvec(np.cross(view.axis, tilt)).apply(view.axis)
    prior = RingPrior(axis=axis)
    if share is not None:
        given = far * (1.0 + share * rng.standard_normal())
        prior = RingPrior(axis=axis, range_m=given, range_sigma_m=share * given)
    sensor = _Given(CAMERA, view.ring.radius_m, circles=view.ring.circles if known else ())
    reading = sensor.read(detection, prior)

    def off(pose) -> float:
        return float(np.linalg.norm(pose.centre_m - view.centre)) / far

    answer: dict = {"status": str(reading.status), "range_m": far, "off": None}
    if not reading.circles:
        return answer
    pose = reading.circle or max(reading.circles, key=lambda p: float(p.axis @ view.axis))
    answer["off"] = off(pose)
    among = [reading.circles, *(circles for _, circles in reading.rivals)]
    answer["among"] = any(off(p) < RIGHT for circles in among for p in circles)
    odd = np.concatenate(
        [view.centre - pose.centre_m, tangent_basis(pose.axis).T @ (view.axis - pose.axis)]
    )
    answer["nees"] = nees(odd, pose.covariance)
    answer["nees_place"] = nees(odd[:3], pose.covariance[:3, :3])
    return answer


def _summary(answers: list[dict]) -> list[str]:
    total = len(answers)
    given = [a for a in answers if a["off"] is not None]
    right = [a for a in given if a["off"] < RIGHT]
    ok = [a for a in given if a["status"] == Status.OK]
    wrong = [a for a in ok if a["off"] >= RIGHT]
    unsure = [a for a in given if a["status"] == Status.AMBIGUOUS]
    sure = [a for a in ok if a["off"] < RIGHT]

    def share(part: list[dict]) -> str:
        return f"{100.0 * len(part) / total:.1f} %"

    spread = ["–", "–"]
    if sure:
        spread = [
            f"{np.mean([a[key] for a in sure]):.1f} / {np.median([a[key] for a in sure]):.1f}"
            for key in ("nees", "nees_place")
        ]
    return [
        f"{len(given)} of {total}",
        *(share(part) for part in (right, ok, wrong, unsure)),
        share([a for a in given if a["among"]]),
        *spread,
    ]
