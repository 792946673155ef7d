"""How far the surface of a target is from where it should be: the measures of BOP.

Hodaň et al., "BOP Challenge 2020 on 6D Object Localization", ECCVW 2020, section 2.2 (MSSD,
MSPD); Hinterstoisser et al., ACCV 2012 (ADD, ADD-S). The numbers are those of the public BOP
toolkit, its way of taking continuous symmetries in steps included; lengths here are metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, discrete_turns

# The toolkit's step: the farthest point moves by at most this share of the diameter.
STEP = 0.01
_REFERENCE_WIDTH_PX = 640.0  # BOP's thresholds in pixels are for pictures that wide
_BLOCK = 2000  # rows of distances at once


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """What the measures need of a target."""

    points_m: Array  # (V, 3) vertices, target frame
    hull_m: Array  # (H, 3) those on the convex hull
    diameter_m: float  # largest distance of two vertices
    alike: tuple[Pose, ...]  # target_from_target that change nothing, the identity first

    @classmethod
    def of(
        cls,
        points_m: npt.ArrayLike,
        alike: Sequence[Pose] = (),
        diameter_m: float | None = None,
    ) -> Surface:
        """The surface with these vertices.

        Args:
            points_m: (V, 3) vertices, target frame.
            alike: see `alike_of`; none: no symmetry.
            diameter_m: largest distance of two vertices, where it is known.

        Raises:
            ValueError: no vertices, or all in one place.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
            raise ValueError(f"points_m must be (V, 3), not {points.shape}")
        try:
            hull = points[ConvexHull(points).vertices]
        except QhullError:  # flat
            hull = np.unique(points, axis=0)
        if diameter_m is None:
            blocks = (cdist(hull[i : i + _BLOCK], hull).max() for i in range(0, len(hull), _BLOCK))
            diameter_m = float(max(blocks))
        if not diameter_m > 0.0:
            raise ValueError("all vertices are in one place")
        return cls(points, hull, diameter_m, tuple(alike) or (Pose.identity(),))


@dataclass(frozen=True, slots=True)
class SurfaceErrors:
    """One estimate against the truth; 0 or more, infinite where it cannot be projected."""

    mssd_m: float  # maximum symmetry-aware surface distance
    mspd_px: float  # maximum symmetry-aware projection distance, without lens distortion
    add_m: float  # mean distance of vertices
    add_s_m: float  # mean distance to the nearest vertex
    diameter_m: float  # of the target
    width_px: int  # of the picture

    @property
    def mssd_fraction(self) -> float:
        """MSSD over the diameter."""
        return self.mssd_m / self.diameter_m

    @property
    def mspd_640_px(self) -> float:
        """MSPD as in a picture 640 pixels wide."""
        return self.mspd_px * _REFERENCE_WIDTH_PX / self.width_px


def alike_of(symmetries: Sequence[Symmetry]) -> tuple[Pose, ...]:
    """The turns of a target's symmetries, target_from_target, the identity first.

    A continuous symmetry is taken in 315 steps (`STEP`), as the toolkit does.

    Raises:
        ValueError: discrete turns that never come round.
    """
    discrete = [Pose(turn, np.zeros(3)) for turn in discrete_turns(symmetries)]
    axes = [s.axis / np.linalg.norm(s.axis) for s in symmetries if s.kind == "continuous"]
    return combined(discrete, [turn for axis in axes for turn in turns_about(axis, np.zeros(3))])


def turns_about(axis: Array, through_m: Array) -> list[Pose]:
    """Turns about an axis (3,), unit, through a point (3,), in steps; the identity first."""
    count = int(np.ceil(np.pi / STEP))
    turns = Rotation.from_rotvec(np.arange(count)[:, None] * (2.0 * np.pi / count) * axis)
    return [Pose(turn, through_m - turn @ through_m) for turn in turns.as_matrix()]


def combined(discrete: Sequence[Pose], continuous: Sequence[Pose]) -> tuple[Pose, ...]:
    """Each discrete turn, then each step of the continuous ones."""
    if not continuous:
        return tuple(discrete)
    return tuple(step @ turn for turn in discrete for step in continuous)


def surface_errors(
    truth: Pose, estimate: Pose, surface: Surface, matrix: Array, width_px: int
) -> SurfaceErrors:
    """Errors of one estimated ``camera_from_target``.

    Args:
        truth: camera_from_target.
        estimate: the same, estimated.
        surface: of the target.
        matrix: (3, 3) of the camera, px.
        width_px: of the picture.
    """
    points, truths = surface.points_m, [truth @ turn for turn in surface.alike]
    found, true = estimate.apply(points), truth.apply(points)
    # The distance of two images of a point under affine maps is convex: largest on the hull.
    hull = estimate.apply(surface.hull_m)
    mssd = min(_norms(hull - alike.apply(surface.hull_m)).max() for alike in truths)
    mspd = np.inf
    if (found_px := _projected(found, matrix)) is not None:
        for alike in truths:
            true_px = _projected(alike.apply(points), matrix)
            if true_px is not None:
                mspd = min(mspd, _norms(found_px - true_px).max())
    return SurfaceErrors(
        mssd_m=float(mssd),
        mspd_px=float(mspd),
        add_m=float(_norms(found - true).mean()),
        add_s_m=float(cKDTree(found).query(true)[0].mean()),
        diameter_m=surface.diameter_m,
        width_px=width_px,
    )


def _norms(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def _projected(points: Array, matrix: Array) -> Array | None:
    """(V, 2) pixels of points (V, 3); None where one is beside or behind the camera.

    There the toolkit goes on with the mirrored pixel; no picture has it.
    """
    if not (points[:, 2] > 0.0).all():
        return None
    projected = points @ matrix.T
    return np.asarray(projected[:, :2] / projected[:, 2:])
