"""The sketch network in PyTorch: a U-Net on squares of pixels, its losses, its training."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
from torch import nn
from torch.nn import functional

from rendezview.sensors.appearance.edges.network import FAINT_GREY, SIDE_PX, SQUARE_PX, to_squares
from rendezview.sensors.appearance.model.sketches import COVER, MAPS

CHANNELS = 2  # grey levels, and faint differences magnified
# Channels at full size, a half, a quarter, an eighth and a sixteenth of the squares.
WIDTHS = (56, 80, 112, 128, 192)
LARGE_WIDTHS = (96, 144, 224, 336, 544)  # 5 times as many weights, 3 times as many products
LINE_WEIGHT = 3.0  # of a pixel on a line: most are on none
MAP_WEIGHTS = (1.0, 1.5, 1.5)
DICE_PX = 50.0  # px²; keeps the overlap of small targets smooth
WARM_UP = 200  # steps
REPORT_S, REPORTS = 60.0, 20  # least time between reports and checkpoints; their count
LEARNING_RATE = 2e-3  # the highest
MEAN_DECAY = 0.998  # of the running mean of the weights, a step
HELD_PIXELS = 32 * SIDE_PX**2  # of held-out pictures, at once
Batch = tuple[np.ndarray, np.ndarray]  # grey levels (N, S, S), maps (N, MAPS, S, S) 0 … 255


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

    def __init__(self, widths=WIDTHS):
        super().__init__()
        a, b, c, d, e = widths
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


def inputs(batch: Batch, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures (N, CHANNELS, S, S) as ``channels_of``, and maps (N, MAPS, S, S) 0 … 1."""
    grey, maps = (torch.from_numpy(part).to(device).float() for part in batch)
    middle = grey[:, ::4, ::4].flatten(1).median(1).values[:, None, None]
    pictures = torch.stack([grey / 255.0, torch.tanh((grey - middle) / FAINT_GREY)], 1)
    return pictures.contiguous(memory_format=torch.channels_last), maps / 255.0


def brief(device: str) -> bool:
    """Whether numbers of half the bits, which are as exact, are also faster."""
    return device == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported()


def judged(network, held: Batch, device: str) -> tuple[float, float, np.ndarray]:
    """The two losses and the overlap (IoU) of the cover of each held-out picture (N,)."""
    network.eval()
    pictures, maps = inputs(held, device)
    count = max(1, HELD_PIXELS // pictures.shape[-1] ** 2)
    with torch.no_grad(), torch.autocast(device, dtype=torch.bfloat16, enabled=brief(device)):
        odds = torch.cat([log_odds(network, part) for part in pictures.split(count)])
        entropy, overlap = losses(odds, maps)
    seen, truth = odds[:, COVER] > 0, maps[:, COVER] > 0.5
    both, either = (seen & truth).sum((1, 2)), (seen | truth).sum((1, 2))
    return float(entropy), float(overlap), ((both + 1) / (either + 1)).cpu().numpy()


class Trained:
    """A network while it learns, and the running mean of its weights."""

    def __init__(
        self, path: Path, widths: tuple[int, ...], device: str, *, resume: bool = False
    ) -> None:
        self.path, self._device, self._steps = path, device, 0
        self._network, self.mean = (
            SketchUNet(widths).to(device=device, memory_format=torch.channels_last)
            for _ in range(2)
        )
        if resume:
            self._network.load_state_dict(torch.load(path.with_suffix(".pt"), device))
        self.mean.load_state_dict(self._network.state_dict())
        self._kept, self._now = (
            [v for v in one.state_dict().values() if v.dtype.is_floating_point]
            for one in (self.mean, self._network)
        )
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(), weight_decay=1e-3, fused=device == "cuda"
        )
        self._running: list[torch.Tensor] = []
        count = sum(p.numel() for p in self._network.parameters())
        print(f"{path.stem}: {count} weights, on {device}", flush=True)

    def step(self, pictures: torch.Tensor, maps: torch.Tensor, rate: float) -> None:
        """Learn from one batch."""
        network = self._network
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        with torch.autocast(self._device, dtype=torch.bfloat16, enabled=brief(self._device)):
            odds = log_odds(network, pictures)
        entropy, overlap = losses(odds, maps)
        self._optimizer.zero_grad(set_to_none=True)
        (entropy + overlap).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        self._optimizer.step()
        self._steps += 1
        decay = min(MEAN_DECAY, self._steps / (self._steps + 20))
        with torch.no_grad():
            torch._foreach_lerp_(self._kept, self._now, 1.0 - decay)
        self._running.append(torch.stack([entropy.detach(), overlap.detach()]))

    def report(self, held: list[Batch]) -> None:
        """Print how well it does, and keep the mean of its weights beside the path."""
        now = torch.stack(self._running or [torch.zeros(2)]).mean(0).tolist()
        self._running.clear()
        print(f"{self.path.stem}, step {self._steps}: cross entropy {now[0]:.3f}, "
              f"1 − Dice {now[1]:.3f}; held out:", flush=True)  # fmt: skip
        for batch in held:
            entropy, overlap, iou = judged(self.mean, batch, self._device)
            shares = f"{iou.mean():.3f} mean, {np.median(iou):.3f} median"
            side_px = batch[0].shape[-1]
            print(f"    {side_px} px: {entropy:.3f}, {overlap:.3f}, IoU {shares}", flush=True)
        save(self.mean, self.path)


