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
from sklearn.tree import DecisionTreeClassifier

from experiments.benchmark.check import Bench, Row, times
from experiments.flight_code.check import LIMIT_BYTES, OPTIMISE, driver, perturbed
from experiments.timing import Way
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.model.signature import Signature, radial_maxima, spokes_of, twist
from rendezview.sensors.appearance.outline.silhouette import outer_borders, outlines_of_mask
from rendezview.sensors.appearance.outline.tracing import crack_outline
from rendezview.sensors.appearance.outline.votes import Matcher
from rendezview_ground.learn.views.views import look_from
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import SceneOptions, ShadingOptions, render_frame, sun_at_phase

SIZE = 1024  # px a side
SKY_GREY, NODES_SKY_GREY = 30.0, 25.0  # the thresholds of the floors
TRACKING, WITH_NODES = "tracking, refinement only", "tracking with active nodes"
FIRST, PRIOR = "first pose, no prior", "with a prior"
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
    table: dict[str, list[float]] = {}
    errors: dict[str, list[float]] = {PRIOR: [], "first pose": [], NEAREST: []}
    for frame, prior, truth in pose_scene(bench.mesh, camera, bench.frames, bench.seed):
        nearest = nearest_view(frame, camera, model)
        ways = {
            TRACKING: lambda f=frame, p=prior: fast.recognize(f, p),
            WITH_NODES: lambda f=frame, p=prior: full.recognize(f, p).active_nodes,
            FIRST: lambda f=frame: full.recognize(f),
            FLOOR: lambda f=frame: floor(f, camera, model),
            NEAREST: nearest,
        }
        for name, spent in bench.race(ways).items():
            table.setdefault(name, []).append(spent)
        for name, pose in (
            (PRIOR, fast.recognize(frame, prior).pose),
            ("first pose", full.recognize(frame).pose),
            (NEAREST, Pose(nearest(), truth.translation_m)),
        ):
            off = np.inf if pose is None else angle_between(pose, truth, model.symmetries)
            errors[name].append(math.degrees(off))
    spent = {name: float(np.median(values)) for name, values in table.items()}
    ours = (TRACKING, WITH_NODES, FIRST)
    yield from times("benchmark", spent, dict.fromkeys(ours, (FLOOR, NEAREST)))
    for name in (PRIOR, "first pose"):
        ours, peer = np.array(errors[name]), np.array(errors[NEAREST])
        yield Row(f"attitude error, median, {name}", float(np.median(ours)), NEAREST,
                  float(np.median(peer)), "°", "pose-accuracy")  # fmt: skip
        yield Row(f"no pose or over 10° off, frames, {name}", float(np.sum(ours > 10.0)), NEAREST,
                  float(np.sum(peer > 10.0)), "", "pose-accuracy")  # fmt: skip


def node_scene(
    mesh: Mesh, model: ViewModel, count: int
) -> tuple[Camera, list[np.ndarray], list[Pose]]:
    """A camera, frames that the target fills, and poses some 10° off."""
    range_m = 1.3 * model.sphere_radius_m
    focal = 0.42 * SIZE / np.tan(np.arcsin(model.target_radius_m / range_m))
    camera = Camera(SIZE, SIZE, focal, focal, 0.5 * (SIZE - 1), 0.5 * (SIZE - 1))
    rng = np.random.default_rng(1)
    frames, priors = [], []
    for _ in range(count):
        direction = rng.normal(size=3)
        rotation = look_from(direction / np.linalg.norm(direction), rng.uniform(0.0, 6.28))
        truth = Pose(rotation, np.array([0.0, 0.0, range_m]) - rotation @ model.centre_m)
        sun = sun_at_phase(truth.apply(model.centre_m), 0.0, 0.0)
        options = SceneOptions(shading=ShadingOptions(samples=2))
        frames.append(render_frame(mesh, camera, truth, sun, options, rng))
        off = Rotation.from_rotvec(np.deg2rad(10.0) * rng.normal(size=3) / np.sqrt(3.0))
        priors.append(Pose(off.as_matrix() @ truth.rotation, truth.translation_m))
    return camera, frames, priors


