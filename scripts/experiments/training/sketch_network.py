"""Train the network that sketches a photograph, on random spacecraft in hard light."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from joblib import Parallel, delayed

from experiments.training.sketch_feed import LARGE, Grey, Maps, Pool, batches
from rendezview.sensors.appearance.edges.network import channels_of

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
    reuse: Annotated[float, "photographs of each drawing"] = 10.0,
    rate: Annotated[float, "the highest learning rate"] = 2e-3,
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
    feed = batches(workers, batch, reuse, seed)
    print(f"{workers} processes draw, {HELD_PARTS * (HELD + LARGE_HELD)} pictures held out",
          flush=True)  # fmt: skip
    widths = {network: unet.WIDTHS}
    if larger is not None:
        widths[larger] = unet.LARGE_WIDTHS
    for path in widths:
        path.parent.mkdir(parents=True, exist_ok=True)
    trained = unet.train(feed, held, widths, minutes, seed, rate, resume=resume)
    feed.close()
    pictures = [channels_of(grey.astype(np.float32)) for greys, _ in shown for grey in greys]
    for path, one in zip(widths, trained, strict=True):
        unet.write(one, path, pictures)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB", flush=True)
