"""Camera files of every origin: OpenCV, ROS, SPEED, BOP, and what is none."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera, LensModel
from rendezview.io.camera_files import load_camera, save_camera

PLAIN = Camera(640, 480, 800.0, 810.0, 310.0, 245.0)
FOUR = Camera(640, 480, 800.0, 810.0, 310.0, 245.0, (-0.3, 0.1, 0.001, -0.002))
FIVE = Camera(640, 480, 800.0, 810.0, 310.0, 245.0, (-0.3, 0.1, 0.001, -0.002, 0.02))
EIGHT = Camera(
    640, 480, 800.0, 810.0, 310.0, 245.0, (0.1, -0.2, 0.001, -0.002, 0.03, 0.4, -0.1, 0.02)
)
FOURTEEN = replace(EIGHT, distortion=(*EIGHT.distortion, 0.1, 0.2, 0.3, 0.4, 0.05, 0.06))
FISHEYE = replace(FOUR, lens_model=LensModel.FISHEYE, bit_depth=12)
ALL = pytest.mark.parametrize(
    "camera",
    [PLAIN, FOUR, FIVE, EIGHT, FOURTEEN, FISHEYE],
    ids=["0", "4", "5", "8", "14", "fisheye"],
)


@ALL
def test_a_saved_camera_is_loaded_unchanged_and_read_by_opencv(camera, tmp_path):
    path = tmp_path / "camera.yaml"
    camera = replace(camera, fx=camera.fx / 3.0, fy=camera.fy / 7.0, cx=1e-7, cy=1e5)
    save_camera(camera, path)
    assert load_camera(path) == camera
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert (file.getNode("camera_matrix").mat() == camera.matrix).all()
    assert file.getNode("image_width").real() == 640
    coefficients = file.getNode("distortion_coefficients").mat().ravel()
    assert coefficients.tolist() == list(camera.distortion or (0.0,) * 5)
    file.release()
    assert [entry.name for entry in tmp_path.iterdir()] == ["camera.yaml"]


@pytest.mark.requirement("RV-CAM-2")
@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
@pytest.mark.parametrize(
    ("matrix_key", "distortion_key"),
    [
        ("camera_matrix", "distortion_coefficients"),
        ("cameraMatrix", "distCoeffs"),
        ("K", "D"),
        ("M1", "D1"),
    ],
)
def test_what_opencv_writes_is_read(tmp_path, suffix, matrix_key, distortion_key):
    path = tmp_path / f"c{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("calibration_time", "Thu 03 Feb 2011 10:57:34 AM # not a comment: [")
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write(matrix_key, FIVE.matrix)
    file.write(distortion_key, np.array([FIVE.distortion]).T)
    file.write("extrinsic_parameters", np.zeros((3, 6)))
    file.release()
    assert load_camera(path) == FIVE


ROS_CALIBRATION = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783367, 0.000000, 305.593336,
         0.000000, 437.302876, 243.738352, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361976, 0.110510, 0.001014, 0.000505, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.000000, 0.000000, 0.000000, 0.000000, 1.000000, 0.000000, 0.000000, 0.000000, 1.000000]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.653800, 0.000000, 322.797939, 0.000000, 0.000000, 393.653800, 241.090902, 0.000000,
    0.000000, 0.000000, 1.000000, 0.000000]
"""
ROS_BLOCKS = """\
# written by a YAML library
camera_matrix:
  cols: 3
  data:
  - 438.783367
  - 0
  - 305.593336
  - .0
  - 437.302876
  - 243.738352
  - 0.0
  - 0.0
  - 1.
  rows: 3
distortion_coefficients: {cols: 5, data: [-0.361976, .110510, 0.001014, 5.05e-4, -0], rows: 1}
distortion_model: 'plumb_bob'   # the usual one
image_height: 480
image_width: 640
"""
ROS_MESSAGE = """\
header:
  seq: 0
  stamp:
    secs: 1394757285
    nsecs:         0
  frame_id: ''
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.361976, 0.110510, 0.001014, 0.000505, 0.0]
K: [438.783367, 0.0, 305.593336, 0.0, 437.302876, 243.738352, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
roi:
  do_rectify: False
---
"""
ROS2_MESSAGE = """\
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.361976
- 0.110510
- 0.001014
- 0.000505
- 0.0
k:
- 438.783367
- 0.0
- 305.593336
- 0.0
- 437.302876
- 243.738352
- 0.0
- 0.0
- 1.0
"""


