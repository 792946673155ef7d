"""Train the network that separates target and bright sky, on random spacecraft."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from joblib import Parallel, delayed
from torch import nn
from torch.nn import functional

from experiments.frame import kept
from experiments.training.sketch_unet import Layer, dice, export, log_odds, twice
from rendezview.sensors.appearance.outline.foreground import SQUARE_PX
from rendezview_ground.simulate.foreground_frames import foreground_frame

BATCH = 8
SIDE_PX = 192  # of the squares that are cut out of the pictures
BLOCK = 200  # pictures a file
HELD_OUT = 64
PIXELS = SQUARE_PX**2


def draw(folder: Path, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, H, W) pictures and covers; blocks that are there already are read."""

    def block(first: int) -> dict[str, np.ndarray]:
        def made() -> dict[str, np.ndarray]:
            rngs = (np.random.default_rng([seed, k]) for k in range(first, first + BLOCK))
            pictures, covers = zip(*map(foreground_frame, rngs), strict=True)
            return {"pictures": np.array(pictures), "covers": np.array(covers)}

        return kept(folder / f"{seed}-{first:06d}.npz", made)

    blocks = Parallel(n_jobs=-1)(delayed(block)(k) for k in range(0, count, BLOCK))
    return tuple(np.concatenate([b[name] for b in blocks]) for name in ("pictures", "covers"))


class ForegroundUNet(nn.Module):
    """(N, n², h, w) squares to (N, n², h, w) log-odds; n = SQUARE_PX."""

    def __init__(self):
        super().__init__()
        self.a = nn.Sequential(Layer(PIXELS, 24), Layer(24, 24))
        self.b = nn.Sequential(Layer(24, 32), Layer(32, 32))
        self.c = nn.Sequential(Layer(32, 48), Layer(48, 48))
        self.d = nn.Sequential(Layer(48, 48), Layer(48, 48))
        self.up_c, self.up_b, self.up_a = Layer(96, 48), Layer(80, 32), Layer(56, 24)
        self.out = nn.Conv2d(24, PIXELS, 3, padding=1)

    def forward(self, squares):
        a = self.a(squares)
        b = self.b(functional.max_pool2d(a, 2))
        c = self.c(functional.max_pool2d(b, 2))
        d = self.d(functional.max_pool2d(c, 2))
        c = self.up_c(torch.cat([twice(d), c], 1))
        b = self.up_b(torch.cat([twice(c), b], 1))
        return self.out(self.up_a(torch.cat([twice(b), a], 1)))


def odds_of(network, pictures):
    """(N, H, W) log-odds of pictures 0 … 1."""
    return log_odds(network, torch.from_numpy(pictures)[:, None])[:, 0]


def cut(pictures, covers, rng):
    """(N, SIDE_PX, SIDE_PX) squares around the craft, 0 … 1, mirrored and brightened."""
    parts = []
    for picture, cover in zip(pictures, covers, strict=True):
        y, x = np.nonzero(cover > 127)
        centre = np.array([y.mean(), x.mean()]) if len(y) else np.array(picture.shape) / 2
        corner = centre + rng.uniform(-70, 70, 2) - SIDE_PX / 2
        top, left = np.clip(corner, 0, np.array(picture.shape) - SIDE_PX).astype(int)
        part = np.stack([picture, cover])[:, top : top + SIDE_PX, left : left + SIDE_PX]
        parts.append(part[:, :: rng.choice([-1, 1]), :: rng.choice([-1, 1])] / np.float32(255))
    shown, truth = np.array(parts).swapaxes(0, 1)
    gain = np.exp(rng.normal(0.0, 0.15, (len(shown), 1, 1)))
    return np.clip(shown * gain, 0, 1).astype(np.float32), np.ascontiguousarray(truth)


def padded(pictures):
    """Rows to a multiple of 32, the outermost repeated; 0 … 1."""
    return np.pad(pictures, ((0, 0), (8, 8), (0, 0)), mode="edge") / np.float32(255)


def run(
    frames: Path, output: Annotated[Path, "ONNX file to write"], *, count: int = 5600,
    steps: int = 7000, seed: int = 7,
) -> None:  # fmt: skip
    """Train the network that separates target and bright sky, on random spacecraft.

    Needs pip install torch onnx. Draws images (simulation/foreground_frames.py) into FRAMES, trains
    on all but the first 64, and writes the network whenever it has printed its overlap on those 64.
    An hour on two cores.
    """
    pictures, covers = draw(frames, count, seed)
    held, truth = padded(pictures[:HELD_OUT]), padded(covers[:HELD_OUT]) > 0.5
    rng, losses = np.random.default_rng(seed), []
    torch.manual_seed(seed)
    network = ForegroundUNet()
    optimizer = torch.optim.Adam(network.parameters(), 4e-3)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, 8e-5)
    for k in range(1, steps + 1):
        chosen = rng.integers(HELD_OUT, len(pictures), BATCH)
        shown, cover = cut(pictures[chosen], covers[chosen], rng)
        odds, cover = odds_of(network.train(), shown), torch.from_numpy(cover)
        entropy = functional.binary_cross_entropy_with_logits(odds, cover)
        loss = 2 * entropy + (1 - dice(torch.sigmoid(odds), cover)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        rates.step()
        losses.append(loss.item())
        if k % 500 == 0 or k == steps:
            with torch.no_grad():
                seen = odds_of(network.eval(), held).numpy() > 0.0
            overlap = (seen & truth).sum((1, 2)) / (seen | truth).sum((1, 2))
            print(f"step {k}: loss {np.mean(losses[-500:]):.3f}, overlap (IoU) of the held out "
                  f"{np.mean(overlap):.3f} mean, {np.median(overlap):.3f} median",
                  flush=True)  # fmt: skip
            export(network, PIXELS, output)
