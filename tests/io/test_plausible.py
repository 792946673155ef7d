"""What is legal but absurd in cameras and times is asked about, or refused; what is real is not."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera, LensModel
from rendezview.io.camera_files import load_camera
from rendezview.io.plausible import camera_doubts, time_doubts


def written(tmp_path, camera: Camera, **more):
    keys = ("width", "height", "fx", "fy", "cx", "cy")
    path = tmp_path / "camera.json"
    lens = {"distCoeffs": camera.distortion}
    path.write_text(json.dumps({key: getattr(camera, key) for key in keys} | lens | more))
    return path


FISHEYE = Camera(1280, 960, 290.0, 290.0, 640.0, 480.0, (0.0,) * 4, LensModel.FISHEYE)
REAL = {
    "webcam": Camera(640, 480, 610.0, 612.0, 325.1, 231.8),
    "rendezvous camera of 2 degrees": Camera(1024, 1024, 29330.0, 29330.0, 511.5, 511.5),
    "star tracker": Camera(1024, 1024, 2900.0, 2900.0, 480.0, 560.0),
    "wide lens": Camera(1920, 1080, 900.0, 900.0, 970.0, 533.0),
    "action camera": Camera(4000, 3000, 1750.0, 1751.0, 1990.0, 1520.0),
    "fisheye of 250 degrees": FISHEYE,
    "PAL pixels": Camera(720, 576, 800.0, 876.0, 359.5, 287.5),
    "rectified stereo": Camera(1280, 720, 700.0, 700.0, 480.0, 350.0),
    # Published calibrations: TUM's RGB-D set (fr1), EuRoC (cam0), KITTI (2011_09_26, camera 0).
    "TUM": Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "EuRoC": Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0, 0)),
    "KITTI": Camera(
        1392, 512, 984.2, 980.8, 690.0, 233.2, (-0.3729, 0.2037, 0.0022, 0.0014, -0.0723)
    ),
    "upright": Camera(480, 640, 600.0, 600.0, 239.5, 319.5),
    "square": Camera(512, 512, 700.0, 700.0, 260.0, 250.0),
    "line": Camera(2048, 64, 3000.0, 3000.0, 1023.5, 31.5),
    "tiny": Camera(8, 8, 1.0, 1.0, 0.0, 0.0),
}


@pytest.mark.parametrize("name", REAL)
def test_real_cameras_raise_no_doubt(name):
    assert camera_doubts(REAL[name]) == []


ABSURD = [
    (Camera(640, 480, 0.9, 1.2, 0.5, 0.5), "units of the picture"),
    (Camera(1920, 1080, 1.1, 1.96, 0.49, 0.52), "units of the picture"),
    (Camera(1280, 960, 3.6, 3.6, 639.5, 479.5), "field of view is 179"),
    (Camera(1280, 960, 4.2e6, 4.2e6, 639.5, 479.5), "field of view is 0.017"),
    (Camera(1280, 960, 20.0, 20.0, 639.5, 479.5, (0.0,) * 4, LensModel.FISHEYE), "field of view"),
    (Camera(480, 640, 700.0, 700.0, 322.0, 238.0), "width and height are swapped"),
    (Camera(1080, 1920, 1400.0, 1400.0, 955.0, 541.0), "width and height are swapped"),
    (Camera(1280, 960, 500.0, 500.0, 318.0, 242.0), "matrix is of pictures of 640 × 480"),
    (Camera(1280, 960, 250.0, 250.0, 160.0, 119.0), "matrix is of pictures of 320 × 240"),
    (Camera(640, 480, 1000.0, 1000.0, 645.0, 472.0), "matrix is of pictures of 1280 × 960"),
    (Camera(640, 480, 1500.0, 1500.0, 963.0, 725.0), "matrix is of pictures of 1920 × 1440"),
    (Camera(640, 480, 700.0, 700.0, 0.0, 0.0), "the corner"),
    (Camera(640, 480, 6e9, 600.0, 319.5, 239.5), "times as high as wide"),
    (Camera(640, 480, 641.8, 641.8, 319.5, 239.5, (-5.0, 0.0, 0.0, 0.0)), "folds the picture, 8"),
    (Camera(640, 480, 641.8, 641.8, 319.5, 239.5, (9e5, 0.0, 0.0, 0.0)), "folds the picture, 100"),
]


@pytest.mark.parametrize(("camera", "words"), ABSURD)
def test_absurd_cameras_are_refused_unless_they_are_meant(tmp_path, camera, words):
    assert [doubt.refused for doubt in camera_doubts(camera)] == [True]
    if camera.lens_model is LensModel.FISHEYE:
        return  # BOP's keys have no fisheye
    with pytest.raises(RendezviewError, match=words) as caught:
        load_camera(written(tmp_path, camera))
    assert "checked: true in the file if it is meant" in str(caught.value)
    meant = load_camera(written(tmp_path, camera, checked=True))
    assert meant == camera
    assert any(words in doubt for doubt in meant.doubts)
    with pytest.raises(RendezviewError, match="checked: must be true or false"):
        load_camera(written(tmp_path, camera, checked=1))


ODD = [
    (Camera(1024, 1024, 1.1e5, 1.1e5, 511.5, 511.5), "field of view is 0.53"),
    (Camera(640, 480, 600.0, 800.0, 319.5, 239.5), "fx 600 and fy 800 differ"),
    (Camera(640, 240, 600.0, 300.0, 319.5, 119.5), "fx 600 and fy 300 differ"),
    (Camera(640, 480, 600.0, 600.0, 900.0, 200.0), "if the pictures are a part"),
    (Camera(300, 300, 2900.0, 2900.0, -400.0, 130.0), "if the pictures are a part"),
]


@pytest.mark.parametrize(("camera", "words"), ODD)
def test_odd_cameras_are_read_with_a_doubt(tmp_path, camera, words):
    assert [words in doubt for doubt in load_camera(written(tmp_path, camera)).doubts] == [True]


def test_a_region_of_a_camera_raises_no_doubt(tmp_path):
    whole = Camera(2048, 2048, 2900.0, 2900.0, 1030.0, 1010.0)
    region = {"x_offset": 1500, "y_offset": 40, "width": 256, "height": 128}
    camera = load_camera(written(tmp_path, whole, roi=region))
    assert camera == whole.cropped(1500, 40, 256, 128)
    assert camera.doubts == ()


def test_a_matrix_that_is_none_is_told_by_its_look():
    k = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    assert Camera.from_matrix(k, (640, 480)) == Camera(640, 480, 500, 510, 320, 240)
    assert Camera.from_matrix(k.ravel().tolist(), (640, 480)).fy == 510.0
    skewed = k.copy()
    skewed[0, 1] = 4.0
    for wrong, words in [
        (k.T, "transposed"),
        (k * [1, 1, -1], "of OpenGL"),
        (k * 2.0, "divide it by its last number, 2"),
        (np.zeros((3, 3)), "not calibrated"),
        (skewed, "without skew"),
        (k[:2], "has 6 numbers"),
        (k * np.nan, "finite"),
        ("K", "must be numbers"),
    ]:
        with pytest.raises(ValueError, match=words):
            Camera.from_matrix(wrong, (640, 480))


@pytest.mark.parametrize(
    ("times_s", "words"),
    [
        ([0.0, 0.1, 0.2], []),
        ([1.7e9, 1.7e9 + 1.0], []),
        ([None, None], []),
        ([1.7e12, 1.7e12 + 100.0], ["milliseconds"]),
        ([1.7e18], ["milliseconds"]),
        ([0.0, None, 2.0], ["1 of 3 frames have no time"]),
    ],
)
def test_times_that_are_no_seconds_or_missing_are_told(times_s, words):
    doubts = time_doubts(times_s)
    assert len(doubts) == len(words)
    assert all(word in doubt for word, doubt in zip(words, doubts, strict=True))


def test_coefficients_in_another_order_are_asked_about():
    """k1 k2 k3 p1 p2 of a webcam, whose p1 is 0.0012."""
    folded = Camera(640, 480, 533.0, 533.0, 342.0, 234.0, (-0.281, 0.025, 0.163, 0.0012, -0.0001))
    (doubt,) = camera_doubts(folded)
    assert "k1 k2 p1 p2 k3" in doubt.what
    assert not doubt.refused
