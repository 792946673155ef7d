"""Pictures of every depth and size, and the camera that they fit."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.decoding import decode_levels
from rendezview.io.sequences.message_images import RawPicture, grey
from rendezview.io.sequences.misfit import misfit

CAMERA = Camera(64, 48, 80.0, 81.0, 31.0, 24.0)
LEVELS = np.linspace(0, 4095, 64 * 48).round().astype(np.uint16).reshape(48, 64)


@pytest.mark.parametrize(
    ("suffix", "colour"),
    [(".png", False), (".png", True), (".tiff", False), (".tif", True), (".pgm", False)],
)
def test_twelve_of_sixteen_bits_keep_their_highest_eight(tmp_path, suffix, colour):
    pixels = np.dstack([LEVELS] * 3) if colour else LEVELS
    assert cv2.imwrite(str(tmp_path / f"a{suffix}"), pixels)
    sequence = open_sequence(tmp_path, CAMERA)
    found = sequence.frames[0].read()
    assert found.dtype == np.uint8
    np.testing.assert_allclose(found, LEVELS >> 4, atol=1)
    assert len(sequence.notes) == 1
    assert "12 bits are used" in sequence.notes[0]


def test_the_brightest_sampled_picture_decides_for_all(tmp_path):
    for index in range(9):
        level = 3000 if index == 4 else 500
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.full((48, 64), level, np.uint16))
    frames = open_sequence(tmp_path, CAMERA).frames
    assert (frames[0].read() == 500 >> 4).all()
    assert (frames[4].read() == 3000 >> 4).all()


def test_a_level_beyond_the_depth_is_an_error_and_the_camera_file_decides(tmp_path):
    for index in range(9):
        level = 20000 if index == 3 else 500  # 3 is none of those that are looked at
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.full((48, 64), level, np.uint16))
    with pytest.raises(RendezviewError, match=r"3\.png: a level of 20000 needs more than 10 bits"):
        open_sequence(tmp_path, CAMERA).frames[3].read()
    save_camera(replace(CAMERA, bit_depth=16), tmp_path / "camera.yaml")
    sequence = open_sequence(tmp_path)
    assert sequence.notes == ()
    assert (sequence.frames[3].read() == 20000 >> 8).all()


def test_floating_point_levels_of_a_single_frame_have_no_scale(tmp_path):
    picture = cv2.imencode(".tiff", np.ones((48, 64), np.float32))[1]
    assert decode_levels(picture.tobytes()) is None


def test_a_single_image_is_a_sequence_of_one(tmp_path):
    cv2.imwrite(str(tmp_path / "photo.jpg"), np.full((48, 64, 3), 90, np.uint8))
    cv2.imwrite(str(tmp_path / "other.jpg"), np.full((48, 64, 3), 10, np.uint8))
    (frame,) = open_sequence(tmp_path / "photo.jpg", CAMERA).frames
    assert (frame.read() == 90).all()
    assert frame.name == "photo.jpg"


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((320, 240), "binned 2 × 2, put `binning: 2`"),
        ((160, 120), "binned 4 × 4"),
        ((480, 640), "rotated by 90°"),
        ((480, 360), r"resized by 0\.75"),
        ((1280, 960), "resized by 2:"),
        ((500, 400), r"roi: \{x_offset: …, y_offset: …, width: 500, height: 400\}"),
        ((700, 300), "use the camera file of these images"),
    ],
)
def test_a_wrong_size_says_which_camera_would_fit(size, words):
    assert re.search(words, misfit(*size, Camera(640, 480, 800.0, 800.0, 319.5, 239.5)))


def test_a_camera_file_beside_the_images_that_fits_is_named(tmp_path):
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "0.png"), np.zeros((24, 32), np.uint8))
    save_camera(CAMERA, tmp_path / "large.yaml")
    save_camera(CAMERA.binned(2), tmp_path / "small.yaml")
    (tmp_path / "notes.json").write_text("[1, 2]")
    with pytest.raises(RendezviewError, match=r"binned 2 × 2.*small\.yaml would fit"):
        open_sequence(tmp_path / "frames", CAMERA)
    assert open_sequence(tmp_path / "frames", CAMERA.binned(2)).frames[0].read().shape == (24, 32)


def test_a_video_of_another_size_is_refused_when_opened(tmp_path):
    path = tmp_path / "a.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (32, 24))
    for _ in range(3):
        video.write(np.zeros((24, 32, 3), np.uint8))
    video.release()
    with pytest.raises(RendezviewError, match="binned 2 × 2"):
        open_sequence(path, CAMERA)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1", "rgb16"])
def test_recorded_pictures_of_sixteen_bits_need_their_depth(encoding, big):
    pixels = np.repeat(LEVELS[:, :, None], 3 if encoding == "rgb16" else 1, axis=2)
    content = pixels.astype(">u2" if big else "<u2").tobytes()
    step = pixels.shape[1] * pixels.shape[2] * 2
    picture = RawPicture(64, 48, step, encoding, content, big)
    np.testing.assert_allclose(grey(picture, "here", 12), LEVELS >> 4, atol=1)
    with pytest.raises(RendezviewError, match=r"here: a level of 40.. needs more than 10 bits"):
        grey(picture, "here", 10)
