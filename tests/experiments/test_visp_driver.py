"""ViSP's tracker, driven from here: its poses are ours, its failures are told."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.peers.visp import Visp, build, missing
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose

CAMERA = Camera(width=320, height=240, fx=400.0, fy=410.0, cx=170.0, cy=115.0)
CUBE = """V1
8
-1 -1 -1
-1 -1 1
-1 1 -1
-1 1 1
1 -1 -1
1 -1 1
1 1 -1
1 1 1
0
0
6
4 0 1 3 2
4 4 6 7 5
4 0 4 5 1
4 2 3 7 6
4 0 2 6 4
4 1 5 7 3
0
0
"""
CORNERS = np.array([[float(w) for w in row.split()] for row in CUBE.splitlines()[2:10]])
FACES = [[int(w) for w in row.split()[1:]] for row in CUBE.splitlines()[13:19]]
POSE = Pose(
    Rotation.from_euler("xyz", (30.0, 40.0, 10.0), degrees=True).as_matrix(),
    np.array([-0.3, 0.2, 9.0]),
)


@pytest.fixture(scope="module")
def visp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Visp]:
    reason = missing()
    if reason is not None:
        pytest.skip(f"ViSP: {reason}")
    program = build(tmp_path_factory.mktemp("visp"))
    with Visp(program, CUBE, CAMERA, {"range": 12.0, "mask": 3.0}) as running:
        yield running


def picture(pose: Pose) -> np.ndarray:
    """The cube, every face of its own grey, drawn four times as large and averaged."""
    scale, inside = 4, pose.apply(np.zeros(3))
    image = np.full((scale * CAMERA.height, scale * CAMERA.width), 10, dtype=np.uint8)
    for k, face in enumerate(FACES):
        corners = pose.apply(CORNERS[face])
        centre = corners.mean(axis=0)
        if centre @ (centre - inside) < 0.0:
            fine = scale * (CAMERA.project(corners) + 0.5) - 0.5
            cv2.fillConvexPoly(image, np.rint(fine).astype(np.int32), 70 + 35 * k)
    small = cv2.resize(image, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (3, 3), 0.5))


def turned(pose: Pose, degrees: float, axis: tuple[float, float, float]) -> Pose:
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * np.array(axis)).as_matrix()
    return Pose(turn @ pose.rotation, pose.translation_m)


def test_a_cube_is_found_from_two_degrees_off(visp: Visp) -> None:
    prior = turned(POSE, 2.0, (0.6, 0.0, 0.8))
    found = visp.frame(picture(POSE), prior, passes=2, repeats=3)
    assert found.pose is not None, found.thrown
    assert np.rad2deg(found.pose.angle_to(POSE)) < 0.6
    shift = CAMERA.project(found.pose.translation_m) - CAMERA.project(POSE.translation_m)
    assert np.all(np.abs(shift) < 0.4)  # pixels: half a pixel is another convention
    assert found.points > 50
    assert found.processor_s > 0.0


def test_a_turning_cube_is_followed_from_its_own_pose(visp: Visp) -> None:
    visp.start(picture(POSE), POSE)
    for k in range(1, 9):
        truth = turned(POSE, 1.5 * k, (0.0, 1.0, 0.0))
        found = visp.next(picture(truth))
        assert found.pose is not None, found.thrown
    assert np.rad2deg(found.pose.angle_to(truth)) < 1.0


def test_a_frame_without_the_target_is_a_failure_with_words(visp: Visp) -> None:
    found = visp.frame(np.full((CAMERA.height, CAMERA.width), 10, dtype=np.uint8), POSE)
    assert found.pose is None
    assert found.thrown
    again = visp.frame(picture(POSE), POSE)
    assert again.pose is not None, again.thrown


def test_the_edges_in_view_end_at_the_corners_in_view(visp: Visp) -> None:
    visp.frame(picture(POSE), POSE)
    ends = visp.edges_px(POSE).reshape(-1, 2)
    corners = CAMERA.project(POSE.apply(CORNERS))
    apart = np.linalg.norm(ends[:, None] - corners[None], axis=2)
    assert len(np.unique(np.argmin(apart, axis=1))) == 7  # of a cube's eight
    assert np.median(apart.min(axis=1)) < 2.0


def test_a_model_that_is_none_is_told(tmp_path: Path) -> None:
    reason = missing()
    if reason is not None:
        pytest.skip(f"ViSP: {reason}")
    program = build(tmp_path)
    with pytest.raises(AssertionError, match="ended"), Visp(program, "no model", CAMERA) as running:
        running.frame(picture(POSE), POSE)


def test_without_a_compiler_the_reason_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    reason = missing.__wrapped__()
    assert reason is not None
    assert "compiler" in reason
    assert "libvisp-mbt-dev" in reason
