"""The numbers that an operator flies by: from the filter's state, port, corridor and limits.

The port's frame, as its chaser sees it: z into the port, y down, x to the right. A chaser that is
aligned with the port has the axes of this frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview_service.messages.approach_messages import ApproachRequest, Level, LimitMessage
from rendezview_service.messages.fusion_messages import FusionRequest

_NEARLY_PARALLEL = 0.9  # cosine, of axis and default up. Source: chosen
_LEAST_M = 1e-9  # m; nearer there is no direction. Source: by construction
_LEAST_RATE_M_S = 1e-6  # m/s; slower there is no contact. Source: chosen
Json = dict[str, Any]


def _apart_deg(state: Json, one: str, other: str) -> float:
    """The angle of a direction that is turned by two angles, one after the other."""
    cosine = math.cos(state[one]) * math.cos(state[other])
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


# Name, unit and value in a state of what a limit may bound.
_QUANTITIES: dict[str, tuple[str, str, Callable[[Json], float | None]]] = {
    "range_m": ("range", "m", itemgetter("range_m")),
    "range_sigma_m": ("range σ", "m", itemgetter("range_sigma_m")),
    "range_rate_m_s": ("range rate", "m/s", itemgetter("range_rate_m_s")),
    "along_m": ("distance along the axis", "m", itemgetter("along_m")),
    "lateral_m": ("lateral offset", "m", lambda s: math.hypot(s["right_m"], s["up_m"])),
    "lateral_rate_m_s": (
        "lateral rate",
        "m/s",
        lambda s: math.hypot(s["right_rate_m_s"], s["up_rate_m_s"]),
    ),
    "miss_m": ("predicted miss", "m", itemgetter("miss_m")),
    "plan_m": ("distance from the plan", "m", itemgetter("plan_m")),
    "bearing_deg": ("bearing", "°", lambda s: _apart_deg(s, "azimuth_rad", "elevation_rad")),
    "off_axis_deg": ("angle off the axis", "°", lambda s: math.degrees(s["off_axis_rad"])),
    "roll_deg": ("roll", "°", lambda s: math.degrees(s["roll_rad"])),
    "pitch_deg": ("pitch", "°", lambda s: math.degrees(s["pitch_rad"])),
    "yaw_deg": ("yaw", "°", lambda s: math.degrees(s["yaw_rad"])),
    "misalignment_deg": ("misalignment", "°", lambda s: _apart_deg(s, "yaw_rad", "pitch_rad")),
    "turn_rate_deg_s": ("turn rate", "°/s", lambda s: math.degrees(s["turn_rate_rad_s"])),
}
_WITHOUT_PORT = ("range_m", "range_sigma_m", "range_rate_m_s", "plan_m", "bearing_deg",
                 "turn_rate_deg_s")  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Port:
    """A docking port."""

    centre_m: Array  # (3,) target frame
    port_from_target: Array  # (3, 3) rotation


class ApproachMonitor:
    """Compares the filter's state with what a session asked for."""

    def __init__(
        self, request: ApproachRequest | None, fusion: FusionRequest | None, centre_m: Array
    ) -> None:
        """A monitor.

        Args:
            fusion: its ring is the port where the request names none.
            centre_m: view centre, target frame.

        Raises:
            RendezviewError: what is asked needs a port, or its up direction is impossible.
        """
        self._asked = request or ApproachRequest()
        self._centre_m = np.asarray(centre_m, np.float64)
        self._port = _port_of(self._asked, fusion)
        self._plan_s = np.array([point.time_s for point in self._asked.plan])
        self._plan_m = np.array([point.position_m for point in self._asked.plan]).reshape(-1, 3)
        probe = self._asked.probe_from_camera
        self._probe = Pose.identity() if probe is None else probe.pose
        if self._port is None and (self._asked.corridor or self._needs_port()):
            raise RendezviewError(
                "approach: a corridor, and limits along or about a port's axis, need a port: give "
                "port, or a docking ring"
            )

    def state(self, time_s: float, motion: Json, covariance: Array | None) -> Json | None:
        """The `Approach` by a `Motion`; None without a pose.

        Args:
            time_s: of the frame.
            covariance: (12, 12) of the filter, as `Fused` has it.
        """
        if motion["pose"] is None or motion["rates"] is None or covariance is None:
            return None
        pose = Pose.from_quat_wxyz(**motion["pose"])
        turn = np.array(motion["rates"]["angular_rad_s"])
        move = np.array(motion["rates"]["linear_m_s"])
        aim = self._centre_m if self._port is None else self._port.centre_m
        arm = pose.rotation @ aim
        sight, range_m = _sight(self._probe.apply(arm + pose.translation_m))
        along_sight = self._probe.rotation.T @ sight  # camera frame
        speed = move + np.cross(turn, arm)  # of the port, camera frame
        by_pose = np.concatenate([np.cross(arm, along_sight), along_sight])
        state: Json = {
            "range_m": range_m,
            "range_sigma_m": math.sqrt(max(0.0, by_pose @ covariance[:6, :6] @ by_pose)),
            "range_rate_m_s": float(along_sight @ speed),
            "range_rate_sigma_m_s": math.sqrt(max(0.0, by_pose @ covariance[6:, 6:] @ by_pose)),
            "azimuth_rad": math.atan2(sight[0], sight[2]),
            "elevation_rad": math.atan2(-sight[1], math.hypot(sight[0], sight[2])),
            "turn_rate_rad_s": float(np.linalg.norm(turn)),
        }
        state |= self._beside_port(pose, turn, move)
        state["in_corridor"] = self._in_corridor(state)
        probe_m = (self._probe @ pose).inverse().translation_m  # target frame
        state["in_keep_out"] = self._in_keep_out(probe_m)
        state["plan_m"] = self._from_plan(time_s, probe_m)
        state["alarms"] = self._alarms(state)
        return state

    def _needs_port(self) -> bool:
        return any(limit.quantity not in _WITHOUT_PORT for limit in self._asked.limits)

    def _beside_port(self, pose: Pose, turn: Array, move: Array) -> Json:
        """Place, motion and attitude of the probe in the port's frame."""
        if self._port is None:
            return dict.fromkeys(
                ("along_m", "right_m", "up_m", "along_rate_m_s", "right_rate_m_s", "up_rate_m_s",
                 "off_axis_rad", "roll_rad", "pitch_rad", "yaw_rad", "contact_s", "miss_m")
            )  # fmt: skip
        probe_from_target = self._probe @ pose
        back = self._port.port_from_target @ probe_from_target.rotation.T  # port_from_probe
        place = self._port.port_from_target @ (
            probe_from_target.inverse().translation_m - self._port.centre_m
        )
        # d/dt (−Rᵀ t) = −Rᵀ (v − ω × t), with the velocity of the target's origin in the probe.
        of_origin = self._probe.rotation @ (move - np.cross(turn, pose.translation_m))
        arm = self._probe.rotation @ np.cross(turn, self._probe.inverse().translation_m)
        speed = -back @ (of_origin + arm)
        sideways = math.hypot(place[0], place[1])
        contact_s = place_at = None
        if speed[2] > _LEAST_RATE_M_S and place[2] < 0.0:
            contact_s = float(-place[2] / speed[2])
            place_at = math.hypot(*(place[:2] + contact_s * speed[:2]))
        yaw, pitch, roll = Rotation.from_matrix(back).as_euler("YXZ").tolist()
        return {
            "along_m": float(-place[2]),
            "right_m": float(place[0]),
            "up_m": float(-place[1]),
            "along_rate_m_s": float(-speed[2]),
            "right_rate_m_s": float(speed[0]),
            "up_rate_m_s": float(-speed[1]),
            "off_axis_rad": math.atan2(sideways, -place[2]),
            "roll_rad": roll,
            "pitch_rad": pitch,
            "yaw_rad": yaw,
            "contact_s": contact_s,
            "miss_m": place_at,
        }

    def _in_corridor(self, state: Json) -> bool | None:
        corridor, along_m = self._asked.corridor, state["along_m"]
        if corridor is None or state["range_m"] > corridor.length_m:
            return None
        wide_m = corridor.radius_m + along_m * math.tan(math.radians(corridor.half_angle_deg))
        return bool(along_m >= 0.0 and math.hypot(state["right_m"], state["up_m"]) <= wide_m)

    def _in_keep_out(self, probe_m: Array) -> bool | None:
        if self._asked.keep_out_m is None:
            return None
        return bool(np.linalg.norm(probe_m - self._centre_m) < self._asked.keep_out_m)

    def _from_plan(self, time_s: float, probe_m: Array) -> float | None:
        if not len(self._plan_s) or not self._plan_s[0] <= time_s <= self._plan_s[-1]:
            return None
        planned = [np.interp(time_s, self._plan_s, self._plan_m[:, k]) for k in range(3)]
        return float(np.linalg.norm(probe_m - planned))

    def _alarms(self, state: Json) -> list[Json]:
        found = []
        if state["in_keep_out"] and not state["in_corridor"]:
            text = f"inside the keep-out zone of {self._asked.keep_out_m:g} m"
            found.append({"level": Level.ALARM, "quantity": "keep_out", "text": text})
        if state["in_corridor"] is False:
            text = "outside the corridor"
            found.append({"level": Level.ALARM, "quantity": "corridor", "text": text})
        for limit in self._asked.limits:
            if limit.within_m is not None and state["range_m"] > limit.within_m:
                continue
            value = _QUANTITIES[limit.quantity][2](state)
            said = None if value is None else _exceeded(limit, value)
            if said is not None:
                found.append({"level": limit.level, "quantity": limit.quantity, "text": said})
        return found


