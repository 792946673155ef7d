"""The reflectors of one group, and the face frame of a guidance sensor's numbers."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import Reflector, Target

# area of a triangle over its longest side squared: thinner ones fix no attitude. Source: by
# construction, a bound only
_FLAT = 1e-3
# m, and σ of the places: reflectors that a rotation brings so near each other look the same.
# Source: by construction, rounding, and 4 σ of the difference of two
_ALIKE_M, _ALIKE_SIGMAS = 1e-6, 6.0


@dataclass(frozen=True, slots=True, eq=False)
class ReflectorPattern:
    """Three or more reflectors that are looked for together.

    The *face frame*: origin midway between the outer reflectors (the base), x from the left one
    to the right one, z along the mean normal towards whoever looks at the target, y up. Left is
    the one that the target file names first.

    Raises:
        RendezviewError: fewer than three reflectors, or no three that span a triangle.
    """

    name: str
    names: tuple[str, ...]
    positions_m: Array  # (N, 3) target frame
    normals: Array  # (N, 3) unit
    diameters_m: Array  # (N,)
    sigmas_m: Array = field(default_factory=lambda: np.empty(0))  # (N,) σ of each coordinate; 0
    sigmas_known: bool = False  # whether they are given for all

    def __post_init__(self) -> None:
        if not len(self.sigmas_m):
            object.__setattr__(self, "sigmas_m", np.zeros(len(self.names)))
        if len(self.names) < 3:
            raise RendezviewError(
                f"reflectors of group {self.name!r}: {len(self.names)}, but a pose needs three: "
                "add some to the target file, or name another group"
            )
        if not self.triangles():
            raise RendezviewError(
                f"reflectors of group {self.name!r}: no three of them span a triangle: "
                "one must be on a post or off the line"
            )
        facing = self.normals.sum(axis=0)
        if np.linalg.norm(facing) < 0.5 * len(self.names):
            raise RendezviewError(
                f"reflectors of group {self.name!r} face apart and cannot be seen together: "
                "make them two groups"
            )

    @classmethod
    def of(cls, name: str, reflectors: tuple[Reflector, ...]) -> ReflectorPattern:
        """The pattern of some reflectors of a target file."""
        return cls(
            name,
            tuple(r.name for r in reflectors),
            np.array([r.position_m for r in reflectors], dtype=np.float64).reshape(-1, 3),
            np.array([r.normal for r in reflectors], dtype=np.float64).reshape(-1, 3),
            np.array([r.diameter_m for r in reflectors], dtype=np.float64),
            np.array([r.position_sigma_m or 0.0 for r in reflectors], dtype=np.float64),
            all(r.position_sigma_m is not None for r in reflectors),
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def discs(self) -> Array:
        """(N, 2) diameter, and σ of each coordinate of the place, m."""
        return np.column_stack([self.diameters_m, self.sigmas_m])

    @property
    def facing(self) -> Array:
        """(3,) unit mean normal, target frame."""
        mean = self.normals.sum(axis=0)
        return np.asarray(mean / np.linalg.norm(mean))

    @property
    def centre_m(self) -> Array:
        """(3,) mean position of the reflectors, target frame."""
        return np.asarray(self.positions_m.mean(axis=0))

    def range_m(self, camera_from_target: Pose) -> float:
        """Distance of their middle from the camera."""
        return math.hypot(*camera_from_target.apply(self.centre_m).tolist())

    @property
    def base(self) -> tuple[int, int]:
        """Left and right reflector: those farthest apart across the facing direction.

        Of pairs equally far apart, as in the five-reflector target, the first in the file.
        """
        flat = self.positions_m - np.outer(self.positions_m @ self.facing, self.facing)
        pairs = list(itertools.combinations(range(len(self)), 2))
        lengths = [float(np.linalg.norm(flat[j] - flat[i])) for i, j in pairs]
        longest = max(lengths)
        return next(
            pair
            for pair, length in zip(pairs, lengths, strict=True)
            if length > (1.0 - 1e-6) * longest
        )

    @property
    def base_m(self) -> float:
        """Distance between left and right reflector."""
        left, right = self.base
        return float(np.linalg.norm(self.positions_m[right] - self.positions_m[left]))

    @property
    def target_from_face(self) -> Pose:
        """The face frame in the target frame."""
        left, right = self.base
        along, facing = self.positions_m[right] - self.positions_m[left], self.facing
        x = along - (along @ facing) * facing
        x /= np.linalg.norm(x)
        rotation = np.column_stack([x, np.cross(facing, x), facing])
        return Pose(rotation, 0.5 * (self.positions_m[left] + self.positions_m[right]))

    def triangles(self) -> list[tuple[int, int, int]]:
        """(left, centre, right): each three that span a triangle, the outer two farthest apart."""
        found = []
        for three in itertools.combinations(range(len(self)), 3):
            sides = {
                pair: float(np.linalg.norm(self.positions_m[pair[0]] - self.positions_m[pair[1]]))
                for pair in itertools.combinations(three, 2)
            }
            (left, right), longest = max(sides.items(), key=lambda item: item[1])
            (centre,) = set(three) - {left, right}
            a, b, c = self.positions_m[[left, centre, right]]
            if np.linalg.norm(np.cross(b - a, c - a)) > _FLAT * longest**2:
                found.append((left, centre, right))
        return found

    def mirrored(self) -> ReflectorPattern:
        """Its mirror image: what a mirrored picture shows."""
        image = np.array([-1.0, 1.0, 1.0])
        return replace(self, positions_m=self.positions_m * image, normals=self.normals * image)

    def symmetries(self) -> list[tuple[int, ...]]:
        """The renumberings other than none that a rotation of the pattern makes.

        Places that differ by less than they are known to are alike. Two mirror-equal outer
        reflectors about a post give one: a roll by 180° that no picture of this pattern can show.
        """
        return [order for order, _ in self._alike()]

    def turns(self) -> list[Pose]:
        """The turns of the target frame that bring the pattern onto itself."""
        centre = self.centre_m
        return [Pose(turn, centre - turn @ centre) for _, turn in self._alike()]

    def _alike(self) -> Iterator[tuple[tuple[int, ...], Array]]:
        """Renumberings with their rotations (3, 3)."""
        centred = self.positions_m - self.centre_m
        loose_m = _ALIKE_SIGMAS * float(self.sigmas_m.max())
        # Which also leaves a turn open, and with it the normals.
        loose_rad = loose_m / float(np.linalg.svd(centred, compute_uv=False)[1])
        for order in itertools.permutations(range(len(self))):
            other = list(order)
            if order == tuple(range(len(self))):
                continue
            if np.abs(self.diameters_m - self.diameters_m[other]).max() > _ALIKE_M:
                continue
            u, _, vt = np.linalg.svd(centred[other].T @ centred)
            turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            moved = np.abs(centred @ turn.T - centred[other]).max()
            leaned = np.abs(self.normals @ turn.T - self.normals[other]).max()
            if moved < _ALIKE_M + loose_m and leaned < 1e-6 + loose_rad:
                yield order, turn


def patterns_of(target: Target, groups: tuple[str, ...] | None = None) -> list[ReflectorPattern]:
    """The reflector groups of a target, the one with the longest base (the far target) first.

    Raises:
        RendezviewError: no reflectors, an unknown group, or a group that gives no pose.
    """
    known = list(dict.fromkeys(reflector.group for reflector in target.reflectors))
    if not known:
        raise RendezviewError(
            f"target {target.name!r} has no reflectors: add [[reflectors]] to its target file"
        )
    for group in groups or ():
        if group not in known:
            raise RendezviewError(
                f"target {target.name!r} has no reflector group {group!r}: "
                f"choose from {', '.join(known)}"
            )
    patterns = [
        ReflectorPattern.of(g, tuple(r for r in target.reflectors if r.group == g))
        for g in (groups or known)
    ]
    return sorted(patterns, key=lambda pattern: -pattern.base_m)


def left_out_of(target: Target, used: list[ReflectorPattern]) -> tuple[ReflectorPattern, ...]:
    """The other groups of a target that give a pose."""
    others = []
    for name in dict.fromkeys(reflector.group for reflector in target.reflectors):
        if name not in {pattern.name for pattern in used}:
            with contextlib.suppress(RendezviewError):
                others += patterns_of(target, (name,))
    return tuple(others)


@dataclass(frozen=True, slots=True)
class SixNumbers:
    """The six numbers of a guidance sensor: the face frame in the camera frame.

    ``camera_from_face = Rz(roll) Ry(−yaw) Rx(pitch) diag(1, −1, −1)``: head-on with the base
    level all three are 0. Roll is clockwise on the screen; yaw moves the post's tip to the right
    and pitch moves it down, in the picture unrolled.
    """

    range_m: float  # to the middle of the base
    azimuth_rad: float  # right of the boresight
    elevation_rad: float  # above the boresight
    roll_rad: float  # (−π, π]
    pitch_rad: float
    yaw_rad: float


_HEAD_ON = np.diag([1.0, -1.0, -1.0])  # camera from face. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """The face frame of a pattern, computed once, for six numbers many times a second."""

    rotation: Array  # (3, 3) target from head-on camera: face axes, y and z turned over
    origin_m: Array  # (3,) target frame

    @classmethod
    def of(cls, pattern: ReflectorPattern) -> Face:
        """The face frame of a pattern."""
        target_from_face = pattern.target_from_face
        return cls(target_from_face.rotation @ _HEAD_ON, target_from_face.translation_m)

    def six_numbers(self, camera_from_target: Pose) -> SixNumbers:
        """The six numbers of a pose."""
        x, y, z = camera_from_target.apply(self.origin_m).tolist()
        angles = attitude_angles(camera_from_target.rotation @ self.rotation)
        bearing = math.atan2(x, z), math.atan2(-y, math.hypot(x, z))
        return SixNumbers(math.hypot(x, y, z), *bearing, *angles)

    def six_rates(self, camera_from_target: Pose, rates: Array) -> Array:
        """(6,) rates of the six numbers; ``rates`` (6,) rad/s and m/s, camera frame."""
        arm = camera_from_target.rotation @ self.origin_m
        x, y, z = (arm + camera_from_target.translation_m).tolist()
        wx, wy, wz, *velocity = rates.tolist()
        (p, q, r), (u, v, w) = arm.tolist(), velocity
        vx, vy, vz = u + wy * r - wz * q, v + wz * p - wx * r, w + wx * q - wy * p
        turn = (camera_from_target.rotation @ self.rotation).tolist()
        (a, h, i), (b, e, f), (c, d, g) = turn
        da, db, dc = wy * c - wz * b, wz * a - wx * c, wx * b - wy * a  # dR/dt = [w]× R
        dd, dg = wx * e - wy * h, wx * f - wy * i
        level, far, along = math.hypot(x, z), math.hypot(x, y, z), x * vx + z * vz
        return np.array(
            [
                (along + y * vy) / far,
                (z * vx - x * vz) / level**2,
                (y * along / level - level * vy) / far**2,
                (a * db - b * da) / (a * a + b * b),
                (g * dd - d * dg) / (d * d + g * g),
                dc / math.sqrt(1.0 - min(c**2, 1.0 - 1e-12)),
            ]
        )


def attitude(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """(3, 3) ``Rz(roll) Ry(−yaw) Rx(pitch)``, the turn from head-on."""
    turn = Rotation.from_euler("ZYX", [roll_rad, -yaw_rad, pitch_rad])
    return np.asarray(turn.as_matrix())


def attitude_angles(turn: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw of an `attitude` matrix."""
    return (
        math.atan2(turn[1, 0], turn[0, 0]),
        math.atan2(turn[2, 1], turn[2, 2]),
        math.asin(min(max(float(turn[2, 0]), -1.0), 1.0)),
    )


def six_numbers(camera_from_target: Pose, pattern: ReflectorPattern) -> SixNumbers:
    """The six numbers of a pose."""
    return Face.of(pattern).six_numbers(camera_from_target)


def pose_of(six: SixNumbers, pattern: ReflectorPattern) -> Pose:
    """The pose ``camera_from_target`` that has these six numbers."""
    turn = attitude(six.roll_rad, six.pitch_rad, six.yaw_rad)
    level = math.cos(six.elevation_rad)
    sight = np.array(
        [
            math.sin(six.azimuth_rad) * level,
            -math.sin(six.elevation_rad),
            math.cos(six.azimuth_rad) * level,
        ]
    )
    camera_from_face = Pose(turn @ _HEAD_ON, six.range_m * sight)
    return camera_from_face @ pattern.target_from_face.inverse()
