"""The training job: mesh in, view model out."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib.util
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import rendezview.sensors.appearance
import rendezview_ground
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.results import json_value
from rendezview.io.target import DockingRing, Reflector
from rendezview.sensors.appearance.model.view_model import HeldOut, ViewModel, Views
from rendezview_ground.learn.jobs.cores import Cores
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor
from rendezview_ground.learn.jobs.stages import Progress, Shards
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry, view_geometry
from rendezview_ground.learn.training_stages import TrainingStages
from rendezview_ground.learn.trees.calibrate import calibrated
from rendezview_ground.learn.trees.node_trees import Decisions, Samples, decide
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.simplify import TOLERANCE_RADII, simplified
from rendezview_ground.render.crossings import faces_beside
from rendezview_ground.render.pyrender_renderer import PyrenderRenderer
from rendezview_ground.render.renderers import Renderer, make_renderer

# Streams of random numbers; trees use 3, calibration 4, decisions 5, surface points 6, forest 7.
_STREAM_OF_TRAINING, _STREAM_OF_HELD_OUT, _STREAM_OF_DECISIONS = 1, 2, 5


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A trained model and its figures."""

    model: ViewModel
    decisions: Decisions | None  # on held-out views, if there were any
    geometry: ViewGeometry
    drawn_triangles: int | None = None  # None: the views are of an earlier run


def train(
    mesh: Mesh,
    path: Path,
    *,
    name: str,
    options: TrainingOptions | None = None,
    camera: Camera | None = None,
    symmetries: Sequence[Symmetry] = (),
    shape_error: float = 0.0,
    docking_ring: DockingRing | None = None,
    port: DockingRing | None = None,
    reflectors: tuple[Reflector, ...] = (),
    bounding_sphere: tuple[Array, float] | None = None,
    jobs: int = -1,
    executor: ShardExecutor | None = None,
    progress: Progress | None = None,
) -> Trained:
    """Train a view model and write it to ``path``.

    Finished shards are kept in ``path`` + ``.partial`` until the model is written: a killed job
    continues where it stopped. The same mesh, options and camera give the same bytes, with any
    executor, any number of jobs and any interruptions.

    Args:
        mesh: the target, in its own frame.
        path: the model file to write.
        name: of the target.
        options: see ``TrainingOptions``.
        symmetries: of the target, declared or found by ``find_symmetries``.
        shape_error: σ of the strain between the mesh and the real spacecraft.
        docking_ring, reflectors: of the target, kept in the model for other sensors.
        port: a circle around what a close camera looks at, which views of that part serve;
            ``None``: the docking ring.
        camera: the flight camera; it sets the sphere radius and the sharpness of the perturbed
            views. ``None``: a 40° field of view, 480 pixels.
        bounding_sphere: centre (3,) and radius (m) around the target at all angles of its joints;
            ``None``: the mesh's own.
        jobs: parallel jobs on this machine, −1 for all cores.
        executor: where shards run instead, such as a ``Cluster``.
        progress: called with the stage, the shards done and all shards.

    Raises:
        RendezviewError: the sphere does not enclose the target, the target is flat, or the model
            cannot be written.
    """
    options = options or TrainingOptions()
    executor = executor or Cores(jobs)
    if (path.exists() and not path.is_file()) or not path.parent.is_dir():
        raise RendezviewError(f"{path}: give a file name in an existing folder for the model")
    geometry = view_geometry(mesh, options, camera, bounding_sphere)
    drawn = simplified(mesh, TOLERANCE_RADII * geometry.target_radius_m)
    inputs = provenance(mesh, options, camera)
    renderer = make_renderer(options.renderer, drawn)
    surfaces = renderer if isinstance(renderer, PyrenderRenderer) else None
    port = port or docking_ring
    sphere = [*geometry.centre_m.tolist(), geometry.target_radius_m]
    key = inputs | {"code": _code_sha256(), "sphere": sphere}
    key |= {"port": None if port is None else port.record()}
    with Shards(path, key) as shards, _one_opencv_thread():  # the jobs are the parallelism
        stages = TrainingStages(
            shards, drawn, faces_beside(drawn), renderer, surfaces, geometry, options, executor,
            progress,
        )  # fmt: skip
        trained = _train(stages, name, tuple(symmetries), shape_error, inputs)
        model = dataclasses.replace(
            trained.model,
            docking_ring=docking_ring,
            reflectors=reflectors,
            near=stages.near(mesh, port, camera),
        )
        model.save(path)
        shards.remove()
    # As others read it: compiled loops have another version for arrays that may be written.
    model = ViewModel.load(path)
    return dataclasses.replace(trained, model=model, drawn_triangles=len(drawn.faces))


