"""The drawn frame: edges, axes, uncertainty and status, and the video of a run."""

import contextlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.video_file import VideoWriter, playing_rate_hz
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.sensors.appearance.edges.contour_at import contour_pixels
from rendezview.sensors.appearance.overlay import draw_observation, length
from rendezview.sensors.observation import Status

CAMERA = Camera.from_fov(400, 300, np.deg2rad(40.0))
AHEAD = Pose(np.eye(3), np.array([0.3, -0.2, 9.0]))
COVARIANCE = np.diag([1e-6] * 3 + [1e-4, 1e-4, 1e-2])
SEEN = AppearanceObservation(Status.OK, pose=AHEAD, covariance=COVARIANCE, confidence=0.97)
DARK = np.zeros((300, 400), np.uint8)


def near(picture, colour, tolerance=40):
    return (np.abs(picture.astype(int) - colour) <= tolerance).all(axis=2)


def test_the_edges_are_drawn_where_the_mesh_is(refining_model, bumpy_mesh, draw):
    picture = draw_observation(DARK, SEEN, CAMERA, refining_model)
    assert picture.shape == (480 + 74, 640, 3)
    orange = near(picture[:480], (0, 159, 230))
    assert orange.sum() > 200
    body = draw(bumpy_mesh, AHEAD, CAMERA) > 60
    border = cv2.morphologyEx(body.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((9, 9), np.uint8))
    border = cv2.resize(border, (640, 480), interpolation=cv2.INTER_NEAREST) > 0
    assert (orange & border).sum() > 0.8 * orange.sum()


def test_contour_directions_follow_the_outline(refining_model):
    found = contour_pixels(refining_model, CAMERA, AHEAD)
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=1), 1.0, atol=1e-9)
    outline = found.points_px[found.kinds == 0]
    along = found.directions[found.kinds == 0]
    to_next = np.array([outline[np.argsort(np.hypot(*(outline - p).T))[1]] for p in outline])
    step = to_next - outline
    cosine = np.abs((step * along).sum(axis=1)) / np.linalg.norm(step, axis=1)
    assert np.median(cosine) > 0.9


def test_the_ellipse_is_one_sigma_times_a_power_of_ten(refining_model):
    picture = draw_observation(DARK, SEEN, CAMERA, refining_model)
    without = draw_observation(DARK, replace(SEEN, covariance=None), CAMERA, refining_model)
    yellow = near(picture[:480], (66, 228, 240)) & ~near(without[:480], (66, 228, 240))
    rows, columns = np.nonzero(yellow)
    centre = (CAMERA.project(AHEAD.apply(refining_model.centre_m)) + 0.5) * 1.6 - 0.5
    reach = np.hypot(columns - centre[0], rows - centre[1]).max()
    # 10 mm across at 9 m through fx = 549 px, drawn 1.6 times as large: 0.98 px, times 10 or 100
    assert reach == pytest.approx(1.6 * 549.5 * 0.01 / 9.0 * 100, rel=0.25)


def test_without_a_pose_the_reason_is_drawn_and_no_edges(refining_model):
    none = AppearanceObservation(Status.EMPTY, "nothing brighter than the sky")
    for image in (DARK, None):
        picture = draw_observation(image, none, CAMERA, refining_model, title="frame 3")
        assert not near(picture[30:480], (0, 159, 230)).any()
        assert near(picture[480:], (67, 112, 255)).sum() > 100
        other = replace(none, reason="the silhouette touches the border")
        again = draw_observation(image, other, CAMERA, refining_model, title="frame 3")
        assert not np.array_equal(picture[480:], again[480:])


def test_lengths_have_the_unit_that_suits_them():
    assert [length(x) for x in (0.0034, 0.034, 0.34, 3.4)] == [
        "3.4 mm",
        "3.4 cm",
        "0.34 m",
        "3.40 m",
    ]


def test_a_video_plays_in_real_time_where_that_can_be_watched():
    assert playing_rate_hz([0.0, 0.05, 0.1]) == pytest.approx(20.0)
    assert playing_rate_hz([0.0, 30.0, 60.0]) == 10.0
    assert playing_rate_hz([None, None]) == 10.0
    assert playing_rate_hz([5.0]) == 10.0


@pytest.mark.parametrize("suffix", [".mp4", ".webm", ".avi", ".gif"])
def test_a_video_is_written_in_silence_and_read_back(tmp_path, suffix, capfd):
    path = tmp_path / f"run{suffix}"
    with VideoWriter(path, 10.0) as video:
        for level in (40, 120, 200):
            video.add(np.full((120, 160, 3), level, np.uint8))
        video.add(np.full((60, 80, 3), 240, np.uint8))  # another size
        assert not path.exists()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    capture = cv2.VideoCapture(str(path))
    levels = []
    while True:
        more, frame = capture.read()
        if not more:
            break
        assert frame.shape == (120, 160, 3)
        levels.append(frame.mean())
    np.testing.assert_allclose(levels, [40, 120, 200, 240], atol=6)
    assert capfd.readouterr() == ("", "")


def test_an_interrupted_video_keeps_its_frames_and_an_empty_one_leaves_no_file(tmp_path):
    with contextlib.suppress(KeyboardInterrupt), VideoWriter(tmp_path / "a.avi", 10.0) as video:
        video.add(np.zeros((48, 64, 3), np.uint8))
        raise KeyboardInterrupt
    assert [file.name for file in tmp_path.iterdir()] == ["a.avi"]
    with VideoWriter(tmp_path / "b.mp4", 10.0):
        pass
    assert not (tmp_path / "b.mp4").exists()


def test_a_video_of_another_ending_is_refused(tmp_path):
    with pytest.raises(RendezviewError, match=r"must end in \.webm, \.mp4, \.avi or \.gif"):
        VideoWriter(tmp_path / "run.mov", 10.0)
    with pytest.raises(RendezviewError, match="absent"):
        VideoWriter(tmp_path / "absent" / "run.mp4", 10.0)
