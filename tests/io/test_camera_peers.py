"""Camera files of other programs: each gives the camera that the same numbers give in ours."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera, LensModel
from rendezview.io.camera_files import load_camera
from rendezview.io.sequences import open_sequence

FOUR = (-0.21, 0.07, 0.0011, -0.0007)
FIVE = (*FOUR, 0.013)
PLAIN = Camera(808, 606, 702.5, 698.25, 411.0, 297.5)
BENT = Camera(808, 606, 702.5, 698.25, 411.0, 297.5, FIVE)
FISH = Camera(808, 606, 702.5, 698.25, 411.0, 297.5, FOUR, LensModel.FISHEYE)
# COLMAP counts from the picture's corner.
CORNER = "411.5 298.0"


def with_terms(*terms: float, fx: float = 702.5, fy: float = 698.25) -> Camera:
    return Camera(808, 606, fx, fy, 411.0, 297.5, (*terms, *[0.0] * (5 - len(terms))))


def fisheye(*terms: float) -> Camera:
    four = (*terms, *[0.0] * (4 - len(terms)))
    return Camera(808, 606, 702.5, 702.5, 411.0, 297.5, four, LensModel.FISHEYE)


COLMAP = {
    f"SIMPLE_PINHOLE 808 606 702.5 {CORNER}": with_terms(fy=702.5).pinhole,
    f"PINHOLE 808 606 702.5 698.25 {CORNER}": PLAIN,
    f"SIMPLE_RADIAL 808 606 702.5 {CORNER} -0.1": with_terms(-0.1, fy=702.5),
    f"RADIAL 808 606 702.5 {CORNER} -0.1 0.02": with_terms(-0.1, 0.02, fy=702.5),
    f"OPENCV 808 606 702.5 698.25 {CORNER} -0.21 0.07 0.0011 -0.0007": with_terms(*FOUR),
    f"FULL_OPENCV 808 606 702.5 698.25 {CORNER} -0.21 0.07 0.0011 -0.0007 0.013 0.1 0.2 0.3":
        Camera(808, 606, 702.5, 698.25, 411.0, 297.5, (*FIVE, 0.1, 0.2, 0.3)),
    f"SIMPLE_RADIAL_FISHEYE 808 606 702.5 {CORNER} 0.03": fisheye(0.03),
    f"RADIAL_FISHEYE 808 606 702.5 {CORNER} 0.03 0.004": fisheye(0.03, 0.004),
    f"OPENCV_FISHEYE 808 606 702.5 698.25 {CORNER} -0.21 0.07 0.0011 -0.0007": FISH,
}  # fmt: skip
NERF = {"w": 808, "h": 606, "fl_x": 702.5, "fl_y": 698.25, "cx": 411.5, "cy": 298.0, "frames": []}
NERF_TERMS = dict(zip(("k1", "k2", "p1", "p2", "k3"), FIVE, strict=True))
REALSENSE = {
    "width": 808, "height": 606, "fx": 702.5, "fy": 698.25, "ppx": 411.0, "ppy": 297.5,
    "coeffs": list(FIVE), "model": "distortion.brown_conrady",
}  # fmt: skip
K_ROWS = [[702.5, 0, 411.0], [0, 698.25, 297.5], [0, 0, 1]]
SIX = "f_u: 702.5\n  f_v: 698.25\n  pp_x: 411.0\n  pp_y: 297.5\n  width: 808\n  height: 606"
ORB = """%YAML:1.0
Camera.type: "PinHole"
{0}.fx: 702.5
{0}.fy: 698.25
{0}.cx: 411.0
{0}.cy: 297.5
"""
ORB_SIZE = "Camera.width: 808\nCamera.height: 606\n"
ORB_TERMS = "".join(f"Camera1.{k}: {v}\n" for k, v in NERF_TERMS.items())
CAMODOCAL = """%YAML:1.0
model_type: {0}
camera_name: left
image_width: 808
image_height: 606
"""
VISP = """<?xml version="1.0"?><root><camera><name>eye</name>
<image_width>808</image_width><image_height>606</image_height>{0}</camera></root>"""
VISP_MODEL = (
    "<model><type>perspectiveProj{0}Distortion</type><px>702.5</px><py>698.25</py>"
    "<u0>411</u0><v0>297.5</v0>{1}</model>"
)
INI = """[image]
width
808
height
606
[forward]
camera matrix
702.5 0 411
0 698.25 297.5
0 0 1
distortion
-0.21 0.07 0.0011 -0.0007 0.013
"""
EUROC = """sensor_type: camera
resolution: [808, 606]
camera_model: pinhole
intrinsics: [702.5, 698.25, 411.0, 297.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.21, 0.07, 0.0011, -0.0007, 0.013]
"""


@pytest.mark.parametrize("line", COLMAP)
def test_each_model_of_colmap_is_read(tmp_path, line):
    path = tmp_path / "cameras.txt"
    path.write_text(f"# CAMERA_ID, MODEL\n7 {line}\n")
    assert load_camera(path) == COLMAP[line]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (NERF | NERF_TERMS | {"camera_model": "OPENCV"}, BENT),
        (NERF | {"camera_model": "PINHOLE"}, PLAIN),
        (NERF | dict(zip(("k1", "k2", "k3", "k4"), FOUR, strict=True))
         | {"camera_model": "OPENCV_FISHEYE"}, FISH),
        (REALSENSE, BENT),
        (REALSENSE | {"coeffs": [0] * 5, "model": "Inverse Brown Conrady"}, PLAIN),
        (REALSENSE | {"coeffs": [*FOUR, 0], "model": "Kannala Brandt4"}, FISH),
        ({"K": K_ROWS, "resolution": [606, 808]}, PLAIN),
        ({"intrinsic_matrix": np.transpose(K_ROWS).ravel().tolist(), "width": 808, "height": 606},
         PLAIN),
    ],
    ids=["nerf", "nerf-pinhole", "nerf-fisheye", "realsense", "realsense-zeros",
         "realsense-fisheye", "megapose", "open3d"],
)  # fmt: skip
def test_json_files_of_others_are_read(tmp_path, content, expected):
    path = tmp_path / "c.json"
    path.write_text(json.dumps(content))
    assert load_camera(path) == expected


def test_an_angle_alone_gives_the_focal_length_of_instant_ngp(tmp_path):
    angle = 2.0 * math.atan(0.5 * 808 / 702.5)
    content = {"camera_angle_x": angle, "w": 808, "h": 606, "frames": [{"file_path": "0"}]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    camera = load_camera(tmp_path / "transforms.json")
    assert (camera.fx, camera.fy) == pytest.approx((702.5, 702.5))
    assert (camera.cx, camera.cy) == (403.5, 302.5)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("intrinsics:\n  " + SIX + "\nimage_name_pre: a_\n", PLAIN),
        (ORB.format("Camera") + ORB_SIZE, PLAIN),
        (ORB.format("Camera1") + ORB_SIZE + ORB_TERMS, BENT),
        (ORB.format("Camera") + "Camera.cols: 808\nCamera.rows: 606\n", PLAIN),
        (ORB.format("Camera").replace("PinHole", "KannalaBrandt8") + ORB_SIZE
         + "".join(f"Camera.k{k + 1}: {v}\n" for k, v in enumerate(FOUR)), FISH),
        (CAMODOCAL.format("PINHOLE") + "distortion_parameters:\n  k1: -0.21\n  k2: 0.07\n"
         "  p1: 0.0011\n  p2: -0.0007\nprojection_parameters:\n  fx: 702.5\n  fy: 698.25\n"
         "  cx: 411.0\n  cy: 297.5\n", with_terms(*FOUR)),
        (CAMODOCAL.format("KANNALA_BRANDT") + "projection_parameters:\n  k2: -0.21\n  k3: 0.07\n"
         "  k4: 0.0011\n  k5: -0.0007\n  mu: 702.5\n  mv: 698.25\n  u0: 411.0\n  v0: 297.5\n",
         FISH),
        (VISP.format(VISP_MODEL.format("Without", "")), PLAIN),
        (VISP.format(VISP_MODEL.format("Without", "")
         + VISP_MODEL.format("With", "<kud>-0.1</kud><kdu>0.1</kdu>")), with_terms(-0.1)),
        (INI, BENT),
        (EUROC, BENT),
    ],
    ids=["m3t", "orb", "orb3", "stella", "orb-fisheye", "vins", "vins-fisheye", "visp",
         "visp-two-models", "ros-ini", "euroc"],
)  # fmt: skip
def test_texts_of_others_are_read(tmp_path, text, expected):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    camera = load_camera(path)
    assert camera == expected
    assert camera.doubts == ()


def test_region_and_checked_count_in_the_files_of_others_too(tmp_path):
    text = "intrinsics:\n  " + SIX + "\nroi: {x_offset: 8, y_offset: 6, width: 800, height: 600}\n"
    (tmp_path / "c.yaml").write_text(text)
    assert load_camera(tmp_path / "c.yaml") == PLAIN.cropped(8, 6, 800, 600)


@pytest.mark.parametrize("place", [".", "rgb"])
def test_a_matrix_alone_takes_its_size_from_the_images_beside_it(tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    cv2.imwrite(str(tmp_path / place / "0.png"), np.zeros((606, 808), np.uint8))
    np.savetxt(tmp_path / "cam_K.txt", K_ROWS)
    assert open_sequence(tmp_path).frames[0].camera == PLAIN
    with pytest.raises(RendezviewError, match=r"size is missing: .* put it beside the images"):
        load_camera(tmp_path / "cam_K.txt")


KALIBR = """cam0:
  camera_model: {}
  distortion_coeffs: {}
  distortion_model: {}
  intrinsics: [{}, 420.0, 419.0, 403.5, 302.5]
  resolution: [808, 606]
