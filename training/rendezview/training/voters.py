"""Voters: small trees of a node on whole and sunlit silhouettes; see `outline.voters`.

Each tree learns from its own draw of the node's samples and tries a few bins at a split
(L. Breiman, Random forests, Machine Learning 45, 2001); the gain is eq. 5 of Cleghorn & Sternberg.
Readings are bytes, so a split is found in a histogram.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.geodesic import Geodesic, angle_between
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.shadowed_silhouettes import (
    READING_UNIT,
    ShadowedSilhouettes,
)
from rendezview.sensors.appearance.outline.signature import rebinning, twist
from rendezview.sensors.appearance.outline.voters import (
    BINS,
    LEAF,
    ODDS_UNIT,
    Bytes,
    Voters,
    roll_readings,
)
from rendezview.training.options import TrainingOptions
from rendezview.training.stages import Arrays
from rendezview.training.views import ViewSet

_STREAM_OF_VOTERS = 7  # of random numbers, with the node
_TRIED = 14  # bins at a split
_LEAST = 8  # samples of a leaf
_LEAST_GAIN = 4.0  # nats of all samples of a split
_ENTRIES = 1023  # of a tree at most
_FAR_FRACTION = 0.1  # of the samples beyond the reach; they keep distant nodes inactive
_PRIOR = (0.5, 4.5)  # samples on and off in every leaf, before any is seen
_LEVELS = 256  # of a byte
_SHAPE_ERROR = 0.01  # one σ of a sample's readings, smooth over the outline: error of the mesh
_WAVES = 6  # of that error around the outline


@dataclass(frozen=True, slots=True, eq=False)
class VoterSamples:
    """Signatures in BINS bytes with their attitudes: whole silhouettes, then sunlit ones."""

    order: int
    node_rotations: Array  # (nodes, 3, 3)
    readings: Bytes  # (K, BINS) in READING_UNIT
    centred_from_target: npt.NDArray[np.float32]  # (K, 3, 3)
    direction: npt.NDArray[np.float32]  # (K, 3) unit, view centre → camera

    @classmethod
    def of(
        cls, order: int, lattice: ViewSet, perturbed: ViewSet | None, lit: ShadowedSilhouettes
    ) -> VoterSamples:
        """Of the perturbed views, or the lattice's where there are none, and of sunlit parts."""
        sphere, views = Geodesic.of_order(order), lattice if perturbed is None else perturbed
        weights = rebinning(views.readings.shape[1], BINS)
        coarse = views.readings @ weights / np.float32(READING_UNIT)
        w, x, y, z = lit.quat_wxyz.astype(np.float64).T
        turned = np.stack(
            [
                1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
            ],
            axis=1,
        ).reshape(-1, 3, 3)  # fmt: skip
        directions = Geodesic.of_order(order + 1).nodes[lit.view]
        return cls(
            order,
            lattice.centred_from_target[: len(sphere.nodes)],
            np.concatenate([np.clip(np.rint(coarse), 0, 255).astype(np.uint8), lit.readings]),
            np.concatenate([views.centred_from_target, turned]).astype(np.float32),
            np.concatenate([views.direction, directions]).astype(np.float32),
        )

    def of_node(
        self, node: int, options: TrainingOptions, rng: np.random.Generator
    ) -> tuple[Bytes, npt.NDArray[np.bool_]]:
        """Readings (K, BINS) rolled to the node's own camera, and labels (K,)."""
        sphere = Geodesic.of_order(self.order)
        distance = angle_between(self.direction, sphere.nodes[node]) / sphere.mean_edge_rad
        far = (distance > options.reach_edges) & (distance <= options.far_edges)
        taken = (distance <= options.reach_edges) | (far & (rng.random(len(far)) < _FAR_FRACTION))
        chosen = np.flatnonzero(taken)
        views = self.centred_from_target[chosen].astype(np.float64)
        rolls = twist(views, self.node_rotations[node])
        rolls = rolls + options.roll_error_rad * rng.normal(size=len(chosen))
        angle = 2.0 * np.pi * np.arange(BINS) / BINS
        waves = np.concatenate([f(k * angle)[None] for k in range(1, _WAVES + 1)
                                for f in (np.cos, np.sin)])  # fmt: skip
        size = _SHAPE_ERROR / np.sqrt(_WAVES)
        strain = 1.0 + size * rng.normal(size=(len(chosen), len(waves))) @ waves
        out = np.empty((len(chosen), BINS), dtype=np.uint8)
        _rolled_bytes(self.readings, chosen, rolls, strain.astype(np.float32), out)
        return out, distance[chosen] <= options.label_edges


def learn_voters(samples: VoterSamples, options: TrainingOptions, nodes: range) -> Arrays:
    """The fields of `Voters` of some nodes; ``roots`` count from the first entry of them."""
    grown: list[tuple[npt.NDArray[np.int64], ...]] = []
    roots = np.empty((len(nodes), options.voters), dtype=np.int32)
    entries = 0
    for k, node in enumerate(nodes):
        rng = np.random.default_rng([options.seed, _STREAM_OF_VOTERS, node])
        readings, labels = samples.of_node(node, options, rng)
        for t in range(options.voters):
            drawn = rng.integers(0, len(labels), len(labels))
            keys = rng.integers(0, 2**31, (_ENTRIES, _TRIED))
            tree = grow(readings, labels, drawn, keys, _LEAST)
            roots[k, t] = entries
            entries += len(tree[0])
            grown.append(tree)
    component, threshold, right, on, off = (np.concatenate(c) for c in zip(*grown, strict=True))
    odds = np.log((on + _PRIOR[0]) / (off + _PRIOR[1])) / ODDS_UNIT
    leaf = component == LEAF
    return {
        "roots": roots,
        "component": component.astype(np.uint8),
        "threshold": threshold.astype(np.uint8),
        "right": right.astype(np.uint16),
        "odds": np.where(leaf, np.clip(np.rint(odds), -127, 127), 0).astype(np.int8),
    }


