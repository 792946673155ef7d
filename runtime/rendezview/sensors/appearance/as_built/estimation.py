"""The shape of a target as it was built: the strain between its CAD model and the craft.

Contour points of the model and edges of many frames disagree in a pattern that no pose explains.
The poses of all frames and one homogeneous strain of the model are estimated together by
Gauss–Newton; each frame's pose is eliminated (Schur complement), as in bundle adjustment (Triggs et
al. 2000, section 6.1). A strain S moves a point from view centre + q to view centre + (I + S) q.

One camera does not see the overall size: a larger target further away gives the same picture. The
strain is then the one that leaves most dimensions as they are, unless a length is known: the
variance that a component may have follows its size beside the largest one, so that one large
component is likelier than three of half its size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import exp
from rendezview.io.grey_frame import Picture, check_frame, shrunk
from rendezview.sensors.appearance.as_built.shape import AsBuilt, ShapeOptions, SurfaceResiduals
from rendezview.sensors.appearance.as_built.strain import matrix_of, strain_names, strained
from rendezview.sensors.appearance.edges.levels import (
    FINEST_RADIUS_PX,
    shrunk_blur,
    times_smaller,
)
from rendezview.sensors.appearance.edges.measured import MeasuredEdges
from rendezview.sensors.appearance.edges.refinement import RefineOptions, Refiner
from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.recognizer import Recognizer
from rendezview.sensors.appearance.sketch.found import SketchFound
from rendezview.sensors.appearance.sketch.network import Sketch
from rendezview.sensors.appearance.sketch.search import SketchSearch
from rendezview.sensors.appearance.sky import Sky

# σ of the strain while it is not yet known: edges are looked for further away, without profiles.
_ROUGH = 0.02  # Source: by construction
_ROUGH_ROUNDS = 3  # Source: by construction
_PRIOR_ROUNDS = 30  # Source: by construction, the weights no longer change
_MOST_SHOWN = 6000  # edges in a picture. Source: by construction
# Mean of the strain along the axes. Source: by construction
_SIZE = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) / 3.0


@dataclass(slots=True, eq=False)
class _Frame:
    """One frame with the pose that is estimated with the strain."""

    index: int
    picture: Picture
    sky: Sky
    pose: Pose
    times: int  # the picture is so many times smaller than the frame
    sketch: Sketch | None  # its edges are the sketch's; None: grey edges


class ShapeEstimator:
    """Estimates the strain of one model from the frames of one camera."""

    def __init__(
        self, model: ViewModel, camera: Camera, options: ShapeOptions | None = None
    ) -> None:
        if model.contours is None:
            raise RendezviewError("the model has no contour points: train it with contours")
        self.model = model
        self.camera = camera
        self.options = options or ShapeOptions()

    def estimate(
        self,
        frames: Sequence[Picture],
        priors: Sequence[Pose | None] | None = None,
        known: Mapping[int, tuple[float, float]] | None = None,
        progress: Callable[[str], None] = lambda line: None,
    ) -> AsBuilt:
        """The strain that explains the frames.

        Args:
            frames: (H, W) uint8 each, any order.
            priors: camera_from_target of each frame, roughly (10°); None: not known.
            known: components of the strain (0, 1, 2: along x, y, z) that are measured otherwise:
                value and σ.
            progress: gets a line now and then.

        Raises:
            RendezviewError: too few frames give a pose, or they do not show the strain.
        """
        strain, before = np.zeros(6), None
        untouched = SurfaceResiduals(np.zeros((0, 3)), np.zeros(0))
        for _ in range(self.options.looks):
            recognizer = Recognizer(
                strained(self.model, matrix_of(strain), shape_error=_ROUGH), self.camera
            )
            used = self._posed(recognizer, frames, priors, progress)
            count = len(used)
            if count < self.options.least_frames:
                raise RendezviewError(
                    f"{count} of {len(frames)} frames give a pose: the shape needs "
                    f"{self.options.least_frames}; add frames or give --poses"
                )
            self._check_spread(used)
            sketcher = recognizer.sketch
            began = strain
            for turn in range(self.options.rounds):
                measured = self._measured(used, strain, sketcher, rough=turn < _ROUGH_ROUNDS)
                rms = self._shares(used, measured)
                if before is None:
                    before = float(np.median(rms[np.isfinite(rms)]))
                    untouched = self._over_surface(used, measured)
                step = self._step(used, measured, rms, strain, known or {})
                strain = strain + step
                largest = float(np.abs(step).max())
                progress(f"round {turn + 1}: {_told(strain)}, changed by {100 * largest:.3f} %")
                if turn >= _ROUGH_ROUNDS and largest < self.options.stop:
                    break
            if np.abs(strain - began).max() < self.options.look_again:
                break
        measured = self._measured(used, strain, sketcher, rough=False)
        rms = self._shares(used, measured)
        good = self._good(rms)
        covariance = self._covariance(used, measured, good, strain, known or {})
        self._check_observed(covariance)
        size_sigma = float(np.sqrt(_SIZE @ covariance @ _SIZE))
        poses: list[Pose | None] = [None] * len(frames)
        for k in np.flatnonzero(good):
            poses[used[k].index] = used[k].pose
        return AsBuilt(
            matrix_of(strain), covariance, size_sigma, tuple(poses), before or 0.0,
            float(np.median(rms[good])), size_sigma < 0.5 * self.options.size_sigma,
            untouched, self._over_surface(used, measured),
        )  # fmt: skip

    def _posed(
        self,
        recognizer: Recognizer,
        frames: Sequence[Picture],
        priors: Sequence[Pose | None] | None,
        progress: Callable[[str], None],
    ) -> list[_Frame]:
        """The frames in which the recognizer gives a pose."""
        used = []
        for k, image in enumerate(frames):
            frame = check_frame(image, self.camera.width, self.camera.height)
            prior = None if priors is None else priors[k]
            seen = recognizer.recognize(frame, prior)
            if seen.pose is None:
                continue
            sketch = None
            if isinstance(seen.found, SketchFound) and recognizer.sketch is not None:
                sketch = recognizer.sketch.closer_sketch(frame, seen.pose)
            range_m = float(np.linalg.norm(seen.pose.apply(self.model.centre_m)))
            times = times_smaller(
                self.camera, self.model.target_radius_m, range_m, FINEST_RADIUS_PX
            )
            picture = shrunk(frame, times) if times > 1 else frame
            used.append(_Frame(k, picture, Sky.of(picture), seen.pose, times, sketch))
            if (k + 1) % 20 == 0:
                progress(f"{k + 1} of {len(frames)} frames, {len(used)} with a pose")
        return used

    def _measured(
        self, frames: list[_Frame], strain: Array, sketcher: SketchSearch | None, *, rough: bool
    ) -> list[MeasuredEdges | None]:
        """The edges of all frames at the poses that fit them best; the poses are kept."""
        model = strained(self.model, matrix_of(strain), shape_error=_ROUGH if rough else 0.0)
        refiners: dict[int, Refiner] = {}
        search = None
        found: list[MeasuredEdges | None] = []
        for frame in frames:
            if frame.times not in refiners:
                blur_px = shrunk_blur(RefineOptions().blur_px, frame.times)
                refiners[frame.times] = Refiner(
                    model, self.camera.binned(frame.times), RefineOptions(blur_px=blur_px)
                )
            refiner = refiners[frame.times]
            if frame.sketch is None:
                edges = refiner.measured(frame.picture, frame.sky, frame.pose)
            else:
                if search is None and sketcher is not None:
                    search = sketcher.with_tables(model, refiner.views)
                edges = None if search is None else search.measured(frame.sketch, frame.pose)
            if edges is not None:
                frame.pose = _pose(edges.rotation, edges.centre_m, self.model)
            found.append(edges)
        return found

    def _shares(self, frames: list[_Frame], measured: list[MeasuredEdges | None]) -> Array:
        """(F,) rms of each frame, of the target's radius; infinite where nothing is found."""
        shares = np.full(len(frames), np.inf)
        for k, (frame, edges) in enumerate(zip(frames, measured, strict=True)):
            if edges is None or not edges.weight.sum() > 0.0:
                continue
            scale = 1.0 / frame.times if frame.sketch is None else frame.sketch.scale
            radius_px = self.camera.fx * scale * self.model.target_radius_m / edges.centre_m[2]
            shares[k] = edges.residual_rms_px / radius_px
        return shares

    def _over_surface(
        self, frames: list[_Frame], measured: list[MeasuredEdges | None]
    ) -> SurfaceResiduals:
        """Edges of all frames on the target, thinned to what a picture shows."""
        places, shares = [np.zeros((0, 3))], [np.zeros(0)]
        for frame, edges in zip(frames, measured, strict=True):
            if edges is None:
                continue
            scale = 1.0 / frame.times if frame.sketch is None else frame.sketch.scale
            radius_px = self.camera.fx * scale * self.model.target_radius_m / edges.centre_m[2]
            places.append(edges.places_m)
            shares.append(edges.residual_px / radius_px)
        place, share = np.concatenate(places), np.concatenate(shares)
        kept = slice(None, None, 1 + len(place) // _MOST_SHOWN)
        return SurfaceResiduals(place[kept], share[kept])

    def _good(self, rms: Array) -> np.ndarray:
        """(F,) the frames that count."""
        median = np.median(rms[np.isfinite(rms)]) if np.isfinite(rms).any() else np.inf
        return np.asarray(np.isfinite(rms) & (rms <= self.options.most_rms * median))

    def _reduced(self, edges: MeasuredEdges) -> tuple[Array, Array, Array, Array]:
        """Information (6, 6) and right side (6,) of the strain with the pose eliminated; the pose's
        own answer (6,) and its response to the strain (6, 6)."""
        sigma2 = max(edges.residual_rms_px, 1e-3) ** 2 * self.options.edges_as_one
        weight = edges.weight / sigma2
        pose, shape = edges.pose_slopes, edges.strain_slopes
        weighted = pose * weight[:, None]
        own = weighted.T @ pose
        own += 1e-9 * np.diag(np.diag(own))
        cross = weighted.T @ shape
        right = weighted.T @ edges.residual_px
        response = np.linalg.solve(own, cross)
        answer = np.linalg.solve(own, right)
        moved = shape * weight[:, None]
        information = moved.T @ shape - cross.T @ response
        left = np.asarray(moved.T @ edges.residual_px - cross.T @ answer)
        return information, left, np.asarray(answer), np.asarray(response)

    def _step(
        self,
        frames: list[_Frame],
        measured: list[MeasuredEdges | None],
        rms: Array,
        strain: Array,
        known: Mapping[int, tuple[float, float]],
    ) -> Array:
        """(6,) change of the strain; the poses follow it."""
        matrix, right = np.zeros((6, 6)), np.zeros(6)
        good = self._good(rms)
        if not good.any():
            raise RendezviewError("no frame's edges fit the model")
        parts = {}
        for k in np.flatnonzero(good):
            edges = measured[k]
            if edges is not None:
                parts[k] = self._reduced(edges)
                matrix += parts[k][0]
                right += parts[k][1]
        about = None
        for _ in range(_PRIOR_ROUNDS):  # the prior's weights follow the strain
            information, towards = self._prior(strain, known, about)
            step = np.linalg.solve(matrix + information, right + towards)
            about = strain + step
        for k, (_, _, answer, response) in parts.items():
            edges = measured[k]
            if edges is not None:
                move = answer - response @ step
                rotation = exp(np.ascontiguousarray(move[:3])) @ edges.rotation
                frames[k].pose = _pose(rotation, edges.centre_m + move[3:], self.model)
        return np.asarray(step)

    def _prior(
        self,
        strain: Array,
        known: Mapping[int, tuple[float, float]],
        about: Array | None = None,
    ) -> tuple[Array, Array]:
        """Information (6, 6) and right side (6,) of what is known without frames.

        ``about``: (6,) a strain: the smaller a component of it beside the largest, the less is
        the variance of that component; None: all have the same.
        """
        variance = np.ones(6)
        if about is not None:
            variance = self.options.usual_sigma**2 + about**2
        information = np.diag(variance.max() / variance) / self.options.prior_sigma**2
        if not known:  # a length says more about the size than the model does
            information += self.options.size_sigma**-2 * np.outer(_SIZE, _SIZE)
        right = -information @ strain
        for component, (value, sigma) in known.items():
            information[component, component] += sigma**-2
            right[component] += (value - strain[component]) * sigma**-2
        return information, right

    def _covariance(
        self,
        frames: list[_Frame],
        measured: list[MeasuredEdges | None],
        good: np.ndarray,
        strain: Array,
        known: Mapping[int, tuple[float, float]],
    ) -> Array:
        """(6, 6): the larger of the edges' own and of the scatter between the frames.

        The scatter is the sandwich H⁻¹ (Σ g gᵀ) H⁻¹ over the frames (Huber 1967): frames are
        independent, the edges of one are not.
        """
        matrix, _ = self._prior(strain, known)
        prior = matrix.copy()
        scatter = np.zeros((6, 6))
        for k in np.flatnonzero(good):
            edges = measured[k]
            if edges is not None:
                information, right, _, _ = self._reduced(edges)
                matrix += information
                scatter += np.outer(right, right)
        inverse = np.linalg.inv(matrix)
        own, between = inverse, inverse @ (scatter + prior) @ inverse
        return np.asarray(own if np.trace(own) > np.trace(between) else between)

    def _check_spread(self, frames: list[_Frame]) -> None:
        """One side of a target shows its depth by perspective only.

        Raises:
            RendezviewError: all views are from about the same side.
        """
        sides = np.array([f.pose.rotation.T @ f.pose.apply(self.model.centre_m) for f in frames])
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        spread = float(np.arccos(np.clip((sides @ sides.T).min(), -1.0, 1.0)))
        if spread < self.options.least_spread_rad:
            raise RendezviewError(
                f"all views lie within {np.rad2deg(spread):.0f}° of each other: the shape needs "
                f"views from more sides, {np.rad2deg(self.options.least_spread_rad):.0f}° at least"
            )

    def _check_observed(self, covariance: Array) -> None:
        """All but the overall size must be seen.

        Raises:
            RendezviewError: it is not; which components is said.
        """
        away = np.eye(6) - 3.0 * np.outer(_SIZE, _SIZE)
        sigmas = np.sqrt(np.diag(away @ covariance @ away.T))
        loose = [
            name
            for name, sigma in zip(strain_names(), sigmas, strict=True)
            if sigma > 0.5 * self.options.prior_sigma
        ]
        if loose:
            raise RendezviewError(
                f"the frames do not show the strain {', '.join(loose)}: they need views of the "
                "target from more sides"
            )


def _told(strain: Array) -> str:
    return ", ".join(
        f"{name} {100 * value:+.2f} %" for name, value in zip(strain_names(), strain, strict=True)
    )


def _pose(rotation: Array, centre_m: Array, model: ViewModel) -> Pose:
    return Pose(rotation, centre_m - rotation @ model.centre_m)
