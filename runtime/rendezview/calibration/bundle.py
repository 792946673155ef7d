"""Bundle adjustment: cameras, lenses, places of boards and lights, all at once.

The paper calibrates in steps, each on the result of the step before. Here the same equations
(eq. 4 and 6, the detector's response done before) are solved together, by Levenberg's and
Marquardt's method with analytic derivatives, so that every number has a covariance that
counts all the others.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.estimation.least_squares import FIRST_DAMPING, Equations, Options, minimise
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.rig import (
    INTRINSICS,
    POSE,
    RigCamera,
    by_pose,
    intrinsics_of,
    with_intrinsics,
)

# To the rounding of the sum of squares, since a calibration is made once. Source: by construction
_CONVERGED = Options(
    iterations=100, trials=16, least_gain=1e-18, relative_gain=1e-14, first_damping=FIRST_DAMPING
)

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """M places of points on detectors."""

    camera: Ints  # (M,)
    view: Ints  # (M,) which pose of the board
    point: Ints  # (M,) which point of the board
    positions: Array  # (M, 2) detector units
    sigma: Array  # (M, 2)
    terms: Array | None = None  # (M, T) of the detector's response, where that is adjusted too

    @classmethod
    def joined(
        cls, parts: Iterable[tuple[int, int, Ints, Array, Array, Array | None]]
    ) -> Observations:
        """Those of all cameras and views: the numbers of both, and the other columns."""
        camera, view, *columns = zip(*parts, strict=True)
        counts = [len(points) for points in columns[0]]
        terms = None if columns[-1][0] is None else np.concatenate(columns[-1])
        point, positions, sigma = (np.concatenate(column) for column in columns[:3])
        numbers = np.repeat(camera, counts), np.repeat(view, counts)
        return cls(*numbers, point, positions, sigma, terms)


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The parameters to adjust, and which of them are free."""

    cameras: tuple[RigCamera, ...]
    views: tuple[Pose, ...]  # rig_from_board
    points: Array  # (P, 3) board frame, metres
    free_intrinsics: tuple[tuple[str, ...], ...]  # of each camera, from INTRINSICS
    free_cameras: tuple[bool, ...]  # pose of each camera
    free_views: tuple[bool, ...]
    points_sigma_m: float | None = None  # of the points' given places; None: exact
    # (camera, name, value, σ): priors on intrinsics
    priors: tuple[tuple[int, str, float, float], ...] = ()
    # Covariance (2, T, T) of each camera's response, which then moves within it
    responses: tuple[Array, ...] = ()
    offsets: tuple[Array, ...] = ()  # (2, T) by which each response has moved


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The adjusted bundle with its residuals and covariance."""

    bundle: Bundle
    residuals: Array  # (M, 2) observed less predicted, detector units
    camera: Ints  # (M,) whose they are
    names: tuple[str, ...]  # of the free parameters
    covariance: Array  # (n, n), of the given σ
    chi2: float
    spare: int  # degrees of freedom
    sigma: dict[str, float] = field(default_factory=dict)

    @property
    def rms(self) -> float:
        """R.m.s. distance of a point from its prediction (as OpenCV counts it)."""
        return float(np.sqrt((self.residuals**2).sum() / len(self.residuals)))

    def scaled(self) -> Adjusted:
        """With a covariance that takes the noise from the residuals, not from the given σ."""
        scale = self.chi2 / max(self.spare, 1)
        sigma = {name: value * float(np.sqrt(scale)) for name, value in self.sigma.items()}
        return replace(self, covariance=self.covariance * scale, sigma=sigma)


def adjust(bundle: Bundle, observed: Observations) -> Adjusted:
    """Least squares over all free parameters.

    Raises:
        RendezviewError: the observations do not determine them, or it does not converge.
    """
    if bundle.responses and not bundle.offsets:
        bundle = replace(bundle, offsets=tuple(np.zeros(c.shape[:2]) for c in bundle.responses))
    columns = _Columns(bundle)

    def at(moved: Bundle) -> _Linearised:
        return _Linearised(moved, *_linearised(moved, observed, columns, bundle))

    found = minimise(
        _Linearised.equations,
        lambda here, step: at(columns.moved(here.bundle, step)),
        at(bundle),
        cost=lambda here: here.cost,
        options=_CONVERGED,
    )
    if found is None:
        raise RendezviewError(
            "the calibration starts with points behind a camera or beyond its lens: "
            "check the boards' size and the order of their points"
        )
    return _finished(found.at.bundle, observed, found.at.residual, found.at.jacobian, columns)


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """A bundle with its whitened residuals and the Jacobian of its predictions."""

    bundle: Bundle
    residual: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    def equations(self) -> Equations:
        normal = self.jacobian.T @ self.jacobian
        # p3 has no effect while p1 and p2 are 0: what has none yet stays where it is.
        normal[np.diag_indices_from(normal)] += np.diag(normal) == 0.0
        return self.cost, normal, self.jacobian.T @ self.residual


def _finished(
    bundle: Bundle, observed: Observations, residual: Array, jacobian: Array, columns: _Columns
) -> Adjusted:
    scale = np.sqrt((jacobian**2).sum(axis=0))
    if not (scale > 0.0).all():
        free = columns.names[int(np.argmin(scale))]
        raise RendezviewError(f"no observation depends on {free}: keep it fixed")
    singular = np.linalg.svd(jacobian / scale, compute_uv=False)
    if singular[-1] < 1e-9 * singular[0]:
        raise RendezviewError(
            "the observations do not determine the calibration: tilt the board more, or free less"
        )
    normal = (jacobian / scale).T @ (jacobian / scale)
    covariance = np.linalg.inv(normal) / np.outer(scale, scale)
    count = len(observed.camera)
    raw = residual[: 2 * count].reshape(-1, 2) * observed.sigma
    sigma = dict(zip(columns.names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    return Adjusted(
        bundle, raw, observed.camera, columns.names, covariance, float(residual @ residual),
        len(residual) - len(columns.names), sigma,
    )  # fmt: skip


class _Columns:
    """Which column of the Jacobian belongs to which free parameter."""

    def __init__(self, bundle: Bundle) -> None:
        names: list[str] = []
        self.intrinsics: list[dict[str, int]] = []
        self.cameras: list[int | None] = []
        self.views: list[int | None] = []
        for camera, free in zip(bundle.cameras, bundle.free_intrinsics, strict=True):
            unknown = set(free) - set(INTRINSICS) - {"f"}
            if unknown:
                raise ValueError(f"there is no intrinsic {sorted(unknown)}; they are {INTRINSICS}")
            self.intrinsics.append({name: len(names) + i for i, name in enumerate(free)})
            names += [f"{camera.name}.{name}" for name in free]
        for camera, moves in zip(bundle.cameras, bundle.free_cameras, strict=True):
            self.cameras.append(len(names) if moves else None)
            names += [f"{camera.name}.{name}" for name in POSE] if moves else []
        for k, moves in enumerate(bundle.free_views):
            self.views.append(len(names) if moves else None)
            names += [f"view{k}.{name}" for name in POSE] if moves else []
        self.points = len(names) if bundle.points_sigma_m is not None else None
        if self.points is not None:
            names += [f"point{k}.{axis}" for k in range(len(bundle.points)) for axis in "xyz"]
        self.responses: list[int] = []
        self.whitening: list[Array] = []  # (2, T, T)
        for camera, covariance in zip(bundle.cameras, bundle.responses, strict=False):
            self.responses.append(len(names))
            names += [
                f"{camera.name}.{axis}{i + 1}" for axis in "ab" for i in range(covariance.shape[1])
            ]
            self.whitening.append(
                np.stack([np.linalg.cholesky(np.linalg.inv(axis)).T for axis in covariance])
            )
        self.names = tuple(names)

    def moved(self, bundle: Bundle, step: Array) -> Bundle:
        """The bundle with a step added to its free parameters."""
        cameras = []
        for camera, columns, at in zip(bundle.cameras, self.intrinsics, self.cameras, strict=True):
            values = intrinsics_of(camera)
            for name, column in columns.items():
                for each in ("fx", "fy") if name == "f" else (name,):
                    values[INTRINSICS.index(each)] += step[column]
            values[:2] = np.maximum(values[:2], 1e-9)
            pose = camera.camera_from_rig
            if at is not None:
                pose = pose.perturbed(step[at : at + 6])
            cameras.append(with_intrinsics(camera, values, pose))
        views = [
            view if at is None else view.perturbed(step[at : at + 6])
            for view, at in zip(bundle.views, self.views, strict=True)
        ]
        points = bundle.points
        if self.points is not None:
            points = points + step[self.points : self.points + points.size].reshape(-1, 3)
        offsets = tuple(
            offset + step[at : at + offset.size].reshape(offset.shape)
            for offset, at in zip(bundle.offsets, self.responses, strict=True)
        )
        return replace(
            bundle, cameras=tuple(cameras), views=tuple(views), points=points, offsets=offsets
        )


def _linearised(
    bundle: Bundle, observed: Observations, columns: _Columns, given: Bundle
) -> tuple[Array, Array]:
    """Whitened residuals (observed less predicted) and the Jacobian of the predictions."""
    count = len(observed.camera)
    jacobian = np.zeros((2 * count, len(columns.names)))
    residual = np.empty((count, 2))
    for k, camera in enumerate(bundle.cameras):
        rows = np.flatnonzero(observed.camera == k)
        if not len(rows):
            continue
        views, points = observed.view[rows], observed.point[rows]
        turn = np.stack([view.rotation for view in bundle.views])[views]
        place = np.stack([view.translation_m for view in bundle.views])[views]
        board = bundle.points[points]
        arm = np.einsum("nij,nj->ni", turn, board)
        rig = arm + place
        if not (camera.camera_from_rig.apply(rig)[:, 2] > 0.0).all():
            return np.full(2 * count, np.inf), jacobian
        predicted, by_own, by_rig = camera.slopes(rig)
        residual[rows] = (observed.positions[rows] - predicted) / observed.sigma[rows]
        block = np.zeros((len(rows), 2, len(columns.names)))
        for name, column in columns.intrinsics[k].items():
            own = [INTRINSICS.index(n) for n in (("fx", "fy") if name == "f" else (name,))]
            block[:, :, column] = by_own[:, :, own].sum(axis=2)
        at = columns.cameras[k]
        if at is not None:
            block[:, :, at : at + 6] = by_own[:, :, len(INTRINSICS) :]
        by_view = by_pose(by_rig, arm)
        for v in np.unique(views):
            at = columns.views[v]
            if at is not None:
                block[views == v, :, at : at + 6] = by_view[views == v]
        if columns.points is not None:
            by_board = by_rig @ turn
            for i, point in enumerate(points):
                at = columns.points + 3 * int(point)
                block[i, :, at : at + 3] = by_board[i]
        if columns.responses:
            assert observed.terms is not None
            at, width = columns.responses[k], observed.terms.shape[1]
            residual[rows] += (observed.terms[rows] @ bundle.offsets[k].T) / observed.sigma[rows]
            block[:, 0, at : at + width] = -observed.terms[rows]
            block[:, 1, at + width : at + 2 * width] = -observed.terms[rows]
        block /= observed.sigma[rows][:, :, None]
        jacobian.reshape(count, 2, -1)[rows] = block
    extra_r, extra_j = _priors(bundle, columns, given)
    return np.concatenate([residual.ravel(), *extra_r]), np.concatenate([jacobian, *extra_j])


def _priors(bundle: Bundle, columns: _Columns, given: Bundle) -> tuple[list[Array], list[Array]]:
    residuals: list[Array] = []
    rows: list[Array] = []
    for camera, name, value, sigma in bundle.priors:
        column = columns.intrinsics[camera].get(name)
        if column is None:
            continue
        held = float(intrinsics_of(bundle.cameras[camera])[INTRINSICS.index(name)])
        row = np.zeros((1, len(columns.names)))
        row[0, column] = 1.0 / sigma
        residuals.append(np.array([(value - held) / sigma]))
        rows.append(row)
    if columns.points is not None:
        assert bundle.points_sigma_m is not None
        size = 3 * len(bundle.points)
        block = np.zeros((size, len(columns.names)))
        block[:, columns.points : columns.points + size] = np.eye(size) / bundle.points_sigma_m
        residuals.append((given.points - bundle.points).ravel() / bundle.points_sigma_m)
        rows.append(block)
    for at, whitening, offset in zip(
        columns.responses, columns.whitening, bundle.offsets, strict=True
    ):
        width = offset.shape[1]
        for axis in range(2):
            block = np.zeros((width, len(columns.names)))
            block[:, at + axis * width : at + (axis + 1) * width] = whitening[axis]
            residuals.append(-whitening[axis] @ offset[axis])
            rows.append(block)
    return residuals, rows