@pytest.mark.requirement("RV-CAM-2")
@pytest.mark.parametrize(
    "text",
    [ROS_CALIBRATION, ROS_BLOCKS, ROS_MESSAGE, ROS2_MESSAGE],
    ids=["calibration", "blocks", "message", "ros2"],
)
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_ros_camera_info_is_read(tmp_path, text, ending):
    path = tmp_path / "camera.yaml"
    path.write_bytes(text.replace("\n", ending).encode())
    assert load_camera(path) == Camera(
        640, 480, 438.783367, 437.302876, 305.593336, 243.738352,
        (-0.361976, 0.110510, 0.001014, 0.000505, 0.0),
    )  # fmt: skip


def test_ros_rational_polynomial_is_read(tmp_path):
    text = ROS_CALIBRATION.replace("plumb_bob", "rational_polynomial").replace(
        "0.000505, 0.000000]", "0.000505, 0.0, 0.1, 0.2, 0.3]"
    )
    (tmp_path / "c.yaml").write_text(text)
    assert load_camera(tmp_path / "c.yaml").distortion[4:] == (0.0, 0.1, 0.2, 0.3)


def test_other_lens_models_are_refused(tmp_path):
    (tmp_path / "c.yaml").write_text(ROS_CALIBRATION.replace("plumb_bob", "fov"))
    with pytest.raises(RendezviewError, match=r"c\.yaml: distortion_model: 'fov'"):
        load_camera(tmp_path / "c.yaml")


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "kannala_brandt"])
def test_a_fisheye_is_read_by_each_of_its_names(tmp_path, model):
    text = ROS_CALIBRATION.replace("plumb_bob", model).replace("0.000505, 0.000000]", "0.000505]")
    (tmp_path / "c.yaml").write_text(text)
    assert load_camera(tmp_path / "c.yaml") == Camera(
        640, 480, 438.783367, 437.302876, 305.593336, 243.738352,
        (-0.361976, 0.110510, 0.001014, 0.000505), LensModel.FISHEYE,
    )  # fmt: skip


def test_a_fisheye_calibrated_by_opencv_is_read(tmp_path):
    path = tmp_path / "c.yaml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("fisheye_model", 1)
    file.write("camera_matrix", PLAIN.matrix)
    file.write("distortion_coefficients", np.zeros((4, 1)))
    file.release()
    camera = load_camera(path)
    assert camera.lens_model is LensModel.FISHEYE
    assert camera.distortion == (0.0,) * 4


