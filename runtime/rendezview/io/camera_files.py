"""Camera files of OpenCV, ROS, Kalibr, BOP and SPEED.

The content of a file decides its kind, not its name:

- OpenCV YAML, XML or JSON: ``camera_matrix`` and ``distortion_coefficients`` with
  ``image_width`` and ``image_height``; also ``cameraMatrix``/``distCoeffs``, ``K``/``D``
  and ``M1``/``D1`` (the left camera of a stereo calibration). ``fisheye_model: 1`` for a fisheye.
- ROS ``CameraInfo`` YAML, as a calibration file or as a printed message; lens models
  ``plumb_bob``, ``rational_polynomial`` and ``equidistant``.
- Kalibr ``camchain.yaml`` of one camera: ``intrinsics``, ``resolution``, ``distortion_coeffs``;
  lens models ``radtan``, ``equidistant`` and ``none``.
- BOP ``camera.json``: ``fx fy cx cy width height``, and ``distCoeffs`` in our own files.
- SPEED ``camera.json``: ``fx``, ``fy`` in metres, pixel pitch ``ppx``, ``ppy`` in metres, size
  ``Nu`` × ``Nv``; SPEED+ also has ``cameraMatrix`` and ``distCoeffs``, which take precedence.
- Those of other programs: `camera_peers`.

In all kinds, ``roi`` and ``binning`` say which part of the calibrated picture the images are, as in
ROS, and ``bit_depth`` how many bits of 16-bit levels are used. ``checked: true`` says that numbers
that are questioned are meant: `plausible`. ``intrinsics_covariance`` is of the calibrated picture:
a matrix, or one σ each, of fx fy cx cy (px) and the coefficients.

SPEED's principal point is (Nu/2, Nv/2), as in its own projection code and in
SPEED+'s ``cameraMatrix``. Both are used unchanged: SPEED+'s matrix is for OpenCV, whose pixel (0,
0) is the centre of a pixel, as here, and SPEED draws its axes over the picture in that convention.
Measured from the corner of the picture, it would be half a pixel less: 0.2 mrad for its lens of
3000 px.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera, LensModel, intrinsics_of
from rendezview.io.calibration_yaml import parse_yaml
from rendezview.io.camera_peers import keys_of_text, number, translated
from rendezview.io.files import StrPath, atomic_write_text, parse_json, read_text
from rendezview.io.plausible import CHECKED, questioned

_MATRIX_KEYS = (
    "camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "M1", "M", "intrinsic_matrix",
)  # fmt: skip
_DISTORTION_KEYS = (
    "distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D", "d",
    "D1", "distortion", "distortion_coeffs", "dist",
)  # fmt: skip
# Under none of these names are coefficients read.
_LIKE_DISTORTION = re.compile(
    "[kps][1-8]|coeffs?|dist.*coef.*|.*distort.*|(radial|tangential).*", re.IGNORECASE
)
_WIDTH_KEYS = ("image_width", "image_Width", "imageWidth", "width", "Nu")
_HEIGHT_KEYS = ("image_height", "image_Height", "imageHeight", "height", "Nv")
_POLYNOMIALS = (
    "plumb_bob", "rational_polynomial", "thin_prism", "tilted", "radtan", "radial-tangential",
    "opencv",
)  # fmt: skip
_FISHEYES = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye")
_COVARIANCE = "intrinsics_covariance"  # of fx fy cx cy and the coefficients; or their σ
_CORRECT = ": correct the camera file"
_GIVE = "give an OpenCV or ROS YAML file, or a BOP or SPEED camera.json"
_LIMIT_BYTES = 4_000_000  # a video given by mistake is not read whole. Source: a chosen limit


def load_camera(path: StrPath, size: Callable[[], tuple[int, int]] | None = None) -> Camera:
    """Read a camera file; its content decides its kind.

    OpenCV YAML, XML and JSON; ROS ``CameraInfo`` YAML; Kalibr YAML; SPEED and SPEED+
    ``camera.json``; BOP ``camera.json``; files of other programs (`camera_peers`). The camera is
    that of the images: ``roi`` and ``binning`` are applied.

    Args:
        path: the file.
        size: gives (width, height), px, of the images, if the file has none (``cam_K.txt``).

    Raises:
        RendezviewError: missing, not a camera file, an unknown lens model, or
            impossible numbers.
    """
    text = read_text(path, "a camera file", limit_bytes=_LIMIT_BYTES)
    data = _parse(text, str(path))
    if not isinstance(data, dict):
        raise RendezviewError(f"{path}: not a camera file (no keys in it): {_GIVE}")
    return camera_from_keys(data, str(path), size)


def camera_from_keys(
    data: dict[Any, Any], where: str, size: Callable[[], tuple[int, int]] | None = None
) -> Camera:
    """The camera in the content of a camera file or of a recorded message.

    Raises:
        RendezviewError: not one of a camera, of an unknown lens model, or impossible numbers.
    """
    with explained(f"{where}: ", _CORRECT):
        keys = translated(_only_camera(data))
        if size is not None and not any(_find(keys, k) for k in (_WIDTH_KEYS, ("resolution",))):
            keys = {**keys, **dict(zip(("width", "height"), size(), strict=True))}
        checked = data.get(CHECKED, False)
        if not isinstance(checked, bool):
            raise ValueError(f"{CHECKED}: must be true or false, not {checked!r}")
        unless = None if checked else f"{CHECKED}: true in the file"
        return _imaged(keys, questioned(_calibrated(keys), unless))


def save_camera(camera: Camera, path: StrPath) -> None:
    """Write an OpenCV YAML file that `load_camera` and ``cv2.FileStorage`` read, atomically.

    Every number keeps its full precision.
    """
    coefficients = camera.distortion or (0.0,) * 5  # OpenCV's readers require some
    text = (
        "%YAML:1.0\n---\n"
        f"image_width: {camera.width}\n"
        f"image_height: {camera.height}\n"
        f"camera_matrix: {opencv_matrix(camera.matrix)}"
        f"distortion_coefficients: {opencv_matrix(np.atleast_2d(coefficients))}"
    )
    if camera.lens_model is LensModel.FISHEYE:
        text += "fisheye_model: 1\ndistortion_model: equidistant\n"
    if camera.bit_depth is not None:
        text += f"bit_depth: {camera.bit_depth}\n"
    if camera.covariance is not None:
        text += f"{_COVARIANCE}: {opencv_matrix(np.array(camera.covariance))}"
    atomic_write_text(path, text)


def opencv_matrix(matrix: npt.NDArray[Any]) -> str:
    """A matrix in OpenCV's YAML, in full precision."""
    rows, cols = matrix.shape
    numbers = ", ".join(repr(float(value)) for value in matrix.ravel())
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {numbers} ]\n"