"""
OMNI_BENT = KALIBR.format("omni", [-0.2, 0.05, 0.001, 0.002], "radtan", 0.91)
BASALT = """{"value0": {"resolution": [[808, 606]], "intrinsics": [{"camera_type": "ds",
"intrinsics": {"fx": 420.0, "fy": 419.0, "cx": 403.5, "cy": 302.5, "xi": -0.2, "alpha": 0.58}}]}}"""
MEI = CAMODOCAL.format("MEI") + (
    "mirror_parameters:\n  xi: 0.9\n"
    "distortion_parameters:\n  k1: -0.1\n  k2: 0.02\n  p1: 0\n  p2: 0\n"
    "projection_parameters:\n  gamma1: 900.0\n  gamma2: 898.0\n  u0: 403.5\n  v0: 302.5\n"
)


def ds(point, xi, alpha):
    """Usenko 2018, by the norms of a point (x, y, z)."""
    x, y, z = point
    d1 = math.hypot(x, y, z)
    d2 = math.hypot(x, y, xi * d1 + z)
    return np.array([x, y]) / (alpha * d2 + (1 - alpha) * (xi * d1 + z))


def eucm(point, alpha, beta):
    """Khomutenko 2016."""
    x, y, z = point
    return np.array([x, y]) / (alpha * math.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z)


def mei(point, xi, k1=0.0, k2=0.0):
    """Mei 2007: the unit sphere, seen from (0, 0, -xi)."""
    x, y, z = np.asarray(point) / np.linalg.norm(point)
    m = np.array([x, y]) / (z + xi)
    return m * (1 + k1 * (m @ m) + k2 * (m @ m) ** 2)


def fov(point, omega):
    """Devernay 2001."""
    x, y, z = point
    r = math.hypot(x, y) / z
    return np.array([x, y]) / z * math.atan(2 * r * math.tan(omega / 2)) / (omega * r)


def divided(point, k):
    """Fitzgibbon 2001: the distorted point p has p / (1 + k p²) undistorted."""
    straight = np.array(point[:2]) / point[2]
    r = np.linalg.norm(straight)
    roots = np.roots([k * r, -1.0, r])
    return straight / r * min(root.real for root in roots if root.real > 0)


def focal(four):
    return lambda m: np.array([four[0] * m[0] + four[2], four[1] * m[1] + four[3]])


MID, COLMAP_MID = (420.0, 419.0, 403.5, 302.5), "420.0 419.0 404.0 303.0"


@pytest.mark.parametrize(
    ("text", "lens", "four"),
    [
        (KALIBR.format("ds", [], "none", "-0.2, 0.58"), lambda q: ds(q, -0.2, 0.58), MID),
        (KALIBR.format("ds", [], "none", "-0.0089, 0.9138"), lambda q: ds(q, -0.0089, 0.9138), MID),
        (KALIBR.format("ds", [], "none", "0.3, 0.5"), lambda q: ds(q, 0.3, 0.5), MID),
        (KALIBR.format("eucm", [], "none", "0.63, 1.05"), lambda q: eucm(q, 0.63, 1.05), MID),
        (KALIBR.format("eucm", [], "none", "0.4, 0.8"), lambda q: eucm(q, 0.4, 0.8), MID),
        (KALIBR.format("omni", [], "none", "0.3"), lambda q: mei(q, 0.3), MID),
        (KALIBR.format("pinhole", "[0.93]", "fov", "").replace("[, ", "["),
         lambda q: fov(q, 0.93), MID),
        (BASALT, lambda q: ds(q, -0.2, 0.58), MID),
        (BASALT.replace("ds", "eucm").replace('"xi": -0.2, ', '"beta": 1.05, '),
         lambda q: eucm(q, 0.58, 1.05), MID),
        (MEI, lambda q: mei(q, 0.9, -0.1, 0.02), (900.0, 898.0, 403.5, 302.5)),
        (f"1 FOV 808 606 {COLMAP_MID} 0.93\n", lambda q: fov(q, 0.93), MID),
        (f"1 EUCM 808 606 {COLMAP_MID} 0.63 1.05\n", lambda q: eucm(q, 0.63, 1.05), MID),
        (f"1 DIVISION 808 606 {COLMAP_MID} -0.2\n", lambda q: divided(q, -0.2), MID),
        (f"1 FISHEYE 808 606 {COLMAP_MID}\n",
         lambda q: np.array(q[:2]) * math.atan2(math.hypot(*q[:2]), q[2]) / math.hypot(*q[:2]),
         MID),
    ],
    ids=["ds", "ds-flat", "ds-round", "eucm", "eucm-flat", "omni", "kalibr-fov", "basalt-ds",
         "basalt-eucm", "mei", "fov", "colmap-eucm", "division", "equidistant"],
)  # fmt: skip
def test_lenses_of_others_project_as_their_authors_say(tmp_path, text, lens, four):
    path = tmp_path / "c.txt"
    path.write_text(text)
    camera = load_camera(path)
    rng = np.random.default_rng(5)
    points = rng.normal(size=(4000, 3)) * (1.0, 1.0, 0.6)
    points = points[points[:, 2] > 0.1]
    expected = np.array([focal(four)(lens(tuple(point))) for point in points])
    seen = (expected > -0.5).all(axis=1) & (expected < (807.5, 605.5)).all(axis=1)
    assert seen.sum() > 200
    apart = np.abs(camera.project(points[seen]) - expected[seen])
    assert apart.max() < 0.1
    back = camera.rays(expected[seen])  # the way back, within what a pixel of 0.1 px allows
    ahead = points[seen] / points[seen][:, 2:]
    near = np.linalg.norm(ahead[:, :2], axis=1) < 2.0
    turned = np.cross(back, ahead) / np.linalg.norm(ahead, axis=1)[:, None] ** 2
    assert np.abs(turned[near]).max() < 0.5 / camera.fx


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 1D_RADIAL 8 6 4 3\n", "1D_RADIAL is not read: use one of SIMPLE_PINHOLE"),
        ("1 PINHOLE 808 606 702.5\n", "PINHOLE: has 1 parameters"),
        ("1 PINHOLE 8 6 7 7 4 3\n2 PINHOLE 8 6 7 7 4 3\n", "2 cameras: keep the line"),
        (json.dumps(REALSENSE | {"model": "Inverse Brown Conrady"}), "'Inverse Brown Conr"),
        (json.dumps(REALSENSE | {"model": "ftheta"}), "'ftheta' is not read"),
        (json.dumps(NERF | {"camera_model": "EQUIRECTANGULAR"}), "'EQUIRECTANGULAR' is not read"),
        (json.dumps({"frames": [{"fl_x": 1.0}]}), "each frame has a camera of its own"),
        (json.dumps({"K": K_ROWS, "resolution": 5}), "not that of a file of megapose"),
        ("cam0:\n  camera_model: ds\n  intrinsics: [1, 2, 3, 4, 5]\n", "5 numbers, ds has 6"),
        ("cam0:\n  camera_model: vcm\n  intrinsics: [1, 2, 3, 4, 5, 6]\n", "'vcm' .* is not read"),
        (OMNI_BENT, r"omni: this lens is \d\.\d+ px from the nearest fisheye"),
        (BASALT.replace("ds", "fov4"), "'fov4' is not read: calibrate kb4, ds or pinhole"),
        (BASALT.replace('[{"camera_type', '[{}, {"camera_type'), "2 cameras in value0"),
        (
            CAMODOCAL.format("SCARAMUZZA") + "projection_parameters:\n  u0: 1\n",
            "'SCARAMUZZA' is no",
        ),
        (ORB.format("Camera").replace("PinHole", "Rolling"), "'rolling' is not read"),
        (ORB.format("Camera1") + ORB.format("Camera2").split("\n", 2)[2], "several cameras"),
        (ORB.format("Camera"), "the image size is missing"),
        (VISP.format(VISP_MODEL.format("WithKannalaBrandt", "")), "is not read: calibrate a persp"),
        (INI.replace("[forward]", "[left]") + "[right]\n", "2 cameras: keep the one"),
        ("intrinsics:\n  f_u: 1\n", "width: missing"),
        ("intrinsics:\n  " + SIX.replace("702.5", "fast"), "f_u: must be a number"),
    ],
)
def test_what_cannot_be_used_is_refused_by_its_name(tmp_path, text, message):
    path = tmp_path / "c.txt"
    path.write_text(text)
    with pytest.raises(RendezviewError, match=message) as caught:
        load_camera(path)
    assert str(caught.value).startswith(str(path))
