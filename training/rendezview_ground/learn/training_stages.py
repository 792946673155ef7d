"""The stages of a training job, from views and contours to trees and calibration."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array
from rendezview.io.target import DockingRing
from rendezview.sensors.appearance.model.contours import Contours
from rendezview.sensors.appearance.model.forest import ScoreForest
from rendezview.sensors.appearance.model.near_views import NearSphere
from rendezview.sensors.appearance.model.shadowed_silhouettes import ShadowedSilhouettes
from rendezview.sensors.appearance.model.shape import Shape
from rendezview.sensors.appearance.model.signature import Readings
from rendezview.sensors.appearance.model.sketches import ViewSketches
from rendezview.sensors.appearance.model.surface import Surface
from rendezview.sensors.appearance.model.trees import Forest
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor, Shared, Task
from rendezview_ground.learn.jobs.stages import Arrays, Progress, Shards, shares
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry
from rendezview_ground.learn.trees.calibrate import prior_errors, recognition_errors
from rendezview_ground.learn.trees.forest import ForestSamples, joined, learn_forest
from rendezview_ground.learn.trees.node_trees import Samples, TreeSet, learn_trees
from rendezview_ground.learn.views.carried_shape import carried_shape
from rendezview_ground.learn.views.contours import contour_points
from rendezview_ground.learn.views.near_spheres import near_spheres
from rendezview_ground.learn.views.perturbed_views import perturbed_views
from rendezview_ground.learn.views.shadowed_silhouettes import (
    SunMaps,
    shadowed_silhouettes,
    sun_maps,
)
from rendezview_ground.learn.views.sketch_maps import sketched_view
from rendezview_ground.learn.views.surface_palette import surface_palette
from rendezview_ground.learn.views.surface_points import (
    SURFACE_ORDER,
    candidate_points,
    chosen_surface,
    shown_from_near,
    visible_points,
)
from rendezview_ground.learn.views.views import ViewSet, clean_views, far_views, lattice_slopes
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.crossings import faces_beside
from rendezview_ground.render.projection import SilhouetteRenderer, SurfaceRenderer
from rendezview_ground.render.renderers import Renderer
from rendezview_ground.render.shown_faces import MANY_AROUND, ShownFaces, ShownRenderer, bits_of

# Shards take about a second each.
_VIEWS_PER_SHARD = 256
_SLOW_VIEWS_PER_SHARD = 64  # of contours and shadowed silhouettes
_NODES_PER_SHARD = 16
_VIEWS_PER_LIST = 8  # views drawn per list of faces; with fewer, lists cost more than they save


@dataclass(frozen=True, slots=True, eq=False)
class TrainingStages:
    """The stages of one training job, each computed in shards, and the data they share."""

    shards: Shards
    mesh: Mesh
    beside: npt.NDArray[np.int32]  # (F, 3) faces over the edges
    renderer: SilhouetteRenderer
    surfaces: SurfaceRenderer | None  # None: the z-buffer of this package
    geometry: ViewGeometry
    options: TrainingOptions
    executor: ShardExecutor
    progress: Progress | None
    shown: SurfaceRenderer | None = None  # of the faces that show
    edges_shown: SurfaceRenderer | None = None  # of these and more, for contours

    def lattice(self) -> tuple[ViewSet, Array, Readings | None]:
        """Clean views at the sphere radius, slopes of their area with range, and far readings."""
        directions = Geodesic.of_order(self.options.order + 1).nodes
        near = self._views(
            "lattice",
            clean_views,
            [(directions[p.start : p.stop],) for p in shares(len(directions), _VIEWS_PER_SHARD)],
        )
        if self.options.perturbed_views == 0:  # the paper assumes weak perspective
            return near, np.zeros(len(near)), None
        far = self._views(
            "perspective",
            far_views,
            [(directions[p.start : p.stop],) for p in shares(len(directions), _VIEWS_PER_SHARD)],
        )
        return near, lattice_slopes(near, far, self.geometry), far.readings

    def perturbed(self, stage: str, stream: int, count: int) -> ViewSet | None:
        """Random views, or ``None`` if ``count`` is 0."""
        if count == 0:
            return None
        parts = [(stream, p) for p in shares(count, _VIEWS_PER_SHARD)]
        return self._views(stage, perturbed_views, parts)

    def contours(self) -> Contours | None:
        """Contour points of every view of the lattice at every shell."""
        radii = self.options.contour_radii
        if self.options.contour_points == 0:
            return None
        directions = Geodesic.of_order(self.options.order + 1).nodes
        shells_m = np.array(radii) * self.geometry.sphere_radius_m
        renderer = self.edges_shown or self.surfaces
        return self._contours("contours", self.geometry, directions, shells_m, renderer)

    def near(
        self, whole: Mesh, port: DockingRing | None, camera: Camera | None
    ) -> tuple[NearSphere, ...]:
        """Contour points of the part around a port; none without one, or with joints.

        Args:
            whole: the mesh with all its triangles: a near camera sees the small ones.
        """
        if 0 in (self.options.contour_points, self.options.near_cone_rad):
            return ()
        if port is None or self.mesh.face_part is not None:
            return ()
        spheres = near_spheres(self.geometry, self.options, port, camera)
        beside = self.beside if whole is self.mesh else faces_beside(whole)
        stages = dataclasses.replace(self, mesh=whole, beside=beside)
        return tuple(
            NearSphere(
                near.geometry.centre_m,
                near.geometry.target_radius_m,
                near.directions,
                stages._contours(f"near-{k}", near.geometry, near.directions, near.shells_m, None),
            )
            for k, near in enumerate(spheres)
        )

    def _contours(
        self,
        stage: str,
        geometry: ViewGeometry,
        directions: Array,
        shells_m: Array,
        renderer: SurfaceRenderer | None,
    ) -> Contours:
        """Contour points of views from directions (V, 3) at each distance."""
        shared = (self.mesh, self.beside, geometry, self.options, renderer)
        parts = [
            (directions[p.start : p.stop], range_m)
            for range_m in shells_m
            for p in shares(len(directions), _SLOW_VIEWS_PER_SHARD)
        ]
        shards = self._run(stage, _contour_arrays, shared, parts)
        views = {name: np.concatenate([a[name] for a in shards]) for name in shards[0]}
        palette, views["strip"] = surface_palette(views.pop("surfaces"))
        shape = (len(shells_m), len(directions))
        return Contours(
            shells_m=shells_m,
            palette=palette,
            **{n: a.reshape(*shape, *a.shape[1:]) for n, a in views.items()},
        )

    def shadowed_silhouettes(self) -> ShadowedSilhouettes | None:
        """Silhouettes of the sunlit parts of every view of the lattice, for every Sun direction."""
        if not self.options.shadowed_silhouettes:
            return None
        directions = Geodesic.of_order(self.options.order + 1).nodes
        maps = sun_maps(self.mesh, self.geometry)
        shared = (self.mesh, maps, self.geometry, self.shown or self.surfaces)
        parts = [
            (directions[p.start : p.stop], p.start)
            for p in shares(len(directions), _SLOW_VIEWS_PER_SHARD)
        ]
        shards = self._run("shadows", _silhouette_arrays, shared, parts)
        views = {name: np.concatenate([a[name] for a in shards]) for name in shards[0]}
        return ShadowedSilhouettes(suns=maps.suns, **views)

    def surface(self) -> tuple[Surface | None, TrainingStages]:
        """Points of the surface, and the directions from which each is visible, for shading.

        And the stages that draw only the faces that a direction shows, if views enough follow.
        """
        options = self.options
        shading = 0 not in (options.surface_points, options.contour_points)
        count = 2 + (len(options.contour_radii) if options.contour_points else 0)
        count *= len(Geodesic.of_order(options.order + 1).nodes)
        directions = Geodesic.of_order(SURFACE_ORDER).nodes
        many = count + options.perturbed_views > _VIEWS_PER_LIST * len(directions)
        lists = many and options.renderer is Renderer.NUMBA
        if not (shading or lists):
            return None, self
        points, faces = candidate_points(self.mesh, self.geometry, options)
        shared = (self.mesh, self.geometry, points, faces, options, self.surfaces, lists)
        parts = [
            (directions[p.start : p.stop],) for p in shares(len(directions), _SLOW_VIEWS_PER_SHARD)
        ]
        shards = self._run("surface", _surface_arrays, shared, parts)
        stages, surface = self, None
        if lists:
            bits = np.concatenate([a["faces"] for a in shards])
            shown = ShownFaces(directions, bits, len(self.mesh.faces))
            renderer = ShownRenderer(self.mesh, shown, self.geometry.centre_m)
            more = ShownRenderer(self.mesh, shown, self.geometry.centre_m, MANY_AROUND)
            stages = dataclasses.replace(self, renderer=renderer, shown=renderer, edges_shown=more)
        if shading:
            visible = np.concatenate([a["visible"] for a in shards])
            surface = chosen_surface(self.mesh, self.geometry, points, faces, visible, options)
        return surface, stages

    def sketches(self) -> ViewSketches | None:
        """Every node's view as the sketch network would draw it."""
        if not self.options.sketches or self.options.contour_points == 0:
            return None
        directions = Geodesic.of_order(self.options.order).nodes
        parts = [
            (directions[p.start : p.stop],) for p in shares(len(directions), _SLOW_VIEWS_PER_SHARD)
        ]
        shared = (self.mesh, self.geometry, self.shown or self.surfaces)
        shards = self._run("sketches", _sketch_arrays, shared, parts)
        return ViewSketches(**{n: np.concatenate([a[n] for a in shards]) for n in shards[0]})

    def shape(self) -> Shape | None:
        """The mesh that the craft carries, and its look-alikes; None with joints."""
        if 0 in (self.options.contour_points, self.options.surface_points) or (
            self.mesh.face_part is not None
        ):
            return None
        shared = (self.mesh, self.geometry, self.options.seed)
        return Shape(**self._run("shape", _shape_arrays, shared, [()])[0])

    def trees(self, samples: Samples) -> TreeSet:
        """Trees of all nodes."""
        nodes = len(Geodesic.of_order(self.options.order).nodes)
        parts = [(p,) for p in shares(nodes, _NODES_PER_SHARD)]
        shards = self._run("trees", _tree_arrays, (samples, self.options), parts)
        return TreeSet.joined([_tree_set(a) for a in shards])

    def score_forest(
        self, lattice: ViewSet, perturbed: ViewSet | None, lit: ShadowedSilhouettes | None
    ) -> ScoreForest | None:
        """The forest of all nodes; None without shadowed silhouettes."""
        if self.options.forest_trees == 0 or lit is None:
            return None
        samples = ForestSamples.of(self.options.order, lattice, perturbed, lit)
        nodes = len(Geodesic.of_order(self.options.order).nodes)
        parts = [(p,) for p in shares(nodes, _NODES_PER_SHARD)]
        return joined(self._run("forest", learn_forest, (samples, self.options), parts))

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
    surfaces: SurfaceRenderer | None,
    directions: Array,
    range_m: float,
) -> Arrays:
    views = [
        contour_points(mesh, beside, geometry, d, range_m, options, surfaces) for d in directions
    ]
    return {name: np.stack([view[name] for view in views]) for name in views[0]}


