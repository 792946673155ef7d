"""The frames of a calibration: their poses, and their edges beside those of a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.calibration.as_built.deformation import Deformation
from rendezview.calibration.as_built.shape import Mounting, ShapeOptions
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.grey_frame import Picture, check_frame, shrunk
from rendezview.sensors.appearance.edges.contour_at import nearest_points
from rendezview.sensors.appearance.edges.measured import MeasuredEdges
from rendezview.sensors.appearance.edges.network import Sketch
from rendezview.sensors.appearance.edges.refinement import RefineOptions, Refiner
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.recognizer import Recognizer
from rendezview.sensors.appearance.search.levels import (
    FINEST_RADIUS_PX,
    shrunk_blur,
    times_smaller,
)
from rendezview.sensors.appearance.search.sketch_search import SketchSearch
from rendezview.sensors.appearance.sky import Sky

_LEAST_OF_REST = 20  # edges; fewer give no pose. Source: by construction, three times six unknowns
_UNKNOWN = 1e-6  # of the information, added: it can be solved for. Source: by construction
LEAST_RMS_PX = 1e-3  # px; no frame fits better. Source: by construction


@dataclass(slots=True, eq=False)
class PosedFrame:
    """One frame with the pose that is estimated with the shape."""

    index: int
    picture: Picture
    sky: Sky
    pose: Pose
    times: int  # the picture is so many times smaller than the frame
    sketch: Sketch | None  # its edges are the sketch's; None: grey edges

    def radius_px(self, camera: Camera, radius_m: float, depth_m: float) -> float:
        """The target's radius at a depth, pixels of what is measured."""
        scale = 1.0 / self.times if self.sketch is None else self.sketch.scale
        return camera.fx * scale * radius_m / depth_m


def posed(
    recognizer: Recognizer,
    frames: Sequence[Picture],
    priors: Sequence[Pose | None] | None,
    progress: Callable[[str], None],
) -> list[PosedFrame]:
    """The frames in which the recognizer gives a pose."""
    camera, model = recognizer.camera, recognizer.model
    used = []
    for k, image in enumerate(frames):
        frame = check_frame(image, camera)
        prior = None if priors is None else priors[k]
        seen = recognizer.recognize(frame, prior)
        if seen.pose is None:
            continue
        sketch = None
        if seen.found and seen.found.on_sketch and recognizer.sketch is not None:
            sketch = recognizer.sketch.closer_sketch(frame, seen.pose)
        range_m = float(np.linalg.norm(seen.pose.apply(model.centre_m)))
        times = times_smaller(camera, model.target_radius_m, range_m, FINEST_RADIUS_PX)
        picture = shrunk(frame, times) if times > 1 else frame
        used.append(PosedFrame(k, picture, Sky.of(picture), seen.pose, times, sketch))
        if (k + 1) % 20 == 0:
            progress(f"{k + 1} of {len(frames)} frames, {len(used)} with a pose")
    return used


def measured(
    frames: list[PosedFrame], model: ViewModel, camera: Camera, sketcher: SketchSearch | None
) -> list[MeasuredEdges | None]:
    """The edges of all frames at the poses that fit them best; the poses are kept."""
    refiners: dict[int, Refiner] = {}
    search = None
    found: list[MeasuredEdges | None] = []
    for frame in frames:
        if frame.times not in refiners:
            options = RefineOptions(blur_px=shrunk_blur(RefineOptions().blur_px, frame.times))
            refiners[frame.times] = Refiner(model, camera.binned(frame.times), options)
        refiner = refiners[frame.times]
        if frame.sketch is None:
            edges = refiner.measured(frame.picture, frame.sky, frame.pose)
        else:
            if search is None and sketcher is not None:
                search = sketcher.with_tables(model, refiner.views, camera)
            edges = None if search is None else search.measured(frame.sketch, frame.pose)
        if edges is not None:
            frame.pose = pose_of(edges.rotation, edges.centre_m, model)
        found.append(edges)
    return found


