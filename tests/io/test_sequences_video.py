"""Videos as sequences: frames in any order, cut short, of another size."""

import pickle
import shutil

import cv2
import numpy as np
import pytest
from tests.io.small_videos import GREYS, TIMES_S
from tests.io.small_videos import video as small_video

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview.io.sequences import open_sequence

CAMERA = Camera(64, 48, 80.0, 81.0, 31.0, 24.0)


def write_video(path, count):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (64, 48))
    assert writer.isOpened()
    for index in range(count):
        writer.write(np.full((48, 64, 3), 20 * index, dtype=np.uint8))
    writer.release()
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video") / "approach.avi", 12)


def number_in(image):
    return round(image.mean() / 20)


def test_video_frames_are_timed_and_read_in_any_order(video):
    sequence = open_sequence(video, CAMERA)
    assert len(sequence) == 12
    assert [frame.time_s for frame in sequence] == pytest.approx([0.2 * i for i in range(12)])
    assert [number_in(frame.read()) for frame in sequence] == list(range(12))
    rng = np.random.default_rng(1)
    for index in rng.permutation(12):
        frame = sequence.frames[index]
        assert frame.im_id == index
        assert number_in(frame.read()) == index
        assert number_in(frame.read()) == index  # again


def test_a_picture_read_belongs_to_the_caller(video):
    frame = open_sequence(video, CAMERA).frames[3]
    frame.read()[:] = 255
    assert number_in(frame.read()) == 3


def test_video_frames_can_be_sent_to_another_process(video):
    frame = open_sequence(video, CAMERA).frames[5]
    frame.read()
    assert number_in(pickle.loads(pickle.dumps(frame)).read()) == 5


def test_a_video_needs_a_camera_given_or_beside_it(video, tmp_path):
    path = shutil.copy(video, tmp_path / "v.avi")
    with pytest.raises(RendezviewError, match=r"v\.avi: no camera"):
        open_sequence(path)
    save_camera(CAMERA, tmp_path / "camera.yaml")
    assert open_sequence(path).frames[0].camera == CAMERA


def test_a_video_shorter_than_it_said_names_where_it_ends(tmp_path):
    path = write_video(tmp_path / "v.avi", 12)
    sequence = open_sequence(path, CAMERA)
    write_video(path, 5)  # replaced after it was opened
    with pytest.raises(RendezviewError, match=r"v\.avi: frame 11 cannot be read, .* at frame 5:"):
        sequence.frames[11].read()
    assert number_in(sequence.frames[4].read()) == 4  # the frames before are still read
    path.unlink()
    with pytest.raises(RendezviewError, match=r"v\.avi: not a video"):
        sequence.frames[0].read()


@pytest.mark.parametrize("suffix", ["mkv", "mp4", "mov", "webm", "flv"])
def test_frames_of_uneven_times_have_the_times_at_which_they_are_shown(tmp_path, suffix):
    path = tmp_path / f"v.{suffix}"
    path.write_bytes(small_video(suffix))
    sequence = open_sequence(path, Camera(32, 32, 40.0, 40.0, 15.5, 15.5))
    assert [frame.time_s for frame in sequence] == pytest.approx(TIMES_S)
    assert sequence.notes == ("the frames come 0.04 to 1.46 s apart",)
    assert [frame.read().mean() for frame in sequence] == pytest.approx(GREYS, abs=2.0)


@pytest.mark.parametrize("suffix", ["avi", "mkv", "mp4", "mov"])
def test_a_video_of_even_times_has_those_of_its_rate(tmp_path, suffix):
    path = tmp_path / f"v.{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for index in range(40):
        writer.write(np.full((48, 64, 3), 5 * index, dtype=np.uint8))
    writer.release()
    sequence = open_sequence(path, CAMERA)
    assert [frame.time_s for frame in sequence] == pytest.approx([i / 30.0 for i in range(40)])
    assert sequence.notes == ()
