"""The compiled loops and the models of a worker process, and what is made of these for a camera."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

from numba.core.event import install_listener

from rendezview.cli.compiling import Compiling, load_ahead
from rendezview.geometry.camera import Camera
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview_service.messages.messages import CameraMessage
from rendezview_service.messages.wire import Header
from rendezview_service.tracker.tracking import camera_of

_SPARE_MODELS = 2  # that stay in memory without a session. Source: chosen
LOOPS, SENSOR_LOOPS = ("track", "hard"), ("sensors",)  # groups, as `load_ahead` has them


class Sight(NamedTuple):
    """What a recognizer is made for. Sessions with the same one share it: it takes 90 MB and 0.1 s
    with a model of 642 nodes, and keeps nothing of the frames."""

    model: Path  # its file, named by its hash
    camera: Camera
    trees: bool

    @classmethod
    def of(cls, asked: Header) -> Sight:
        """From a message with model_path, camera and trees.

        Raises:
            RendezviewError: the camera is wrong.
        """
        camera = camera_of(CameraMessage.model_validate(asked["camera"]))
        return cls(Path(asked["model_path"]), camera, asked["trees"])


class WorkerModels:
    """Models and recognizers, each made once and dropped when nobody needs it."""

    def __init__(self, tell: Callable[[int], None]) -> None:
        """None yet.

        Args:
            tell: receives the number of loops compiled so far.
        """
        self.compiled = 0  # number of loops; see `warm_up`
        self._tell = tell
        self._loaded: set[tuple[str, ...]] = set()  # groups of loops
        self._models: dict[Path, ViewModel] = {}
        self._recognizers: dict[Sight, Recognizer] = {}
        self._prepared: list[Sight] = []

    def load_loops(self, *, sensors: bool) -> None:
        """Load the loops of trackers, or compile them, once; and those of sessions' own sensors."""
        for groups in (LOOPS, SENSOR_LOOPS) if sensors else (LOOPS,):
            if groups not in self._loaded:
                self._loaded.add(groups)
                self.compiled += warm_up(groups, self._tell)

    def model(self, path: Path) -> ViewModel:
        """A model, read once; the file is named by its content."""
        if path not in self._models:
            used = {sight.model for sight in self._recognizers}
            for other in [p for p in self._models if p not in used][:-_SPARE_MODELS]:
                del self._models[other]
            self._models[path] = ViewModel.load(path)
            _give_back()
        return self._models[path]

    def recognizer(self, sight: Sight) -> Recognizer:
        """The recognizer of a model and a camera."""
        if sight not in self._recognizers:
            made = Recognizer(self.model(sight.model), sight.camera, trees=sight.trees)
            self._recognizers[sight] = made
        return self._recognizers[sight]

    def prepare(self, sights: list[Sight]) -> None:
        """Have these recognizers ready, until others are asked for."""
        self._prepared = sights
        for sight in sights:
            self.recognizer(sight)

    def keep(self, used: Collection[Sight]) -> None:
        """Drop the recognizers that are neither used nor prepared."""
        wanted = {*used, *self._prepared}
        kept = {s: r for s, r in self._recognizers.items() if s in wanted}
        if len(kept) < len(self._recognizers):
            self._recognizers = kept
            _give_back()


def _give_back() -> None:
    """Return freed memory to the system, which glibc keeps where it is between blocks in use.

    Measured: 185 of 529 MB after three recognizers of 642 nodes were dropped; it takes 10 ms.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # absent without glibc
    if trim is not None:
        trim(0)


def warm_up(groups: tuple[str, ...], tell: Callable[[int], None] = lambda count: None) -> int:
    """Load groups of loops from the cache; the number of those that it lacked and were compiled.

    Fresh loops may round differently from those of the cache: restart a process that had to
    compile before you record its poses.

    Args:
        tell: receives the number of loops compiled so far, after each.
    """
    compiled = 0

    def done() -> None:
        nonlocal compiled
        compiled += 1
        tell(compiled)

    with install_listener("numba:compile", Compiling(done=done)):
        load_ahead(*groups)
    return compiled