def mountings(
    edges_of_frames: Sequence[MeasuredEdges],
    model: ViewModel,
    shape: Deformation,
    covariance: Array,
    options: ShapeOptions,
) -> tuple[Mounting, ...]:
    """What is found of each part.

    Its trust is what an edge of it tells about the pose beside one of the rest of the craft: the
    share of edges that are found, by weight, over their mean square beside the pose that the rest
    has without it. So a part that moves from frame to frame has little, although the pose of all
    edges follows it.

    Args:
        edges_of_frames: of the frames that count, measured with the shape.
        model: as it was.
        covariance: (U, U) of the shape.
    """
    squares = np.zeros(len(shape.parts) + 1)  # the rest of the craft stands last
    expected, weights, counts, looked_for = (np.zeros_like(squares) for _ in range(4))
    for edges in edges_of_frames:
        of = shape.members(edges, model.target_radius_m)
        beside, spread = _beside_rest(edges, of)
        if beside is None:
            continue
        sigma2 = max(edges.residual_rms_px, LEAST_RMS_PX) ** 2
        np.add.at(squares, of, edges.weight * beside**2 / sigma2)
        np.add.at(expected, of, edges.weight * spread)
        np.add.at(weights, of, edges.weight)
        np.add.at(counts, of, 1.0)
        np.add.at(looked_for, _of_nearest_view(edges, model, shape), 1.0)
    shares = weights * expected / np.maximum(looked_for * squares, 1e-12)
    found = []
    for k, part in enumerate(shape.parts):
        own, trust = shape.of_part(k), 1.0
        if looked_for[k] >= options.least_edges:
            ratio = float(shares[k] / shares[-1])
            trust = 1.0 if ratio > options.whole_trust else ratio
        found.append(Mounting(part.name, part.motion, covariance[own, own], trust, int(counts[k])))
    return tuple(found)


def _beside_rest(edges: MeasuredEdges, of: npt.NDArray[np.intp]) -> tuple[Array | None, Array]:
    """(N,) residuals beside the pose that the edges of no part have, px, and their variance there.

    The variance is that of an edge of unit weight: of the edge itself and of that pose. None: too
    few edges are of no part.
    """
    slopes = edges.pose_slopes
    rest = np.where(of < 0, edges.weight, 0.0)
    if np.count_nonzero(rest) < _LEAST_OF_REST:
        return None, np.ones(len(rest))
    scale = np.sqrt(np.maximum(np.einsum("n,ni,ni->i", rest, slopes, slopes), 1e-300))
    unit = slopes / scale  # radians and metres alike
    own = (unit * rest[:, None]).T @ unit + _UNKNOWN * np.eye(6)
    move = np.linalg.solve(own, unit.T @ (rest * edges.residual_px))
    leverage = np.einsum("ni,ij,nj->n", unit, np.linalg.inv(own), unit)
    mean_weight = rest.sum() / np.count_nonzero(rest)
    spread = np.where(
        of < 0, np.maximum(1.0 - mean_weight * leverage, 0.05), 1.0 + mean_weight * leverage
    )
    return edges.residual_px - unit @ move, spread


def _of_nearest_view(
    edges: MeasuredEdges, model: ViewModel, shape: Deformation
) -> npt.NDArray[np.intp]:
    """(N,) which part each contour point of the view nearest to a pose is of; −1: of none."""
    contours = model.contours
    assert contours is not None
    pose = pose_of(edges.rotation, edges.centre_m, model)
    _, points = nearest_points(model, contours, pose)
    of = np.full(len(points), -1, dtype=np.intp)
    for k, part in enumerate(shape.parts):
        of[part.holds(points) & (of < 0)] = k
    return of


def pose_of(rotation: Array, centre_m: Array, model: ViewModel) -> Pose:
    """camera_from_target, from where the view centre is."""
    return Pose(rotation, centre_m - rotation @ model.centre_m)