def joined(parts: list[Arrays]) -> Voters:
    """The voters of all nodes, in order."""
    offsets = np.cumsum([0, *(len(p["component"]) for p in parts[:-1])])
    roots = [p["roots"] + offset for p, offset in zip(parts, offsets, strict=True)]
    others = {
        name: np.concatenate([p[name] for p in parts])
        for name in ("component", "threshold", "right", "odds")
    }
    return Voters(roots=np.concatenate(roots).astype(np.int32), **others)


@njit(cache=True, nogil=True)
def _rolled_bytes(
    readings: Bytes, rows: npt.NDArray[np.intp], rolls_rad: Array,
    strain: npt.NDArray[np.float32], out: Bytes,
) -> None:  # fmt: skip
    """Rows of readings at rolls, each reading times its strain."""
    row = np.empty(readings.shape[1], dtype=np.float32)
    turned = np.empty(readings.shape[1], dtype=np.float32)
    for k in range(len(rows)):
        row[:] = readings[rows[k]]
        roll_readings(row, rolls_rad[k], turned)
        for b in range(len(row)):
            out[k, b] = np.uint8(min(max(np.rint(turned[b] * strain[k, b]), 0.0), 255.0))


@njit(cache=True, nogil=True)
def grow(
    readings: Bytes, labels: npt.NDArray[np.bool_], drawn: npt.NDArray[np.int64],
    keys: npt.NDArray[np.int64], least: int,
) -> tuple[npt.NDArray[np.int64], ...]:  # fmt: skip
    """One tree on drawn samples, depth first.

    ``keys`` (M, B) are random: entry i tries B bins, chosen by row i.

    Returns:
        Component (M,), LEAF at a leaf; threshold; entries ahead of the right child; samples on
        and off of every entry.
    """
    most = len(keys)
    component, threshold = np.full(most, LEAF), np.zeros(most, np.int64)
    right, on, off = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros(most, np.int64)
    samples, bins = drawn.copy(), np.arange(readings.shape[1])
    # First and last sample of parts that wait, and the entry whose right child they are.
    first, last, parent = np.zeros(most, np.int64), np.zeros(most, np.int64), np.full(most, -1)
    last[0], waiting, count = len(drawn), 1, 0
    while waiting > 0:
        waiting -= 1
        begin, end, above = first[waiting], last[waiting], parent[waiting]
        if above >= 0:
            right[above] = count - above
        entry = count
        count += 1
        for i in range(begin, end):
            on[entry] += labels[samples[i]]
        off[entry] = end - begin - on[entry]
        # A split makes two entries; room is kept for those that wait.
        if on[entry] == 0 or off[entry] == 0 or count + waiting + 2 > most:
            continue
        best = split(readings, labels, samples[begin:end], bins, keys[entry], least)
        if best[0] < 0:
            continue
        component[entry], threshold[entry] = best
        middle = begin
        for i in range(begin, end):
            if readings[samples[i], best[0]] <= best[1]:
                samples[i], samples[middle] = samples[middle], samples[i]
                middle += 1
        first[waiting], last[waiting], parent[waiting] = middle, end, entry
        first[waiting + 1], last[waiting + 1], parent[waiting + 1] = begin, middle, -1
        waiting += 2
    return component[:count], threshold[:count], right[:count], on[:count], off[:count]


@njit(cache=True, nogil=True)
def split(
    readings: Bytes, labels: npt.NDArray[np.bool_], samples: npt.NDArray[np.int64],
    bins: npt.NDArray[np.int64], keys: npt.NDArray[np.int64], least: int,
) -> tuple[int, int]:  # fmt: skip
    """Bin and threshold of the greatest gain (eq. 5) among some bins; bin −1 where none gains."""
    counts = np.empty((2, _LEVELS), np.int64)
    best, where, level = _LEAST_GAIN, -1, 0
    for t in range(len(keys)):
        swap = t + keys[t] % (len(bins) - t)
        bins[t], bins[swap] = bins[swap], bins[t]
        counts[:] = 0
        for i in samples:
            counts[int(labels[i]), readings[i, bins[t]]] += 1
        total = counts.sum(axis=1)
        whole = _n_log(total[0], total[1])
        a, b = 0, 0
        for v in range(_LEVELS - 1):
            if counts[0, v] == 0 and counts[1, v] == 0:
                continue
            a, b = a + counts[0, v], b + counts[1, v]
            if a + b < least or total[0] + total[1] - a - b < least:
                continue
            gain = _n_log(a, b) + _n_log(total[0] - a, total[1] - b) - whole
            if gain > best:
                best, where, level = gain, bins[t], v
    return where, level


@njit(cache=True, nogil=True, inline="always")
def _n_log(a: int, b: int) -> float:
    """``a ln(a/n) + b ln(b/n)``, n = a + b."""
    total = 0.0
    if a > 0:
        total += a * np.log(a / (a + b))
    if b > 0:
        total += b * np.log(b / (a + b))
    return total
