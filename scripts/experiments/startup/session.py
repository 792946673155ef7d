"""What a session of the service may do, on few made-up frames and lines: for the list of loops."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

import rendezview as rv
from rendezview.fusion.logs import kind_of
from rendezview.io.target import Reflector, Target
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.sky import Sky
from rendezview.trajectory import PathFollower, Shape
from rendezview_service.messages.fusion_messages import FusionRequest
from rendezview_service.tracker.sensor_lines import read_line
from rendezview_service.tracker.session_filter import SessionFilter
from rendezview_service.tracker.tracking import contour_at

_AHEAD = np.array([0.0, 0.0, -1.0])


def track(model: rv.ViewModel) -> None:
    """Recognise a blob before a noisy sky, dark (without a prior) and bright (with one)."""
    rng = np.random.default_rng(0)
    ahead = np.array([0.0, 0.0, 3.0 * model.sphere_radius_m])
    prior = rv.Pose(np.eye(3), ahead - model.centre_m)
    recognizer = rv.Recognizer(model, _camera())
    for sky_grey in (0, 100):
        image = rng.integers(sky_grey, sky_grey + 12, size=(240, 320), dtype=np.uint8)
        image[70:170, 110:220] = rng.integers(170, 250, size=(100, 110), dtype=np.uint8)
        recognizer.recognize(image, None if sky_grey == 0 else prior)
        if recognizer.search is not None:
            recognizer.search.at(image, Sky.of(image), Near(prior, np.pi, model.centre_m))
    contour_at(model, _camera(), prior)


def fuse() -> None:
    """Give the filter a line of each kind."""
    ring = {"centre_m": [0.0, 0.0, 0.5], "axis": [0.0, 0.0, 1.0], "radius_m": 0.5}
    asked = {"ring": ring, "options": {"ring_radius_sigma": 1e-3}}
    wall = rv.BeamMesh(
        np.array([[-9.0, -9.0, 0.5], [9.0, -9.0, 0.5], [0.0, 9.0, 0.5]]), np.array([[0, 1, 2]])
    )
    fused = SessionFilter(FusionRequest.model_validate(asked), mesh=wall)
    seen: dict[str, Any] = {
        "centre_m": [0.0, 0.0, 10.5], "axis": [0.0, 0.0, 1.0],
        "covariance": (1e-4 * np.eye(5)).tolist(),
    }  # fmt: skip
    tilted = seen | {"axis": [0.0, 0.1, math.sqrt(0.99)]}
    start = rv.Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    lines: list[tuple[str, dict[str, Any]]] = [
        ("pose", {"pose": start.as_dict(), "covariance": (1e-4 * np.eye(6)).tolist()}),
        ("ring", {"ellipses": [], "poses": [seen, tilted]}),
        ("ring", {"ellipses": [], "poses": [seen]}),
        ("range", {"range_m": 10.5, "sigma_m": 0.02}),
    ]
    for k in range(4):
        for sensor, record in lines if k < 3 else [("range", {"range_m": 30.0, "sigma_m": 0.02})]:
            timed = record | {"time_s": min(float(k), 2.9)}
            kind = kind_of(timed, sensor)
            fused.take(sensor, read_line(timed, kind, sensor, fused._context, sensor))
        if k < 3:
            spread = 0.1 ** (4 + k) * np.eye(6)
            fused.track(rv.Observation(rv.Status.OK, time_s=k + 0.5, pose=start, covariance=spread))


def sense() -> None:
    """Find rings and reflectors in frames, and fit paths."""
    camera, rng = _camera(), np.random.default_rng(0)
    rings = rv.RingSensor(camera, 0.5, circles=((0.0, 0.4), (-0.1, 0.7)))
    places = np.array([[-0.2, 0.0, 0.0], [0.0, 0.05, -0.15], [0.2, 0.0, 0.0]])
    known = tuple(Reflector(str(k), "g", place, _AHEAD, 0.02) for k, place in enumerate(places))
    patterns = rv.patterns_of(Target("session", "", None, None, reflectors=known))
    lights = [rv.ReflectorSensor(camera, patterns) for _ in range(2)]
    radius_px = camera.fx / 4.0  # of a ring of 0.5 m at 2 m
    for k in range(6):
        dark = rng.integers(0, 12, size=(camera.height, camera.width), dtype=np.uint8)
        ring = dark.copy()
        for share, grey in ((1.3, 90), (1.0, 200), (0.8, 60)):
            size = tuple(16 * round(share * radius_px * squeeze) for squeeze in (1.0, 0.9))
            middle = 16 * (camera.width // 2 + k), 16 * (camera.height // 2)
            cv2.ellipse(ring, middle, size, 20.0, 0.0, 360.0, grey, -1, cv2.LINE_AA, 4)
        prior = rv.RingPrior(-2.0 * _AHEAD, _AHEAD, range_sigma_m=0.02) if k % 2 else None
        rings.update(float(k), ring + dark, prior).record()
        lit = dark.copy()
        for spot in places:
            u, v = camera.fx * spot[:2] / 2.0 + (camera.cx + k, camera.cy)
            cv2.circle(lit, (round(16 * u), round(16 * v)), 40, 230, -1, cv2.LINE_AA, 4)
        lit = np.asarray(cv2.GaussianBlur(lit, (0, 0), 0.8), dtype=np.uint8)
        for sensor, frames in zip(lights, (rv.LitDark(lit), rv.LitDark(lit, dark)), strict=True):
            sensor.update(float(k), frames).record()
    for shape in (Shape.CIRCULAR, Shape.VBAR):
        follower = PathFollower(np.zeros(3), shape)
        for k in range(8):
            hop = 3.0 * abs(math.sin(0.4 * k)) if shape is Shape.VBAR else 0.0
            place = np.array([0.1 * k, hop, 30.0 - 0.5 * k])
            turned = rv.Pose(cv2.Rodrigues(np.array([0.0, 0.03 * k, 0.0]))[0], place)
            wrong = np.eye(6)[3] * (5.0 if k % 4 == 3 else 0.0)
            seen = turned.perturbed(1e-3 * rng.normal(size=6) + wrong)
            follower.update(4.0 * k, seen, 1e-6 * np.eye(6), place[None], np.ones(1))


def _camera() -> rv.Camera:
    return rv.Camera.from_fov(320, 240, np.deg2rad(40.0))
