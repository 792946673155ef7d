"""The pose of a frame among many starting points, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.appearance.hypotheses import Hypotheses
from rendezview.appearance.model import ViewModel
from rendezview.appearance.refine import Picture, Refined, RefineOptions, Refiner, Sky
from rendezview.appearance.signature import Signature
from rendezview.camera import Camera
from rendezview.pose import Array, Pose
from rendezview.symmetry import angle_between

_EXCESS_WEIGHT = 1.0  # lit parts outside the silhouette count against the support
_RIVAL_RAD = np.deg2rad(5.0)  # another answer, no longer the same one


@dataclass(frozen=True, kw_only=True)
class FinderOptions:
    """How far to look."""

    hypotheses: int = 60  # views and rolls that are aligned where nothing is known
    refined: int = 6  # of them that are refined
    refined_near: int = 3  # the same near a prior
    sure_support: float = 0.5  # of the prior alone: nothing else is tried


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """What the threshold found of the target: rays, and their signature."""

    rays: list[Array]  # (M, 3) each
    signature: Signature


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The best pose and the best other one."""

    best: Refined
    excess: float  # lit outlines beyond the predicted silhouette, see ``Hypotheses.excess``
    margin: float  # merit above that of the best pose more than 5° away
    rival: Refined | None = None

    @property
    def confidence(self) -> float:
        """Probability that the pose is right to 5°, 0 … 1.

        A logistic regression on what is known of the frame, fitted to simulated frames of
        four targets by ``scripts/pose_confidence.py``.
        """
        best = self.best
        features = np.array(
            [1.0, best.outline, best.inner, best.residual_px, min(self.excess, 0.5),
             min(self.margin, 0.3), best.seen]
        )  # fmt: skip
        return float(1.0 / (1.0 + np.exp(-np.clip(features @ _LOGISTIC, -30.0, 30.0))))


_LOGISTIC = np.array([-4.0, 8.0, 6.0, 0.0, -20.0, 20.0, 0.0])


def merit(refined: Refined, excess: float) -> float:
    """One figure to choose among poses of one frame by."""
    return refined.support - _EXCESS_WEIGHT * excess


@dataclass(slots=True, eq=False)
class PoseFinder:
    """Finds poses of one model in the frames of one camera."""

    model: ViewModel
    camera: Camera
    options: FinderOptions = field(default_factory=FinderOptions)
    refine_options: RefineOptions = field(default_factory=RefineOptions)
    refiner: Refiner = field(init=False)
    hypotheses: Hypotheses = field(init=False)

    def __post_init__(self) -> None:
        self.refiner = Refiner(self.model, self.camera, self.refine_options)
        self.hypotheses = Hypotheses(self.model)

    def anywhere(
        self, image: Picture, sky: Sky, outlines: Outlines, sun_camera: Array | None = None
    ) -> Found | None:
        """The pose where nothing is known of it."""
        starts = self.hypotheses.of(outlines.signature, self.options.hypotheses, sun_camera)
        refined = self.refiner.best(image, sky, starts, self.options.refined)
        return self._chosen(refined, sky, outlines)

    def at(self, image: Picture, sky: Sky, prior: Pose) -> Found | None:
        """The pose next to a prior that is right to a few degrees; None unless it is sure."""
        refined = self.refiner.refine(image, sky, prior)
        if refined is None or refined.support < self.options.sure_support:
            return None
        return self._chosen([refined], sky, None)

    def near(
        self,
        image: Picture,
        sky: Sky,
        prior: Pose,
        error_rad: float,
        outlines: Outlines | None,
        also: list[Pose],
    ) -> Found | None:
        """The pose within some angle of a prior, from turns of it and other starting points."""
        starts = _turned(prior, self.model.centre_m, error_rad) + also
        if outlines is not None:
            most = self.options.hypotheses
            starts += [
                pose
                for pose in self.hypotheses.of(outlines.signature, 3 * most)
                if pose.angle_to(prior) < error_rad
            ][:most]
        refined = self.refiner.best(image, sky, starts, self.options.refined_near)
        # An edge of tolerance: alignment may carry a start a little further.
        reach = 1.5 * error_rad + np.deg2rad(3.0)
        inside = [r for r in refined if r.pose.angle_to(prior) < reach]
        return self._chosen(inside, sky, outlines)

    def _chosen(self, refined: list[Refined], sky: Sky, outlines: Outlines | None) -> Found | None:
        """The best of refined poses by merit, and the best that is another one."""
        if not refined:
            return None
        judged = outlines is not None and sky.dark
        excess = [
            self.hypotheses.excess(outlines.rays, r.pose) if judged and outlines else 0.0
            for r in refined
        ]
        merits = [merit(r, x) for r, x in zip(refined, excess, strict=True)]
        k = int(np.argmax(merits))
        best = refined[k]
        others = [
            j
            for j, r in enumerate(refined)
            if angle_between(r.pose, best.pose, self.model.symmetries) > _RIVAL_RAD
        ]
        if not others:
            return Found(best, excess[k], 1.0)
        j = max(others, key=lambda i: merits[i])
        return Found(best, excess[k], merits[k] - merits[j], refined[j])


def _turned(prior: Pose, centre_m: Array, error_rad: float) -> list[Pose]:
    """The prior, and turns of it about the view centre: along three axes and four diagonals."""
    step = min(error_rad, np.deg2rad(20.0)) * 0.8
    axes = [sign * step * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    diagonals = [
        step * 0.7 * np.array([a, b, c]) for a in (1, -1) for b in (1, -1) for c in (1, -1)
    ]
    centre = prior.apply(centre_m)
    poses = [prior]
    for turn in Rotation.from_rotvec(axes + diagonals).as_matrix():
        rotation = turn @ prior.rotation
        poses.append(Pose(rotation, centre - rotation @ centre_m))
    return poses
