"""Refinement: from a starting pose to a pose on the edges of the frame, with its covariance.

The contour points of the nearest view of the model are projected, their edges are searched in the
grey frame, and a robust Gauss–Newton moves the pose onto them, from coarse to fine. The inlier
ratio, the share of points with an edge in place, chooses among several starting poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rendezview.estimation.hypotheses import choose
from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import about_origin
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.alignment import (
    CLOSE_PX,
    CUT_SPREADS,
    DIVERGED,
    LOOSE_PX,
    SPREAD,
    VIEWS,
    align,
    align_each,
    inlier_ratios,
)
from rendezview.sensors.appearance.edges.articulation import (
    LEAST_SUPPORT,
    Articulation,
    JointStep,
)
from rendezview.sensors.appearance.edges.lit_inliers import lit_inliers
from rendezview.sensors.appearance.edges.measured import (
    MeasuredEdges,
    nothing_known,
)
from rendezview.sensors.appearance.edges.predicted import COLUMNS
from rendezview.sensors.appearance.edges.shared_edges import without_shared
from rendezview.sensors.appearance.edges.stages import (
    COARSE,
    COARSE_STAGES,
    CUT_PX,
    FINE,
    INEXACT,
    INEXACT_CUT_PX,
    ROUGH,
)
from rendezview.sensors.appearance.hypothesis import Hypothesis, inlier_ratio
from rendezview.sensors.appearance.model.contours import Contours
from rendezview.sensors.appearance.model.error_model import ErrorModel
from rendezview.sensors.appearance.model.near_views import NearSphere
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.model.view_tables import ViewTables, read_only
from rendezview.sensors.appearance.sky import Sky

# px; one σ of an edge's place in the best of cases. Source: fixed with the fit of error_model.json
_LEAST_SIGMA_PX = 0.1
# σ by which all edges are off alike: a limb that fades into the dark. Source: a Mitsuba approach of
# the client, 60–30 m: for two minutes off by 0.04 to 0.09 px, where the residuals claim 0.04
SHARED_PX = 0.06
# Of the target's size, one σ of a strain: the contour points are those of a view up to 2.5° away,
# and neighbouring ones err together. Source: docs/notes/refinement.md, size of the target
_VIEW_STRAIN = 3e-4
# Where edges are farther off than this, those that a strain moves most do not count any more: one
# σ of the strain is also so many times the excess, of the target's radius. Source: experiment
# pose-misfit (0.1), hubble and client, seed 6, strains of 0, 1 and 4 %
_STRAIN_OF_RESIDUAL = 12.0
_FAR_RESIDUAL_PX = 0.2  # px, root mean square. Source: as above; 0.10 to 0.15 with the right mesh
# Of the inflation, which is fitted to whole targets of 100 to 220 px: the edges of a near part are
# longer and err together less. Source: experiment close-in (0.1), client, seeds 2 and 5 (Mitsuba)
_NEAR_INFLATION = 0.45
# px; one σ by which the edges of white surfaces are off alike, as nobody knows how bright those
# are. Source: integrity-draw, saturated, hubble and client, seed 7
_WHITE_PX = 0.25
_JOINT_ROUNDS = 4  # of alignment and a step of the angles. Source: experiment pose-joints (0.1)
# Of a start's inlier ratio: an alignment that ends below it has been led away. Source: assess, seed
# 61, four panels: from a start 0.03° off to 5.8°; frames of docs/notes/rivals.md as before
_HELD_SHARE = 0.95
_TURNED_PX = 0.3  # px; angles whose step moves their edges less are found. Source: its last stage


@dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """How the edges are searched."""

    # σ of an edge as the camera shows it, with reading between pixels. Source: by construction,
    # √(0.7² + 1/12 + 1/6) with optics of 0.7 px
    blur_px: float = 0.85

    def __post_init__(self) -> None:
        if not 0.3 <= self.blur_px <= 5.0:
            raise ValueError(f"blur_px must be 0.3 to 5: {self.blur_px}")


class Refiner:
    """Refines poses of one model in the frames of one camera."""

    def __init__(
        self,
        model: ViewModel,
        camera: Camera,
        options: RefineOptions | None = None,
        sphere: NearSphere | None = None,
    ) -> None:
        """A refiner on the views of the whole target, or on those of a ``sphere`` of its near part.

        The inlier ratios of a near part are those of the points in the picture.
        """
        if model.contours is None:
            raise ValueError("the model has no contour points")
        self.model = model
        self.sphere = sphere
        self.centre_m = model.centre_m if sphere is None else sphere.centre_m
        self._radius_m = model.target_radius_m if sphere is None else sphere.radius_m
        self.camera = camera
        self.options = options or RefineOptions()
        contours: Contours = model.contours if sphere is None else sphere.contours
        directions = model.lattice.nodes if sphere is None else sphere.directions
        own = np.copy if model.joints else np.asarray  # the points of parts are turned in place
        point, tangent = own(contours.point), own(contours.tangent)
        self.views = ViewTables(
            read_only(directions),
            read_only(contours.shells_m),
            read_only(point),
            read_only(tangent),
            read_only(contours.kind),
            read_only(contours.run),
            read_only(contours.strip),
            read_only(contours.start),
            read_only(contours.palette),
            self._radius_m,
            self.options.blur_px,
            model.shape_error,
        )
        turns = Articulation(model, self.views, point, tangent) if model.joints else None
        self.articulation = turns
        self._lens = (lens_vector(camera), camera.is_distorted)
        inexact = model.shape_error > 0.0
        self._stages, self._cut_px = (INEXACT, INEXACT_CUT_PX) if inexact else (FINE, CUT_PX)
        most = int(self._stages[:, VIEWS].max())
        self._rows = most * contours.kind.shape[2]  # of the measurements
        self._strain = model.shape_uncertainty + _VIEW_STRAIN**2 * np.eye(6)
        self._nothing_known = nothing_known(self._radius_m)

    def refine(
        self, image: Picture, sky: Sky, start: Pose, *, closely: bool = False, least: float = 0.0
    ) -> Hypothesis | None:
        """The pose next to ``start`` that fits the edges; None where it finds no hold.

        Args:
            image: (H, W) frame.
            sky: behind the target.
            start: camera_from_target.
            closely: only edges a few pixels away are looked for.
            least: inlier ratio after the coarse stages; below it the pose is given up.

        Coarse stages that lead away from a start that explains more, as edges of shadows do, are
        left out.
        """
        if self.articulation is not None:
            return self._moved(image, sky, start, self._stages[int(closely) :], least)
        before = self._ratio(image, sky, *self._centred(start), CLOSE_PX)
        first = None
        for k in range(int(closely), len(self._stages)):
            moved = self._moved(image, sky, start, self._stages[k:], least)
            if moved is not None and moved.inlier_ratio >= _HELD_SHARE * before:
                return moved
            first = first or moved
            if before <= least:
                break
        return first

    def _moved(
        self, image: Picture, sky: Sky, start: Pose, stages: Array, least: float
    ) -> Hypothesis | None:
        """The pose that some stages lead to; the finest alone is asked twice, to find the light."""
        rotation, centre = self._centred(start)
        if len(stages) == 1:
            stages = np.repeat(stages, 2, axis=0)
        if least > 0.0 and self.articulation is None:
            edges = np.zeros((self._rows, COLUMNS))
            first, frame = stages[:COARSE_STAGES], sky.vector  # and again below: light is fitted
            light = align(image, self._lens, frame, first, self.views, rotation, centre, edges)
            if light == DIVERGED or self._ratio(image, sky, rotation, centre, LOOSE_PX) < least:
                return None
        return self._refined(image, sky.vector, stages, rotation, centre)

    def _ratio(
        self, image: Picture, sky: Sky, rotation: Array, centre: Array, spread_px: float
    ) -> float:
        outline, inner, _ = inlier_ratios(
            image, self._lens, sky.vector, self.views, rotation, centre, spread_px, 1,
            np.zeros((self._rows, COLUMNS)),
        )  # fmt: skip
        return inlier_ratio(outline, inner)

    def measured(self, image: Picture, sky: Sky, start: Pose) -> MeasuredEdges | None:
        """The edges at the pose next to ``start`` that fits them; None where it finds no hold."""
        rotation, centre = self._centred(start)
        edges = np.zeros((self._rows, COLUMNS))
        light = align(
            image, self._lens, sky.vector, self._stages, self.views, rotation, centre, edges
        )
        if light == DIVERGED:
            return None
        return MeasuredEdges.of(edges, self._cut_px, rotation, centre)

    def best(
        self,
        image: Picture,
        sky: Sky,
        rotations: Array,
        centres: Array,
        keep: int = 4,
        *,
        least: float = 0.0,
    ) -> list[Hypothesis]:
        """Align starting poses coarsely, refine the ``keep`` best; by inlier ratio, best first.

        Args:
            rotations: (K, 3, 3) camera_from_target, changed in place.
            centres: (K, 3) of the view centre in the camera frame, changed in place.
            least: inlier ratio after the coarse stages; others are not refined.
        """
        ratios = np.empty((len(rotations), 3))
        frame = sky.vector
        survivors = max(2 * keep, len(rotations) * 2 // 5)
        align_each(
            image, self._lens, frame, ROUGH, COARSE, self.views, rotations, centres,
            survivors, ratios,
        )  # fmt: skip
        merit = [inlier_ratio(*ratio[:2]) for ratio in ratios]

        def same(k: int, known: int) -> bool:
            cosine = 0.5 * (np.sum(rotations[k] * rotations[known]) - 1.0)
            return bool(cosine >= _SAME_COSINE)

        choice = choose(merit, same, most=keep - 1)
        found = []
        for k in () if choice is None else choice.answers:
            if merit[k] <= 0.0 or merit[k] < least:
                continue
            refined = self._refined(image, frame, self._stages, rotations[k], centres[k])
            if refined is not None:
                found.append(refined)
        return sorted(found, key=lambda r: -r.inlier_ratio)

    def _refined(
        self, image: Picture, frame: Array, stages: Array, rotation: Array, centre: Array
    ) -> Hypothesis | None:
        """The pose (changed in place) moved onto the edges; None where it finds no hold."""
        edges = np.zeros((self._rows, COLUMNS))
        if self.articulation is not None:
            return self._turned(self.articulation, image, frame, stages, rotation, centre, edges)
        light = align(image, self._lens, frame, stages, self.views, rotation, centre, edges)
        if light == DIVERGED:
            return None
        return self._result(image, frame, rotation, centre, light, edges)

    def _turned(
        self, articulation: Articulation, image: Picture, frame: Array, stages: Array,
        rotation: Array, centre: Array, edges: Array,
    ) -> Hypothesis | None:  # fmt: skip
        """The pose and the angles of the joints, in turns; None where they find no hold.

        As the pose, the angles are found on edges further away first, and then on near ones.
        """
        coarse = [stages[:1]] if articulation.tracked else [stages[:1], stages[:2]]
        angles = articulation.start_rad.copy()
        step, light = None, DIVERGED
        last = stages[1:] if len(stages) == len(self._stages) else stages
        for part in [*coarse, *[last] * _JOINT_ROUNDS]:
            articulation.turn(angles, rotation, centre)
            light = align(image, self._lens, frame, part, self.views, rotation, centre, edges)
            if light == DIVERGED:
                return None
            fine = part is last
            cut_px = self._cut_px if fine else CUT_SPREADS * part[-1, SPREAD]
            step = articulation.step(
                edges, cut_px, int(part[-1, VIEWS]), rotation, centre, angles, self._nothing_known
            )
            if step is None:
                return None
            if fine and step.moved_px < _TURNED_PX:
                break
        articulation.turn(angles, rotation, centre)
        refined = self._result(image, frame, rotation, centre, light, edges)
        return self._with_angles(refined, angles, step, rotation) if step else None

    def _with_angles(
        self, refined: Hypothesis, angles: Array, step: JointStep, rotation: Array
    ) -> Hypothesis:
        """The pose with the angles and the covariance of all of them.

        The edges give both; what the strain of the mesh does to the pose is added. An angle whose
        parts have few edges in place could be any.
        """
        # As the covariance of the pose alone was scaled: its residual, inflation and views.
        own = about_origin(step.covariance, rotation @ self.model.centre_m)
        joint = refined.edge_variance_px2 * own
        if refined.strain_covariance is not None:
            joint[:6, :6] += refined.strain_covariance
        for k, turned in enumerate(self.model.joints):
            if step.support[k] < LEAST_SUPPORT:
                range_rad = turned.highest_rad - turned.lowest_rad
                joint[6 + k, 6 + k] += range_rad**2 / 12.0  # as evenly spread
        return replace(
            refined,
            angles_rad=angles,
            joint_covariance=joint,
            joint_support=float(step.support.min()),
            covariance=joint[:6, :6],
        )

    def _centred(self, pose: Pose) -> tuple[Array, Array]:
        """Rotation and view centre of a pose, fresh arrays."""
        return pose.rotation.copy(), pose.apply(self.centre_m)

    def _result(
        self,
        image: Picture,
        frame: Array,
        rotation: Array,
        centre: Array,
        light: float,
        edges: Array,
    ) -> Hypothesis:
        """The pose with its covariance and inlier ratios; ``edges`` are those last measured."""
        arm, none = rotation @ self.centre_m, self._nothing_known
        each = MeasuredEdges.of(edges, self._cut_px, rotation, centre)
        alone = without_shared(edges, self._cut_px, self._radius_m, float(centre[2]))
        known = each
        if alone is not edges:
            known = MeasuredEdges.of(alone, self._cut_px, rotation, centre)
        residual, sigma_px = each.residual_rms_px, max(known.residual_rms_px, _LEAST_SIGMA_PX)
        strain = self._strain
        if self.model.shape_error == 0.0:
            scale_px = self.camera.fx * self._radius_m / centre[2]
            more_px2 = max(residual**2 - _FAR_RESIDUAL_PX**2, 0.0)
            variance = known.likely_strain(none, max(residual, _LEAST_SIGMA_PX))
            variance += _STRAIN_OF_RESIDUAL**2 * more_px2 / scale_px**2
            strain = strain + variance * np.eye(6)
        strained = known.strained(none, arm, strain) + self._shared_offset(centre)
        white = known.beside_white(image)
        if white.any():
            strained += known.off_together(none, arm, _WHITE_PX * white)
        if self.model.shape_error > 0.0:
            # As for an exact model: the classifier was fitted to that.
            residual = MeasuredEdges.of(edges, CUT_PX, rotation, centre).residual_rms_px
        outline, inner, visible = inlier_ratios(
            image, self._lens, frame, self.views, rotation, centre, CLOSE_PX, 1, edges
        )
        points = 0
        if self.sphere is not None:
            outline, points = lit_inliers(edges, image, float(frame[1]))
            inner, visible = outline, 1.0
        inflation = ErrorModel.packaged().inflation(outline, known.residual_rms_px, frame[2])
        inflation *= self._stages[-1, VIEWS]  # which show the same edges
        if self.sphere is not None:
            inflation *= _NEAR_INFLATION
        pose = Pose(rotation, centre - arm)
        return Hypothesis(
            pose,
            inflation * sigma_px**2 * known.covariance(none, arm) + strained,
            outline,
            inner,
            visible,
            residual,
            light,
            inflation * sigma_px**2,
            strained,
            points=points,
        )

    def _shared_offset(self, centre: Array) -> Array:
        """(6, 6) of the pose where all edges are off alike, which no residual shows."""
        sight = centre / np.linalg.norm(centre)
        across = (SHARED_PX * centre[2] / self.camera.fx) ** 2
        covariance = np.zeros((6, 6))
        covariance[3:, 3:] = across * (np.eye(3) - np.outer(sight, sight))
        return covariance


# 1.5°. Source: by hand, seeds of docs/notes/refinement.md
_SAME_COSINE = float(np.cos(np.deg2rad(1.5)))
