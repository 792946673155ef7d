"""The search for the pose of a frame on its sketch.

The network draws a sketch of the frame (``network``). Correlation with the model's views proposes
poses (``retrieval``), which are moved onto the sketch's edges (``alignment``). What of its lines
they explain (``explained``), and how far the grey levels are those of a lit surface at the pose
(``edges/shading``), decides between them. The best are looked at again in a sketch twice as fine.
A forest gives the probability that the best of them is right (``choice``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import about_origin, log
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.alignment import CUT_SPREADS
from rendezview.sensors.appearance.edges.contour_at import target_box
from rendezview.sensors.appearance.edges.measured import MeasuredEdges
from rendezview.sensors.appearance.edges.network import FINER, Box, Sketch, Sketcher, around
from rendezview.sensors.appearance.edges.predicted import COLUMNS
from rendezview.sensors.appearance.edges.sketch import (
    Maps,
    align_all_to_sketch,
    align_to_sketch,
    pose_covariance,
)
from rendezview.sensors.appearance.hypothesis import Bound, Hypothesis
from rendezview.sensors.appearance.judge.explained import explained_share
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.judge.shading import SurfaceTables, shading
from rendezview.sensors.appearance.judge.sketch_choice import DOUBT, Passes, distinct, packaged
from rendezview.sensors.appearance.model.sketches import COVER, CREASE, EDGE, Float32s
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.model.view_tables import Lens, ViewTables
from rendezview.sensors.appearance.search.by_sketch import SketchRetrieval
from rendezview.sensors.appearance.search.partial_views import NOTHING
from rendezview.sensors.appearance.search.starts import rotated_about
from rendezview.sensors.appearance.search.windows import Body, bodies_in_windows
from rendezview.sensors.appearance.sky import Sky

# Stages of alignment: reach and spread (sketch px), steps, stride, weight of inner edges. A third
# of the target is looked over first, then less and less. Source: experiment photo-accuracy
_COARSE = np.array(
    [[14.0, 7.0, 3.0, 4.0, 0.5], [9.0, 4.0, 3.0, 1.0, 0.5], [6.0, 2.5, 4.0, 1.0, 0.5]]
)
# In the finer sketch all edges within 3 % of the target's size count: where the mesh is wrong, the
# mean of many edges is nearer to the pose than the few that fit. Source: experiment photo-accuracy
_FINE = np.array([[18.0, 8.0, 10.0, 2.0, 1.0]])
# The pose that is given has converged: edges hold it where it is, so it takes more steps. Lengths
# are of a first pass, and grow with its fineness: the mesh's errors do. Source: frames of
# sketch-confidence and photo-accuracy (docs/notes/photographs.md)
_LAST = np.array([[10.0, 4.5, 40.0, 1.0, 0.7]])
# Source: experiment photo-accuracy
_RETRIEVED = 120  # views and rolls that are aligned without a prior
_RETRIEVED_NEAR = 30  # the same near a prior. Source: experiment photo-accuracy
_KEPT = 24  # of them after the first stage. Source: experiment photo-accuracy, rank of right ones
# Of outline, inner edges and contrast, how promising a pose is then. Source: the same
_PROMISE = np.array([1.0, 0.3, 0.5])
_LOOKED_AT = 5  # of the aligned poses, more closely. Source: experiment photo-accuracy
# Rad, between them; and so far around the pose that fits best is looked for. Source: the same
_ASIDE_RAD = np.deg2rad(4.0)
_VIEW_RAD = np.deg2rad(6.0)  # rad; from any attitude to the nearest view. Source: the node sphere
_UNKNOWN = 1e-9  # of the information, added: it can be solved for. Source: by construction
_SMOOTH_PX = 0.7  # sketch px; σ of the lines before they are read. Source: half their width
# Source: experiment photo-accuracy
_CREASE_SHARE = 0.5  # of the edges in the map of creases: the network confuses the two


class Reading(NamedTuple):
    """A sketch as poses are aligned to it and judged by it."""

    maps: Maps
    grey: Picture  # (h, w) of the sketch
    lens: Lens  # of a camera whose picture that is
    last: Array  # (1, 5) of ``_last``
    lines: Float32s  # (h, w) of ``_lines``
    lines_lens: Lens  # of a camera whose picture they are
    sky: Array  # (6,) of ``Sky.vector``


class SketchSearch:
    """Finds poses of one model in the frames of one camera by their sketches."""

    def __init__(
        self, model: ViewModel, camera: Camera, views: ViewTables, sketcher: Sketcher
    ) -> None:
        """A search; ``views`` are the contour points of the model.

        Raises:
            ValueError: the model has no sketches.
        """
        if model.sketches is None:
            raise ValueError("the model has no sketches")
        self.sketcher = sketcher
        self.bounds: tuple[Bound, ...] = ()  # of all poses
        self.box: Box | None = None  # of the target, frame px, where it is known to a fifth
        self.retrieval = SketchRetrieval(model, model.sketches, camera)
        self._set_tables(model, camera, views)

    def _set_tables(self, model: ViewModel, camera: Camera, views: ViewTables) -> None:
        self.model, self.camera, self._views = model, camera, views
        self._lens = (lens_vector(camera), camera.is_distorted)
        self._surface = None
        if model.surface is not None:
            self._surface = SurfaceTables.of(model.surface, model.target_radius_m)

    def best(self, frame: Picture, sky: Sky, sketch: Sketch | None = None) -> Found | None:
        """As ``anywhere``, with a second opinion where the pose is in doubt.

        Near a prior there is none: both searches are held by the prior, and agree where it is
        wrong.
        """
        first = self.anywhere(frame, sky, sketch)
        if first is None or not DOUBT[0] <= first.confidence < DOUBT[1]:
            return first
        second = self.anywhere(frame, sky, turned=True)
        return first if second is None else first.with_opinion(second, self.model.symmetries)

    def anywhere(
        self, frame: Picture, sky: Sky, sketch: Sketch | None = None, *, turned: bool = False
    ) -> Found | None:
        """The best pose of a frame without a prior; None where the sketch shows no target.

        ``sketch``: that of the frame, if it was drawn. ``turned``: the network sees the frame
        upside down.
        """
        if self.box is not None:
            sketch = sketch or self.sketcher.look(frame, around(self.box), turned=turned)
            rotations, centres = self.retrieval.starts_in(sketch, self.box, _RETRIEVED)
        else:
            sketch = sketch or self.sketcher.find(frame, turned=turned)
            if sketch is None:
                return None
            rotations, centres = self.retrieval.starts(sketch, _RETRIEVED)
        reading = self.read(sketch, sky)
        poses = self._bounded(self.aligned(reading, rotations, centres))
        return self._closer(frame, sky, reading, poses, None, turned=turned)

    def near(self, frame: Picture, sky: Sky, near: Near) -> Found | None:
        """The best pose within some angle of a prior; None where there is none."""
        sketch = self.sketcher.near(frame, target_box(self.model, self.camera, near.prior))
        if sketch is None:
            return None
        around, stay = rotated_about(near.prior, self.model.centre_m, near.error_rad)
        alike, places = self.retrieval.starts(
            sketch, _RETRIEVED_NEAR, near.prior.rotation, near.error_rad + _VIEW_RAD
        )
        rotations = np.concatenate([around, alike])
        centres = np.concatenate([stay, places])
        reading = self.read(sketch, sky)
        first = near.wider(_VIEW_RAD)
        poses = self._bounded(self.aligned(reading, rotations, centres), first)
        return self._closer(frame, sky, reading, poses, near, turned=False)

    def bodies(
        self, frame: Picture, most: int, may_be: Callable[[Array], bool] | None = None
    ) -> list[Body]:
        """Bodies of a frame, those most like the target first; see ``bodies_in_windows``."""
        return bodies_in_windows(self.sketcher, self.retrieval, frame, most, may_be)

    def with_tables(self, model: ViewModel, views: ViewTables, camera: Camera) -> SketchSearch:
        """The same search for the model with its contour points moved, and a camera alike."""
        moved = copy(self)
        moved._set_tables(model, camera, views)
        moved.retrieval = self.retrieval.with_camera(camera)
        return moved

    def closer_sketch(self, frame: Picture, pose: Pose, *, turned: bool = False) -> Sketch | None:
        """The finer sketch of the target at a pose; None where it lies outside the frame."""
        box = target_box(self.model, self.camera, pose)
        return self.sketcher.near(frame, box, FINER, turned=turned)

    def measured(self, sketch: Sketch, start: Pose) -> MeasuredEdges | None:
        """The edges of a sketch at the pose next to ``start`` that fits them, sketch px."""
        return self._measured(_maps(sketch), self._lens_of(sketch.place), _last(sketch), start)

    def _measured(self, maps: Maps, lens: Lens, last: Array, start: Pose) -> MeasuredEdges | None:
        edges = np.zeros((self._views.point.shape[2], COLUMNS))
        rotation, centre = start.rotation.copy(), start.apply(self.model.centre_m)
        if not align_to_sketch(maps, lens, self._views, last, rotation, centre, edges):
            return None
        return MeasuredEdges.of(edges, CUT_SPREADS * last[-1, 1], rotation, centre)

    def aligned(self, reading: Reading, rotations: Array, centres: Array) -> list[Hypothesis]:
        """Poses (K, 3, 3) and view centres (K, 3), changed in place, moved onto a sketch.

        All take the first stage, the most promising ones the others. Those that find no hold are
        left out.
        """
        scores = np.empty((len(rotations), 4))
        align_all_to_sketch(
            reading.maps, reading.lens, self._views, _COARSE[:1], rotations, centres, scores,
            int(_COARSE[0, 3]),
        )  # fmt: skip
        promise = np.where(scores[:, 0] >= 0.0, scores[:, :3] @ _PROMISE, -np.inf)
        kept = np.argsort(-promise, kind="stable")[:_KEPT]
        kept = kept[np.isfinite(promise[kept])]
        return self._aligned(reading, rotations[kept], centres[kept], _COARSE[1:])

    def read(self, sketch: Sketch, sky: Sky) -> Reading:
        """What alignment and judgement read of a sketch of a frame."""
        lines, place = _lines(sketch)
        lens, lines_lens = self._lens_of(sketch.place), self._lens_of(place)
        return Reading(
            _maps(sketch), sketch.grey, lens, _last(sketch), lines, lines_lens, sky.vector
        )

    def _each_aligned(self, reading: Reading, poses: Sequence[Pose]) -> list[Hypothesis | None]:
        """Where the closer pass leads each pose to; None: no hold."""
        each = (
            self._aligned(
                reading, p.rotation[None].copy(), p.apply(self.model.centre_m)[None], _FINE
            )
            for p in poses
        )
        return [found[0] if found else None for found in each]

    def _aligned(
        self, reading: Reading, rotations: Array, centres: Array, stages: Array
    ) -> list[Hypothesis]:
        maps, grey, lens, _, lines, lines_lens, sky = reading
        scores = np.empty((len(rotations), 4))
        align_all_to_sketch(maps, lens, self._views, stages, rotations, centres, scores)
        seen = np.empty(lines.shape, np.uint8)
        found = []
        for k in np.flatnonzero(scores[:, 0] >= 0.0):
            at = rotations[k], centres[k]
            pose = Pose(at[0], at[1] - at[0] @ self.model.centre_m)
            explained = explained_share(lines, lines_lens, self._views, *at, seen)
            alike = (0.0, 0.0)
            if self._surface is not None:
                alike = shading(grey, lens, sky, self._surface, *at, np.zeros(3))
            lit = (max(correlation, 0.0) ** 2 for correlation in alike)
            outline, inner, _, visible = (float(score) for score in scores[k])
            features = np.array([*scores[k], explained, *lit])
            found.append(Hypothesis(pose, None, outline, inner, visible=visible, sketch=features))
        return found

    def _closer(
        self, frame: Picture, sky: Sky, first: Reading, poses: list[Hypothesis],
        near: Near | None, *, turned: bool,
    ) -> Found | None:  # fmt: skip
        """The best of some poses of a first sketch after a closer pass at the target."""
        best = distinct(poses, _LOOKED_AT, _ASIDE_RAD)
        if not best:
            return None
        sketch = self.closer_sketch(frame, best[0].pose, turned=turned)
        # The trees have hardly seen frames that the target overflows, and are sure of wrong poses.
        if sketch is None or sketch.overflows:
            return None
        centre_m, reading = self.model.centre_m, self.read(sketch, sky)
        starts, places = rotated_about(best[0].pose, centre_m, _ASIDE_RAD)
        around = self._aligned(reading, starts, places, _FINE)
        starts = np.array([b.pose.rotation for b in best[1:]]).reshape(-1, 3, 3)
        places = np.array([b.pose.apply(centre_m) for b in best[1:]]).reshape(-1, 3)
        others = self._aligned(reading, starts, places, _FINE)
        around, others = (self._bounded(found, near) for found in (around, others))
        passes = Passes(
            poses, around, others, self.model.symmetries, near is not None, sketch.is_cut
        )
        chosen = passes.chosen()
        if chosen is None:
            return None
        one, rival, margin = chosen
        pose, spread_deg, scatter = self._finest(one.pose, [first, reading])
        passes = replace(passes, spread_deg=spread_deg)
        covariance, strained, residual_px = pose_covariance(
            reading.maps, reading.lens, self._views, reading.last[-1], pose.rotation.copy(),
            pose.apply(centre_m), pose.rotation @ centre_m, self.model.shape_uncertainty,
        )  # fmt: skip
        # Errors of poses show how far edges are from independent.
        covariance = covariance * packaged().inflation + (strained + scatter)

        def known(one: Hypothesis, pose: Pose) -> Hypothesis:
            residual = residual_px / sketch.scale
            return replace(one, pose=pose, covariance=covariance, residual_px=residual)

        return Found(
            known(one, pose), margin, sky.dark, passes.prior, rival and known(rival, rival.pose),
            probability=passes.probability, aligned=partial(self._each_aligned, reading),
            passes=passes,
        )  # fmt: skip

    def _bounded(self, poses: list[Hypothesis], near: Near | None = None) -> list[Hypothesis]:
        """The poses that may be the answer."""
        bounds = self.bounds if near is None else (*self.bounds, near.holds)
        return [found for found in poses if all(bound(found.pose) for bound in bounds)]

    def _finest(self, best: Pose, readings: list[Reading]) -> tuple[Pose, float, Array]:
        """The pose that one leads to in the last and finest of some sketches.

        Coarser ones draw outlines a quarter to half a sketch pixel inside: too far away.

        Returns:
            The pose; the largest angle between the sketches' poses and their mean, °, weighted by
            what each knows; (6, 6) covariance of the mean as their scatter shows it, of the
            rotation vector and the target's origin.
        """
        centre = best.apply(self.model.centre_m)
        each = [self._measured(r.maps, r.lens, r.last, best) for r in readings]
        found, finest = [edges for edges in each if edges is not None], each[-1]
        if not found:
            return best, 0.0, np.zeros((6, 6))
        moves = np.array(
            [np.append(log(e.rotation @ best.rotation.T), e.centre_m - centre) for e in found]
        )
        known = np.array([edges.information for edges in found])
        total = known.sum(0)
        total += _UNKNOWN * np.diag(np.diag(total))
        off = moves - np.linalg.solve(total, np.einsum("kij,kj->i", known, moves))
        pose = best
        if finest is not None:
            arm = finest.rotation @ self.model.centre_m
            pose = Pose(finest.rotation, finest.centre_m - arm)
        count = len(found)
        scatter = about_origin(off.T @ off, pose.rotation @ self.model.centre_m)
        scatter /= count * max(count - 1, 1)
        spread_deg = float(np.rad2deg(np.linalg.norm(off[:, :3], axis=1).max()))
        return pose, spread_deg, scatter

    def _lens_of(self, place: Array) -> Lens:
        """The lens of a camera whose picture is a sketch, ``place`` as of ``Sketch.place``."""
        scale, left, top = place
        vector = self._lens[0].copy()
        vector[:4] *= scale
        vector[2:4] += left, top
        return vector, self._lens[1]


def _last(sketch: Sketch) -> Array:
    """(1, 5) the last stage of alignment, its lengths in pixels of this sketch."""
    finer = np.array([sketch.fineness, sketch.fineness, 1.0, 1.0, 1.0])
    return np.asarray(_LAST * finer, dtype=np.float64)


def _maps(sketch: Sketch) -> Maps:
    """The maps as alignment reads them."""
    edge, crease = sketch.maps[EDGE], sketch.maps[CREASE]
    crease = np.maximum(crease, np.float32(_CREASE_SHARE) * edge)
    soft = [np.asarray(cv2.GaussianBlur(m, (0, 0), _SMOOTH_PX)) for m in (edge, crease)]
    return Maps(np.ascontiguousarray(sketch.maps[COVER]), soft[0], soft[1])


def _lines(sketch: Sketch) -> tuple[Float32s, Array]:
    """How much of a line there is, (h, w), as a share of the sum, and its place as of a sketch.

    They are as fine as a first pass. Squares of the probabilities of edges and creases: faint
    doubts all over a sketch add up to as much as its lines.
    """
    lines = sketch.maps[EDGE] ** 2 + sketch.maps[CREASE] ** 2
    n = min(max(1, round(sketch.fineness)), *lines.shape)
    height, width = (side // n for side in lines.shape)
    whole = lines[: n * height, : n * width]
    lines = np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))
    scale, left, top = sketch.place
    place = np.array([scale / n, (left + 0.5) / n - 0.5, (top + 0.5) / n - 0.5])
    return np.asarray(lines / (lines.sum() + NOTHING), dtype=np.float32), place
