"""Compiles the loops of a session, or reads them from their cache, before its first frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba.core.event import Event, Listener, install_listener

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.sky import Sky
from rendezview_service.tracker.frame_sensors import warm_up as warm_up_frame_sensors
from rendezview_service.tracker.session_filter import warm_up as warm_up_filter
from rendezview_service.tracker.session_path import warm_up as warm_up_path
from rendezview_service.tracker.tracking import contour_at


class _Counted(Listener):
    """Counts the loops that are compiled."""

    def __init__(self, tell: Callable[[int], None]) -> None:
        self.count = 0
        self._tell = tell

    def on_start(self, event: Event) -> None:
        """A loop is being compiled."""

    def on_end(self, event: Event) -> None:
        """A loop is compiled."""
        self.count += 1
        self._tell(self.count)


def _untold(count: int) -> None:
    """Nobody is told of loops that are compiled."""


def warm_up(model: ViewModel, tell: Callable[[int], None] = _untold) -> int:
    """Compile the loops of tracker and filter, or read them from their cache, before a frame.

    A blob before a noisy sky, dark (without a prior) and bright (with one), runs them all, always
    in the same order. The order matters: it decides which compiled copy of a shared loop a process
    uses, and copies that were compiled separately may round differently. For the same reason,
    restart a process that had to compile before you record its poses.

    Args:
        tell: receives the number of loops compiled so far, after each.

    Returns:
        number of loops that were compiled rather than read from the cache.
    """
    camera = Camera.from_fov(320, 240, np.deg2rad(40.0))
    rng = np.random.default_rng(0)
    ahead = np.array([0.0, 0.0, 3.0 * model.sphere_radius_m])
    prior = Pose(np.eye(3), ahead - model.centre_m)
    recognizer = Recognizer(model, camera)
    counted = _Counted(tell)
    with install_listener("numba:compile", counted):
        for sky_grey in (0, 100):
            noise = rng.integers(sky_grey, sky_grey + 12, size=(240, 320), dtype=np.uint8)
            image = noise.copy()
            image[70:170, 110:220] = rng.integers(170, 250, size=(100, 110), dtype=np.uint8)
            recognizer.recognize(image, None if sky_grey == 0 else prior)
            if recognizer.search is not None:
                recognizer.search.at(image, Sky.of(image), Near(prior, np.pi, model.centre_m))
        contour_at(model, camera, prior)
        warm_up_filter()
    return counted.count


def warm_up_sensors(tell: Callable[[int], None] = _untold) -> int:
    """As `warm_up`, of the sensors that a session may read in its frames, and of its path."""
    rng = np.random.default_rng(0)
    counted = _Counted(tell)
    with install_listener("numba:compile", counted):
        warm_up_frame_sensors(Camera.from_fov(320, 240, np.deg2rad(40.0)), rng)
        warm_up_path(rng)
    return counted.count