def _parse(text: str, where: str) -> Any:
    with explained(f"{where}: ", _CORRECT):
        known = keys_of_text(text)
    if known is not None:
        return known
    start = text.lstrip()[:1]
    if start == "{":
        return parse_json(text, where)
    if start == "<":
        faults = (ElementTree.ParseError, ValueError, RecursionError)
        remedy = "): correct or replace the camera file"
        with explained(f"{where}: not valid XML (", remedy, faults):
            return _xml_value(ElementTree.fromstring(text))
    unread = f"{where}: not a camera file that can be read ("
    with explained(unread, f"): {_GIVE}", (ValueError, RecursionError)):
        return parse_yaml(text)


def _xml_value(element: ElementTree.Element) -> Any:
    """Children as a dict, of one name as a list; text as numbers if all of it is, else as it is."""
    if len(element):
        named: dict[str, list[Any]] = {}
        for child in element:
            named.setdefault(child.tag, []).append(_xml_value(child))
        return {tag: found if len(found) > 1 else found[0] for tag, found in named.items()}
    text = (element.text or "").strip()
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return text
    return numbers[0] if len(numbers) == 1 else numbers


def _only_camera(data: dict[Any, Any]) -> dict[Any, Any]:
    """The keys of the only camera of a Kalibr file; other files as they are."""
    if not isinstance(data.get("cam0"), dict):
        return data
    if isinstance(data.get("cam1"), dict):
        raise ValueError(
            "several cameras (cam0, cam1 …): copy the keys of the one that took the images into a "
            "file of their own"
        )
    return dict(data["cam0"])


def _calibrated(data: dict[Any, Any]) -> Camera:
    """The camera of the whole calibrated picture."""
    size_keys = _find(data, _WIDTH_KEYS), _find(data, _HEIGHT_KEYS)
    matrix_key = _find(data, _MATRIX_KEYS)
    if matrix_key is not None:
        numbers = _numbers(data[matrix_key], matrix_key)
        try:
            fx, fy, cx, cy = intrinsics_of(numbers)
        except ValueError as error:
            raise ValueError(f"{matrix_key}: {error}") from None
    elif "intrinsics" in data:
        fx, fy, cx, cy = counted(data, "intrinsics", 4)
    elif "ppx" in data or "ppy" in data:
        fx = number(data, "fx") / _positive(data, "ppx")
        fy = number(data, "fy") / _positive(data, "ppy")
        cx, cy = number(data, "Nu") / 2.0, number(data, "Nv") / 2.0
    elif "fx" in data:
        fx, fy, cx, cy = (number(data, key) for key in ("fx", "fy", "cx", "cy"))
    else:
        raise ValueError(
            "no camera matrix in it (looked for camera_matrix, cameraMatrix, K, M1, intrinsics and "
            "fx): give an OpenCV, ROS or Kalibr YAML file, or a BOP or SPEED camera.json"
        )
    if "resolution" in data:
        sides = dict(zip(("width", "height"), counted(data, "resolution", 2), strict=True))
        width, height = (_whole(sides, key) for key in sides)
    elif size_keys[0] is None or size_keys[1] is None:
        raise ValueError(
            "the image size is missing: add image_width and image_height (pixels) to the file, or "
            "put it beside the images as cam_K.txt if it is a matrix alone"
        )
    else:
        width, height = (_whole(data, key) for key in size_keys if key is not None)
    depth = None if data.get("bit_depth") is None else _whole(data, "bit_depth")
    return Camera(width, height, fx, fy, cx, cy, *_lens(data), depth, _covariance(data))


