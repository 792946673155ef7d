"""The conversions of the ROS 2 example, which need no ROS."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "ros2_bridge.py"


@pytest.fixture(scope="module")
def bridge() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ros2_bridge", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("encoding", "channels"), [("mono8", 1), ("rgb8", 3), ("bgr8", 3)])
def test_images_become_grey_whatever_their_rows(bridge, encoding, channels):
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (5, 7, channels), dtype=np.uint8)
    rows = np.zeros((5, 7 * channels + 3), np.uint8)
    rows[:, : 7 * channels] = pixels.reshape(5, -1)
    image = SimpleNamespace(
        encoding=encoding, height=5, width=7, step=rows.shape[1], data=rows.tobytes()
    )
    grey = bridge.grey_from_image(image)
    rgb = pixels[..., ::-1] if encoding == "bgr8" else pixels
    weights = np.ones(1) if channels == 1 else np.array([0.299, 0.587, 0.114])
    assert grey == pytest.approx(rgb @ weights, abs=0.51)
    with pytest.raises(ValueError, match="mono8"):
        bridge.grey_from_image(SimpleNamespace(encoding="bayer_rggb8"))


def test_the_camera_is_that_of_the_info(bridge, camera):
    info = SimpleNamespace(
        width=400, height=400, k=camera.matrix.ravel(), d=[0.0] * 5, distortion_model="plumb_bob"
    )
    assert bridge.camera_from_info(info) == camera
    info.distortion_model = "equidistant"
    with pytest.raises(ValueError, match="lens model"):
        bridge.camera_from_info(info)


def test_the_covariance_is_in_the_order_of_ros(bridge):
    ours = np.arange(36.0).reshape(6, 6)
    state = {
        "pose": {"quat_wxyz": [1.0, 0.0, 0.0, 0.0], "translation_m": [1.0, 2.0, 3.0]},
        "covariance": ours.tolist(),
    }
    message = SimpleNamespace(
        pose=SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    )
    bridge.fill_pose(message, state)
    theirs = np.reshape(message.covariance, (6, 6))
    assert (theirs[:3, :3] == ours[3:, 3:]).all()
    assert (theirs[3:, 3:] == ours[:3, :3]).all()
    assert (message.pose.position.z, message.pose.orientation.w) == (3.0, 1.0)
