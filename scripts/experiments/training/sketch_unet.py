"""The sketch network in PyTorch: a U-Net on squares of pixels, its losses, its training."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
from torch import nn
from torch.nn import functional

from rendezview.sensors.appearance.edges.network import SQUARE_PX, to_squares
from rendezview.sensors.appearance.model.sketches import COVER, MAPS

CHANNELS = 2  # grey levels, and faint differences magnified
# Channels at full size, a half, a quarter, an eighth and a sixteenth of the squares.
WIDTHS = (56, 80, 112, 128, 192)
LINE_WEIGHT = 3.0  # of a pixel on a line: most are on none
MAP_WEIGHTS = (1.0, 1.5, 1.5)
DICE_PX = 50.0  # px²; keeps the overlap of small targets smooth
WARM_UP, REPORT_EVERY = 200, 200  # steps
LEARNING_RATE = 2e-3
MEAN_DECAY = 0.998  # of the running mean of the weights, a step
HELD_BATCH = 16
Batch = tuple[torch.Tensor, torch.Tensor]  # pictures (N, 2, S, S) and maps (N, MAPS, S, S)


class Layer(nn.Module):
    """3 × 3 convolution, normalisation, ramp."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(outputs, momentum=0.03)

    def forward(self, x):
        return functional.relu(self.norm(self.convolution(x)), inplace=True)


class Residual(nn.Module):
    """Two layers beside a way past them; it begins as that way alone."""

    def __init__(self, channels):
        super().__init__()
        self.first = Layer(channels, channels)
        self.convolution = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(channels, momentum=0.03)
        nn.init.zeros_(self.norm.weight)

    def forward(self, x):
        return functional.relu(x + self.norm(self.convolution(self.first(x))), inplace=True)


def twice(x):
    """As many pixels again along each side."""
    return functional.interpolate(x, scale_factor=2, mode="nearest")


class SketchUNet(nn.Module):
    """(N, CHANNELS n², h, w) squares to (N, MAPS n², h, w) log-odds; n = SQUARE_PX."""

    def __init__(self):
        super().__init__()
        a, b, c, d, e = WIDTHS
        self.a = nn.Sequential(Layer(CHANNELS * SQUARE_PX**2, a), Layer(a, a))
        self.b = nn.Sequential(Layer(a, b), Layer(b, b))
        self.c = nn.Sequential(Layer(b, c), Layer(c, c))
        self.d = nn.Sequential(Layer(c, d), Layer(d, d), Layer(d, d))
        self.more_b, self.more_c, self.more_d = Residual(b), Residual(c), Residual(d)
        self.more_up_c, self.more_up_b = Residual(c), Residual(b)
        self.e = nn.Sequential(Layer(d, e), Layer(e, e), Layer(e, e))
        self.from_e, self.from_d = nn.Conv2d(e, d, 1), nn.Conv2d(d, c, 1)
        self.from_c, self.from_b = nn.Conv2d(c, b, 1), nn.Conv2d(b, a, 1)
        self.up_c = nn.Sequential(Layer(c, c), Layer(c, c))
        self.up_b = Layer(b, b)
        self.up_a = nn.Sequential(Layer(a, a), Layer(a, a))
        self.out = nn.Conv2d(a, MAPS * SQUARE_PX**2, 1)

    def forward(self, squares):
        a = self.a(squares)
        b = self.more_b(self.b(functional.max_pool2d(a, 2)))
        c = self.more_c(self.c(functional.max_pool2d(b, 2)))
        d = self.more_d(self.d(functional.max_pool2d(c, 2)))
        e = self.e(functional.max_pool2d(d, 2))
        d = d + twice(self.from_e(e))
        c = self.more_up_c(self.up_c(c + twice(self.from_d(d))))
        b = self.more_up_b(self.up_b(b + twice(self.from_c(c))))
        return self.out(self.up_a(a + twice(self.from_b(b))))


def log_odds(network, pictures):
    """(N, C, S, S) of pictures (N, D, S, S), by a network of squares."""
    squares = functional.pixel_unshuffle(pictures, SQUARE_PX)
    return functional.pixel_shuffle(network(squares), SQUARE_PX)


def losses(odds, maps):
    """Cross entropy of all maps, and one minus the overlap of the covers (Dice)."""
    odds = odds.float()
    per_map = (1, MAPS, 1, 1)
    weights = odds.new_tensor([1.0, LINE_WEIGHT, LINE_WEIGHT]).view(per_map)
    cross = functional.binary_cross_entropy_with_logits
    entropy = cross(odds, maps, pos_weight=weights, reduction="none")
    entropy = (entropy.mean((0, 2, 3)) * odds.new_tensor(MAP_WEIGHTS)).sum()
    share, truth = torch.sigmoid(odds[:, COVER]), maps[:, COVER]
    return entropy, (1 - dice(share, truth)).mean()


def dice(share, truth):
    """(N,) overlap of the covers (N, S, S) of pictures."""
    both = (share * truth).sum((1, 2))
    return (2 * both + DICE_PX) / (share.sum((1, 2)) + truth.sum((1, 2)) + DICE_PX)


