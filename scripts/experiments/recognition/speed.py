"""Time from an 8-bit frame to the active nodes, beside the floor of that frame, in one run."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from rendezview.sensors.appearance.outline.signature import (
    Signature,
    radial_maxima,
    spokes_of,
    twist,
)
from rendezview.simulation import SceneOptions, ShadingOptions, render_frame
from rendezview.simulation.scene import sun_at_phase
from rendezview.training.job import train
from rendezview.training.mesh import Mesh
from rendezview.training.options import TrainingOptions
from rendezview.training.views import look_from
from scipy.spatial.transform import Rotation

from experiments.frame import PeerPython, mesh_of, show, table_of
from experiments.peers.opencv_contrib import linemod_ms
from experiments.timing import median_ms
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.outline.silhouette import outer_borders
from rendezview.sensors.appearance.outline.tracing import crack_outline

SIZE = 1024


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


def small_model(mesh: Mesh) -> ViewModel:
    """Trained on few views: the time of a frame does not depend on how many there were."""
    options = TrainingOptions(
        perturbed_views=6000, held_out_views=500, contour_points=0, shadowed_silhouettes=False
    )
    with tempfile.TemporaryDirectory() as folder:
        return train(mesh, Path(folder) / "hubble.rvm", name="hubble", options=options).model


def run(
    *, model: Annotated[Path | None, "of hubble; else a small one is trained"] = None,
    peer_python: PeerPython = None,
) -> None:  # fmt: skip
    """Time from an 8-bit frame to the active nodes, beside the floor of that frame.

    The floor is what reading the frame must cost: OpenCV's threshold, its external contours, and
    the readings of their outline. Peer: OpenCV's linemod. One thread, medians; compare the
    ratios, not the milliseconds.
    """
    cv2.setNumThreads(1)
    _, mesh = mesh_of("hubble")
    views = ViewModel.load(model) if model else small_model(mesh)
    camera, frames, priors = scene(mesh, views, 20)
    recognizer = Recognizer(views, camera, refine=False)
    floors = np.array(
        [[median_ms(s, 5, seconds=0.1) for s in floor_calls(f, camera, views.bins)] for f in frames]
    )
    stages: dict[str, list[float]] = {}
    whole = []
    for frame, prior in zip(frames, priors, strict=True):

        def once(frame: np.ndarray = frame, prior: Pose = prior) -> None:
            for name, ms in recognizer.recognize(frame, prior).stage_ms.items():
                stages.setdefault(name, []).append(ms)

        whole.append(median_ms(once, 5, seconds=0.15))
    signature = recognizer.recognize(frames[0], priors[0]).signature
    assert signature is not None  # a rendered frame of the whole target
    trees_ms = median_ms(all_trees(views, signature, priors[0]), 5, seconds=0.5)
    floor_ms = float(np.median(floors.sum(axis=1)))
    medians = {name: float(np.median(values)) for name, values in stages.items()}
    to_nodes = sum(medians[name] for name in ("silhouette", "signature", "trees"))
    lines = dict(
        zip(
            ("floor: threshold", "floor: external contours", "floor: binning"),
            np.median(floors, axis=0), strict=True,
        )
    )  # fmt: skip
    lines |= {"floor: together": floor_ms}
    lines |= {f"recognizer: {name}": ms for name, ms in medians.items()}
    lines |= {
        "recognizer: frame to active nodes": to_nodes,
        "recognizer: frame to pose": float(np.median(whole)),
        f"all {len(views.forest)} trees": trees_ms,
    }
    for templates, ms in linemod_ms(peer_python, frames).items():
        lines[f"peer: cv2.linemod, templates: {templates}"] = ms
    rows = table_of(f"{SIZE} × {SIZE}, 20 frames, one thread, medians", ("what", "ms", "× floor"))
    for name, ms in lines.items():
        rows.add_row(name, f"{ms:.3f}", f"{ms / floor_ms:.2f}")
    show(rows, width=100)
    ratio = to_nodes / floor_ms
    print(f"frame to active nodes / floor: {ratio:.2f}; all trees {1e3 * trees_ms:.1f} µs")
