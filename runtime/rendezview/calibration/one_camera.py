"""One camera from pictures of a board: OpenCV's chessboard or its ChArUco board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.calibration.board import Chessboard, find_corners, pictures_of_a_camera
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array

_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
_FEWEST_VIEWS = 5  # Source: OpenCV's calibration tutorial asks for ten; five determine it
_FEWEST_CORNERS = 8  # of a view of a ChArUco board. Source: by construction, twice those of a pose
_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, slots=True)
class CharucoBoard:
    """A chessboard with markers in its white squares, as OpenCV prints it."""

    columns: int  # squares
    rows: int
    pitch_m: float
    marker_m: float
    dictionary: str = "DICT_4X4_50"

    def detector(self) -> cv2.aruco.CharucoDetector:
        """OpenCV's detector of it.

        Raises:
            RendezviewError: no such dictionary, or markers larger than squares.
        """
        number = getattr(cv2.aruco, self.dictionary, None)
        if not self.dictionary.startswith("DICT_") or number is None:
            raise RendezviewError(
                f"--dictionary: OpenCV has no {self.dictionary!r}: give one like DICT_4X4_50"
            )
        if not self.marker_m < self.pitch_m:
            raise RendezviewError("--marker-mm must be smaller than --pitch-mm")
        markers = cv2.aruco.getPredefinedDictionary(number)
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.pitch_m, self.marker_m, markers
        )
        return cv2.aruco.CharucoDetector(board)


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera with the σ of its numbers."""

    camera: Camera
    sigma: Array  # (9,) of fx fy cx cy k1 k2 p1 p2 k3
    rms_px: float
    used: int
    given: int
    without: tuple[str, ...]  # pictures without a board

    def rows(self) -> Iterator[tuple[str, float, float]]:
        """Name, value and σ of every number."""
        c = self.camera
        values = (c.fx, c.fy, c.cx, c.cy, *c.distortion)
        yield from zip(_NAMES, values, self.sigma.tolist(), strict=True)


def calibrate_camera(
    pictures: Sequence[Path], board: Chessboard | CharucoBoard
) -> CameraCalibration:
    """Intrinsics and five lens terms by ``cv2.calibrateCameraExtended``.

    Raises:
        RendezviewError: pictures that cannot be read or differ in size, or too few boards.
    """
    paths = _listed(pictures)
    detector = board.detector() if isinstance(board, CharucoBoard) else None
    size: tuple[int, int] | None = None
    points, corners, without = [], [], []
    for path, grey in zip(paths, pictures_of_a_camera(paths), strict=True):
        size = (grey.shape[1], grey.shape[0])
        found = _seen(grey, board, detector)
        if found is None:
            without.append(path.name)
            continue
        points.append(found[0].astype(np.float32))
        corners.append(found[1].astype(np.float32))
    if size is None or len(points) < _FEWEST_VIEWS:
        raise RendezviewError(
            f"the board is in {len(points)} of {len(paths)} pictures, {_FEWEST_VIEWS} are needed: "
            "check --board, or take more pictures, tilted and up to the corners of the picture"
        )
    rms, matrix, lens, _, _, sigma, *_ = cv2.calibrateCameraExtended(
        points, corners, size, np.eye(3), np.zeros(5)
    )
    terms = tuple(float(term) for term in np.ravel(lens)[:5])
    camera = Camera(*size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], terms)
    order = np.ravel(sigma)[:9]
    return CameraCalibration(
        camera, np.asarray(order, np.float64), float(rms), len(points), len(paths), tuple(without)
    )


def _listed(pictures: Sequence[Path]) -> list[Path]:
    paths: list[Path] = []
    for path in pictures:
        if path.is_dir():
            paths += sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES)
        else:
            paths.append(path)
    if not paths:
        raise RendezviewError("no pictures of a board: name them, or their folder")
    return paths


def _seen(
    grey: npt.NDArray[np.uint8],
    board: Chessboard | CharucoBoard,
    detector: cv2.aruco.CharucoDetector | None,
) -> tuple[Array, Array] | None:
    """Points (N, 3) of the board and their corners (N, 2); None where there is no board."""
    if isinstance(board, Chessboard):
        corners = find_corners(grey, board)
        return None if corners is None else (board.points_m, corners)
    assert detector is not None
    found, numbers, _, _ = detector.detectBoard(grey)
    if numbers is None or len(numbers) < _FEWEST_CORNERS:
        return None
    all_ = np.asarray(detector.getBoard().getChessboardCorners(), np.float64)
    return all_[np.ravel(numbers)], np.asarray(found, np.float64).reshape(-1, 2)
