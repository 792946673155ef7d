"""The edges of one frame at an aligned pose: what they say of it, and of a strain of the model.

A strain S (symmetric) moves the edge of a point q from the view centre by s = j S q along its
normal, for the slope j. The pose absorbs most of that: (ΣwJJᵀ)⁻¹ ΣwJs. The rest is left in the
residuals, and tells how large the strains are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import about_origin
from rendezview.io.grey_frame import WHITE_GREY, Picture
from rendezview.sensors.appearance.edges.grey import points_of_slopes
from rendezview.sensors.appearance.edges.predicted import (
    FOUND,
    NX,
    NY,
    RESIDUAL,
    STATE,
    WEIGHT,
    U,
    V,
)

# Components of a symmetric strain, in the order of all arrays. Source: by construction
STRAINS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_ROOTS = np.sqrt([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])  # shears stand twice. Source: by construction
# One σ of a strain: each is as likely before the frame is looked at, since nobody knows how exact
# a mesh is. Source: by construction, a third of what the views are off by, to a tenth of the size
_SIGMAS = np.geomspace(1e-4, 0.1, 12)
# Of the variance: a craft differs from its model in other ways than by one strain, too, of which
# the edges show less. Source: pose-misfit (0.1), hubble and client, seed 7, and close-in (0.1),
# client, seed 5 (Mitsuba): no mean normalised error squared above eight
_OTHER_WAYS = 1.6
# Of the strain that shows most: one that shows less is absorbed by the pose, as a uniform one is by
# the range. Source: by construction, rounding
_UNSEEN = 1e-9
_LEAST_RMS_PX = 0.3  # px; no frame's edges fit better. Source: by construction
_INSIDE_PX = 2.0  # px; inside an edge by this, its blur has ended. Source: by construction


@dataclass(frozen=True, eq=False)
class MeasuredEdges:
    """N edges that were found, with robust weights."""

    rotation: Array  # (3, 3) camera_from_target
    centre_m: Array  # (3,) view centre, camera frame
    residual_px: Array  # (N,) along the edge's normal, outwards
    weight: Array  # (N,) with Tukey's
    pose_slopes: Array  # (N, 6) of the predicted edge: px per rad and m, left perturbation
    inside_px: Array  # (N, 2) of the picture, just inside the edge: column, row

    @classmethod
    def of(cls, edges: Array, cut_px: float, rotation: Array, centre_m: Array) -> MeasuredEdges:
        """Those rows of the measurements (M, COLUMNS) that count; beyond the cut none does."""
        rows = edges[(edges[:, STATE] == FOUND) & (np.abs(edges[:, RESIDUAL]) < cut_px)]
        residual, slopes = rows[:, RESIDUAL].copy(), rows[:, :6].copy()
        weight = rows[:, WEIGHT] * (1.0 - (residual / cut_px) ** 2) ** 2
        inside = rows[:, [U, V]] + (residual - _INSIDE_PX)[:, None] * rows[:, [NX, NY]]
        return cls(rotation.copy(), centre_m.copy(), residual, weight, slopes, inside)

    @cached_property
    def places_m(self) -> Array:
        """(N, 3) of the edges on the target, from the view centre, target axes."""
        places: Array = points_of_slopes(self.pose_slopes, self.rotation, self.centre_m)
        return places

    @cached_property
    def strain_slopes(self) -> Array:
        """(N, 6) of the predicted edge, px per unit of each of ``STRAINS``, target axes."""
        q, j = self.places_m, self.pose_slopes[:, 3:] @ self.rotation
        return np.stack(
            [j[:, a] * q[:, b] + (j[:, b] * q[:, a] if a != b else 0.0) for a, b in STRAINS], axis=1
        )

    @property
    def information(self) -> Array:
        """(6, 6) of the pose as ``pose_slopes`` has it, edges taken as independent."""
        sigma2 = max(self.residual_rms_px, _LEAST_RMS_PX) ** 2
        return np.asarray((self.pose_slopes * (self.weight / sigma2)[:, None]).T @ self.pose_slopes)

    @property
    def residual_rms_px(self) -> float:
        """Root of the weighted mean square; 0 without edges."""
        total = float(self.weight.sum())
        return float(np.sqrt(self.weight @ self.residual_px**2 / total)) if total > 0.0 else 0.0

    def covariance(self, loose: Array, arm: Array) -> Array:
        """(6, 6) of the pose of the target's origin, for independent edges of one pixel.

        With weights w and independent edges of variance σ² the estimate (ΣwJJᵀ)⁻¹ ΣwJr has
        covariance σ² (ΣwJJᵀ)⁻¹ Σw²JJᵀ (ΣwJJᵀ)⁻¹.

        Args:
            loose: (6,) information that there is anyway, so that all stays finite.
            arm: (3,) from the target's origin to the view centre, camera axes.
        """
        return about_origin(sandwich(self.pose_slopes, self.weight, loose), arm)

    def beside_white(self, image: Picture) -> Array:
        """(N,) 1 for the edges of surfaces that are white in the frame, else 0."""
        last = np.array(image.shape[::-1]) - 1
        column, row = np.clip(np.rint(self.inside_px), 0, last).astype(int).T
        return np.asarray(image[row, column] >= WHITE_GREY, dtype=float)

    def off_together(self, loose: Array, arm: Array, off_px: Array) -> Array:
        """(6, 6) of the pose of the target's origin where edges are off together.

        Args:
            loose, arm: as of ``covariance``.
            off_px: (N,) one σ of each, outwards.
        """
        weighted = self.pose_slopes * self.weight[:, None]
        information = self.pose_slopes.T @ weighted + np.diag(loose)
        move = np.linalg.solve(information, weighted.T @ off_px)
        return about_origin(np.outer(move, move), arm)

    def strained(self, loose: Array, arm: Array, strain: Array) -> Array:
        """(6, 6) of the pose of the target's origin where the craft is the model strained.

        Args:
            loose, arm: as of ``covariance``.
            strain: (6, 6) covariance of the strain's components, shears times √2 in target axes:
                with these factors one that is alike in all directions is diagonal.
        """
        response, _, _ = self.strain_moves(loose)
        return about_origin(response @ strain @ response.T, arm)

    def likely_strain(self, loose: Array, sigma_px: float) -> float:
        """The expected square of a component of the strain, as the residuals show it.

        Strains of best fit are independent along the eigenvectors of their information a, and
        ŝ ~ N(0, σ² + 1/a) for strains of one σ in all directions. The mean of σ² is taken over
        ``_SIGMAS`` by their likelihood. Where the edges show no strain, that is about what they
        could not show.

        Args:
            loose: (6,) information on the pose that there is anyway.
            sigma_px: one σ of an edge.
        """
        _, information, right = self.strain_moves(loose)
        shown, axes = np.linalg.eigh(information / sigma_px**2)
        right = axes.T @ right / sigma_px**2
        seen = shown > _UNSEEN * shown[-1]
        shown, right = shown[seen], right[seen]
        square = right**2 / shown  # ŝ over its own σ, squared
        spread = 1.0 + shown * _SIGMAS[:, None] ** 2
        log = -0.5 * np.sum(np.log(spread) + square / spread, axis=1)
        likelihood = np.exp(log - log.max())
        return _OTHER_WAYS * float(likelihood @ _SIGMAS**2 / likelihood.sum())

    def strain_moves(self, loose: Array) -> tuple[Array, Array, Array]:
        """(6, 6) response of the pose to a unit of each strain; information (6, 6) on the strains
        that it does not absorb, 1/px², and the same sums with the residuals (6,)."""
        moves, slopes = self.strain_slopes * _ROOTS, self.pose_slopes
        by_pose, by_strain = (slopes.T * self.weight, moves.T * self.weight)
        both = by_pose @ moves
        response = np.asarray(np.linalg.solve(by_pose @ slopes + np.diag(loose), both))
        right = by_strain @ self.residual_px - response.T @ (by_pose @ self.residual_px)
        return response, by_strain @ moves - both.T @ response, right


def sandwich(slopes: Array, weight: Array, loose: Array) -> Array:
    """(D, D) covariance of a weighted least squares with slopes (N, D) and independent residuals of
    σ = 1; ``loose``: (D,) information that there is anyway."""
    weighted = slopes * weight[:, None]
    response = np.linalg.inv(slopes.T @ weighted + np.diag(loose))
    return np.asarray(response @ (weighted.T @ weighted + np.diag(loose)) @ response.T)


def nothing_known(radius_m: float) -> Array:
    """(6,) information of about a radian and a target radius: what no edge shows stays finite."""
    return np.asarray(1e-4 * np.array([1.0] * 3 + [radius_m**-2] * 3))