def train(
    batches: Iterable[Batch], held: list[Batch], networks: dict[Path, tuple[int, ...]],
    minutes: float, seed: int, *, resume: bool = False,
) -> list[SketchUNet]:  # fmt: skip
    """AdamW with a cosine of learning rates over the time; all networks see all batches.

    Args:
        networks: widths by the ONNX files they will be written to; their weights are kept beside
            these as .pt, once a minute.
        resume: the networks begin with the weights that are kept there.

    Returns:
        The running means of their weights.
    """
    torch.manual_seed(seed)
    torch.backends.cudnn.benchmark, torch.backends.cudnn.benchmark_limit = True, 4
    device = "cuda" if torch.cuda.is_available() else "cpu"
    learning = [Trained(path, widths, device, resume=resume) for path, widths in networks.items()]
    began, reported = time.monotonic(), 0.0
    for step, batch in enumerate(batches):
        spent = time.monotonic() - began
        if (done := spent / (60.0 * minutes)) >= 1.0:
            break
        rate = LEARNING_RATE * min(1.0, (step + 1) / WARM_UP) * 0.5 * (1.0 + np.cos(np.pi * done))
        pictures, maps = inputs(batch, device)
        for one in learning:
            one.step(pictures, maps, rate + 1e-6)
        if spent - reported > max(REPORT_S, 60.0 * minutes / REPORTS):
            reported = spent
            for one in learning:
                one.report(held)
    for one in learning:
        one.report(held)
    return [one.mean.cpu() for one in learning]


def save(network, path: Path) -> None:
    """Keep the weights as .pt beside an ONNX file, matrices in halves."""
    kept = path.with_suffix(".pt")
    partial = kept.with_suffix(".partial")
    state = network.state_dict()
    torch.save({name: v.half() if v.dim() > 1 else v for name, v in state.items()}, partial)
    partial.replace(kept)


def export(network, channels: int, path: Path) -> None:
    """Write a network of ``squares`` (1, channels, h, w) as ONNX, its normalisation folded in."""
    network.eval()
    sides = {2: "h", 3: "w"}
    torch.onnx.export(
        network, (torch.zeros(1, channels, 64, 64),), str(path), input_names=["squares"],
        output_names=["y"], dynamic_axes={"squares": sides, "y": sides}, dynamo=False,
        opset_version=17,
    )  # fmt: skip


def write(network, path: Path, pictures: list[np.ndarray]) -> None:
    """Write the network as ONNX in whole numbers of 8 bits, for pictures of any size.

    Input ``squares`` (1, CHANNELS n², h, w), output ``y`` (1, MAPS n², h, w) log-odds, float32. The
    normalisation is folded into the weights.
    ``pictures``: (CHANNELS, S, S) each, that show the range of every layer's values.
    """
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
