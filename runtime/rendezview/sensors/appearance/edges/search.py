"""The pose of a frame among many starting points, and how sure it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance.edges.contours import NO_POINT
from rendezview.sensors.appearance.edges.error_model import ErrorModel
from rendezview.sensors.appearance.edges.refinement import (
    Picture,
    Refined,
    RefineOptions,
    Refiner,
    Sky,
)
from rendezview.sensors.appearance.edges.retrieval import Retrieval
from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.outline.signature import Signature

_EXCESS_WEIGHT = 1.0  # lit parts outside the silhouette count against the support
_LIGHT_WEIGHT = 0.25  # grey levels that one light explains speak for a pose
_RESIDUAL_WEIGHT = 0.08  # of its logarithm: of a right pose the edges are where they should be …
_LEAST_RESIDUAL_PX = 0.05  # … and below that all are
_SHADING_WEIGHT = 0.4  # and so do bright and dark over all of its surface …
_IN_DOUBT = 0.35  # … which are looked at where edges leave so much merit to the best
_PLAIN = 0.98  # confidence that needs no look around, and by the edges alone none at the surface
_ASIDE_RAD = np.deg2rad(9.0)  # a local best is that far from the right one
_CLOSE_RAD = np.deg2rad(3.0)  # a good prior is that near
_ROUNDS = 2  # of looks around the best two poses, where none is sure
_RIVAL_RAD = np.deg2rad(5.0)  # another answer, no longer the same one


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """How far to look."""

    hypotheses: int = 60  # views and rolls that are aligned where nothing is known
    hypotheses_first: int = 20  # of them, which often are enough
    hypotheses_of_several: int = 40  # for each of several outlines
    refined: int = 6  # of them that are refined
    refined_near: int = 3  # the same near a prior
    sure_support: float = 0.5  # of the prior alone: nothing else is tried …
    sure_support_bright: float = 0.6  # … and before a bright sky, where chance supports too


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """What the threshold found of the target: rays, and their signature."""

    rays: list[Array]  # (M, 3) each
    signature: Signature


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The best pose and the best other one."""

    best: Refined
    excess: float  # lit outlines beyond the predicted silhouette, see ``Retrieval.excess``
    margin: float  # merit above that of the best pose more than 5° away; 1 where there is none
    dark: bool  # before a dark sky
    prior: bool  # found near a prior
    rival: Refined | None = None
    shading: float | None = None  # see ``surface.shading``; None: not looked at
    alone: bool = False  # the prior's own, nothing else was tried
    error_model: ErrorModel = field(default_factory=ErrorModel.packaged)

    @property
    def merit(self) -> float:
        """Of the best pose, as poses of one frame are compared."""
        return merit(self.best, self.excess, self.shading)

    @property
    def features(self) -> Array:
        """(11,) ``CONFIDENCE_FEATURES``: what tells a right pose from a wrong one."""
        best = self.best
        return np.array(
            [
                1.0,
                best.outline,
                best.inner,
                best.residual_px,
                min(self.excess, 0.3),
                min(max(self.margin, 0.0), 0.3),
                best.seen,
                float(self.dark),
                float(self.prior),
                best.light,
                self.shading or 0.0,
            ]
        )

    @property
    def confidence(self) -> float:
        """Probability that the pose is right to 5°, 0 … 1: a logistic regression."""
        return self.error_model.confidence(
            self.features, shading=self.shading is not None, dark=self.dark
        )


def merit(refined: Refined, excess: float, shading: float | None) -> float:
    """One figure to choose among poses of one frame by."""
    edges = refined.support - _EXCESS_WEIGHT * excess + _LIGHT_WEIGHT * refined.light
    edges -= _RESIDUAL_WEIGHT * math.log(max(refined.residual_px, _LEAST_RESIDUAL_PX))
    return edges if shading is None else edges + _SHADING_WEIGHT * shading


@dataclass(slots=True, eq=False)
class _Candidate:
    """A refined pose of a frame, and what was found of it besides its edges."""

    refined: Refined
    excess: float
    shading: float | None = None  # None: not looked at yet, or nothing to look at

    @property
    def by_edges(self) -> float:
        """Its merit without a look at the surface."""
        return merit(self.refined, self.excess, None)


