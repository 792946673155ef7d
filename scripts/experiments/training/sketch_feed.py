"""Batches for the sketch network, made by processes that draw and photograph without end.

Each process keeps a pool of drawings. It takes photographs of them, and after every few it replaces
the oldest drawing with a new one, so that no two batches are alike and few pictures share a craft.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from rendezview.geometry.zbuffer import Float32s
from rendezview.sensors.appearance.edges.network import SIDE_PX
from rendezview.sensors.appearance.model.sketches import MAPS
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import sketch_frames
from rendezview_ground.simulate.cluttered_rooms import INDOORS, crowded, room
from rendezview_ground.simulate.random_craft import any_craft
from rendezview_ground.simulate.random_objects import random_object
from rendezview_ground.simulate.random_textures import random_texture

LARGE = 2  # times SIDE_PX: the side of larger pictures, as those of a closer pass
LARGE_SHARE = 0.35  # of the batches
OBJECT_SHARE = 0.18  # of the targets are everyday objects, the others craft
TEXTURED_SHARE, PRINTED_SHARE = 0.6, 0.05  # of objects and of craft have a texture
INDOORS_SHARE, LABORATORY_SHARE = 0.85, 0.05  # of objects and of craft are in rooms
CROWDED_SHARE, ALONE_SHARE = 0.5, 0.06  # of objects and of craft have other bodies around them
MOST_OTHERS = 2
POOL, LEAST_POOL = 160, 16  # drawings of SIDE_PX; there are a quarter as many large ones
DRAWINGS_A_BACKGROUND = 3
AHEAD = 3  # batches for each process
MOST_S = 600.0  # s, for the next batch; with more, the processes hang

Grey = npt.NDArray[np.float16]  # (N, S, S) grey levels
Maps = npt.NDArray[np.uint8]  # (N, MAPS, S, S) of ``sketch_maps``, 0 … 255


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What is photographed, and whether it stands in a room."""

    drawing: sketch_frames.CraftDrawing
    indoors: bool


class Pool:
    """Drawings and backgrounds; a new drawing pushes the oldest out."""

    def __init__(self, rng: np.random.Generator, reuse: float) -> None:
        """``reuse``: photographs that are taken of each drawing, on average."""
        self.rng, self._reuse = rng, reuse
        self._targets = {
            1: deque[Target](maxlen=POOL), LARGE: deque[Target](maxlen=POOL // LARGE**2)
        }  # fmt: skip
        self._due = dict.fromkeys(self._targets, 0.0)  # photographs without a new drawing
        self._skies, self._rooms = deque[Float32s](maxlen=POOL), deque[Float32s](maxlen=POOL)
        self._mesh: Mesh | None = None
        self._is_object, self._drawn = False, 0

    def photographs(self, count: int, larger: int) -> tuple[Grey, Maps]:
        """Photographs of any of the drawings, ``larger`` times SIDE_PX large."""
        targets, side = self._targets[larger], larger * SIDE_PX
        least = LEAST_POOL // larger**2
        while len(targets) < least or self._due[larger] >= self._reuse:
            self._due[larger] -= self._reuse if len(targets) >= least else 0.0
            targets.append(self._new(side, targets))
        self._due[larger] += count
        pictures = np.empty((count, side, side), np.float16)
        maps = np.empty((count, MAPS, side, side), np.uint8)
        for k in range(count):
            target = targets[self.rng.integers(len(targets))]
            behind = self._rooms if target.indoors else self._skies
            sky = behind[self.rng.integers(len(behind))]
            options = INDOORS if target.indoors else None
            pictures[k], drawn = sketch_frames.take(target.drawing, sky, self.rng, options)
            maps[k] = np.rint(255.0 * drawn)
        return pictures, maps

    def _new(self, side: int, around: deque[Target]) -> Target:
        rng = self.rng
        if self._drawn % DRAWINGS_A_BACKGROUND == 0:
            self._skies.append(sketch_frames.draw_sky(rng))
            self._rooms.append(room(sketch_frames.SKY_PX, rng))
        if self._mesh is None or self._drawn % sketch_frames.DRAWINGS == 0:
            self._is_object = bool(rng.random() < OBJECT_SHARE)
            self._mesh = random_object(rng) if self._is_object else any_craft(rng)
        self._drawn += 1
        printed, indoors, others = (
            bool(rng.random() < shares[0 if self._is_object else 1])
            for shares in (
                (TEXTURED_SHARE, PRINTED_SHARE),
                (INDOORS_SHARE, LABORATORY_SHARE),
                (CROWDED_SHARE, ALONE_SHARE),
            )
        )
        drawing = sketch_frames.draw_craft(
            self._mesh, rng, side, random_texture(sketch_frames.SKY_PX, rng) if printed else None
        )
        if others:
            count = min(int(rng.integers(MOST_OTHERS + 1)), len(around))
            chosen = [around[rng.integers(len(around))].drawing for _ in range(count)]
            drawing = crowded(drawing, chosen, rng)
        return Target(drawing, indoors)


def batches(
    workers: int, batch: int, reuse: float, seed: int
) -> Generator[tuple[Grey, Maps], None, None]:
    """Batches without end, by processes that begin now and end with the generator.

    ``batch``: pictures of SIDE_PX; of larger ones there are as many pixels.

    Raises:
        BrokenProcessPool: a process has ended.
        TimeoutError: none makes a batch.
    """
    cv2.setNumThreads(1)  # a child of a fork would wait for OpenCV's own threads for ever
    # Children of a fork have all compiled loops at once.
    context = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(workers, context, _begin, (reuse, seed))
    due = deque(pool.submit(_batch, batch) for _ in range(AHEAD * workers))

    def made() -> Generator[tuple[Grey, Maps], None, None]:
        try:
            while True:
                yield due.popleft().result(MOST_S)
                due.append(pool.submit(_batch, batch))
        finally:
            pool.shutdown(cancel_futures=True)

    return made()


_pools: list[Pool] = []  # of this process


def _begin(reuse: float, seed: int) -> None:
    cv2.setNumThreads(1)
    threadpool_limits(1, "blas")
    _pools[:] = [Pool(np.random.default_rng([seed, 2, os.getpid()]), reuse)]


def _batch(count: int) -> tuple[Grey, Maps]:
    larger = LARGE if _pools[0].rng.random() < LARGE_SHARE else 1
    return _pools[0].photographs(count // larger**2, larger)
