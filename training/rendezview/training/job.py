"""The training job: mesh in, view model out."""

from __future__ import annotations

import dataclasses
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

import rendezview.sensors.appearance.outline.tracing
import rendezview.training.views
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry
from rendezview.sensors.appearance.edges.contours import Contours
from rendezview.sensors.appearance.edges.error_model import ErrorModel
from rendezview.sensors.appearance.edges.shading import Surface
from rendezview.sensors.appearance.edges.shadowed_silhouettes import ShadowedSilhouettes
from rendezview.sensors.appearance.model import HeldOut, ViewModel, Views
from rendezview.sensors.appearance.outline.signature import Readings
from rendezview.sensors.appearance.outline.trees import Forest
from rendezview.training.calibrate import calibrated, prior_errors, recognition_errors
from rendezview.training.contours import contour_points
from rendezview.training.cores import Cores
from rendezview.training.crossings import faces_beside
from rendezview.training.learn import Decisions, Samples, TreeSet, decide, learn_trees
from rendezview.training.mesh import Mesh
from rendezview.training.options import TrainingOptions, ViewGeometry, view_geometry
from rendezview.training.projection import SilhouetteRenderer
from rendezview.training.renderers import make_renderer
from rendezview.training.shadowed_silhouettes import SunMaps, lit_views, sun_maps
from rendezview.training.shard_executor import ShardExecutor, Shared, Task
from rendezview.training.stages import Arrays, Progress, Shards, shares
from rendezview.training.surface_palette import surface_palette
from rendezview.training.surface_points import (
    SURFACE_ORDER,
    candidate_points,
    chosen_surface,
    seen_points,
)
from rendezview.training.views import (
    ViewSet,
    clean_views,
    far_views,
    lattice_slopes,
    perturbed_views,
)