def _exceeded(limit: LimitMessage, value: float) -> str | None:
    name, unit, _ = _QUANTITIES[limit.quantity]
    if limit.most is not None and value > limit.most:
        return f"{name} {value:.3g} {unit}: more than {limit.most:g} {unit}"
    if limit.least is not None and value < limit.least:
        return f"{name} {value:.3g} {unit}: less than {limit.least:g} {unit}"
    return None


def _port_of(asked: ApproachRequest, fusion: FusionRequest | None) -> Port | None:
    if asked.port is not None:
        centre, axis, given = asked.port.centre_m, asked.port.axis, asked.port.up
    elif fusion is not None and fusion.ring is not None:
        centre, axis, given = fusion.ring.centre_m, fusion.ring.axis, None
    else:
        return None
    inwards = -np.array(axis) / np.linalg.norm(axis)
    up = np.array([0.0, 0.0, 1.0] if given is None else given)
    if given is None and abs(inwards[2]) > _NEARLY_PARALLEL:
        up = np.array([1.0, 0.0, 0.0])
    down = -(up - (up @ inwards) * inwards)
    length = np.linalg.norm(down)
    if not length > _LEAST_M * max(1.0, float(np.linalg.norm(up))):
        raise RendezviewError("approach: port: up must not be zero, or parallel to the axis")
    down /= length
    return Port(np.array(centre), np.array([np.cross(down, inwards), down, inwards]))


def _sight(place: Array) -> tuple[Array, float]:
    """Direction and length."""
    length = float(np.linalg.norm(place))
    return place / max(length, _LEAST_M), length
