"""The stages of a training job, from views and contours to trees and calibration."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor, Shared, Task
from rendezview_ground.learn.jobs.stages import Arrays, Join, Progress, Shards, shares, together
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry
from rendezview_ground.learn.trees.calibrate import prior_errors, recognition_errors
from rendezview_ground.learn.trees.forest import ForestSamples, joined, learn_forest
from rendezview_ground.learn.trees.node_trees import Samples, TreeSet, learn_trees
from rendezview_ground.learn.views.carried_shape import carried_shape
from rendezview_ground.learn.views.contours import contour_points
from rendezview_ground.learn.views.near_spheres import near_spheres
from rendezview_ground.learn.views.perturbed_views import perturbed_views
from rendezview_ground.learn.views.shadowed_silhouettes import shadowed_silhouettes, sun_maps
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

    @property
    def directions(self) -> Array:
        """(V, 3) from which the views of the lattice are drawn."""
        return Geodesic.of_order(self.options.order + 1).nodes

    def lattice(self) -> tuple[ViewSet, Array, Readings | None]:
        """Clean views at the sphere radius, slopes of their area with range, and far readings."""
        directions = self.directions
        parts = [(directions[p.start : p.stop],) for p in shares(len(directions), _VIEWS_PER_SHARD)]
        near = self._views("lattice", clean_views, parts)
        if self.options.perturbed_views == 0:  # the paper assumes weak perspective
            return near, np.zeros(len(near)), None
        far = self._views("perspective", far_views, parts)
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
        shells_m = np.array(radii) * self.geometry.sphere_radius_m
        renderer = self.edges_shown or self.surfaces
        return self._contours("contours", self.geometry, self.directions, shells_m, renderer)

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
        draw = partial(
            contour_points, self.mesh, self.beside, geometry, options=self.options,
            renderer=renderer,
        )  # fmt: skip
        each = [(direction, range_m) for range_m in shells_m for direction in directions]
        views = self._drawn(stage, draw, each)
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
        maps = sun_maps(self.mesh, self.geometry)
        draw = partial(
            shadowed_silhouettes, self.mesh, maps, self.geometry,
            renderer=self.shown or self.surfaces,
        )  # fmt: skip
        views = self._drawn("shadows", draw, list(enumerate(self.directions)), np.concatenate)
        return ShadowedSilhouettes(suns=maps.suns, **views)

    def surface(self) -> tuple[Surface | None, TrainingStages]:
        """Points of the surface, and the directions from which each is visible, for shading.

        And the stages that draw only the faces that a direction shows, if views enough follow.
        """
        options = self.options
        shading = 0 not in (options.surface_points, options.contour_points)
        count = 2 + (len(options.contour_radii) if options.contour_points else 0)
        count *= len(self.directions)
        directions = Geodesic.of_order(SURFACE_ORDER).nodes
        many = count + options.perturbed_views > _VIEWS_PER_LIST * len(directions)
        lists = many and options.renderer is Renderer.NUMBA
        if not (shading or lists):
            return None, self
        points, faces = candidate_points(self.mesh, self.geometry, options)
        draw = partial(
            _surface_view, self.mesh, self.geometry, points, faces, options, self.surfaces, lists
        )
        seen = self._drawn("surface", draw, [(direction,) for direction in directions])
        stages, surface = self, None
        if lists:
            shown = ShownFaces(directions, seen["faces"], len(self.mesh.faces))
            renderer = ShownRenderer(self.mesh, shown, self.geometry.centre_m)
            more = ShownRenderer(self.mesh, shown, self.geometry.centre_m, MANY_AROUND)
            stages = dataclasses.replace(self, renderer=renderer, shown=renderer, edges_shown=more)
        if shading:
            surface = chosen_surface(
                self.mesh, self.geometry, points, faces, seen["visible"], options
            )
        return surface, stages

    def sketches(self) -> ViewSketches | None:
        """Every node's view as the sketch network would draw it."""
        if not self.options.sketches or self.options.contour_points == 0:
            return None
        draw = partial(
            sketched_view, self.mesh, self.geometry, renderer=self.shown or self.surfaces
        )
        directions = Geodesic.of_order(self.options.order).nodes
        return ViewSketches(**self._drawn("sketches", draw, [(d,) for d in directions]))

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
        return TreeSet.joined(self._run("trees", _tree_arrays, (samples, self.options), parts))

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

    def _drawn(
        self,
        stage: str,
        draw: Callable[..., Arrays],
        views: list[tuple[Any, ...]],
        join: Join = np.stack,
    ) -> Arrays:
        """What ``draw`` makes of the arguments of each view, one view after the other."""
        parts = [(views[p.start : p.stop],) for p in shares(len(views), _SLOW_VIEWS_PER_SHARD)]
        return together(self._run(stage, _drawn_views, (draw, join), parts))

    def _run(
        self, stage: str, task: Task, shared: Shared, parts: list[tuple[Any, ...]]
    ) -> list[Arrays]:
        return self.shards.run(stage, task, shared, parts, self.executor, self.progress)


def _view_arrays(draw: Any, *arguments: Any) -> Arrays:
    return _fields(draw(*arguments))


def _fields(one: ViewSet | Shape) -> Arrays:
    return {f.name: getattr(one, f.name) for f in dataclasses.fields(one)}


def _drawn_views(draw: Callable[..., Arrays], join: Join, views: list[tuple[Any, ...]]) -> Arrays:
    return together([draw(*view) for view in views], join)


def _surface_view(
    mesh: Mesh,
    geometry: ViewGeometry,
    points: Array,
    faces: npt.NDArray[np.int32],
    options: TrainingOptions,
    surfaces: SurfaceRenderer | None,
    lists: bool,
    direction: Array,
) -> Arrays:
    """Which points are visible from a direction, and which faces if these are listed."""
    visible, afar = visible_points(mesh, geometry, points, faces, direction, options, surfaces)
    if not lists:
        return {"visible": visible}
    near = shown_from_near(mesh, geometry, direction, options)
    return {"visible": visible, "faces": near | bits_of(afar, len(mesh.faces))}


def _shape_arrays(mesh: Mesh, geometry: ViewGeometry, seed: int) -> Arrays:
    return _fields(carried_shape(mesh, geometry, seed))


def _tree_arrays(samples: Samples, options: TrainingOptions, nodes: range) -> Arrays:
    return learn_trees(samples, options, nodes).arrays()


def _error_arrays(model: ViewModel, held_out: ViewSet, priors: Array, rows: slice) -> Arrays:
    return {"errors": recognition_errors(model, held_out, priors, rows)}
