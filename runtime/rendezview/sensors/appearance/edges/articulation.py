"""The joints of one configuration: its contour points turned, angles found with the pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.joint import apart, hinges_of, within
from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import exp
from rendezview.sensors.appearance.edges.alignment import nearest_views
from rendezview.sensors.appearance.edges.grey import point_of_slope
from rendezview.sensors.appearance.edges.measured import sandwich
from rendezview.sensors.appearance.edges.predicted import FOUND, NOT_FOUND, RESIDUAL, STATE, WEIGHT
from rendezview.sensors.appearance.model.contours import POINT_UNIT
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.model.view_tables import ViewTables

_CONE_COSINE = np.cos(np.deg2rad(15.0))  # of views that a refinement may reach. Source: twice 5°
_STALE_RAD = 1e-5  # rad; a smaller turn is below the unit of the points. Source: by construction
_LONGEST_RAD = (
    0.15  # rad, of one step of an angle. Source: half the configurations' distance, and some
)
# Of angles that no edge shows. Source: as of the alignment's first stage
_DAMPING = 1e-3
_LEVER_RADII = 0.3  # of the target's radius: of a part that turns. Source: pose-joints (0.1)
# Of the target's radius: a measured point and the table's own. Source: by construction
_SAME_RADII = 5e-3
# Of the visible points of a joint: with fewer in place no edge confirms its angle. Source:
# experiment pose-joints (0.1), 7 to 13 % at wrong angles and above 34 % at right ones
LEAST_SUPPORT = 0.22
_INT16 = 32767  # Source: by construction, the largest stored coordinate


class JointStep(NamedTuple):
    """A Gauss–Newton step of a pose with its angles."""

    moved_px: float  # of the turning edges, root mean square
    covariance: Array  # (6 + J, 6 + J) of the view centre's pose and the angles, for 1 px² of σ²
    support: Array  # (J,) share of the visible points of a joint's parts with an edge in place


class Articulation:
    """Turns the contour points of a configuration, in tables of its own, and refines its angles."""

    def __init__(
        self,
        model: ViewModel,
        views: ViewTables,
        point: npt.NDArray[np.int16],
        tangent: npt.NDArray[np.int8],
    ) -> None:
        """Tables of a configuration of a target with joints.

        Args:
            model: with joints.
            views: the tables.
            point: the memory of theirs, as is ``tangent``: changed in place.

        Raises:
            ValueError: the model's contour points have no parts.
        """
        contours = model.contours
        if contours is None or contours.part is None:
            raise ValueError("the contour points of a target with joints need their parts")
        self.joints = model.joints
        self._model, self._views = model, views
        self._turned = point, tangent
        self._part, self._point, self._tangent = contours.part, contours.point, contours.tangent
        numbered = hinges_of(model.joints)
        self._joint = np.array([k for k, _ in numbered])
        self._axes = np.stack([hinge.axis for _, hinge in numbered])
        self._origins_m = np.stack([hinge.origin_m - model.centre_m for _, hinge in numbered])
        self._turned_to = np.tile(model.angles_rad, (len(views.directions), 1))
        self.start_rad = model.angles_rad.copy()  # of the next refinement
        self.tracked = False  # whether these are known to a few degrees

    def turn(self, angles_rad: Array, rotation: Array, centre_m: Array) -> None:
        """Turn the points of the views around a pose to angles (J,)."""
        views = self._views
        towards = -(centre_m @ rotation) / np.linalg.norm(centre_m)
        stale = np.abs(self._turned_to - angles_rad).max(axis=1) > _STALE_RAD
        stale &= views.directions @ towards > _CONE_COSINE
        chosen = np.flatnonzero(stale)
        if not len(chosen):
            return
        off = apart(self.joints, angles_rad, self._model.angles_rad)[self._joint]
        turns = np.stack([exp(axis * angle) for axis, angle in zip(self._axes, off, strict=True)])
        shifts = self._origins_m - np.einsum("kij,kj->ki", turns, self._origins_m)
        unit_m = views.radius_m * POINT_UNIT
        _turn_points(
            chosen, self._part, self._point, self._tangent, turns, shifts / unit_m,
            *self._turned,
        )  # fmt: skip
        self._turned_to[chosen] = angles_rad

    def step(
        self, edges: Array, cut_px: float, nearest: int, rotation: Array, centre_m: Array,
        angles_rad: Array, loose: Array,
    ) -> JointStep | None:  # fmt: skip
        """One step of pose and angles, all in place; None where the equations give none.

        Args:
            edges: (N, COLUMNS) measured at this pose, of the ``nearest`` views.
            cut_px: residuals beyond do not count.
            rotation: (3, 3), and ``centre_m``: (3,) of the view centre, camera frame.
            angles_rad: (J,)
            loose: (6,) information that there is anyway.
        """
        rows, slopes, support = self._slopes(edges, cut_px, nearest, rotation, centre_m)
        if not len(rows):
            return None
        residual = rows[:, RESIDUAL]
        weight = rows[:, WEIGHT] * (1.0 - (residual / cut_px) ** 2) ** 2
        weighted = weight[:, None] * slopes
        joints = len(self.joints)
        known = np.concatenate([loose, np.full(joints, loose[0])])
        lever_px = (
            _LEVER_RADII
            * self._model.target_radius_m
            * np.linalg.norm(slopes[:, 3:6])
            / (np.sqrt(len(slopes)))
        )
        held = np.zeros(6 + joints)
        held[6:] = _DAMPING * weight.sum() * lever_px**2
        try:
            information = slopes.T @ weighted + np.diag(known + held)
            step = np.linalg.solve(information, weighted.T @ residual)
            covariance = sandwich(slopes, weight, known)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        step *= min(1.0, _LONGEST_RAD / max(float(np.abs(step[6:]).max()), 1e-12))
        rotation[:] = exp(np.asarray(step[:3], dtype=np.float64)) @ rotation
        centre_m += step[3:6]
        angles_rad[:] = within(self.joints, angles_rad + step[6:])
        moved = slopes[:, 6:] @ step[6:]
        total = max(float(weight.sum()), 1e-12)
        return JointStep(float(np.sqrt(weight @ moved**2 / total)), covariance, support)

    def _slopes(
        self, edges: Array, cut_px: float, nearest: int, rotation: Array, centre_m: Array
    ) -> tuple[Array, Array, Array]:
        """The rows that count, the slopes (M, 6 + J) of their predicted edges, px, and support."""
        views = self._views
        chosen = np.zeros(nearest, dtype=np.int64)
        shell = nearest_views(views.directions, views.shells_m, rotation, centre_m, chosen)
        slopes = np.empty((len(edges), 6 + len(self.joints)))
        counted, support = np.empty(len(edges), dtype=np.int64), np.empty(len(self.joints))
        count = _joint_slopes(
            edges, cut_px, self._part[shell], views.point[shell], chosen, rotation, centre_m,
            self._joint, self._axes, self._origins_m, views.radius_m, counted, slopes, support,
        )  # fmt: skip
        return edges[counted[:count]], slopes[:count], support


@njit(cache=True, nogil=True, error_model="numpy")
def _joint_slopes(
    edges: Array, cut_px: float, part: npt.NDArray[np.uint8], point: npt.NDArray[np.int16],
    chosen: npt.NDArray[np.int64], rotation: Array, centre_m: Array, joint: npt.NDArray[np.int64],
    axes: Array, origins_m: Array, radius_m: float, counted: npt.NDArray[np.int64], slopes: Array,
    support: Array,
) -> int:  # fmt: skip
    """Fill the slopes of the edges with |r| < cut with pose and angles; how many there are.

    An edge that is not the table's own point gets no slope with the angles.

    Args:
        edges: (N, COLUMNS) of the ``chosen`` views (K,), one after the other.
        part, point: (V, P) and (V, P, 3) of their shell.
        joint: (H,) of each hinge.
        axes: (H, 3) of the hinges, and ``origins_m``: (H, 3) from the view centre, target frame.
        counted: (N,) gets the rows, and ``slopes``: (N, 6 + J) their slopes, px.
        support: (J,) gets the share of a joint's visible points that have an edge in place.
    """
    points, joints = part.shape[1], support.shape[0]
    q, g, known = np.empty(3), np.empty(3), np.empty(3)
    count = 0
    looked = np.zeros(joints)
    support[:] = 0.0
    for n in range(min(edges.shape[0], len(chosen) * points)):
        state = edges[n, STATE]
        if state != FOUND and state != NOT_FOUND:
            continue
        view, j = chosen[n // points], n % points
        k = int(part[view, j]) - 1
        if k >= 0:
            looked[joint[k]] += 1.0
        if state != FOUND or abs(edges[n, RESIDUAL]) >= cut_px:
            continue
        if k >= 0:
            support[joint[k]] += 1.0
        counted[count] = n
        slope = slopes[count]
        count += 1
        for a in range(6):
            slope[a] = edges[n, a]
        slope[6:] = 0.0
        if k < 0:
            continue
        point_of_slope(edges[n], rotation, centre_m, q, g)
        apart = 0.0
        for i in range(3):
            known[i] = point[view, j, i] * POINT_UNIT * radius_m
            apart += (q[i] - known[i]) ** 2
            known[i] -= origins_m[k, i]
        if apart > (_SAME_RADII * radius_m) ** 2:
            continue
        u = axes[k]
        slope[6 + joint[k]] = (
            g[0] * (u[1] * known[2] - u[2] * known[1])
            + g[1] * (u[2] * known[0] - u[0] * known[2])
            + g[2] * (u[0] * known[1] - u[1] * known[0])
        )
    for k in range(joints):
        support[k] /= max(looked[k], 1.0)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _turn_points(
    views: npt.NDArray[np.int64], part: npt.NDArray[np.uint8], point: npt.NDArray[np.int16],
    tangent: npt.NDArray[np.int8], turns: Array, shifts: Array, out_point: npt.NDArray[np.int16],
    out_tangent: npt.NDArray[np.int8],
) -> None:  # fmt: skip
    """Fill the points and tangents of some views with a configuration's, turned part by part.

    Args:
        views: (M,) of the views.
        part, point, tangent: of ``Contours``, at the configuration's own angles.
        turns: (H, 3, 3) of the hinges, and ``shifts``: (H, 3) in units of the points.
    """
    p, t = np.empty(3), np.empty(3)
    for shell in range(part.shape[0]):
        for view in views:
            for j in range(part.shape[2]):
                k = int(part[shell, view, j]) - 1
                if k < 0:
                    continue
                for a in range(3):
                    p[a], t[a] = shifts[k, a], 0.0
                    for b in range(3):
                        p[a] += turns[k, a, b] * point[shell, view, j, b]
                        t[a] += turns[k, a, b] * tangent[shell, view, j, b]
                for a in range(3):
                    out_point[shell, view, j, a] = min(max(np.rint(p[a]), -_INT16), _INT16)
                    out_tangent[shell, view, j, a] = np.rint(t[a])
