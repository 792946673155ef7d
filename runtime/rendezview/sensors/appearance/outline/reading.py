"""What is read in the outline of a frame: the silhouette, its signature, the active nodes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.outline.silhouette import Silhouette


@dataclass(frozen=True, slots=True, eq=False)
class OutlineReading:
    """The silhouette of a frame and the nodes that it makes active."""

    silhouette: Silhouette | None = None
    signature: Signature | None = None
    active_nodes: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    weights: Array = field(default_factory=lambda: np.zeros(0))  # (K,) trust in each active node
    # (K, 3) m, target frame: where each active node puts the camera; none without a pose
    points_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    # Where views between the nodes put the camera (J, 3), and weights (J,). It takes a
    # millisecond, so it is computed when the cloud is asked for.
    interpolated: Callable[[], tuple[Array, Array]] | None = None


class LateReading:
    """A reading that is made when it is first asked for: a pose by edges does not need it."""

    def __init__(self, make: Callable[[], OutlineReading]) -> None:
        """``make`` is called once at most, by whichever thread asks first."""
        self._make: Callable[[], OutlineReading] | None = make
        self._made = OutlineReading()
        self._lock = threading.Lock()

    def __call__(self) -> OutlineReading:
        """The reading."""
        with self._lock:
            if self._make is not None:
                self._made = self._make()
                self._make = None  # and the picture that it holds
        return self._made