@dataclass(slots=True, eq=False)
class PoseSearch:
    """Finds poses of one model in the frames of one camera."""

    model: ViewModel
    camera: Camera
    options: SearchOptions = field(default_factory=SearchOptions)
    refine_options: RefineOptions = field(default_factory=RefineOptions)
    refiner: Refiner = field(init=False)
    hypotheses: Retrieval = field(init=False)
    _flips: Array = field(init=False)  # (3, 3, 3)
    _error_model: ErrorModel = field(init=False)

    def __post_init__(self) -> None:
        self.refiner = Refiner(self.model, self.camera, self.refine_options)
        self.hypotheses = Retrieval(self.model)
        self._flips = half_turns(self.model)
        self._error_model = self.model.error_model or ErrorModel.packaged()

    def anywhere(
        self,
        image: Picture,
        sky: Sky,
        bodies: list[Outlines],
        sun_camera: Array | None = None,
    ) -> Found | None:
        """The pose where nothing is known of it, from one or several readings of the outline."""
        each = self.options.hypotheses
        if len(bodies) > 1:
            each = self.options.hypotheses_of_several
        starts = [self.hypotheses.of(o.signature, each, sun_camera) for o in bodies]
        first = self.options.hypotheses_first // len(bodies)
        keep = self.options.refined
        candidates: list[_Candidate] = []
        turned: list[Refined] = []  # whose half turns have been tried
        found = None
        for part, thorough in (
            (slice(0, first), False),
            (slice(first, None), False),
            (slice(None), True),
        ):
            rotations = np.concatenate([r[part] for r, _ in starts])
            centres = np.concatenate([c[part] for _, c in starts])
            refined = self.refiner.best(image, sky, rotations, centres, keep, thorough=thorough)
            candidates += self._candidates(refined, sky, bodies)
            best = max(candidates, key=lambda c: c.refined.support, default=None)
            if best is not None and best.refined not in turned:
                flipped = self._flipped(image, sky, best.refined)
                candidates += self._candidates(flipped, sky, bodies)
                turned.append(best.refined)
            found = self._chosen(candidates, image, sky)
            if found is not None and found.confidence >= _PLAIN:
                return found
        looked: list[Refined] = []  # around which all has been tried
        for _ in range(_ROUNDS):
            poses = [] if found is None else [found.best, found.rival]
            more = []
            for pose in poses:
                if pose is None or pose in looked:
                    continue
                looked.append(pose)
                more += self._around(image, sky, pose) + self._beside(image, sky, pose.pose)
                if pose not in turned:
                    turned.append(pose)
                    more += self._flipped(image, sky, pose)
            if not more:
                break
            candidates += self._candidates(more, sky, bodies)
            found = self._chosen(candidates, image, sky)
            if found is not None and found.confidence >= _PLAIN:
                break
        return found

    def at(
        self,
        image: Picture,
        sky: Sky,
        prior: Pose,
        error_rad: float,
        enough: float = 1.0,
    ) -> Found | None:
        """The pose next to a prior that is right to a few degrees; None unless it is sure.

        ``enough`` support will do, if it is less than the options ask for.
        """
        refined = self.refiner.refine(image, sky, prior)
        if refined is None or refined.support < min(enough, self._sure(sky)):
            return None
        if refined.pose.angle_to(prior) > _reach(error_rad):
            return None
        lone = self._candidates([refined], sky, [])
        usual = refined.support >= self._sure(sky)
        found = self._chosen(lone, image, sky, prior=True, look=not usual)
        if usual and found is not None and found.confidence < _PLAIN:
            found = self._chosen(lone, image, sky, prior=True)
        if found is None or found.confidence < _PLAIN:
            return None
        return replace(found, alone=True)

    def near(
        self,
        image: Picture,
        sky: Sky,
        prior: Pose,
        error_rad: float,
        bodies: list[Outlines],
        also: list[Pose],
    ) -> Found | None:
        """The pose within some angle of a prior, from turns of it and other starting points."""
        rotations, centres = _turned(prior, self.model.centre_m, error_rad)
        rotations = np.concatenate([rotations, *(p.rotation[None] for p in also)])
        centres = np.concatenate([centres, *(p.apply(self.model.centre_m)[None] for p in also)])
        cosine = np.cos(error_rad)
        for outlines in bodies:
            more, places = self.hypotheses.of(outlines.signature, 3 * self.options.hypotheses)
            trace = np.einsum("kij,ij->k", more, prior.rotation)
            close = np.flatnonzero(0.5 * (trace - 1.0) > cosine)[: self.options.hypotheses]
            rotations = np.concatenate([rotations, more[close]])
            centres = np.concatenate([centres, places[close]])
        refined = self._beside(image, sky, prior)
        refined += self.refiner.best(image, sky, rotations, centres, self.options.refined_near)
        inside = [r for r in refined if r.pose.angle_to(prior) < _reach(error_rad)]
        candidates = self._candidates(inside, sky, bodies)
        found = self._chosen(candidates, image, sky, prior=True)
        if found is not None and found.confidence < _PLAIN:
            around = self._around(image, sky, found.best)
            inside = [r for r in around if r.pose.angle_to(prior) < _reach(error_rad)]
            candidates += self._candidates(inside, sky, bodies)
            found = self._chosen(candidates, image, sky, prior=True)
        return found

    def _sure(self, sky: Sky) -> float:
        return self.options.sure_support if sky.dark else self.options.sure_support_bright

    def _around(self, image: Picture, sky: Sky, best: Refined) -> list[Refined]:
        """Poses from around the best one, where it is not sure: edges may have held it aside."""
        rotations, centres = _turned(best.pose, self.model.centre_m, _ASIDE_RAD)
        return self.refiner.best(image, sky, rotations[1:], centres[1:], 2)

    def _beside(self, image: Picture, sky: Sky, prior: Pose) -> list[Refined]:
        """Poses next to a good prior, where coarse looks may find no hold or another one."""
        rotations, centres = _turned(prior, self.model.centre_m, _CLOSE_RAD)
        starts = map(Pose, rotations[:7], (centres - rotations @ self.model.centre_m)[:7])
        found = [self.refiner.refine(image, sky, start, closely=True) for start in starts]
        found.append(self.refiner.refine(image, sky, prior))
        return [refined for refined in found if refined is not None]

    def _flipped(self, image: Picture, sky: Sky, best: Refined) -> list[Refined]:
        """Half turns of the best pose: many craft look nearly the same from behind or below."""
        rotations = best.pose.rotation @ self._flips
        centres = np.tile(best.pose.apply(self.model.centre_m), (len(rotations), 1))
        starts = map(Pose, rotations, centres - rotations @ self.model.centre_m)
        # Where they nearly fit a coarse look may move them away.
        close = [self.refiner.refine(image, sky, start) for start in starts]
        found = [refined for refined in close if refined is not None]
        return found + self.refiner.best(image, sky, rotations, centres, 2)

    def _candidates(
        self, refined: list[Refined], sky: Sky, bodies: list[Outlines]
    ) -> list[_Candidate]:
        return [_Candidate(r, self._excess(r.pose, sky, bodies)) for r in refined]

    def _chosen(
        self,
        candidates: list[_Candidate],
        image: Picture,
        sky: Sky,
        *,
        prior: bool = False,
        look: bool = True,
    ) -> Found | None:
        """The best of refined poses by merit, and the best that is another one.

        ``look`` at the surface too, once, of those poses whose edges leave them a chance.
        """
        if not candidates:
            return None
        least = max(c.by_edges for c in candidates) - _IN_DOUBT if look else np.inf
        merits = []
        for c in candidates:
            doubtful = c.by_edges >= least
            if doubtful and c.shading is None:
                c.shading = self.refiner.shading(image, sky, c.refined.pose)
            merits.append(merit(c.refined, c.excess, c.shading if doubtful else None))
        k = int(np.argmax(merits))
        best, shading = candidates[k], candidates[k].shading
        others = [
            j
            for j, c in enumerate(candidates)
            if angle_between(c.refined.pose, best.refined.pose, self.model.symmetries) > _RIVAL_RAD
        ]
        if not others:
            return Found(
                best.refined, best.excess, 1.0, sky.dark, prior, shading=shading,
                error_model=self._error_model,
            )  # fmt: skip
        j = max(others, key=lambda i: merits[i])
        lead, rival = merits[k] - merits[j], candidates[j].refined
        return Found(
            best.refined, best.excess, lead, sky.dark, prior, rival, shading,
            error_model=self._error_model,
        )  # fmt: skip

    def _excess(self, pose: Pose, sky: Sky, bodies: list[Outlines]) -> float:
        """Before a bright sky the outlines themselves are in doubt, and say nothing."""
        if not sky.dark:
            return 0.0
        return max((self.hypotheses.excess(body.rays, pose) for body in bodies), default=0.0)


