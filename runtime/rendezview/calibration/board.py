"""Ordinary cameras from pictures of a chessboard, and OpenCV's own words for a rig."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.calibration.bundle import Adjusted, Bundle, Observations, adjust
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import StrPath
from rendezview.io.sequences.images import read_grey
from rendezview.sensors.beacons.detect.brown_lens import Lens
from rendezview.sensors.beacons.rig import Rig, RigCamera

OPENCV_FIVE = ("fx", "fy", "cx", "cy", "l1", "l2", "l3", "p1", "p2")  # as cv2.calibrateCamera
_FEWEST_VIEWS = 3  # Source: Zhang 2000, three views for all intrinsics
# half-width; a wider one takes in the neighbouring corners of small squares. Source: by hand,
# stereo-calibration (0.1) --part pictures
_WINDOW_PX = 5
# cells of a picture, across and down, in which an error of the lens model is about the same.
# Source: by construction, a lens of nine numbers has no finer errors, and a dozen boards fill them
_CELLS = (6, 4)
_FLAT_M = 1e-9  # m; points that differ less along z lie in a plane. Source: by construction
_CORNER_PX = 1.0  # initial σ; the residuals give the true one. Source: by construction


@dataclass(frozen=True, slots=True)
class Chessboard:
    """Inner corners and their pitch."""

    columns: int
    rows: int
    pitch_m: float

    @property
    def points_m(self) -> Array:
        """(columns × rows, 3) corners, row by row, z = 0."""
        grid = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2)
        return np.column_stack([grid * self.pitch_m, np.zeros(len(grid))])


@dataclass(frozen=True, slots=True, eq=False)
class BoardViews:
    """Corners that cameras saw of one board at several places."""

    board: Chessboard
    names: tuple[str, ...]  # of the cameras
    sizes: tuple[tuple[int, int], ...]  # width, height in px
    corners: tuple[tuple[Array | None, ...], ...]  # [camera][view] (N, 2) px


def read_board_views(
    folders: Sequence[tuple[str, Sequence[StrPath]]], board: Chessboard
) -> BoardViews:
    """Find the board in every picture; equal indices are equal moments.

    Raises:
        RendezviewError: a picture cannot be read or differs in size, or no board in any.
    """
    sizes, corners = [], []
    for name, paths in folders:
        size: tuple[int, int] | None = None
        found: list[Array | None] = []
        for grey in pictures_of_a_camera(paths):
            size = (grey.shape[1], grey.shape[0])
            found.append(find_corners(grey, board))
        if size is None or sum(view is not None for view in found) < _FEWEST_VIEWS:
            raise RendezviewError(
                f"camera {name!r}: the board with {board.columns} × {board.rows} inner corners is "
                f"in {sum(view is not None for view in found)} of {len(found)} pictures, "
                f"{_FEWEST_VIEWS} are needed: check --board"
            )
        sizes.append(size)
        corners.append(tuple(found))
    return BoardViews(board, tuple(name for name, _ in folders), tuple(sizes), tuple(corners))


def pictures_of_a_camera(paths: Iterable[StrPath]) -> Iterator[npt.NDArray[np.uint8]]:
    """The pictures (H, W) of files, which must all be of one size.

    Raises:
        RendezviewError: a picture cannot be read or differs in size.
    """
    first: tuple[int, ...] | None = None
    for path in paths:
        grey = read_grey(Path(path))
        first = first or grey.shape
        if grey.shape != first:
            raise RendezviewError(
                f"{path}: is {grey.shape[1]} × {grey.shape[0]} pixels, the others are "
                f"{first[1]} × {first[0]}: give pictures of one camera"
            )
        yield grey


def find_corners(grey: npt.NDArray[np.uint8], board: Chessboard) -> Array | None:
    """(N, 2) sub-pixel corners of a chessboard; ``None`` where it is not completely visible."""
    shape = (board.columns, board.rows)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    ok, corners = cv2.findChessboardCorners(grey, shape, flags=flags)
    if not ok:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    refined = cv2.cornerSubPix(grey, corners, (_WINDOW_PX, _WINDOW_PX), (-1, -1), criteria)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class BoardCalibration:
    """A rig from a board, with the steps on the way."""

    rig: Rig
    separate: tuple[Adjusted, ...]  # each camera by itself
    together: Adjusted  # all at once


def calibrate_board(
    views: BoardViews, *, free: tuple[str, ...] = OPENCV_FIVE, corrects: bool = False
) -> BoardCalibration:
    """Cameras, lenses and their places from a board; the rig frame is the first camera's.

    Args:
        views: the views of the board; a moment that only one camera sees counts for that camera.
        free: which intrinsics to adjust, from `rendezview.calibration.bundle.INTRINSICS`, or "f"
            for one focal length instead of "fx" and "fy".
        corrects: the lens in the paper's sense (measured to ideal) in place of OpenCV's.

    Raises:
        RendezviewError: too few views, or views that do not determine the parameters.
    """
    points = views.board.points_m
    separate = tuple(
        _calibrated_alone(views, k, points, free, corrects) for k in range(len(views.names))
    )
    cameras, poses = _joined(views, separate)
    used = [v for v, pose in enumerate(poses) if pose is not None]
    bundle = Bundle(
        cameras, tuple(poses[v] for v in used), points, (free,) * len(cameras),  # type: ignore[misc]
        (False, *([True] * (len(cameras) - 1))), (True,) * len(used),
    )  # fmt: skip
    seen = _observations(views, range(len(cameras)), used)
    together = adjust(bundle, seen).scaled()
    rig = rig_of(together)
    shares = [
        misfit(seen.positions[seen.camera == k], together.residuals[together.camera == k], size)
        for k, size in enumerate(views.sizes)
    ]
    found = tuple(replace(c, misfit=m) for c, m in zip(rig.cameras, shares, strict=True))
    return BoardCalibration(replace(rig, cameras=found), separate, together)


def misfit(positions: Array, residuals: Array, size: tuple[int, int]) -> float:
    """What a lens model leaves, r.m.s. an axis: the part of the residuals that neighbours share.

    Noise of the corners averages out in a cell of the picture, an error of the lens model does not.
    What chance would leave of the noise is taken off, and one σ of that chance is added.

    Args:
        positions, residuals: (M, 2) of the corners, px.
        size: of the picture, px.
    """
    cell = np.clip(np.floor(positions / size * _CELLS).astype(int), 0, np.subtract(_CELLS, 1))
    number = cell[:, 0] + _CELLS[0] * cell[:, 1]
    count = np.bincount(number, minlength=_CELLS[0] * _CELLS[1])
    some = count > 1
    sums = np.column_stack([np.bincount(number, r, minlength=len(count)) for r in residuals.T])
    means = sums[some] / count[some, None]
    within = residuals - (sums / np.maximum(count, 1)[:, None])[number]
    spare = float(count[some].sum() - some.sum())
    if spare < 1.0:
        return float(np.sqrt((residuals**2).mean()))
    noise = float((within[some[number]] ** 2).sum()) / (2.0 * spare)  # variance an axis
    share = count[some] / count[some].sum()
    shared = float(share @ (means**2).mean(axis=1)) - noise * float(share @ (1.0 / count[some]))
    chance = noise * math.sqrt(float((share**2 / count[some] ** 2).sum()))
    return math.sqrt(max(shared, 0.0) + chance)


def rig_of(adjusted: Adjusted) -> Rig:
    """The rig of an adjusted bundle: each camera with its σ and residual."""
    cameras = []
    for k, camera in enumerate(adjusted.bundle.cameras):
        prefix = f"{camera.name}."
        sigma = {
            name.removeprefix(prefix): value
            for name, value in adjusted.sigma.items()
            if name.startswith(prefix)
        }
        rms = float(np.sqrt((adjusted.residuals[adjusted.camera == k] ** 2).mean()))
        # With a picture camera the whole residual is the floor of a spot, for the tests of spots:
        # they also have to allow for errors of the calibration. `misfit` is what is not noise.
        floor = rms if camera.photodiode is None else camera.floor
        cameras.append(replace(camera, sigma=sigma, rms=rms, floor=floor))
    kept = [i for i, name in enumerate(adjusted.names) if not name.startswith(("view", "point"))]
    return Rig(
        tuple(cameras), adjusted.covariance[np.ix_(kept, kept)],
        tuple(adjusted.names[i] for i in kept),
    )  # fmt: skip


def _observations(views: BoardViews, cameras: Sequence[int], used: Sequence[int]) -> Observations:
    return Observations.joined(
        (i, j, np.arange(len(corners)), corners, np.full(corners.shape, _CORNER_PX), None)
        for i, k in enumerate(cameras)
        for j, v in enumerate(used)
        if (corners := views.corners[k][v]) is not None
    )


def _calibrated_alone(
    views: BoardViews, k: int, points: Array, free: tuple[str, ...], corrects: bool
) -> Adjusted:
    """One camera by itself: its rig frame is its own."""
    used = [v for v, corners in enumerate(views.corners[k]) if corners is not None]
    corners = [np.asarray(views.corners[k][v], dtype=np.float32) for v in used]
    boards = [points.astype(np.float32)] * len(used)
    matrix = cv2.initCameraMatrix2D(boards, corners, views.sizes[k])
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
        raise RendezviewError(
            f"camera {views.names[k]!r}: the views do not give a focal length: tilt the board more"
        )
    focal = 0.5 * (matrix[0, 0] + matrix[1, 1])
    camera = RigCamera(
        views.names[k], focal, focal, float(matrix[0, 2]), float(matrix[1, 2]), Pose.identity(),
        Lens(corrects=corrects), views.sizes[k],
    )  # fmt: skip
    poses = tuple(_board_pose(camera, points, np.asarray(found)) for found in corners)
    bundle = Bundle((camera,), poses, points, (free,), (False,), (True,) * len(used))
    return adjust(bundle, _observations(views, [k], used)).scaled()


def _board_pose(camera: RigCamera, points: Array, corners: Array) -> Pose:
    """camera_from_board of one view, lens left aside."""
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    pose = pose_of_points(points, corners.astype(np.float64), matrix)
    if pose is None:
        raise RendezviewError("a view of the board gives no pose: check --board and its pictures")
    return pose


def pose_of_points(points: Array, seen: Array, matrix: Array) -> Pose | None:
    """camera_from_points of points (N, 3) seen at (N, 2), by OpenCV: in a plane z = 0, or not."""
    flag = cv2.SOLVEPNP_IPPE if np.ptp(points[:, 2]) < _FLAT_M else cv2.SOLVEPNP_SQPNP
    ok, turn, place = cv2.solvePnP(points, seen, matrix, None, flags=flag)
    if not ok:
        return None
    return Pose(
        np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.asarray(place.ravel(), np.float64)
    )


def _joined(
    views: BoardViews, separate: tuple[Adjusted, ...]
) -> tuple[tuple[RigCamera, ...], list[Pose | None]]:
    """Cameras in the first one's frame, and rig_from_board of every visible view."""
    by_view: list[dict[int, Pose]] = []
    for k, one in enumerate(separate):
        used = [v for v, corners in enumerate(views.corners[k]) if corners is not None]
        by_view.append(dict(zip(used, one.bundle.views, strict=True)))
    cameras = [separate[0].bundle.cameras[0]]
    for k in range(1, len(separate)):
        both = sorted(set(by_view[0]) & set(by_view[k]))
        if not both:
            raise RendezviewError(
                f"cameras {views.names[0]!r} and {views.names[k]!r} never see the board together"
            )
        relative = [by_view[k][v] @ by_view[0][v].inverse() for v in both]
        middle = np.argmin(
            [sum(a.angle_to(b) for b in relative) for a in relative]
        )  # the medoid: one bad view does no harm
        cameras.append(
            replace(separate[k].bundle.cameras[0], camera_from_rig=relative[int(middle)])
        )
    poses: list[Pose | None] = []
    for v in range(len(views.corners[0])):
        pose = None
        for k, camera in enumerate(cameras):
            if v in by_view[k]:
                pose = camera.camera_from_rig.inverse() @ by_view[k][v]
                break
        poses.append(pose)
    return tuple(cameras), poses
