"""Rows of the benchmark: poses of frames, active nodes, and the trees as C."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from scipy import fft
from scipy.spatial.transform import Rotation

from experiments.benchmark.check import Bench, Row, Way, times
from experiments.flight_code.check import OPTIMISE, driver, perturbed
from rendezview import Camera, Pose, Recognizer, ViewModel
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.outline.silhouette import outer_borders, outlines_of_mask
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import SceneOptions, render_frame, sun_at_phase

SIZE = 1024  # px a side
SKY_GREY = 30.0  # the threshold of the floors
TRACKING, WITH_NODES = "tracking, refinement only", "tracking with active nodes"
FIRST = "first pose, no prior"
NODES = "frame to active nodes and rough pose"
FLOOR, NEAREST = "floor: threshold, contours, bins", "nearest of all views by FFT"


def pose_scene(
    mesh: Mesh, camera: Camera, count: int, seed: int
) -> Iterator[tuple[np.ndarray, Pose, Pose]]:
    """Frames; for each a pose about a degree and 1 % of range off, and the true one."""
    centre_m, radius_m = mesh.bounding_sphere
    rng = np.random.default_rng(seed)
    for _ in range(count):
        rotation = Rotation.random(random_state=rng).as_matrix()
        depth = radius_m * rng.uniform(4.0, 7.0)
        pose = Pose(rotation, np.array([0.0, 0.0, depth]) - rotation @ centre_m)
        sun = sun_at_phase([0.0, 0.0, 1.0], np.deg2rad(20.0), rng.uniform(0.0, 6.28))
        frame = render_frame(mesh, camera, pose, sun, SceneOptions(sky_frame="camera"), rng)
        turn = Rotation.from_rotvec(rng.normal(size=3) * 0.01).as_matrix() @ rotation
        yield frame, Pose(turn, np.array([0.0, 0.0, 1.01 * depth]) - turn @ centre_m), pose


def nearest_view(frame: np.ndarray, camera: Camera, model: ViewModel) -> Callable[[], np.ndarray]:
    """Circular correlation of the frame's signature with all views: the best one's attitude."""
    mask = cv2.threshold(frame, SKY_GREY, 255, cv2.THRESH_BINARY)[1]
    outlines = [camera.rays(o) for o in outlines_of_mask(mask)]
    signature = Signature.of_outlines(outlines, model.bins, 1)
    assert signature is not None  # a rendered frame of the whole target
    views = model.views.readings.astype(np.float32)
    views -= views.mean(axis=1, keepdims=True)
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    spectra = np.conj(fft.rfft(views, axis=1))

    def search() -> np.ndarray:
        likeness = fft.irfft(fft.rfft(signature.readings) * spectra, n=model.bins, axis=1)
        view, shift = divmod(int(np.argmax(likeness)), model.bins)
        # Bins run counter-clockwise, a positive roll clockwise.
        roll = Rotation.from_rotvec([0.0, 0.0, -2.0 * np.pi * shift / model.bins]).as_matrix()
        attitude = roll @ model.views.centred_from_target[view]
        return signature.centred_from_camera.T @ attitude

    return search


def floor(frame: np.ndarray, camera: Camera, model: ViewModel) -> object:
    """Threshold, contours, and the bins of the longest: what any reading of a frame costs."""
    mask = cv2.threshold(frame, SKY_GREY, 255, cv2.THRESH_BINARY)[1]
    border = max(outer_borders(np.asarray(mask, np.uint8)), key=len)
    return Signature.of_outlines([camera.rays(border.astype(np.float64))], model.bins, 1)


def poses(bench: Bench) -> Iterator[Row]:
    """Poses of frames beside the floor, and the nearest view."""
    model, camera = bench.model, Camera.from_fov(SIZE, SIZE, np.deg2rad(40.0))
    full, fast = Recognizer(model, camera), Recognizer(model, camera, trees=False)
    rough = Recognizer(model, camera, refine=False)
    table: dict[str, list[float]] = {}
    errors: dict[str, list[float]] = {"first pose": [], NEAREST: []}
    for frame, prior, truth in pose_scene(bench.mesh, camera, bench.frames, bench.seed):
        nearest = nearest_view(frame, camera, model)
        ways = {
            TRACKING: lambda f=frame, p=prior: fast.recognize(f, p),
            WITH_NODES: lambda f=frame, p=prior: full.recognize(f, p).active_nodes,
            FIRST: lambda f=frame: full.recognize(f),
            NODES: lambda f=frame, p=prior: rough.recognize(f, p),
            FLOOR: lambda f=frame: floor(f, camera, model),
            NEAREST: nearest,
        }
        for name, spent in bench.race(ways).items():
            table.setdefault(name, []).append(spent)
        for name, pose in (
            ("first pose", full.recognize(frame).pose),
            (NEAREST, Pose(nearest(), truth.translation_m)),
        ):
            off = np.inf if pose is None else angle_between(pose, truth, model.symmetries)
            errors[name].append(math.degrees(off))
    spent = {name: float(np.median(values)) for name, values in table.items()}
    ours = (TRACKING, WITH_NODES, FIRST)
    yield from times("benchmark", spent, dict.fromkeys(ours, (FLOOR, NEAREST)))
    yield from times("recognition-accuracy", spent, {NODES: (FLOOR,)})
    ours, peer = (float(np.median(errors[name])) for name in ("first pose", NEAREST))
    yield Row("attitude error, median, first pose", ours, NEAREST, peer, "°", "pose-accuracy")


def flight_code(bench: Bench) -> Iterator[Row]:
    """The trees as C beside the runtime's compiled loop."""
    command = "export-c-check hubble.rvm models_cad/hubble"
    model, rng = bench.model, np.random.default_rng(bench.seed)
    trees = np.arange(len(model.forest))
    picked = rng.integers(len(model.views.readings), size=bench.problems)
    readings = [perturbed(model.views.readings[k].astype(np.float32), rng) for k in picked]
    rolls = rng.uniform(-math.pi, math.pi, (bench.problems, len(trees)))
    ours, loop = "all trees in C", "the runtime's loop"
    with tempfile.TemporaryDirectory() as folder:
        built = driver.build(model, Path(folder), [OPTIMISE])
        with driver.FlightCode(built, model) as code:
            stacked, few = np.array(readings)[:40], rolls[:40]
            in_c = lambda: 1e-9 * float(np.median(code.trees_ns(stacked, few)))  # noqa: E731
            here = lambda: [  # noqa: E731
                model.forest.leaves(view, trees, roll)
                for view, roll in zip(stacked, few, strict=True)
            ]  # fmt: skip
            spent = bench.race({ours: Way(in_c, own_clock=True), loop: Way(here, len(stacked))})
        yield from times(command, spent, {ours: (loop,)})
