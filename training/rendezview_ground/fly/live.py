"""A flight at a running service: it sends frames and readings, steers by the fused states that
come back, and does what the operator orders."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.fusion import Estimate
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.observation import Status
from rendezview.sensors.protection import Protection
from rendezview_ground.fly.dynamics import OrbitDynamics, Truth
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.guidance import Guidance, Known
from rendezview_ground.fly.loop import Flight, Loop
from rendezview_ground.fly.rendered import Pictures
from rendezview_ground.fly.setup import CAMERA, Setup
from rendezview_service.client import Client, ServiceError, SessionClient

# Of a log's line, and of the measurement that it is made of
_KEYS = ("time_s", "range_m", "sigma_m", "origin_m", "rate_rad_s", "sigma_rad_s",
         "velocity_change_m_s", "sigma_m_s")  # fmt: skip
_SKIN_GREY = 150  # of a hand. Source: chosen
_BUSY = (429, 503)  # a reading that is lost, no error of the flight

Reading = tuple[str, Any]  # sensor; a frame (H, W), or a line of its log


class LiveSensors(Pictures):
    """What a flight sends: frames, and lines of the sensors that read none of the service's."""

    def __init__(self, setup: Setup, seed: int, fault: Fault | None = None) -> None:
        super().__init__(setup, seed, fault)
        self.prior: Pose | None = None  # of the first frame; None: none yet
        # That the operator may switch; `hand` covers the camera.
        names = ("camera", "laser", "reflectors", *(("stereo",) if self.pair else ()))
        self.on = dict.fromkeys(names, True) | {"hand": False}

    def read(self, truth: Truth, _: Known | None) -> list[Reading]:
        """All readings of a step that are on, in their order."""
        if self.prior is None:
            self.prior = self.begin(truth)
        found: list[Reading] = [
            (reading.sensor, {key: getattr(reading, key) for key in _KEYS if hasattr(reading, key)})
            for reading in self.own.read(truth)
        ]
        image = self.draw(truth)
        if image is not None:
            found.append(("camera", _with_hand(image) if self.on["hand"] else image))
            if not self.on["hand"]:
                seen = {"reflectors": self.spots(image, truth), "stereo": self.lights(image, truth)}
                found += [(name, one.record()) for name, one in seen.items() if one is not None]
        return [reading for reading in found if self.on.get(reading[0], True)]


