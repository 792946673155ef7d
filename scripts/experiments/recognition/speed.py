"""Time from an 8-bit frame to the on nodes, beside the floor of that frame, in one run.

    python -m experiments recognition-speed --model hubble.rvm

Without ``--model`` a small model of ``models_cad/hubble`` is trained first (the time of a
frame does not depend on how many views it learned from). The floor is what reading the
frame must cost: OpenCV's threshold, its external contours, and the readings of their
outline. Peer: OpenCV's linemod, by the interpreter that ``--peer-python`` names. One thread,
medians; compare the ratios, not the milliseconds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD
from experiments.peers.linemod import linemod_ms
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.outline.signature import (
    Signature,
    radial_maxima,
    spokes_of,
    twist,
)
from rendezview.sensors.appearance.outline.silhouette import outer_borders
from rendezview.sensors.appearance.outline.tracing import crack_outline
from rendezview.simulation import SceneOptions, ShadingOptions, render_frame
from rendezview.simulation.scene import sun_at_phase
from rendezview.training.job import train
from rendezview.training.mesh import Mesh, load_mesh
from rendezview.training.options import TrainingOptions
from rendezview.training.views import look_from

SIZE = 1024
FOLDER = MODELS_CAD / "hubble"


def median_ms(call: Callable[[], object], seconds: float = 1.0) -> float:
    """Median time of a call, milliseconds, after a warm-up."""
    for _ in range(3):
        call()
    spent, start = [], time.perf_counter()
    while time.perf_counter() - start < seconds or len(spent) < 5:
        before = time.perf_counter()
        call()
        spent.append(time.perf_counter() - before)
    return 1e3 * float(np.median(spent))


def scene(mesh: Mesh, model: ViewModel, count: int) -> tuple[Camera, list[np.ndarray], list[Pose]]:
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


def floor_calls(frame: np.ndarray, camera: Camera, bins: int) -> list[Callable[[], object]]:
    """Threshold, external contours, and the readings of their outline."""
    level = 25.0
    mask = cv2.threshold(frame, level, 255, cv2.THRESH_BINARY)[1]
    borders = outer_borders(mask)
    outlines = [camera.rays(crack_outline(b, frame, 5.0, 20.0, 2)) for b in borders]
    maxima = np.zeros(bins)
    identity = np.eye(3)

    def binning() -> None:
        for rays in outlines:
            radial_maxima(rays, identity, spokes_of(bins), maxima)

    return [
        lambda: cv2.threshold(frame, level, 255, cv2.THRESH_BINARY),
        lambda: cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE),
        binning,
    ]


def all_trees(model: ViewModel, signature: Signature, prior: Pose) -> Callable[[], object]:
    nodes = np.arange(len(model.forest))
    rotations = model.views.centred_from_target[: len(nodes)]
    rolls = twist(signature.centred_from_camera @ prior.rotation, rotations)
    return lambda: model.forest.leaves(signature.readings, nodes, rolls)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, help="model of models_cad/hubble")
    parser.add_argument("--peer-python", type=Path, help="an interpreter with opencv-contrib")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    target = Target.load(FOLDER)
    mesh = load_mesh(target.mesh_path, target.unit)
    if arguments.model:
        model = ViewModel.load(arguments.model)
    else:
        with tempfile.TemporaryDirectory() as folder:
            options = TrainingOptions(
                perturbed_views=6000,
                held_out_views=500,
                contour_points=0,
                shadowed_silhouettes=False,
            )
            path = Path(folder) / "hubble.rvm"
            model = train(mesh, path, name="hubble", options=options).model
    camera, frames, priors = scene(mesh, model, 20)
    recognizer = Recognizer(model, camera, refine=False)

    def floor_stages(frame: np.ndarray) -> tuple[float, ...]:
        return tuple(median_ms(stage, 0.1) for stage in floor_calls(frame, camera, model.bins))

    floors = np.array([floor_stages(f) for f in frames])
    stages: dict[str, list[float]] = {}
    whole = []
    for frame, prior in zip(frames, priors, strict=True):

        def once(frame: np.ndarray = frame, prior: Pose = prior) -> None:
            for name, ms in recognizer.recognize(frame, prior).stage_ms.items():
                stages.setdefault(name, []).append(ms)

        whole.append(median_ms(once, 0.15))
    signature = recognizer.recognize(frames[0], priors[0]).signature
    assert signature is not None  # a rendered frame of the whole target
    trees_ms = median_ms(all_trees(model, signature, priors[0]), 0.5)
    floor = floors.sum(axis=1)
    table = Table(title=f"{SIZE} × {SIZE}, 20 frames, one thread, medians")
    for column in ("what", "ms", "× floor"):
        table.add_column(column, justify="left" if column == "what" else "right")
    base = float(np.median(floor))

    def row(name: str, ms: float) -> None:
        table.add_row(name, f"{ms:.3f}", f"{ms / base:.2f}")

    for k, name in enumerate(("threshold", "external contours", "binning")):
        row(f"floor: {name}", float(np.median(floors[:, k])))
    row("floor: together", base)
    for name, values in stages.items():
        row(f"recognizer: {name}", float(np.median(values)))
    to_nodes = sum(float(np.median(stages[n])) for n in ("silhouette", "signature", "trees"))
    row("recognizer: frame to on nodes", to_nodes)
    row("recognizer: frame to pose", float(np.median(whole)))
    row(f"all {len(model.forest)} trees", trees_ms)
    if arguments.peer_python is not None:
        for templates, ms in (linemod_ms(arguments.peer_python, frames) or {}).items():
            row(f"peer: cv2.linemod, templates: {templates}", ms)
    Console(width=100).print(table)
    print(f"frame to on nodes / floor: {to_nodes / base:.2f}; all trees {1e3 * trees_ms:.1f} µs")
