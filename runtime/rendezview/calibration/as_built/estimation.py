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

import numpy as np

from rendezview.calibration.as_built.deformation import Deformation
from rendezview.calibration.as_built.frames import (
    LEAST_RMS_PX,
    PosedFrame,
    measured,
    mountings,
    pose_of,
    posed,
)
from rendezview.calibration.as_built.parts import Part, distrusted
from rendezview.calibration.as_built.shape import AsBuilt, ShapeOptions, SurfaceResiduals
from rendezview.calibration.as_built.strain import matrix_of, strain_names
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import exp
from rendezview.io.grey_frame import Picture
from rendezview.io.parts import TrustedPart
from rendezview.sensors.appearance.edges.measured import MeasuredEdges
from rendezview.sensors.appearance.edges.refinement import SHARED_PX
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.recognizer import Recognizer
from rendezview.sensors.appearance.search.sketch_search import SketchSearch

# σ of the strain while it is not yet known: edges are looked for further away, without profiles.
_ROUGH = 0.02  # Source: by construction
_ROUGH_ROUNDS = 3  # Source: by construction
_PRIOR_ROUNDS = 30  # Source: by construction, the weights no longer change
_MOST_SHOWN = 6000  # edges in a picture. Source: by construction
# Mean of the strain along the axes. Source: by construction
_SIZE = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) / 3.0


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
        parts: Sequence[TrustedPart] = (),
        *,
        lens: bool = False,
    ) -> AsBuilt:
        """The strain, and the mounting of parts, that explain the frames.

        Args:
            frames: (H, W) uint8 each, any order.
            priors: camera_from_target of each frame, roughly (10°); None: not known.
            known: components of the strain (0, 1, 2: along x, y, z) that are measured otherwise:
                value and σ.
            progress: gets a line now and then.
            parts: of the craft, with boxes, that may be turned and shifted; their ``trust`` is
                not read.
            lens: whether the camera's focal length and principal point are estimated as well.

        Raises:
            RendezviewError: too few frames give a pose, or they do not show the strain or the
                focal length; a part is nowhere.
        """
        movable = tuple(Part.of(part, self.model) for part in parts)
        shape = Deformation(np.zeros(6), movable, np.zeros(3) if lens else None)
        radius_m, before = self.model.target_radius_m, None
        untouched = SurfaceResiduals(np.zeros((0, 3)), np.zeros(0))
        for _ in range(self.options.passes):
            deformed = shape.model(self.model, shape_error=_ROUGH)
            recognizer = Recognizer(deformed, shape.camera(self.camera))
            used = posed(recognizer, frames, priors, progress)
            count = len(used)
            if count < self.options.least_frames:
                raise RendezviewError(
                    f"{count} of {len(frames)} frames give a pose: the shape needs "
                    f"{self.options.least_frames}; add frames or give --poses"
                )
            self._check_spread(used)
            sketcher = recognizer.sketch
            moved = np.zeros(shape.size)
            for turn in range(self.options.rounds):
                edges = self._measured(used, shape, sketcher, rough=turn < _ROUGH_ROUNDS)
                rms = self._shares(used, edges)
                if before is None:
                    before = float(np.median(rms[np.isfinite(rms)]))
                    untouched = self._over_surface(used, edges)
                step = self._step(used, edges, rms, shape, known or {})
                shape, moved = shape.after(step), moved + step
                largest = shape.change(step, radius_m, self.camera.fx)
                progress(f"round {turn + 1}: {shape.described()}, changed by {100 * largest:.3f} %")
                if turn >= _ROUGH_ROUNDS and largest < self.options.stop:
                    break
            if shape.change(moved, radius_m, self.camera.fx) < self.options.repeat_above:
                break
        edges = self._measured(used, shape, sketcher, rough=False)
        rms = self._shares(used, edges)
        good = self._good(rms)
        whole = self._covariance(edges, good, shape, known or {})
        covariance = whole[:6, :6]
        self._check_observed(covariance)
        lens_covariance = whole[shape.of_lens, shape.of_lens]
        if lens and lens_covariance[0, 0] > (0.5 * self.options.focal_sigma) ** 2:
            raise RendezviewError(
                "the frames do not show the focal length: they need views from nearer, where near "
                "and far edges of the target differ in size"
            )
        fitting = [e for e, is_good in zip(edges, good, strict=True) if is_good and e is not None]
        mounted = mountings(fitting, self.model, shape, whole, self.options)
        trusts = [(p, m.trust) for p, m in zip(shape.parts, mounted, strict=True)]
        size_sigma = float(np.sqrt(_SIZE @ covariance @ _SIZE))
        poses: list[Pose | None] = [None] * len(frames)
        for k in np.flatnonzero(good):
            poses[used[k].index] = used[k].pose
        return AsBuilt(
            matrix_of(shape.strain), covariance, size_sigma, tuple(poses), before or 0.0,
            float(np.median(rms[good])), size_sigma < 0.5 * self.options.size_sigma,
            untouched, self._over_surface(used, edges), mounted,
            distrusted(shape.model(self.model, covariance=covariance), self.model, trusts),
            shape.camera(self.camera), lens_covariance,
        )  # fmt: skip

    def _measured(
        self,
        frames: list[PosedFrame],
        shape: Deformation,
        sketcher: SketchSearch | None,
        *,
        rough: bool,
    ) -> list[MeasuredEdges | None]:
        model = shape.model(self.model, shape_error=_ROUGH if rough else 0.0)
        return measured(frames, model, shape.camera(self.camera), sketcher)

    def _shares(self, frames: list[PosedFrame], measured: list[MeasuredEdges | None]) -> Array:
        """(F,) rms of each frame, of the target's radius; infinite where nothing is found."""
        shares, radius_m = np.full(len(frames), np.inf), self.model.target_radius_m
        for k, (frame, edges) in enumerate(zip(frames, measured, strict=True)):
            if edges is None or not edges.weight.sum() > 0.0:
                continue
            radius_px = frame.radius_px(self.camera, radius_m, edges.centre_m[2])
            shares[k] = edges.residual_rms_px / radius_px
        return shares

    def _over_surface(
        self, frames: list[PosedFrame], measured: list[MeasuredEdges | None]
    ) -> SurfaceResiduals:
        """Edges of all frames on the target, thinned to what a picture shows."""
        places, shares = [np.zeros((0, 3))], [np.zeros(0)]
        radius_m = self.model.target_radius_m
        for frame, edges in zip(frames, measured, strict=True):
            if edges is None:
                continue
            radius_px = frame.radius_px(self.camera, radius_m, edges.centre_m[2])
            places.append(edges.places_m)
            shares.append(edges.residual_px / radius_px)
        place, share = np.concatenate(places), np.concatenate(shares)
        kept = slice(None, None, 1 + len(place) // _MOST_SHOWN)
        return SurfaceResiduals(place[kept], share[kept])

    def _good(self, rms: Array) -> np.ndarray:
        """(F,) the frames that count."""
        median = np.median(rms[np.isfinite(rms)]) if np.isfinite(rms).any() else np.inf
        return np.asarray(np.isfinite(rms) & (rms <= self.options.most_rms * median))

    def _reduced(
        self, edges: MeasuredEdges, deformation: Deformation
    ) -> tuple[Array, Array, Array, Array]:
        """Information (U, U) and right sides (U, 2) of the shape with the pose eliminated; the
        pose's own answer (6,) and its response to the shape (6, U). The first right side is of the
        edges' residuals, the second of what all edges are off alike."""
        off_px = np.column_stack([edges.residual_px, np.full(len(edges.weight), SHARED_PX)])
        sigma2 = max(edges.residual_rms_px, LEAST_RMS_PX) ** 2 * self.options.edges_as_one
        weight = edges.weight / sigma2
        pose = edges.pose_slopes
        shape = deformation.slopes(edges, self.model.target_radius_m, self.camera)
        weighted = pose * weight[:, None]
        own = weighted.T @ pose
        own += 1e-9 * np.diag(np.diag(own))
        cross = weighted.T @ shape
        right = weighted.T @ off_px
        response = np.linalg.solve(own, cross)
        answer = np.linalg.solve(own, right)
        moved = shape * weight[:, None]
        information = moved.T @ shape - cross.T @ response
        left = np.asarray(moved.T @ off_px - cross.T @ answer)
        return information, left, np.asarray(answer[:, 0]), np.asarray(response)

    def _step(
        self,
        frames: list[PosedFrame],
        measured: list[MeasuredEdges | None],
        rms: Array,
        shape: Deformation,
        known: Mapping[int, tuple[float, float]],
    ) -> Array:
        """(U,) change of the shape; the poses follow it."""
        matrix, right = np.zeros((shape.size, shape.size)), np.zeros(shape.size)
        good = self._good(rms)
        if not good.any():
            raise RendezviewError("no frame's edges fit the model")
        parts = {}
        for k in np.flatnonzero(good):
            edges = measured[k]
            if edges is not None:
                parts[k] = self._reduced(edges, shape)
                matrix += parts[k][0]
                right += parts[k][1][:, 0]
        about = None
        for _ in range(_PRIOR_ROUNDS):  # the prior's weights follow the strain
            information, towards = self._prior(shape, known, about)
            step = np.linalg.solve(matrix + information, right + towards)
            about = shape.strain + step[:6]
        for k, (_, _, answer, response) in parts.items():
            edges = measured[k]
            if edges is not None:
                move = answer - response @ step
                rotation = exp(np.ascontiguousarray(move[:3])) @ edges.rotation
                frames[k].pose = pose_of(rotation, edges.centre_m + move[3:], self.model)
        return np.asarray(step)

    def _prior(
        self,
        shape: Deformation,
        known: Mapping[int, tuple[float, float]],
        about: Array | None = None,
    ) -> tuple[Array, Array]:
        """Information (U, U) and right side (U,) of what is known without frames.

        ``about``: (6,) a strain: the smaller a component of it beside the largest, the less is
        the variance of that component; None: all have the same.
        """
        strain, options = shape.strain, self.options
        variance = np.ones(6)
        if about is not None:
            variance = options.usual_sigma**2 + about**2
        information = np.zeros((shape.size, shape.size))
        information[:6, :6] = np.diag(variance.max() / variance) / options.prior_sigma**2
        if not known:  # a length says more about the size than the model does
            information[:6, :6] += options.size_sigma**-2 * np.outer(_SIZE, _SIZE)
        right = np.zeros(shape.size)
        right[:6] = -information[:6, :6] @ strain
        move_sigma_m = options.move_sigma * self.model.target_radius_m
        mounted = np.repeat([options.turn_sigma_rad, move_sigma_m], 3) ** -2.0
        for k, part in enumerate(shape.parts):
            own = shape.of_part(k)
            information[own, own] = np.diag(mounted)
            right[own] = -mounted * part.motion
        if shape.lens is not None:
            centre_sigma_px = options.centre_sigma * self.camera.fx
            own, seen = (
                shape.of_lens,
                np.array([options.focal_sigma, *[centre_sigma_px] * 2]) ** -2.0,
            )
            information[own, own] = np.diag(seen)
            right[own] = -seen * shape.lens
        for component, (value, sigma) in known.items():
            information[component, component] += sigma**-2
            right[component] += (value - strain[component]) * sigma**-2
        return information, right

    def _covariance(
        self,
        measured: list[MeasuredEdges | None],
        good: np.ndarray,
        shape: Deformation,
        known: Mapping[int, tuple[float, float]],
    ) -> Array:
        """(U, U): the larger of the edges' own and of the scatter between the frames.

        The scatter is the sandwich H⁻¹ (Σ g gᵀ) H⁻¹ over the frames (Huber 1967): frames are
        independent, the edges of one are not. What all edges of all frames are off alike shows in
        neither; it is added.
        """
        matrix, _ = self._prior(shape, known)
        alike = np.zeros(shape.size)
        prior, scatter = matrix.copy(), np.zeros_like(matrix)
        for k in np.flatnonzero(good):
            edges = measured[k]
            if edges is not None:
                information, right, _, _ = self._reduced(edges, shape)
                matrix += information
                scatter += np.outer(right[:, 0], right[:, 0])
                alike += right[:, 1]
        inverse = np.linalg.inv(matrix)
        own, between = inverse, inverse @ (scatter + prior) @ inverse
        larger = np.trace(own[:6, :6]) > np.trace(between[:6, :6])
        moved = inverse @ alike
        return np.asarray((own if larger else between) + np.outer(moved, moved))

    def _check_spread(self, frames: list[PosedFrame]) -> None:
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
