"""Time of a pose at 1024 × 1024 on one core, beside other methods."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from rendezview.sensors.appearance.outline.signature import Signature
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.training.job import train
from rendezview.training.mesh import Mesh
from scipy import fft
from scipy.spatial.transform import Rotation
from sklearn.tree import DecisionTreeClassifier
from threadpoolctl import threadpool_limits

from experiments.frame import PeerPython, mesh_of
from experiments.peers.opencv_contrib import linemod_ms
from experiments.timing import median_ms, medians_in_turns_ms
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.outline.silhouette import outer_borders, outlines_of_mask

TRACKING, LATER = "tracking, refinement only", "tracking, active nodes not asked for"
WITH_NODES = "tracking with active nodes"
FIRST, FLOOR = "first pose, no prior", "floor: threshold, contours, bins"
NEAREST = "nearest of all views by FFT"
SKLEARN = "scikit-learn, predict in a loop over the nodes"
REPEATS = {FIRST: 5, FLOOR: 20, NEAREST: 5}
TURNS = 20  # of the three ways of tracking


def recognizers(model: ViewModel) -> tuple[Recognizer, Recognizer]:
    """With the trees and without, for the camera of `scene`."""
    camera = Camera.from_fov(1024, 1024, np.deg2rad(40.0))
    return Recognizer(model, camera), Recognizer(model, camera, trees=False)


def scene(
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


def tracked(
    full: Recognizer, fast: Recognizer, frame: np.ndarray, prior: Pose
) -> dict[str, Callable[[], object]]:
    """A tracked frame without the trees, with them, and with their answer."""
    return {
        TRACKING: lambda: fast.recognize(frame, prior),
        LATER: lambda: full.recognize(frame, prior),
        WITH_NODES: lambda: full.recognize(frame, prior).active_nodes,
    }


def calls(full: Recognizer, frame: np.ndarray) -> dict[str, Callable[[], object]]:
    """The other calls on a frame, ours and those of the peers."""
    model, camera = full.model, full.camera
    found: dict[str, Callable[[], object]] = {
        FIRST: lambda: full.recognize(frame),
        FLOOR: lambda: floor(frame, camera, model),
    }
    nearest = nearest_view(frame, camera, model)
    if nearest is not None:
        found[NEAREST] = nearest
    return found


def nearest_view(
    frame: np.ndarray, camera: Camera, model: ViewModel
) -> Callable[[], np.ndarray] | None:
    """Circular correlation of the frame's signature with all views: the best one's attitude."""
    mask = cv2.threshold(frame, 30, 255, cv2.THRESH_BINARY)[1]
    outlines = [camera.rays(o) for o in outlines_of_mask(mask)]
    signature = Signature.of_outlines(outlines, model.bins, 1)
    if signature is None:
        return None
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


def floor(frame: np.ndarray, camera: Camera, model: ViewModel) -> object:
    mask = cv2.threshold(frame, 30, 255, cv2.THRESH_BINARY)[1]
    border = max(outer_borders(np.asarray(mask, np.uint8)), key=len)
    rays = camera.rays(border.astype(np.float64))
    return Signature.of_outlines([rays], model.bins, 1)


def run(
    target: str, *, model: Path | None = None, peer_python: PeerPython = None,
    frames: int = 12, seed: int = 77,
) -> None:  # fmt: skip
    """Time of a pose at 1024 × 1024 on one core, beside its floor and its peers.

    Frames of our own simulator, Sun phase 20°, medians of single calls. A tracked frame without the
    trees, with them, and with their answer are timed in turns, and what the trees cost is the
    median of the differences over the frames that need no search. In the same run: the floor
    (threshold, contours, contour → bins), the nearest of all views by FFT, scikit-learn's trees
    in a loop, and OpenCV's linemod.
    """
    cv2.setNumThreads(1)
    threadpool_limits(1)
    name, mesh = mesh_of(target)
    with tempfile.TemporaryDirectory() as folder:
        path = model or Path(folder) / "model.rvm"
        if model is None:
            train(mesh, path, name=name)
        load = median_ms(lambda: ViewModel.load(path), 15)
        views, size = ViewModel.load(path), path.stat().st_size
    full, fast = recognizers(views)
    rows: dict[str, list[float]] = {}
    drawn = list(scene(mesh, full.camera, frames, seed))
    costs: dict[str, list[float]] = {LATER: [], WITH_NODES: []}
    for frame, prior, _ in drawn:
        times = medians_in_turns_ms(tracked(full, fast, frame, prior), TURNS)
        for name, call in calls(full, frame).items():
            times[name] = median_ms(call, REPEATS[name])
        for name, ms in times.items():
            rows.setdefault(name, []).append(ms)
        found = full.recognize(frame, prior).found
        if found is not None and found.single:
            for name, cost in costs.items():
                cost.append(times[name] - times[TRACKING])
    rows[SKLEARN] = [median_ms(looped_trees(views), 5)]
    for templates, ms in linemod_ms(peer_python, [frame for frame, _, _ in drawn]).items():
        rows[f"cv2.linemod, templates: {templates}"] = [ms]
    floor_ms = float(np.median(rows[FLOOR]))
    print(f"model {size / 1e6:.1f} MB, loaded in {load:.1f} ms")
    for name, times in rows.items():
        ms = float(np.median(times))
        print(f"{name:48s} {ms:8.2f} ms  {ms / floor_ms:6.1f} × floor")
    for name, cost in costs.items():
        print(f"{name}: the trees cost {np.median(cost):.2f} ms of {len(cost)} frames")
