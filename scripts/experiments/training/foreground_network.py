"""Train the network that separates target and bright sky, on random spacecraft."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import optax
from joblib import Parallel, delayed
from onnx import TensorProto, helper, numpy_helper

from rendezview.sensors.appearance.outline.foreground import SQUARE_PX
from rendezview_ground.simulate.foreground_frames import foreground_frame

BATCH = 8
SIDE_PX = 192  # of the squares that are cut out of the pictures
BLOCK = 200  # pictures a file
HELD_OUT = 64
PIXELS = SQUARE_PX**2
# Channels in and out, 3 × 3 weights each; down by halves from a to d, and up again.
LAYERS = {
    "a1": (PIXELS, 24), "a2": (24, 24), "b1": (24, 32), "b2": (32, 32), "c1": (32, 48),
    "c2": (48, 48), "d1": (48, 48), "d2": (48, 48), "c3": (96, 48), "b3": (80, 32),
    "a3": (56, 24), "out": (24, PIXELS),
}  # fmt: skip
EPSILON = 1e-4  # of the variance, where batches are normalised


def draw(folder: Path, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, H, W) pictures and covers; blocks that are there already are read."""
    folder.mkdir(parents=True, exist_ok=True)

    def block(first: int) -> Path:
        path = folder / f"{seed}-{first:06d}.npz"
        if not path.exists():
            frames = [foreground_frame(np.random.default_rng([seed, k]))
                      for k in range(first, first + BLOCK)]  # fmt: skip
            pictures, covers = (np.array(part) for part in zip(*frames, strict=True))
            np.savez_compressed(path, pictures=pictures, covers=covers)
        return path

    paths = Parallel(n_jobs=-1)(delayed(block)(k) for k in range(0, count, BLOCK))
    blocks = [np.load(path) for path in paths]
    return tuple(np.concatenate([b[name] for b in blocks]) for name in ("pictures", "covers"))


def first_weights(seed: int) -> tuple[dict, dict]:
    """Weights, offsets and gains; and the means and variances of the layers."""
    rng = np.random.default_rng(seed)
    weights = {}
    for name, (i, o) in LAYERS.items():
        first = rng.standard_normal((3, 3, i, o)) * np.sqrt(2 / (9 * i))
        weights[name] = (jnp.array(first, jnp.float32), jnp.zeros(o), jnp.ones(o))
    return weights, {name: (jnp.zeros(o), jnp.ones(o)) for name, (_, o) in LAYERS.items()}


def unet(layer, halved, joined, x):
    """The network of given operations on ``x``."""
    a = layer("a2", layer("a1", x))
    b = layer("b2", layer("b1", halved(a)))
    c = layer("c2", layer("c1", halved(b)))
    d = layer("d2", layer("d1", halved(c)))
    c = layer("c3", joined(d, c))
    b = layer("b3", joined(c, b))
    return layer("out", layer("a3", joined(b, a)))


