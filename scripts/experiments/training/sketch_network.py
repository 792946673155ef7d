"""Train the network that sketches a photograph, on random spacecraft in hard light."""

from __future__ import annotations

import queue
import sys
import threading
from pathlib import Path
from typing import Annotated

import numpy as np
from joblib import Parallel, delayed

from experiments.frame import kept
from rendezview.sensors.appearance.edges import network as sketch
from rendezview.sensors.appearance.edges.network import SIDE_PX
from rendezview_ground.simulate.random_craft import any_craft
from rendezview_ground.simulate.sketch_frames import (
    DRAWINGS,
    CraftDrawing,
    draw_craft,
    draw_sky,
    take,
)

BLOCK = 5  # craft a file
BATCH = 16
LARGE = 2  # times SIDE_PX: the side of larger pictures, as those of a closer pass
LARGE_BATCH = BATCH // LARGE**2
LARGE_SHARE = 0.35  # of the batches, where there are larger drawings
FRAMES_A_SKY = 5
LEAST_SKIES = 10
MOST_HELD_OUT = 22  # craft
LARGE_HELD_OUT = 4  # craft
HELD_SEED = 5  # of their photographs
# Pictures that set the scales of the whole numbers of the network as written; and larger ones.
SHOWN, LARGE_SHOWN = 64, 16
AHEAD = 6  # batches that are made while the network learns


def drawings(folder: Path, count: int, seed: int, side_px: int = SIDE_PX) -> list[CraftDrawing]:
    """``DRAWINGS`` of each craft, in order; files that are there already are read."""
    crafts = -(-count // DRAWINGS)

    def block(first: int) -> dict[str, np.ndarray]:
        last = min(first + BLOCK, crafts)

        def made() -> dict[str, list[np.ndarray]]:
            drawn = []
            for k in range(first, last):
                rng = np.random.default_rng([seed, k])
                mesh = any_craft(rng)
                drawn += [draw_craft(mesh, rng, side_px) for _ in range(DRAWINGS)]
            return {"maps": [d.maps for d in drawn], "light": [d.light for d in drawn]}

        return kept(folder / f"{seed}-{side_px}-{first:06d}-{last:06d}.npz", made)

    firsts = range(0, crafts, BLOCK)
    blocks = Parallel(n_jobs=-1 if len(firsts) > 1 else 1)(delayed(block)(k) for k in firsts)
    both = (zip(one["maps"], one["light"], strict=True) for one in blocks)
    return [CraftDrawing(*drawing) for drawings in both for drawing in drawings]


def skies(folder: Path, count: int, seed: int) -> np.ndarray:
    """(N, SKY_PX, SKY_PX) float16."""

    def made() -> dict[str, np.ndarray]:
        seeds = np.random.SeedSequence([seed, 1]).spawn(count)
        each = (delayed(draw_sky)(np.random.default_rng(s)) for s in seeds)
        return {"skies": np.array(Parallel(n_jobs=-1, prefer="threads")(each), np.float16)}

    return kept(folder / f"{seed}-skies-{count}.npz", made)["skies"]


def photographs(chosen, behind: np.ndarray, rng: np.random.Generator):
    """Pictures (N, 2, S, S) as the network sees them, and maps (N, MAPS, S, S), float32."""
    taken = [take(d, behind[rng.integers(len(behind))], rng) for d in chosen]
    pictures = np.array([sketch.channels_of(picture) for picture, _ in taken])
    return pictures, np.array([maps for _, maps in taken])


def run(
    network: Annotated[Path, "ONNX file to write; the weights go beside it as .pt"], *,
    frames: Annotated[int, "drawings of craft; each is photographed many times"] = 7800,
    large: Annotated[int, "drawings of larger pictures, four times as slow to draw"] = 1800,
    minutes: Annotated[float, "of training"] = 40.0, seed: int = 11,
    folder: Annotated[Path, "keeps the drawings and skies"] = Path("sketch-frames"),
) -> None:  # fmt: skip
    """Train the network that sketches a photograph, on random spacecraft in hard light.

    Needs pip install torch onnx. Draws craft and skies into a folder, or reads them from there,
    then trains on photographs of them, new ones for each step. Up to 22 craft are held out; their
    losses and the overlap (IoU) of their covers are printed every 200 steps and at the end. The
    7800 drawings take ten minutes on two cores and 4 GB of memory; the step count depends on the
    machine, so the weights are not the same twice.
    """
    try:
        import torch

        from experiments.training import sketch_unet as unet
    except ModuleNotFoundError as error:
        sys.exit(f"sketch-network needs {error.name}: pip install torch onnx")
    if frames < 2 * DRAWINGS:
        sys.exit(f"--frames must be at least {2 * DRAWINGS}: two craft, one of them held out")
    drawn = drawings(folder, frames, seed)
    larger = drawings(folder, large, seed + 1, LARGE * SIDE_PX)
    behind = skies(folder, max(LEAST_SKIES, frames // FRAMES_A_SKY), seed)
    held_count = DRAWINGS * max(1, min(MOST_HELD_OUT, len(drawn) // DRAWINGS // 5))
    held_out, seen = drawn[:held_count], drawn[held_count:]
    large_count = min(LARGE_HELD_OUT, len(larger) // DRAWINGS // 5) * DRAWINGS
    large_out, larger = larger[:large_count], larger[large_count:]
    print(f"{len(seen)} drawings, {len(larger)} larger, {held_count} and {large_count} held out, "
          f"{len(behind)} skies", flush=True)  # fmt: skip
    outs = [some for some in (held_out, large_out) if some]
    held = [photographs(some, behind, np.random.default_rng(HELD_SEED)) for some in outs]
    batches: queue.Queue = queue.Queue(AHEAD)

    def feed() -> None:
        rng = np.random.default_rng([seed, 2])
        while True:
            some, count = seen, BATCH
            if larger and rng.random() < LARGE_SHARE:
                some, count = larger, LARGE_BATCH
            chosen = [some[k] for k in rng.integers(len(some), size=count)]
            batches.put(tuple(torch.from_numpy(x) for x in photographs(chosen, behind, rng)))

    threading.Thread(target=feed, daemon=True).start()
    shown, large_shown = (
        photographs(some[:: -(-len(some) // most)], behind, np.random.default_rng([seed, 3]))[0]
        if some else []
        for some, most in ((seen, SHOWN), (larger, LARGE_SHOWN))
    )  # fmt: skip
    tensors = [tuple(torch.from_numpy(x) for x in batch) for batch in held]
    trained = unet.trained(batches.get, tensors, minutes, seed)
    unet.write(trained, network, [*shown, *large_shown])
    size_mb = network.stat().st_size / 1e6
    print(f"{network}: {size_mb:.1f} MB")