_VIEWS_PER_SHARD = 256
_SLOW_VIEWS_PER_SHARD = 64  # a second or two, as the others
_NODES_PER_SHARD = 16
_STREAM_OF_TRAINING, _STREAM_OF_HELD_OUT = 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A model and what is worth telling about its making."""

    model: ViewModel
    decisions: Decisions | None  # on held-out views, if there were any
    geometry: ViewGeometry


def train(
    mesh: Mesh,
    path: Path,
    *,
    name: str,
    options: TrainingOptions | None = None,
    camera: Camera | None = None,
    symmetries: Sequence[Symmetry] = (),
    shape_error: float = 0.0,
    jobs: int = -1,
    executor: ShardExecutor | None = None,
    progress: Progress | None = None,
) -> Trained:
    """Train a view model and write it to ``path``.

    Finished shards lie in ``path`` + ``.partial`` until the model is written, so that a
    killed job goes on where it stopped. The same mesh, options and camera give the same
    bytes, whatever the workers, their number and interruptions.

    Args:
        mesh: the target, in its own frame.
        path: of the model file to write.
        name: of the target.
        options: see ``TrainingOptions``.
        symmetries: of the target, declared or found; see ``find_symmetries``.
        shape_error: σ of the strain by which the mesh may differ from the craft.
        camera: the flight camera; it decides the sphere radius and the sharpness of the
            perturbed views. ``None``: a 40° field of view, 480 pixels.
        jobs: parallel jobs on this machine, −1 for all cores (joblib).
        workers: a cluster instead; see ``rendezview.training.cluster``.
        progress: called with stage, shards done and shards in all.

    Raises:
        RendezviewError: the sphere does not enclose the target, the target is flat, the
            model cannot be written.
    """
    options = options or TrainingOptions()
    executor = executor or Cores(jobs)
    if (path.exists() and not path.is_file()) or not path.parent.is_dir():
        raise RendezviewError(f"{path}: give a file name in an existing folder for the model")
    geometry = view_geometry(mesh, options, camera)
    inputs = provenance(mesh, options, camera)
    renderer = make_renderer(options.renderer, mesh)
    beside = faces_beside(mesh)
    shards = Shards(path.with_name(path.name + ".partial"), inputs | {"code": _code_sha256()})
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the jobs are the parallelism
    try:
        drawn = _Drawn(shards, mesh, beside, renderer, geometry, options, executor, progress)
        trained = _train(drawn, name, tuple(symmetries), shape_error, inputs)
    finally:
        cv2.setNumThreads(threads)
    trained.model.save(path)
    shards.remove()
    return trained


def _train(
    drawn: _Drawn,
    name: str,
    symmetries: tuple[Symmetry, ...],
    shape_error: float,
    inputs: dict[str, Any],
) -> Trained:
    options, geometry = drawn.options, drawn.geometry
    lattice, slopes, far_readings = drawn.lattice()
    perturbed = drawn.perturbed("views", _STREAM_OF_TRAINING, options.perturbed_views)
    held_out = drawn.perturbed("held-out", _STREAM_OF_HELD_OUT, options.held_out_views)
    contours = drawn.contours()
    lit = drawn.lit()
    surface = drawn.surface()
    samples = Samples(options.order, lattice, perturbed)
    trees = drawn.trees(samples)
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
            np.random.default_rng([options.seed, 5]),
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
        lit=lit,
        symmetries=symmetries,
        shape_error=shape_error,
        surface=surface,
        error_model=None if contours is None else ErrorModel.packaged(),
    )
    if held_out is not None:
        model = calibrated(model, drawn.calibration(model, held_out))
    return Trained(model, decisions, geometry)


# A model without held-out views states the errors of the paper's kind of training.
_UNMEASURED = HeldOut(
    direction_rad=float(np.deg2rad(4.0)),
    roll_rad=float(np.deg2rad(2.0)),
    range_fraction=0.03,
    bearing_rad=0.005,
    residual=200.0,
)


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """Everything the stages of one job share."""

    shards: Shards
    mesh: Mesh
    beside: npt.NDArray[np.int32]  # (F, 3) faces over the edges
    renderer: SilhouetteRenderer
    geometry: ViewGeometry
    options: TrainingOptions
    executor: ShardExecutor
    progress: Progress | None

    def lattice(self) -> tuple[ViewSet, Array, Readings | None]:
        """The clean views at the sphere radius, slope of their area with range, far readings."""
        directions = Geodesic.of_order(self.options.order + 1).nodes
        near = self._views(
            "lattice",
            clean_views,
            [(directions[p.start : p.stop],) for p in shares(len(directions), _VIEWS_PER_SHARD)],
        )
        if self.options.perturbed_views == 0:  # the paper's weak perspective
            return near, np.zeros(len(near)), None
        far = self._views(
            "perspective",
            far_views,
            [(directions[p.start : p.stop],) for p in shares(len(directions), _VIEWS_PER_SHARD)],
        )
        return near, lattice_slopes(near, far, self.geometry), far.readings

    def perturbed(self, stage: str, stream: int, count: int) -> ViewSet | None:
        """Random views; ``None`` where none are asked for."""
        if count == 0:
            return None
        parts = [(stream, p) for p in shares(count, _VIEWS_PER_SHARD)]
        return self._views(stage, perturbed_views, parts)

    def contours(self) -> Contours | None:
        """Contour points of every view of the lattice, from every shell."""
        radii = self.options.contour_radii
        if self.options.contour_points == 0:
            return None
        directions = Geodesic.of_order(self.options.order + 1).nodes
        shells_m = np.array(radii) * self.geometry.sphere_radius_m
        shared = (self.mesh, self.beside, self.geometry, self.options)
        parts = [
            (directions[p.start : p.stop], range_m)
            for range_m in shells_m
            for p in shares(len(directions), _SLOW_VIEWS_PER_SHARD)
        ]
        shards = self._run("contours", _contour_arrays, shared, parts)
        views = {name: np.concatenate([a[name] for a in shards]) for name in shards[0]}
        palette, views["strip"] = surface_palette(views.pop("surfaces"))
        shape = (len(shells_m), len(directions))
        return Contours(
            shells_m=shells_m,
            palette=palette,
            **{n: a.reshape(*shape, *a.shape[1:]) for n, a in views.items()},
        )

    def lit(self) -> ShadowedSilhouettes | None:
        """What the Sun lights of every view of the lattice, from every side."""
        if not self.options.lit_views:
            return None
        directions = Geodesic.of_order(self.options.order + 1).nodes
        maps = sun_maps(self.mesh, self.geometry)
        shared = (self.mesh, maps, self.geometry)
        parts = [
            (directions[p.start : p.stop], p.start)
            for p in shares(len(directions), _SLOW_VIEWS_PER_SHARD)
        ]
        shards = self._run("lit", _lit_arrays, shared, parts)
        views = {name: np.concatenate([a[name] for a in shards]) for name in shards[0]}
        return ShadowedSilhouettes(suns=maps.suns, **views)

    def surface(self) -> Surface | None:
        """Points of the surface, and from where each is seen; they serve refined poses."""
        if 0 in (self.options.surface_points, self.options.contour_points):
            return None
        directions = Geodesic.of_order(SURFACE_ORDER).nodes
        points, faces = candidate_points(self.mesh, self.geometry, self.options)
        shared = (self.mesh, self.geometry, points, faces, self.options)
        parts = [(directions[p.start : p.stop],) for p in shares(len(directions), _VIEWS_PER_SHARD)]
        shards = self._run("surface", _surface_arrays, shared, parts)
        seen = np.concatenate([a["seen"] for a in shards])
        return chosen_surface(self.mesh, self.geometry, points, faces, seen, self.options)

    def trees(self, samples: Samples) -> TreeSet:
        """Trees of all nodes."""
        nodes = len(Geodesic.of_order(self.options.order).nodes)
        parts = [(p,) for p in shares(nodes, _NODES_PER_SHARD)]
        shards = self._run("trees", _tree_arrays, (samples, self.options), parts)
        return TreeSet.joined([_tree_set(a) for a in shards])

    def calibration(self, model: ViewModel, held_out: ViewSet) -> Array:
        """Errors of recognition on the held-out views."""
        priors = prior_errors(len(held_out), self.options.seed)
        parts = [(slice(p.start, p.stop),) for p in shares(len(held_out), _VIEWS_PER_SHARD)]
        shards = self._run("calibration", _error_arrays, (model, held_out, priors), parts)
        return np.concatenate([a["errors"] for a in shards])

    def _views(self, stage: str, draw: Any, parts: list[tuple[Any, ...]]) -> ViewSet:
        shared = (draw, self.renderer, self.geometry, self.options)
        shards = self._run(stage, _view_arrays, shared, parts)
        return ViewSet.joined([ViewSet(**a) for a in shards])

    def _run(
        self, stage: str, task: Task, shared: Shared, parts: list[tuple[Any, ...]]
    ) -> list[Arrays]:
        return self.shards.run(stage, task, shared, parts, self.executor, self.progress)


def _view_arrays(draw: Any, *arguments: Any) -> Arrays:
    views = draw(*arguments)
    return {f.name: getattr(views, f.name) for f in dataclasses.fields(ViewSet)}


def _contour_arrays(
    mesh: Mesh,
    beside: npt.NDArray[np.int32],
    geometry: ViewGeometry,
    options: TrainingOptions,
    directions: Array,
    range_m: float,
) -> Arrays:
    views = [contour_points(mesh, beside, geometry, d, range_m, options) for d in directions]
    return {name: np.stack([view[name] for view in views]) for name in views[0]}


def _lit_arrays(
    mesh: Mesh, maps: SunMaps, geometry: ViewGeometry, directions: Array, first: int
) -> Arrays:
    views = [lit_views(mesh, maps, geometry, first + k, d) for k, d in enumerate(directions)]
    return {name: np.concatenate([view[name] for view in views]) for name in views[0]}


def _surface_arrays(
    mesh: Mesh,
    geometry: ViewGeometry,
    points: Array,
    faces: npt.NDArray[np.int32],
    options: TrainingOptions,
    directions: Array,
) -> Arrays:
    views = [seen_points(mesh, geometry, points, faces, d, options) for d in directions]
    return {"seen": np.stack(views)}


def _tree_arrays(samples: Samples, options: TrainingOptions, nodes: range) -> Arrays:
    trees = learn_trees(samples, options, nodes)
    arrays: Arrays = {f.name: getattr(trees.forest, f.name) for f in dataclasses.fields(Forest)}
    return arrays | {
        "leaf_on": trees.leaf_on,
        "leaf_off": trees.leaf_off,
        "training_accuracy": trees.training_accuracy,
    }


def _error_arrays(model: ViewModel, held_out: ViewSet, priors: Array, rows: slice) -> Arrays:
    return {"errors": recognition_errors(model, held_out, priors, rows)}


def _tree_set(arrays: Arrays) -> TreeSet:
    forest = Forest(**{f.name: arrays[f.name] for f in dataclasses.fields(Forest)})
    return TreeSet(forest, arrays["leaf_on"], arrays["leaf_off"], arrays["training_accuracy"])


def _code_sha256() -> str:
    """Of the modules that make shards: shards of other code are of no use."""
    digest = hashlib.sha256()
    for module in (rendezview.training.views, rendezview.sensors.appearance.outline.tracing):
        for source in sorted(Path(str(module.__file__)).parent.glob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()


def provenance(mesh: Mesh, options: TrainingOptions, camera: Camera | None) -> dict[str, Any]:
    """What decides the bytes of the model."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(mesh.vertices_m, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i4").tobytes())
    packages = ("rendezview", "numpy", "opencv-python-headless", "numba", "scikit-learn")
    return {
        "mesh_sha256": digest.hexdigest(),
        "triangles": len(mesh.faces),
        "mesh_notes": list(mesh.notes),
        "options": {
            k: list(v) if isinstance(v, tuple) else v
            for k, v in dataclasses.asdict(options).items()
        },
        "camera": None if camera is None else dataclasses.asdict(camera),
        "versions": {p: metadata.version(p) for p in packages}
        | {"python": ".".join(map(str, sys.version_info[:2]))},
    }
