"""One camera from pictures of a board: OpenCV's chessboard or its ChArUco board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.calibration.board import Chessboard, find_corners, pictures_of_a_camera
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.io.sequences.images import list_images

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
    """A camera with the covariance of its numbers."""

    camera: Camera  # with its covariance
    rms_px: float
    used: int
    given: int
    without: tuple[str, ...]  # pictures without a board

    def rows(self) -> Iterator[tuple[str, float, float]]:
        """Name, value and σ of every number."""
        c = self.camera
        values = (c.fx, c.fy, c.cx, c.cy, *c.distortion)
        assert c.sigma is not None
        yield from zip(_NAMES, values, c.sigma.tolist(), strict=True)


def calibrate_camera(
    pictures: Sequence[Path], board: Chessboard | CharucoBoard
) -> CameraCalibration:
    """Intrinsics and five lens terms by ``cv2.calibrateCamera``, and their covariance.

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
        points.append(found[0])
        corners.append(found[1])
    if size is None or len(points) < _FEWEST_VIEWS:
        raise RendezviewError(
            f"the board is in {len(points)} of {len(paths)} pictures, {_FEWEST_VIEWS} are needed: "
            "check --board, or take more pictures, tilted and up to the corners of the picture"
        )
    camera, rms = camera_of_corners(points, corners, size)
    return CameraCalibration(camera, rms, len(points), len(paths), tuple(without))


def camera_of_corners(
    points: Sequence[Array], corners: Sequence[Array], size: tuple[int, int]
) -> tuple[Camera, float]:
    """A camera with its covariance, and the r.m.s. residual, px.

    Args:
        points: (N, 3) of a board, m, for each view.
        corners: (N, 2) where they are in the picture, px.
        size: of the picture.
    """
    known = [np.asarray(each, np.float32) for each in points]
    seen = [np.asarray(each, np.float32) for each in corners]
    rms, matrix, lens, turns, places = cv2.calibrateCamera(
        known, seen, size, np.eye(3), np.zeros(5)
    )
    camera = Camera.from_matrix(matrix, size, np.ravel(lens)[:5].tolist())
    covariance = _covariance(known, seen, matrix, lens, turns, places)
    return replace(camera, covariance=covariance), float(rms)


def _covariance(
    points: Sequence[npt.NDArray[np.float32]], corners: Sequence[npt.NDArray[np.float32]],
    matrix: cv2.typing.MatLike, lens: cv2.typing.MatLike,
    turns: Sequence[cv2.typing.MatLike], places: Sequence[cv2.typing.MatLike],
) -> tuple[tuple[float, ...], ...]:  # fmt: skip
    """(9, 9) of fx fy cx cy k1 k2 p1 p2 k3; the boards' poses are unknown too."""
    count = len(lens.ravel()) + 4
    normal, squares, spare = np.zeros((count, count)), 0.0, -count
    for known, seen, turn, place in zip(points, corners, turns, places, strict=True):
        at, slopes = cv2.projectPoints(known, turn, place, matrix, lens)
        by_pose, by_camera = slopes[:, :6], slopes[:, 6 : 6 + count]
        residual = (seen - at.reshape(-1, 2)).ravel()
        # What the board's own pose cannot take up.
        left = by_camera - by_pose @ np.linalg.lstsq(by_pose, by_camera, rcond=None)[0]
        normal += left.T @ left
        squares += float(residual @ residual)
        spare += len(residual) - 6
    scale = np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    return tuple(tuple(row) for row in (squares / max(spare, 1) * inverse).tolist())


def _listed(pictures: Sequence[Path]) -> list[Path]:
    paths: list[Path] = []
    for path in pictures:
        if path.is_dir():
            paths += list_images(path)
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