def log_odds(weights, statistics, pictures, learning):
    """(N, H, W) of pictures 0 … 1; batches are normalised by their own statistics or the kept."""
    kept = dict(statistics)

    def layer(name, x):
        weight, offset, gain = weights[name]
        axes = ("NHWC", "HWIO", "NHWC")
        y = jax.lax.conv_general_dilated(x, weight, (1, 1), "SAME", dimension_numbers=axes)
        if name == "out":
            return y + offset
        mean, variance = statistics[name]
        if learning:
            now = y.mean((0, 1, 2)), y.var((0, 1, 2))
            kept[name] = (0.95 * mean + 0.05 * now[0], 0.95 * variance + 0.05 * now[1])
            mean, variance = now
        return jax.nn.relu((y - mean) * gain * jax.lax.rsqrt(variance + EPSILON) + offset)

    def halved(x):
        n, h, w, c = x.shape
        return x.reshape(n, h // 2, 2, w // 2, 2, c).max((2, 4))

    def joined(x, y):
        return jnp.concatenate([jnp.repeat(jnp.repeat(x, 2, 1), 2, 2), y], 3)

    n, h, w = pictures.shape
    s = SQUARE_PX
    squares = pictures.reshape(n, h // s, s, w // s, s).transpose(0, 1, 3, 2, 4)
    out = unet(layer, halved, joined, squares.reshape(n, h // s, w // s, PIXELS))
    out = out.reshape(n, h // s, w // s, s, s).transpose(0, 1, 3, 2, 4)
    return out.reshape(n, h, w), kept


def loss(weights, statistics, pictures, covers):
    """Cross entropy plus one minus the overlap (Dice)."""
    odds, kept = log_odds(weights, statistics, pictures, True)
    entropy = jnp.mean(jax.nn.softplus(odds) - covers * odds)
    share = jax.nn.sigmoid(odds)
    both = jnp.sum(share * covers, (1, 2))
    dice = (2 * both + 50) / (jnp.sum(share, (1, 2)) + jnp.sum(covers, (1, 2)) + 50)
    return 2 * entropy + jnp.mean(1 - dice), kept


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


def write(weights, statistics, path: Path) -> None:
    """The network as ONNX, normalisation folded into the weights."""
    nodes, constants = [], []

    def constant(name, values):
        constants.append(numpy_helper.from_array(np.asarray(values, np.float32), name))
        return name

    def layer(name, x):
        weight, offset, gain = (np.asarray(part) for part in weights[name])
        if name != "out":
            mean, variance = (np.asarray(part) for part in statistics[name])
            gain = gain / np.sqrt(variance + EPSILON)
            weight, offset = weight * gain, offset - mean * gain
        parts = [constant(f"{name}-weight", weight.transpose(3, 2, 0, 1)),
                 constant(f"{name}-offset", offset)]  # fmt: skip
        made = node("Conv", [x, *parts], f"{name}-sum", kernel_shape=[3, 3], pads=[1] * 4)
        return made if name == "out" else node("Relu", [made], name)

    def node(kind, inputs, output, **settings):
        nodes.append(helper.make_node(kind, inputs, [output], **settings))
        return output

    def halved(x):
        return node("MaxPool", [x], f"{x}-half", kernel_shape=[2, 2], strides=[2, 2])

    def joined(x, y):
        twice = node("Resize", [x, "", "twice"], f"{x}-twice", mode="nearest",
                     coordinate_transformation_mode="asymmetric",
                     nearest_mode="floor")  # fmt: skip
        return node("Concat", [twice, y], f"{x}-{y}", axis=1)

    constant("twice", [1, 1, 2, 2])
    out, shape = unet(layer, halved, joined, "squares"), [1, PIXELS, "rows", "columns"]
    first, last = (helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
                   for name in ("squares", out))  # fmt: skip
    graph = helper.make_graph(nodes, "foreground", [first], [last], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    onnx.save(model, path)


def run(
    frames: Path, network: Annotated[Path, "ONNX file to write"], *, count: int = 5600,
    steps: int = 7000, seed: int = 7,
) -> None:  # fmt: skip
    """Train the network that separates target and bright sky, on random spacecraft.

    Needs jax, optax and onnx. Draws images (simulation/foreground_frames.py) into FRAMES, trains on
    all but the first 64, and writes the network whenever it has printed its overlap on those 64.
    An hour on two cores.
    """
    pictures, covers = draw(frames, count, seed)
    rng = np.random.default_rng(seed)
    weights, statistics = first_weights(seed)
    optimizer = optax.adam(optax.cosine_decay_schedule(4e-3, steps, 0.02))
    state = optimizer.init(weights)

    @jax.jit
    def step(weights, statistics, state, shown, truth):
        (value, statistics), slope = jax.value_and_grad(loss, has_aux=True)(
            weights, statistics, shown, truth
        )
        change, state = optimizer.update(slope, state)
        return optax.apply_updates(weights, change), statistics, state, value

    @jax.jit
    def overlap(weights, statistics, shown, truth):
        seen = log_odds(weights, statistics, shown, False)[0] > 0
        return jnp.sum(seen & truth, (1, 2)) / jnp.sum(seen | truth, (1, 2))

    losses = []
    for k in range(1, steps + 1):
        chosen = rng.integers(HELD_OUT, len(pictures), BATCH)
        shown, truth = cut(pictures[chosen], covers[chosen], rng)
        weights, statistics, state, value = step(weights, statistics, state, shown, truth)
        losses.append(float(value))
        if k % 500 == 0 or k == steps:
            held = padded(pictures[:HELD_OUT]), padded(covers[:HELD_OUT]) > 0.5
            seen = np.asarray(overlap(weights, statistics, *held))
            print(f"step {k}: loss {np.mean(losses[-500:]):.3f}, overlap (IoU) of the held out "
                  f"{np.mean(seen):.3f} mean, {np.median(seen):.3f} median",
                  flush=True)  # fmt: skip
            write(weights, statistics, network)