KALIBR = """\
cam0:
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.003, 0.004]
  distortion_model: MODEL
  intrinsics: [800.0, 810.0, 310.0, 245.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""


@pytest.mark.requirement("RV-CAM-2")
@pytest.mark.parametrize(("model", "lens"), [("radtan", "opencv"), ("equidistant", "fisheye")])
def test_kalibrs_files_are_read(tmp_path, model, lens):
    (tmp_path / "c.yaml").write_text(KALIBR.replace("MODEL", model))
    assert load_camera(tmp_path / "c.yaml") == replace(
        PLAIN, distortion=(0.01, -0.02, 0.003, 0.004), lens_model=lens
    )
    (tmp_path / "two.yaml").write_text(KALIBR + KALIBR.replace("cam0", "cam1"))
    with pytest.raises(RendezviewError, match="several cameras"):
        load_camera(tmp_path / "two.yaml")


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("roi: {x_offset: 0, y_offset: 0, width: 0, height: 0}\nbinning_x: 0\n", PLAIN),
        ("roi: {x_offset: 40, y_offset: 30, width: 500, height: 400}\n",
         PLAIN.cropped(40, 30, 500, 400)),
        ("roi: {x_offset: 40, y_offset: 30}\nbinning: 2\n",
         PLAIN.cropped(40, 30, 600, 450).binned(2)),
        ("binning_x: 4\nbinning_y: 2\n", PLAIN.binned(4, 2)),
        ("bit_depth: 12\n", replace(PLAIN, bit_depth=12)),
    ],
)  # fmt: skip
def test_region_binning_and_depth_are_those_of_the_images(tmp_path, keys, expected):
    (tmp_path / "c.yaml").write_text(
        "width: 640\nheight: 480\nK: [800, 0, 310, 0, 810, 245, 0, 0, 1]\n" + keys
    )
    assert load_camera(tmp_path / "c.yaml") == expected


SPEED = {
    "Nu": 1920, "Nv": 1200, "ppx": 5.86e-6, "ppy": 5.86e-6, "fx": 0.0176, "fy": 0.0176,
    "fpx": 3003.41296928, "fpy": 3003.41296928, "horizontalFOV": 35.452, "verticalFOV": 22.595,
}  # fmt: skip


@pytest.mark.requirement("RV-CAM-2")
def test_speed_camera_is_metres_over_pitch_with_its_own_principal_point(tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(SPEED))
    camera = load_camera(tmp_path / "camera.json")
    assert (camera.width, camera.height) == (1920, 1200)
    assert camera.fx == pytest.approx(3003.41296928)
    assert (camera.cx, camera.cy) == (960.0, 600.0)
    assert camera.distortion == ()


def test_speed_plus_matrix_and_distortion_win(tmp_path):
    matrix = [[2988.5795163815555, 0, 960], [0, 2988.3401159176124, 600], [0, 0, 1]]
    coefficients = [-0.2238, 0.5141, -0.0006, -0.0002, -0.1312]
    data = {**SPEED, "cameraMatrix": matrix, "distCoeffs": coefficients}
    (tmp_path / "camera.json").write_text(json.dumps(data))
    camera = load_camera(tmp_path / "camera.json")
    assert (camera.matrix == matrix).all()
    assert camera.distortion == tuple(coefficients)
    assert (camera.width, camera.height) == (1920, 1200)


@pytest.mark.requirement("RV-CAM-2")
def test_bop_camera_is_read(tmp_path):
    data = {"cx": 325.2611, "cy": 242.04899, "depth_scale": 1.0, "fx": 572.4114, "fy": 573.57043,
            "height": 480, "width": 640}  # fmt: skip
    (tmp_path / "camera.json").write_text(json.dumps(data))
    assert load_camera(tmp_path / "camera.json") == Camera(
        640, 480, 572.4114, 573.57043, 325.2611, 242.04899
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a camera file"),
        (b"hello", "not a camera file"),
        (b"- 1\n- 2\n", "not a camera file"),
        (b"\x89PNG\r\n\x1a\n\x00\xff", "not text in UTF-8"),
        (b"{}", "no camera matrix"),
        (b"a: 1\n", "no camera matrix"),
        (b"<a>", "not valid XML"),
        (b"<a>" * 10_000 + b"</a>" * 10_000, r"not valid XML \(.*recursion"),
        (b"K: [1" + b"0" * 400 + b", 0, 0, 0, 1, 0, 0, 0, 1]\n", "K: must be"),
        (b"fx: 1" + b"0" * 400 + b"\n", "fx: "),
        (b"intrinsics: [500, 500, 320, 240]\nresolution: [640.5, 480]\n", "width: must be a pos"),
        (
            b"fx: 500\nfy: 500\ncx: 320\ncy: 240\nwidth: 640\nheight: 480\n"
            b"intrinsics_covariance: 5\n",
            "covariance must be",
        ),
        (
            b"fx: 500\nfy: 500\ncx: 320\ncy: 240\nwidth: 640\nheight: 480\n"
            b"intrinsics_covariance: [1e300, 1, 1, 1]\n",
            "covariance must be",
        ),
        (b'{"fx": 1', "not valid JSON"),
        (b"K: [1, 2", r"line 1: expected ',' or '\]'"),
        (b"K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n", "image size is missing: add image_width"),
        (b"K: [1, 2]\nwidth: 4\nheight: 4\n", "K: has 2 numbers"),
        (b"K: [1, a, 3]\nwidth: 4\nheight: 4\n", "K: must be a list of numbers"),
        (b"K:\nwidth: 4\nheight: 4\n", "K: must be finite numbers"),
        (b"K: [1,5,0,0,1,0,0,0,1]\nwidth: 4\nheight: 4\n", "no skew"),
        (b"K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nwidth: 4.5\nheight: 4\n", "width: must be a positive"),
        (b"K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nwidth: a\nheight: 4\n", "width: must be a number"),
        (b"K: [-1, 0, 0, 0, 1, 0, 0, 0, 1]\nwidth: 4\nheight: 4\n", "fx must be positive"),
        (b"K: [.nan, 0, 0, 0, 1, 0, 0, 0, 1]\nwidth: 4\nheight: 4\n", "K: must be finite"),
        (b"K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD: [1, 2]\nwidth: 4\nheight: 4\n", "D: 2 coefficients"),
        (
            b"K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD: [1,2,3,4,5,6]\nwidth: 4\nheight: 4\n",
            "D: 6 coefficients; expected 4, 5, 8, 12 or 14",
        ),
        (
            b"fisheye_model: 1\nK: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD: [1]\nwidth: 4\nheight: 4\n",
            "D: 1 coefficients; a fisheye has 4",
        ),
        (
            b"K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nwidth: 4\nheight: 4\nroi: {x_offset: 2, width: 4}\n",
            "a region of 4 × 4 px at .2, 0. is not inside",
        ),
        (b"K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nwidth: 4\nheight: 4\nroi: 3\n", "roi: give x_offset"),
        (
            b"K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nwidth: 4\nheight: 4\nbit_depth: 11\n",
            "bit_depth must be one of",
        ),
        (b'{"fx": 1, "fy": 1, "cx": 1, "width": 4, "height": 4}', "cy: missing"),
        (b'{"fx": 1, "fy": 1, "ppx": 0, "ppy": 1, "Nu": 4, "Nv": 4}', "ppx: must be positive"),
        (b"[" * 100_000, "not a camera file"),
        (b"a: 1\na: 2\n", "line 2: the key 'a' is there twice"),
        (b"a: 1\n  b: 2\n", "line 2: mapping values are not allowed here"),
        (b"a: &a [1]\nb: *a\n", "line 2: aliases"),
    ],
)
def test_what_is_no_camera_file_is_refused_by_name(tmp_path, content, message, capfd):
    path = tmp_path / "bad_camera"
    path.write_bytes(content)
    with pytest.raises(RendezviewError, match=message) as caught:
        load_camera(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "more", [{"k1": -0.3, "p1": 0.0}, {"radial": [-0.3, 0.1]}, {"Coeffs": [1]}]
)
def test_coefficients_under_a_name_that_is_not_read_are_no_pinhole(tmp_path, more):
    path, pinhole = tmp_path / "camera.json", Camera(640, 480, 500.0, 501.0, 319.0, 239.0)
    numbers = {"fx": 500, "fy": 501, "cx": 319, "cy": 239, "width": 640, "height": 480}
    path.write_text(json.dumps(numbers | {"distortion_model": "none", "k2": 0}))
    assert load_camera(path) == pinhole
    path.write_text(json.dumps(numbers | {"dist": [-0.3, 0.1, 0, 0]}))
    assert load_camera(path).distortion == (-0.3, 0.1, 0.0, 0.0)
    path.write_text(json.dumps(numbers | more))
    with pytest.raises(RendezviewError, match="distCoeffs"):
        load_camera(path)


def test_trailing_zero_coefficients_of_larger_models_are_dropped(tmp_path):
    text = (
        "K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nwidth: 4\nheight: 4\n"
        "D: [1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0, 0, 0]\n"
    )
    (tmp_path / "c.yaml").write_text(text)
    assert load_camera(tmp_path / "c.yaml").distortion == (1, 2, 3, 4, 5, 6, 7, 8)


def test_a_missing_camera_file_and_a_folder_are_named(tmp_path):
    with pytest.raises(RendezviewError, match="no such file"):
        load_camera(tmp_path / "none.yaml")
    with pytest.raises(RendezviewError, match="is a folder"):
        load_camera(tmp_path)


def test_a_camera_that_cannot_be_saved_is_named(tmp_path):
    with pytest.raises(RendezviewError, match="absent does not exist"):
        save_camera(PLAIN, tmp_path / "absent" / "camera.yaml")
