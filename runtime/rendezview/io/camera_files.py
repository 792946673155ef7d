"""Camera files of OpenCV, ROS, BOP and SPEED.

The content of a file decides its kind, not its name:

- OpenCV YAML, XML or JSON: ``camera_matrix`` and ``distortion_coefficients`` with
  ``image_width`` and ``image_height``; also ``cameraMatrix``/``distCoeffs``, ``K``/``D``
  and ``M1``/``D1`` (the left camera of a stereo calibration).
- ROS ``CameraInfo`` YAML, as a calibration file or as a printed message; lens models
  ``plumb_bob`` and ``rational_polynomial``.
- BOP ``camera.json``: ``fx fy cx cy width height``, and ``distCoeffs`` in our own files.
- SPEED ``camera.json``: ``fx``, ``fy`` in metres, pixel pitch ``ppx``, ``ppy`` in metres, size
  ``Nu`` × ``Nv``; SPEED+ also has ``cameraMatrix`` and ``distCoeffs``, which take precedence.

SPEED's principal point is (Nu/2, Nv/2), as in its own projection code and in
SPEED+'s ``cameraMatrix``. Both are used unchanged: SPEED+'s matrix is for OpenCV, whose pixel (0,
0) is the centre of a pixel, as here, and SPEED draws its axes over the picture in that convention.
Measured from the corner of the picture, it would be half a pixel less: 0.2 mrad for its lens of
3000 px.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.calibration_yaml import parse_yaml
from rendezview.io.files import StrPath, atomic_write_text, parse_json, read_text

_MATRIX_KEYS = (
    "camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "M1", "M", "intrinsic_matrix",
)  # fmt: skip
_DISTORTION_KEYS = (
    "distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D", "d",
    "D1", "distortion",
)  # fmt: skip
_WIDTH_KEYS = ("image_width", "image_Width", "imageWidth", "width", "Nu")
_HEIGHT_KEYS = ("image_height", "image_Height", "imageHeight", "height", "Nv")
_LENS_MODELS = ("plumb_bob", "rational_polynomial")
_LIMIT_BYTES = 4_000_000  # a video given by mistake is not read whole. Source: a chosen limit


class Intrinsics(NamedTuple):
    """The fields of `rendezview.geometry.camera.Camera`, in order, not validated."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]


def load_camera(path: StrPath) -> Camera:
    """Read a camera file; its content decides its kind.

    OpenCV YAML, XML and JSON; ROS ``CameraInfo`` YAML; SPEED and SPEED+ ``camera.json``; BOP
    ``camera.json``.

    Raises:
        RendezviewError: missing, not a camera file, an unknown lens model, or
            impossible numbers.
    """
    try:
        return Camera(*read_intrinsics(path))
    except ValueError as error:
        raise RendezviewError(f"{path}: {error}: correct the camera file") from error


def save_camera(camera: Camera, path: StrPath) -> None:
    """Write an OpenCV YAML file that `load_camera` and ``cv2.FileStorage`` read, atomically."""
    text = intrinsics_to_opencv_yaml(camera.width, camera.height, camera.matrix, camera.distortion)
    atomic_write_text(path, text)


def read_intrinsics(path: StrPath) -> Intrinsics:
    """The intrinsics in a camera file of any kind above.

    Raises:
        RendezviewError: missing, not a camera file, or of an unknown lens model.
    """
    text = read_text(path, "a camera file", limit_bytes=_LIMIT_BYTES)
    data = _parse(text, str(path))
    if not isinstance(data, dict):
        raise RendezviewError(
            f"{path}: not a camera file (no keys in it): give an OpenCV or ROS YAML file, "
            f"or a BOP or SPEED camera.json"
        )
    return intrinsics_of(data, str(path))


def intrinsics_of(data: dict[Any, Any], where: str) -> Intrinsics:
    """The intrinsics in the content of a camera file or of a recorded message.

    Raises:
        RendezviewError: not those of a camera, or of an unknown lens model.
    """
    try:
        return _interpret(data)
    except ValueError as error:
        raise RendezviewError(f"{where}: {error}") from error


def intrinsics_to_opencv_yaml(
    width: int, height: int, matrix: npt.ArrayLike, distortion: tuple[float, ...]
) -> str:
    """The text of an OpenCV YAML camera file; every number keeps its full precision."""
    coefficients = distortion or (0.0,) * 5  # OpenCV's readers require some
    return (
        "%YAML:1.0\n---\n"
        f"image_width: {width}\n"
        f"image_height: {height}\n"
        f"camera_matrix: {_opencv_matrix(np.asarray(matrix))}"
        f"distortion_coefficients: {_opencv_matrix(np.atleast_2d(coefficients))}"
    )


def _opencv_matrix(matrix: npt.NDArray[Any]) -> str:
    rows, cols = matrix.shape
    numbers = ", ".join(repr(float(value)) for value in matrix.ravel())
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {numbers} ]\n"


