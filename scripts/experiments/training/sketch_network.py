"""Train the network that sketches a photograph, on random spacecraft in hard light."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections import deque
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import numpy.typing as npt
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from experiments.training import sketch_frames
from experiments.training.cluttered_rooms import INDOORS, crowded, room
from experiments.training.random_objects import random_object
from experiments.training.random_textures import random_texture
from rendezview.geometry.zbuffer import Float32s
from rendezview.sensors.appearance.edges.network import SIDE_PX, channels_of
from rendezview.sensors.appearance.model.sketches import MAPS
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.random_craft import any_craft

LARGE = 2  # times SIDE_PX: the side of larger pictures, as those of a closer pass
LARGE_SHARE = 0.35  # of the batches
OBJECT_SHARE = 0.18  # of the targets are everyday objects, the others craft
# That have a texture, are in rooms, have other bodies around them.
OBJECT_SHARES, CRAFT_SHARES = (0.6, 0.85, 0.5), (0.05, 0.05, 0.06)
MOST_OTHERS = 2
POOL, LEAST_POOL = 160, 16  # drawings of SIDE_PX; there are a quarter as many large ones
DRAWINGS_A_BACKGROUND = 3
REUSE = 10.0  # photographs of each drawing
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
        shares = OBJECT_SHARES if self._is_object else CRAFT_SHARES
        printed, indoors, others = (bool(rng.random() < share) for share in shares)
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


# Held-out pictures of SIDE_PX, and larger ones: parts, and pictures of each. Their craft are drawn
# for them alone.
HELD_PARTS, HELD, LARGE_HELD = 24, 8, 1
# Parts that set the scales of the whole numbers of the network as written.
SHOWN_PARTS, SHOWN, LARGE_SHOWN = 8, 8, 2
HELD_SEED, SHOWN_SEED = 5, 3


def part(seed: tuple[int, ...], counts: tuple[int, int]) -> list[tuple[Grey, Maps]]:
    """Photographs of craft drawn for them alone: ``counts`` of SIDE_PX, and of larger ones."""
    cv2.setNumThreads(1)
    pool = Pool(np.random.default_rng(seed), reuse=1.0)
    return [pool.photographs(count, k) for count, k in zip(counts, (1, LARGE), strict=True)]


def parts(workers: int, seed: int, count: int, counts: tuple[int, int]) -> list[tuple[Grey, Maps]]:
    """As ``part``, from several seeds, each size in one batch."""
    each = Parallel(workers)(delayed(part)((seed, k), counts) for k in range(count))
    return [
        (np.concatenate([p for p, _ in same]), np.concatenate([m for _, m in same]))
        for same in zip(*each, strict=True)
    ]


def run(
    network: Annotated[Path, "ONNX file to write; the weights go beside it as .pt"], *,
    larger: Annotated[Path | None, "ONNX file of a larger network, trained on the same batches"]
    = None,
    minutes: Annotated[float, "of training"] = 70.0,
    workers: Annotated[int, "processes that draw; 0: one fewer than there are cores"] = 0,
    batch: Annotated[int, "pictures of a step"] = 16,
    resume: Annotated[bool, "go on from the weights beside the ONNX files"] = False, seed: int = 11,
) -> None:  # fmt: skip
    """Train the network that sketches a photograph, on random spacecraft in hard light.

    Needs pip install torch onnx. Some processes draw craft, everyday objects and skies, and take
    photographs; this one trains on them, on a GPU if there is one. Held-out losses and the overlap
    (IoU) of covers are printed each minute. An hour on two cores; ten minutes on a GPU with sixteen
    (--minutes 9 --batch 32). The step count depends on the machine, so the weights are not the
    same twice.
    """
    try:
        import torch  # noqa: F401

        from experiments.training import sketch_unet as unet
    except ModuleNotFoundError as error:
        sys.exit(f"sketch-network needs {error.name}: pip install torch onnx")
    if batch < LARGE**2 or batch % LARGE**2:
        sys.exit(f"--batch must be a multiple of {LARGE**2}, not {batch}")
    workers = workers or max(1, (os.cpu_count() or 2) - 1)
    part((seed, 0), (1, 0))  # compiles the drawing before all processes do so
    held = parts(workers, HELD_SEED, HELD_PARTS, (HELD, LARGE_HELD))
    shown = parts(workers, SHOWN_SEED, SHOWN_PARTS, (SHOWN, LARGE_SHOWN))
    feed = batches(workers, batch, REUSE, seed)
    print(f"{workers} processes draw, {HELD_PARTS * (HELD + LARGE_HELD)} pictures held out",
          flush=True)  # fmt: skip
    widths = {network: unet.WIDTHS}
    if larger is not None:
        widths[larger] = unet.LARGE_WIDTHS
    for path in widths:
        path.parent.mkdir(parents=True, exist_ok=True)
    trained = unet.train(feed, held, widths, minutes, seed, resume=resume)
    feed.close()
    pictures = [channels_of(grey.astype(np.float32)) for greys, _ in shown for grey in greys]
    for path, one in zip(widths, trained, strict=True):
        unet.write(one, path, pictures)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB", flush=True)