def _covariance(data: dict[Any, Any]) -> Any:
    """The matrix, of that or of one σ each; None: not known."""
    given = data.get(_COVARIANCE)
    if given is None:
        return None
    numbers = np.array(_numbers(given, _COVARIANCE))
    rows = given.get("rows") if isinstance(given, dict) else len(np.atleast_1d(given))
    if isinstance(rows, int) and rows > 1 and rows * rows == len(numbers):
        return numbers.reshape(rows, rows).tolist()
    with np.errstate(over="ignore"):  # infinite ones are refused
        return np.diag(numbers**2).tolist()


def _imaged(data: dict[Any, Any], camera: Camera) -> Camera:
    """The camera of the images, by ROS's rules: the region, in calibrated pixels, then binning.

    0 means the whole picture and no binning. Source: sensor_msgs/CameraInfo.
    """
    region = data.get("roi")
    if isinstance(region, dict):
        keys = ("x_offset", "y_offset", "width", "height")
        x, y, width, height = (_whole(region, key, least=0) if key in region else 0 for key in keys)
        if x or y or width or height:
            camera = camera.cropped(x, y, width or camera.width - x, height or camera.height - y)
    elif region is not None:
        raise ValueError("roi: give x_offset, y_offset, width and height (pixels)")
    both = _whole(data, "binning", least=0) if "binning" in data else 1
    across, down = (
        _whole(data, key, least=0) if key in data else both for key in ("binning_x", "binning_y")
    )
    return camera.binned(across or 1, down or 1)


def _lens(data: dict[Any, Any]) -> tuple[tuple[float, ...], LensModel]:
    key = _find(data, _DISTORTION_KEYS)
    if key is None:
        _must_have_no_lens(data)
    values = [] if key is None or data[key] is None else _numbers(data[key], key)
    model = data.get("distortion_model")
    if data.get("fisheye_model") or model in _FISHEYES:
        while len(values) > 4 and values[-1] == 0.0:
            values.pop()
        if len(values) != 4:
            raise ValueError(
                f"{key or 'distortion_coefficients'}: {len(values)} coefficients; a fisheye has 4 "
                "(k1 k2 k3 k4)"
            )
        return tuple(values), LensModel.FISHEYE
    if model not in (None, "", "none", *_POLYNOMIALS) and any(values):
        raise ValueError(
            f"distortion_model: {model!r} is not supported: calibrate with plumb_bob, "
            "rational_polynomial or equidistant, or undistort the images first"
        )
    # OpenCV writes 12 or 14 numbers for some models, although their terms may be zero.
    while len(values) > 8 and values[-1] == 0.0:
        values.pop()
    if not any(values):
        return (), LensModel.OPENCV
    if len(values) not in (4, 5, 8) and not 8 < len(values) <= 14:
        raise ValueError(
            f"{key}: {len(values)} coefficients; expected 4, 5, 8, 12 or 14 "
            "(k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]])"
        )
    if len(values) > 8:  # zeros at the end were dropped
        values += [0.0] * ((12 if len(values) <= 12 else 14) - len(values))
    return tuple(values), LensModel.OPENCV


def _must_have_no_lens(data: dict[Any, Any]) -> None:
    """Refuses coefficients under a name that is not read: the camera would be a pinhole."""
    for key, value in data.items():
        if not _LIKE_DISTORTION.fullmatch(str(key)):
            continue
        try:
            numbers = _numbers(value, key)
        except ValueError:  # words, as of a model
            continue
        if any(numbers):
            raise ValueError(
                f"{key}: distortion under a name that is not read: give distCoeffs, a list of "
                "k1 k2 p1 p2 [k3 …]"
            )


def _find(data: dict[Any, Any], keys: tuple[str, ...]) -> str | None:
    return next((key for key in keys if key in data), None)


def _numbers(value: Any, key: str) -> list[float]:
    """The numbers of a list, nested or flat, or of a mapping with ``data``."""
    if isinstance(value, dict):
        value = value.get("data")
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{key}: must be a list of numbers") from error
    if value is None or not np.isfinite(array).all():
        raise ValueError(f"{key}: must be finite numbers")
    return [float(number) for number in array.ravel()]


def _positive(data: dict[Any, Any], key: str) -> float:
    value = number(data, key)
    if not value > 0.0:
        raise ValueError(f"{key}: must be positive, not {value}")
    return value


def _whole(data: dict[Any, Any], key: str, least: int = 1) -> int:
    value = number(data, key)
    if not value.is_integer() or value < least:
        kind = "positive whole number" if least else "whole number, 0 or more"
        raise ValueError(f"{key}: must be a {kind}, not {value:g}")
    return int(value)


def counted(data: dict[Any, Any], key: str, count: int) -> list[float]:
    """So many finite numbers of a key.

    Raises:
        ValueError: others.
    """
    values = _numbers(data[key], key)
    if len(values) != count:
        raise ValueError(f"{key}: has {len(values)} numbers, needs {count}")
    return values