def _parse(text: str, where: str) -> Any:
    start = text.lstrip()[:1]
    if start == "{":
        return parse_json(text, where)
    if start == "<":
        try:
            return _xml_value(ElementTree.fromstring(text))
        except (ElementTree.ParseError, ValueError) as error:
            raise RendezviewError(
                f"{where}: not valid XML ({error}): correct or replace the camera file"
            ) from error
    try:
        return parse_yaml(text)
    except (ValueError, RecursionError) as error:
        raise RendezviewError(
            f"{where}: not a camera file that can be read ({error}): "
            f"give an OpenCV or ROS YAML file, or a BOP or SPEED camera.json"
        ) from error


def _xml_value(element: ElementTree.Element) -> Any:
    """Children as a dict; text as numbers if all of it is numbers, else unchanged."""
    if len(element):
        return {child.tag: _xml_value(child) for child in element}
    text = (element.text or "").strip()
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return text
    return numbers[0] if len(numbers) == 1 else numbers


def _interpret(data: dict[Any, Any]) -> Intrinsics:
    size_keys = _find(data, _WIDTH_KEYS), _find(data, _HEIGHT_KEYS)
    matrix_key = _find(data, _MATRIX_KEYS)
    if matrix_key is not None:
        matrix = _numbers(data[matrix_key], matrix_key)
        if len(matrix) != 9:
            raise ValueError(
                f"{matrix_key}: has {len(matrix)} numbers, needs the 9 of a 3 × 3 matrix: "
                f"correct the file"
            )
        fx, skew, cx, below, fy, cy, *last = matrix
        if abs(skew) > 1e-6 * abs(fx) or below != 0.0 or last != [0.0, 0.0, 1.0]:
            raise ValueError(
                f"{matrix_key}: must be [fx 0 cx; 0 fy cy; 0 0 1] (no skew), not {matrix}: "
                f"calibrate without skew"
            )
    elif "ppx" in data or "ppy" in data:
        fx = _number(data, "fx") / _positive(data, "ppx")
        fy = _number(data, "fy") / _positive(data, "ppy")
        cx, cy = _number(data, "Nu") / 2.0, _number(data, "Nv") / 2.0
    elif "fx" in data:
        fx, fy, cx, cy = (_number(data, key) for key in ("fx", "fy", "cx", "cy"))
    else:
        raise ValueError(
            "no camera matrix in it (looked for camera_matrix, cameraMatrix, K, M1 and fx): "
            "give an OpenCV or ROS YAML file, or a BOP or SPEED camera.json"
        )
    if size_keys[0] is None or size_keys[1] is None:
        raise ValueError(
            "the image size is missing: add image_width and image_height (pixels) to the file"
        )
    width, height = (_whole(data, key) for key in size_keys if key is not None)
    return Intrinsics(width, height, fx, fy, cx, cy, _distortion(data))


def _distortion(data: dict[Any, Any]) -> tuple[float, ...]:
    key = _find(data, _DISTORTION_KEYS)
    values = [] if key is None or data[key] is None else _numbers(data[key], key)
    model = data.get("distortion_model")
    if model not in (None, "", *_LENS_MODELS) and any(values):
        raise ValueError(
            f"distortion_model: {model!r} is not supported: calibrate with "
            f"{' or '.join(_LENS_MODELS)}, or undistort the images first"
        )
    # OpenCV writes 12 or 14 numbers for some models, although their terms may be zero.
    while len(values) > 8 and values[-1] == 0.0:
        values.pop()
    if len(values) > 8:
        raise ValueError(
            f"{key}: {len(values)} coefficients; thin-prism and tilt terms are not supported: "
            f"calibrate with at most 8"
        )
    if not any(values):
        return ()
    if len(values) not in (4, 5, 8):
        raise ValueError(
            f"{key}: {len(values)} coefficients; expected 4, 5 or 8 (k1 k2 p1 p2 [k3 [k4 k5 k6]])"
        )
    return tuple(values)


def _find(data: dict[Any, Any], keys: tuple[str, ...]) -> str | None:
    return next((key for key in keys if key in data), None)


def _numbers(value: Any, key: str) -> list[float]:
    """The numbers of a list, nested or flat, or of a mapping with ``data``."""
    if isinstance(value, dict):
        value = value.get("data")
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{key}: must be a list of numbers: correct the file") from error
    if value is None or not np.isfinite(array).all():
        raise ValueError(f"{key}: must be finite numbers: correct the file")
    return [float(number) for number in array.ravel()]


def _number(data: dict[Any, Any], key: str) -> float:
    value = data.get(key)
    if key not in data:
        raise ValueError(f"{key}: missing: add it to the file")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key}: must be a number, not {value!r}: correct the file")
    return float(value)


def _positive(data: dict[Any, Any], key: str) -> float:
    value = _number(data, key)
    if not value > 0.0:
        raise ValueError(f"{key}: must be positive, not {value}: correct the file")
    return value


def _whole(data: dict[Any, Any], key: str) -> int:
    value = _number(data, key)
    if not value.is_integer() or value <= 0:
        raise ValueError(f"{key}: must be a positive whole number of pixels, not {value}")
    return int(value)