class ServiceEstimator:
    """The fused state of a session; its operator commands the controller and the sensors."""

    def __init__(
        self, client: Client, sensors: LiveSensors, guidance: Guidance, speed: float = 1.0
    ) -> None:
        """For one flight; its session opens with the first readings.

        Args:
            speed: of the flight over that of the clock; 0: as fast as it goes.
        """
        self.client, self.sensors, self.guidance, self.speed = client, sensors, guidance, speed
        self.session: SessionClient | None = None
        self._turning: Array = np.zeros(3)
        self._start_s = 0.0

    def update(self, time_s: float, readings: Sequence[Reading]) -> Known:
        """The state at a time, with the readings since the last one."""
        session = self.session or self._open()
        if self.speed > 0.0:
            time.sleep(max(0.0, self._start_s + time_s / self.speed - time.monotonic()))
        fused, used = None, []
        for sensor, reading in readings:
            try:
                if isinstance(reading, np.ndarray):
                    answer = session.track(reading, time_s)
                    accepted = answer["pose"] is not None
                else:
                    answer = session.measure(sensor, reading)
                    accepted = any(v is not None and v["accepted"] for v in answer["verdicts"])
            except ServiceError as error:
                if error.status not in _BUSY:
                    raise
                continue
            fused = answer.get("fused") or fused
            if accepted and "rate_rad_s" not in reading:
                used.append(sensor)
            if sensor == "gyro":
                self._turning = np.array(reading["rate_rad_s"])
        self._report(session, time_s)
        return Known(time_s, _estimate(time_s, fused), self._turning, tuple(used))

    def _open(self) -> SessionClient:
        port, plan, fault = self.guidance.port, self.guidance.plan, self.sensors.fault
        ring, guidance = port.ring, plan.guidance
        if ring is not None and fault is not None and fault.kind == "ring":
            ring = replace(ring, radius_m=fault.size * ring.radius_m)
        corridor = {"half_angle_deg": guidance.corridor_deg, "radius_m": guidance.corridor_m,
                    "length_m": plan.chaser.start_m}  # fmt: skip
        place = {"centre_m": port.centre_m, "axis": port.axis, "up": -port.facing[1]}
        probe = Pose(np.eye(3), np.array([0.0, 0.0, -port.ahead_m]))
        self.session = self.client.open(
            CAMERA, prior=self.sensors.prior, fusion={"ring": ring} if ring else None,
            sensors={"ring": ring is not None},
            approach={"port": place, "corridor": corridor, "probe_from_camera": probe},
        )  # fmt: skip
        self._start_s = time.monotonic()
        return self.session

    def _report(self, session: SessionClient, time_s: float) -> None:
        """Say what the flight does, and obey."""
        guidance = self.guidance
        report = {
            "time_s": time_s, "mode": guidance.mode, "reason": guidance.reason[:400],
            "range_m": None if guidance.at is None else guidance.at.range_m,
            "switches": self.sensors.on,
        }  # fmt: skip
        path = f"/v1/sessions/{session.name}/flight"
        for order in self.client.request("PUT", path, json.dumps(report).encode())["orders"]:
            if order["do"] != "switch":
                guidance.order(order["do"])
            elif order["what"] in self.sensors.on:
                self.sensors.on[order["what"]] = order["on"]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self.session is not None:
            self.session.__exit__(kind)


def fly_live(
    setup: Setup, client: Client, seed: int, fault: Fault | None = None, speed: float = 1.0
) -> Flight:
    """The flight of a seed at a service."""
    sensors, guidance = LiveSensors(setup, seed, fault), Guidance(setup.plan, setup.port)
    dynamics = OrbitDynamics(setup.plan, setup.port, seed, fault)
    with ServiceEstimator(client, sensors, guidance, speed) as estimator:
        return Loop(sensors, estimator, guidance, dynamics).run()


def _estimate(time_s: float, fused: dict[str, Any] | None) -> Estimate:
    """The `Fused` state of an answer; without one, or with one of another time, there is none."""
    if fused is None or fused["status"] == "late" or abs(fused["time_s"] - time_s) > 1e-6:
        reason = "the service gives no state" if fused is None else fused["reason"]
        return Estimate(time_s, Status.LOST, reason, None, None, None)
    pose, rates, levels = fused["pose"], fused["rates"], fused["protection"]
    protection = None
    if levels is not None:
        known = {key: levels[key] for key in ("risk", "attitude_rad", "wrong", "drift")}
        protection = Protection(
            position_m=_level(levels["position_m"]), alarms=tuple(levels["alarms"]),
            axes=np.array([_level(value) for value in levels["axes"]]), **known,
        )  # fmt: skip
    return Estimate(
        time_s, Status(fused["status"]), fused["reason"],
        pose and Pose.from_quat_wxyz(pose["quat_wxyz"], pose["translation_m"]),
        rates and np.array([*rates["angular_rad_s"], *rates["linear_m_s"]]),
        fused["covariance"] and np.array(fused["covariance"]), protection=protection,
    )  # fmt: skip


def _level(value: float | None) -> float:
    return math.inf if value is None else value


def _with_hand(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """A frame with a hand before most of it."""
    covered, (high, wide) = image.copy(), image.shape
    palm = (wide // 2, 2 * high // 3), (wide // 3, high // 2)
    cv2.ellipse(covered, *palm, 0.0, 0.0, 360.0, _SKIN_GREY, -1)
    for k in range(4):
        root, tip = (wide * (2 + k) // 7, high // 2), (wide * (1 + 2 * k) // 8, high // 16)
        cv2.line(covered, root, tip, _SKIN_GREY, wide // 7)
    return covered
