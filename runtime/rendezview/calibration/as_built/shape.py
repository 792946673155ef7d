"""What is asked and what is found of the shape of a target as it was built."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.edges.measured import STRAINS
from rendezview.sensors.appearance.model.view_model import ViewModel


@dataclass(frozen=True, kw_only=True)
class ShapeOptions:
    """How the strain is estimated."""

    prior_sigma: float = 0.05  # of each component. Source: by construction, a coarse CAD model
    # Components below it are alike: most are right, a few far off.
    usual_sigma: float = 0.005  # Source: by construction, a careful CAD model
    size_sigma: float = 0.02  # of the mean of xx, yy, zz. Source: by construction, a known craft
    turn_sigma_rad: float = 0.15  # of a part. Source: by construction, 6° is twice less
    move_sigma: float = 0.05  # of a part, share of the target's radius. Source: by construction
    rounds: int = 10  # Gauss–Newton, at most. Source: pose-shape (0.1), twice what it took
    stop: float = 2e-4  # largest change of a component. Source: a tenth of an edge's error
    # The frames are recognised so often at most: again with the model found, while the strain
    # changes by more than ``repeat_above``. Source: experiment photo-accuracy --folds
    passes: int = 3
    repeat_above: float = 5e-3  # Source: a pixel or two of an edge
    least_frames: int = 5  # with a pose. Source: by construction
    least_spread_rad: float = np.deg2rad(30.0)  # between two views. Source: by construction
    focal_sigma: float = 0.05  # of the focal length. Source: by construction, a data sheet
    centre_sigma: float = 0.02  # of the principal point, share of the focal length. Source: same
    whole_trust: float = 0.5  # a part above it is trusted wholly. Source: scatter of such ratios
    least_edges: int = 50  # of a part; fewer say nothing of its trust. Source: by construction
    # Neighbouring edges err together: as many edges count as one.
    edges_as_one: float = 5.0  # Source: experiment photo-accuracy --folds
    # Times the median frame's residual; frames beyond are wrong poses.
    most_rms: float = 2.5  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceResiduals:
    """Where the edges of all frames lie beside those of the model, over its surface."""

    place_m: Array  # (N, 3) from the view centre, target axes
    share: Array  # (N,) outwards, of the target's radius


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """How a part of the craft is mounted, and how well its edges then fit."""

    name: str
    motion: Array  # (6,) rotation vector about the middle of its boxes, rad; shift, m; target axes
    covariance: Array  # (6, 6)
    trust: float  # 0 … 1: what one of its edges is worth beside one of the rest
    edges: int  # of it, in all frames

    @property
    def turn_deg(self) -> float:
        return float(np.rad2deg(np.linalg.norm(self.motion[:3])))


@dataclass(frozen=True, slots=True, eq=False)
class AsBuilt:
    """The strain of a craft and the mounting of its parts, and how well they explain the frames."""

    strain: Array  # (3, 3) symmetric, target axes, about the view centre
    covariance: Array  # (6, 6) of its components xx, yy, zz, xy, xz, yz
    size_sigma: float  # one σ of the mean of xx, yy, zz
    poses: tuple[Pose | None, ...]  # camera_from_target of each frame; None: not used
    rms_before: float  # median over the frames, of the target's radius
    rms_after: float
    size_known: bool  # by lengths, or by the frames
    before: SurfaceResiduals  # of the model as it was
    after: SurfaceResiduals
    mountings: tuple[Mounting, ...]
    model: ViewModel  # as built
    camera: Camera  # as it is, where it was asked for
    # (3, 3) of the logarithm of the focal length and the principal point, px; (0, 0): not asked
    lens_covariance: Array

    @property
    def components(self) -> Array:
        """(6,) of the strain."""
        return np.array([self.strain[a, b] for a, b in STRAINS])

    @property
    def used(self) -> int:
        """Frames with a pose."""
        return sum(pose is not None for pose in self.poses)
