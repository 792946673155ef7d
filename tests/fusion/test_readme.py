"""The example of fusion's README, run on drawn frames of one target in all four sensors."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.target import DockingRing, Led, Reflector, Target
from rendezview.sensors.beacons import Rig, patterns_of
from rendezview.sensors.beacons.rig import RigCamera
from rendezview.sensors.observation import Status
from rendezview_ground.simulate.reflector_frames import ReflectorFrameOptions, render_pair
from rendezview_ground.simulate.ring_frames import Circle, Plate, RingScene, render_ring_frame
from rendezview_ground.simulate.sensor import SensorOptions

README = Path(__file__).resolve().parents[2] / "runtime" / "rendezview" / "fusion" / "README.md"
RING_M = 0.5
FACE = np.array([0.0, 0.0, -1.0])  # of the target, towards the camera


def target_with_marks() -> Target:
    """A ring, four reflectors and five lights on the face that looks at the camera."""
    places = {"left": (-0.6, 0.9, -0.5), "post": (0.0, 0.9, -0.8), "right": (0.6, 0.9, -0.5)}
    places["above"] = (0.2, 1.3, -0.5)  # without it, half a turn of roll would look the same
    reflectors = tuple(
        Reflector(name, "face", np.array(place), FACE, 0.05) for name, place in places.items()
    )
    corners = [(-1.0, -0.8, -0.5), (0.9, -1.0, -0.5), (1.1, 0.7, -0.6), (-0.8, 1.0, -0.9)]
    leds = tuple(
        Led(f"led{k}", np.array(place), FACE)
        for k, place in enumerate([*corners, (0.2, 0.1, -1.1)])
    )
    ring = DockingRing(np.array([0.1, -0.2, -0.6]), FACE, RING_M)
    return Target("bumpy", "", Path("bumpy.stl"), "m", ring, reflectors, leds)


def ring_picture(target: Target, truth: Pose, camera: Camera, rng) -> np.ndarray:
    ring = target.docking_ring
    centre, axis = truth.apply(ring.centre_m), truth.rotation @ ring.axis
    across = truth.rotation @ np.array([1.0, 0.0, 0.0])
    plates = [Plate(centre - 0.1 * axis, axis, across, 60.0, half_sides_m=(0.9, 0.8))]
    circles = []
    for ratio, grey in ((1.0, 170.0), (0.93, 70.0), (0.85, 150.0)):
        plates.append(Plate(centre, axis, across, grey, radii_m=(0.0, ratio * RING_M)))
        circles.append(Circle(centre, axis, ratio * RING_M, True))
    scene = RingScene(camera, tuple(plates), tuple(circles))
    return render_ring_frame(scene, rng, SensorOptions(noise_sigma_grey=2.0))


def light_picture(camera: RigCamera, points_m: np.ndarray, rng) -> np.ndarray:
    width, height = camera.size
    grey = rng.normal(10.0, 1.0, (height, width))
    v, u = np.mgrid[0:height, 0:width]
    for x, y in camera.project(points_m):
        grey += 180.0 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 1.3**2)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.fixture
def names(tiny_model, camera, bumpy_mesh, draw):
    """What the example takes for given, and the truth."""
    rng = np.random.default_rng(5)
    target, narrow = target_with_marks(), Camera.from_fov(640, 480, np.deg2rad(25.0))
    beside = Pose(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    eyes = [("left", Pose.identity()), ("right", beside)]
    rig = Rig(tuple(RigCamera.from_camera(name, narrow, pose) for name, pose in eyes))
    start = Rotation.from_euler("xyz", [0.25, -0.2, 0.3])
    truths, frames = [], []
    for k in range(6):
        turn = Rotation.from_rotvec(0.1 * k * np.array([2e-3, 1e-3, -1e-3]))
        place = np.array([0.1, -0.1, 9.0 - 0.02 * k])
        truth = Pose((turn * start).as_matrix(), place)
        picture = draw(bumpy_mesh, truth, camera, rng)
        pattern = patterns_of(target)[0]
        lit, dark = render_pair(camera, pattern, truth, ReflectorFrameOptions(), rng)
        points = truth.apply(np.array([led.position_m for led in target.leds]))
        left, right = (light_picture(eye, points, rng) for eye in rig.cameras)
        close_up = ring_picture(target, truth, narrow, rng)
        truths.append(truth)
        frames.append((0.5 * k, picture, close_up, lit, dark, left, right))
    given = {"model": tiny_model, "target": target, "rig": rig, "wide": camera, "narrow": narrow}
    return given | {"frames": frames}, truths


def test_the_example_of_the_readme_gives_the_fused_pose(names, capsys):
    given, truths = names
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.DOTALL)
    exec(compile(code, str(README), "exec"), given)
    trusts, state, truth = given["fusion"].trusts, given["state"], truths[-1]
    assert set(trusts) == {"camera", "ring", "reflectors", "stereo"}
    for name, trust in trusts.items():
        assert trust.accepted >= 3, name
    assert state.status is Status.TRACKING
    assert state.pose.angle_to(truth) < np.deg2rad(0.3)
    assert np.linalg.norm(state.pose.translation_m - truth.translation_m) < 0.02
    away = np.concatenate(
        [
            Rotation.from_matrix(state.pose.rotation @ truth.rotation.T).as_rotvec(),
            state.pose.translation_m - truth.translation_m,
        ]
    )
    assert away @ np.linalg.solve(state.covariance[:6, :6], away) < 30.0
    assert "tracking" in capsys.readouterr().out