def half_turns(model: ViewModel) -> Array:
    """(3, 3, 3) half turns about the principal axes of the model's contour points."""
    contours = model.contours
    if contours is None:
        raise ValueError("the model has no contour points")
    shape = (-1, contours.point.shape[-1])
    _, axes = np.linalg.eigh(_second_moments(contours.point.reshape(shape), contours.kind.ravel()))
    return np.array([2.0 * np.outer(axis, axis) - np.eye(3) for axis in axes.T])


@njit(cache=True, nogil=True)
def _second_moments(points, kinds):  # type: ignore[no-untyped-def]
    """(3, 3) Σ p pᵀ of the points (N, 3) int16 that are any; whole numbers, so it is exact."""
    moments = np.zeros((3, 3))
    for k in range(points.shape[0]):
        if kinds[k] != NO_POINT:
            for i in range(3):
                for j in range(3):
                    moments[i, j] += float(points[k, i]) * float(points[k, j])
    return moments


def _reach(error_rad: float) -> float:
    """How far from a prior a pose may come out: as far as the prior may be off, and a little."""
    return float(1.1 * error_rad + np.deg2rad(1.0))


def _turned(prior: Pose, centre_m: Array, error_rad: float) -> tuple[Array, Array]:
    """The prior, and turns of it about the view centre: along three axes and four diagonals."""
    step = min(error_rad, np.deg2rad(20.0)) * 0.8
    axes = [sign * step * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    diagonals = [
        step * 0.7 * np.array([a, b, c]) for a in (1, -1) for b in (1, -1) for c in (1, -1)
    ]
    turns = Rotation.from_rotvec([np.zeros(3), *axes, *diagonals]).as_matrix()
    return turns @ prior.rotation, np.tile(prior.apply(centre_m), (len(turns), 1))