def node_floor(frame: np.ndarray, camera: Camera, bins: int) -> Callable[[], None]:
    """Threshold, external contours, and the readings of their outline."""
    mask = cv2.threshold(frame, NODES_SKY_GREY, 255, cv2.THRESH_BINARY)[1]
    borders = outer_borders(mask)
    outlines = [camera.rays(crack_outline(b, frame, 5.0, 20.0, 2)) for b in borders]
    maxima, identity = np.zeros(bins), np.eye(3)

    def read() -> None:
        cv2.threshold(frame, NODES_SKY_GREY, 255, cv2.THRESH_BINARY)
        cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for rays in outlines:
            radial_maxima(rays, identity, spokes_of(bins), maxima)

    return read


def looped_trees(model: ViewModel) -> Callable[[], object]:
    """A tree of scikit-learn for every node, asked one after the other."""
    samples = model.views.readings[:400].astype(np.float32)
    trees = [
        DecisionTreeClassifier(criterion="entropy", max_depth=8).fit(
            samples, np.arange(len(samples)) % 40 == k % 40
        )
        for k in range(len(model.forest))
    ]
    return lambda: [tree.predict(samples[:1]) for tree in trees]


def nodes(bench: Bench) -> Iterator[Row]:
    """From a frame to its active nodes, and the trees by themselves."""
    model = bench.model
    camera, frames, priors = node_scene(bench.mesh, model, max(3, bench.frames // 2))
    recognizer = Recognizer(model, camera, refine=False)
    pose, below = "frame to active nodes and rough pose", "threshold, contours, binning"
    table: dict[str, list[float]] = {pose: [], below: []}
    for frame, prior in zip(frames, priors, strict=True):
        ask = lambda f=frame, p=prior: recognizer.recognize(f, p)  # noqa: E731
        ways = {pose: ask, below: node_floor(frame, camera, model.bins)}
        for name, value in bench.race(ways).items():
            table[name].append(value)
    medians = {name: float(np.median(values)) for name, values in table.items()}
    yield from times("recognition-accuracy", medians, {pose: (below,)})
    signature = recognizer.recognize(frames[0], priors[0]).signature
    assert signature is not None  # a rendered frame of the whole target
    every = np.arange(len(model.forest))
    rotations = model.views.centred_from_target[: len(every)]
    rolls = twist(signature.centred_from_camera @ priors[0].rotation, rotations)
    trees, peer = f"all {len(every)} trees", "scikit-learn, a call a tree"
    ask = lambda: [model.forest.leaves(signature.readings, every, rolls) for _ in range(100)]  # noqa: E731
    spent = bench.race({trees: Way(ask, 100), peer: looped_trees(model)})
    yield from times("recognition-accuracy", spent, {trees: (peer,)})


def flight_code(bench: Bench) -> Iterator[Row]:
    """The trees as C beside the runtime's compiled loop, and whether they decide alike."""
    command = "export-c-check hubble.rvm models_cad/hubble"
    model, rng = bench.model, np.random.default_rng(bench.seed)
    matcher, trees = Matcher(model), np.arange(len(model.forest))
    picked = rng.integers(len(model.views.readings), size=bench.problems)
    readings = [perturbed(model.views.readings[k].astype(np.float32), rng) for k in picked]
    rolls = rng.uniform(-math.pi, math.pi, (bench.problems, len(trees)))
    ours, loop, differ = "all trees in C", "the runtime's loop", 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with driver.FlightCode(driver.build(model, folder, [OPTIMISE]), model) as code:
            for view, roll in zip(readings, rolls, strict=True):
                trust = matcher.trust_of(model.forest.leaves(view, trees, roll))
                differ += not np.array_equal(code.trees(view, roll), trust)
            stacked, few = np.array(readings)[:40], rolls[:40]
            in_c = lambda: 1e-9 * float(np.median(code.trees_ns(stacked, few)))  # noqa: E731
            here = lambda: [  # noqa: E731
                model.forest.leaves(view, trees, roll)
                for view, roll in zip(stacked, few, strict=True)
            ]  # fmt: skip
            spent = bench.race({ours: Way(in_c, own_clock=True), loop: Way(here, len(stacked))})
        yield from times(command, spent, {ours: (loop,)})
        yield Row("signatures that C decides otherwise", differ, "none may", 0, "", command)
        sizes = driver.object_bytes(model, folder)
        size = sum(sizes[name] for name in sizes if "forest" not in name)
    yield Row("object files of C", size / 1e3, "limit", LIMIT_BYTES / 1e3, "kB", command)