@contextlib.contextmanager
def _one_opencv_thread() -> Iterator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _train(
    stages: TrainingStages,
    name: str,
    symmetries: tuple[Symmetry, ...],
    shape_error: float,
    inputs: dict[str, Any],
) -> Trained:
    options, geometry = stages.options, stages.geometry
    surface, stages = stages.surface()
    lattice, slopes, far_readings = stages.lattice()
    perturbed = stages.perturbed("views", _STREAM_OF_TRAINING, options.perturbed_views)
    held_out = stages.perturbed("held-out", _STREAM_OF_HELD_OUT, options.held_out_views)
    contours = stages.contours()
    silhouettes = stages.shadowed_silhouettes()
    sketches = stages.sketches()
    shape = stages.shape()
    samples = Samples(options.order, lattice, perturbed)
    trees = stages.trees(samples)
    score_forest = stages.score_forest(lattice, perturbed, silhouettes)
    sphere = Geodesic.of_order(options.order)
    nodes = len(sphere.nodes)
    decisions = None
    if held_out is not None:
        decisions = decide(
            trees.forest,
            lattice.centred_from_target[:nodes],
            sphere,
            held_out,
            options.roll_error_rad,
            np.random.default_rng([options.seed, _STREAM_OF_DECISIONS]),
        )
    views = Views(
        lattice.centred_from_target,
        np.asarray(np.minimum(lattice.readings, 65535.0), dtype=np.uint16),
        lattice.area_sr * lattice.range_m**2,
        slopes,
        lattice.offset_m,
    )
    model = ViewModel(
        name=name,
        order=options.order,
        sphere_radius_m=geometry.sphere_radius_m,
        target_radius_m=geometry.target_radius_m,
        centre_m=geometry.centre_m,
        smooth_bins=options.smooth_bins,
        views=views if far_readings is None else views.with_far(far_readings),
        forest=trees.forest,
        leaf_on=trees.leaf_on,
        leaf_off=trees.leaf_off,
        training_accuracy=trees.training_accuracy,
        held_out_accuracy=np.full(nodes, np.nan) if decisions is None else decisions.accuracy,
        held_out=_UNMEASURED,
        provenance=inputs,
        contours=contours,
        lit=silhouettes,
        symmetries=symmetries,
        shape_error=shape_error,
        surface=surface,
        sketches=sketches,
        shape=shape,
        score_forest=score_forest,
    )
    if held_out is not None:
        model = calibrated(model, stages.calibration(model, held_out))
    return Trained(model, decisions, geometry)


# Errors that a model without held-out views states.
_UNMEASURED = HeldOut(
    direction_rad=float(np.deg2rad(4.0)),
    roll_rad=float(np.deg2rad(2.0)),
    range_fraction=0.03,
    bearing_rad=0.005,
    residual=200.0,
)


def kept_model(path: Path, made: dict[str, Any], stated: dict[str, Any]) -> ViewModel | None:
    """The model of an earlier run of the same inputs (``provenance``); None if there is none.

    ``stated``: its fields that are given, not computed from those inputs.
    """
    if not path.is_file():
        return None
    try:
        model = ViewModel.load(path)
    except RendezviewError:
        return None  # damaged: trained again
    wanted = {"provenance": json.loads(json.dumps(made))} | stated
    same = all(json_value(getattr(model, key)) == json_value(v) for key, v in wanted.items())
    return model if same else None


def _code_sha256() -> str:
    """Digest of the modules that compute shards: shards of other code are discarded."""
    digest = hashlib.sha256()
    for package in (rendezview_ground, rendezview.sensors.appearance):
        for source in sorted(Path(str(package.__file__)).parent.rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()


def provenance(mesh: Mesh, options: TrainingOptions, camera: Camera | None) -> dict[str, Any]:
    """The inputs that decide the bytes of the model."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(mesh.vertices_m, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i4").tobytes())
    for of_faces in (mesh.face_rgb, mesh.face_trust, mesh.face_part):
        if of_faces is not None:
            digest.update(np.ascontiguousarray(of_faces, dtype="<f4").tobytes())
    packages = ["rendezview", "numpy", "opencv-python-headless", "numba", "scikit-learn"]
    if options.renderer is Renderer.PYRENDER and importlib.util.find_spec("pyrender"):
        packages.append("pyrender")
    return {
        "mesh_sha256": digest.hexdigest(),
        "triangles": len(mesh.faces),
        "mesh_notes": list(mesh.notes),
        "options": options.as_record(),
        "camera": None if camera is None else dataclasses.asdict(camera),
        "versions": {p: metadata.version(p) for p in packages}
        | {"python": ".".join(map(str, sys.version_info[:2]))},
    }