def _silhouette_arrays(
    mesh: Mesh,
    maps: SunMaps,
    geometry: ViewGeometry,
    surfaces: SurfaceRenderer | None,
    directions: Array,
    first: int,
) -> Arrays:
    views = [
        shadowed_silhouettes(mesh, maps, geometry, first + k, d, surfaces)
        for k, d in enumerate(directions)
    ]
    return {name: np.concatenate([view[name] for view in views]) for name in views[0]}


def _surface_arrays(
    mesh: Mesh,
    geometry: ViewGeometry,
    points: Array,
    faces: npt.NDArray[np.int32],
    options: TrainingOptions,
    surfaces: SurfaceRenderer | None,
    lists: bool,
    directions: Array,
) -> Arrays:
    visible, shown = [], []
    for direction in directions:
        points_bits, afar = visible_points(
            mesh, geometry, points, faces, direction, options, surfaces
        )
        visible.append(points_bits)
        if lists:
            near = shown_from_near(mesh, geometry, direction, options)
            shown.append(near | bits_of(afar, len(mesh.faces)))
    return {"visible": np.stack(visible)} | ({"faces": np.stack(shown)} if lists else {})


def _sketch_arrays(
    mesh: Mesh, geometry: ViewGeometry, surfaces: SurfaceRenderer | None, directions: Array
) -> Arrays:
    views = [sketched_view(mesh, geometry, direction, surfaces) for direction in directions]
    return {name: np.stack([view[name] for view in views]) for name in views[0]}


def _shape_arrays(mesh: Mesh, geometry: ViewGeometry, seed: int) -> Arrays:
    shape = carried_shape(mesh, geometry, seed)
    return {f.name: getattr(shape, f.name) for f in dataclasses.fields(Shape)}


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