def judged(network, held: Batch, device: str) -> tuple[float, float, np.ndarray]:
    """The two losses and the overlap (IoU) of the cover of each held-out picture (N,)."""
    network.eval()
    pictures, maps = held
    with torch.no_grad():
        parts = pictures.split(HELD_BATCH)
        odds = torch.cat([log_odds(network, part.to(device)).cpu() for part in parts])
    seen, truth = odds[:, COVER] > 0, maps[:, COVER] > 0.5
    both, either = (seen & truth).sum((1, 2)), (seen | truth).sum((1, 2))
    return *map(float, losses(odds, maps)), ((both + 1) / (either + 1)).numpy()


def trained(
    next_batch: Callable[[], Batch], held: list[Batch], minutes: float, seed: int
) -> SketchUNet:
    """The running mean of the weights after AdamW with a cosine of learning rates over the time."""
    torch.manual_seed(seed)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network, mean = (
        SketchUNet().to(device=device, memory_format=torch.channels_last) for _ in range(2)
    )
    # Half the bits are as exact, and faster where the processor has them.
    brief = device == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported()
    mean.load_state_dict(network.state_dict())
    print(f"{sum(p.numel() for p in network.parameters())} weights, on {device}", flush=True)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-3)
    began, step, running = time.monotonic(), 0, []
    while (done := (time.monotonic() - began) / (60.0 * minutes)) < 1.0:
        now = LEARNING_RATE * min(1.0, (step + 1) / WARM_UP) * 0.5 * (1.0 + np.cos(np.pi * done))
        for group in optimizer.param_groups:
            group["lr"] = now + 1e-6
        pictures, maps = (part.to(device) for part in next_batch())
        with torch.autocast(device, dtype=torch.bfloat16, enabled=brief):
            odds = log_odds(network, pictures.to(memory_format=torch.channels_last))
        entropy, overlap = losses(odds, maps)
        optimizer.zero_grad(set_to_none=True)
        (entropy + overlap).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        step += 1
        _follow(mean, network, min(MEAN_DECAY, step / (step + 20)))
        running.append((float(entropy.detach()), float(overlap.detach())))
        if step % REPORT_EVERY == 0:
            _report(step, running[-REPORT_EVERY:], mean, held, device)
    _report(step, running[-REPORT_EVERY:], mean, held, device)
    return mean.cpu()


def _follow(mean, network, decay: float) -> None:
    pairs = zip(mean.state_dict().values(), network.state_dict().values(), strict=True)
    with torch.no_grad():
        for kept, now in pairs:
            if kept.dtype.is_floating_point:
                kept.mul_(decay).add_(now, alpha=1.0 - decay)
            else:
                kept.copy_(now)


def _report(step: int, running, network, held: list[Batch], device: str) -> None:
    now = np.mean(running, axis=0)
    print(f"step {step}: cross entropy {now[0]:.3f}, 1 − Dice {now[1]:.3f}; held out:")
    for batch in held:
        entropy, overlap, iou = judged(network, batch, device)
        side_px, shares = batch[0].shape[-1], f"{iou.mean():.3f} mean, {np.median(iou):.3f} median"
        print(f"    {side_px} px: {entropy:.3f}, {overlap:.3f}, IoU {shares}", flush=True)


def export(network, inputs: int, path: Path) -> None:
    """Write a network of ``squares`` (1, inputs, h, w) as ONNX, its normalisation folded in."""
    network.eval()
    sides = {2: "h", 3: "w"}
    torch.onnx.export(
        network, (torch.zeros(1, inputs, 64, 64),), str(path), input_names=["squares"],
        output_names=["y"], dynamic_axes={"squares": sides, "y": sides}, dynamo=False,
        opset_version=17,
    )  # fmt: skip


def write(network, path: Path, pictures: list[np.ndarray]) -> None:
    """Write the network as ONNX in whole numbers of 8 bits, for pictures of any size.

    Input ``squares`` (1, CHANNELS n², h, w), output ``y`` (1, MAPS n², h, w) log-odds, float32. The
    normalisation is folded into the weights. They are kept beside it as .pt, as trained.
    ``pictures``: (CHANNELS, S, S) each, that show the range of every layer's values.
    """
    torch.save(network.state_dict(), path.with_suffix(".pt"))
    with tempfile.TemporaryDirectory() as folder:
        exact = Path(folder) / "exact.onnx"
        export(network, CHANNELS * SQUARE_PX**2, exact)
        # Weights of 7 bits: with 8, sums overflow on processors without VNNI.
        quantize_static(
            exact, path, _Pictures(pictures), per_channel=True, reduce_range=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
        )  # fmt: skip


class _Pictures(CalibrationDataReader):
    """The pictures one by one, as the network takes them."""

    def __init__(self, pictures: list[np.ndarray]) -> None:
        self._each = iter(pictures)

    def get_next(self) -> dict[str, np.ndarray] | None:
        picture = next(self._each, None)
        return None if picture is None else {"squares": to_squares(picture)[None]}
