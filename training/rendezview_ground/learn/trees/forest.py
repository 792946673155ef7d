"""The forest: small trees of a node on whole and sunlit silhouettes; see `model.forest`.

They are scikit-learn's extremely randomised trees: each split tries a few random bins, at a random
threshold each (P. Geurts, D. Ernst, L. Wehenkel, Machine Learning 63, 2006). Samples are rounded up
to whole readings, as those at or below a whole threshold are: the runtime, which does not round,
decides as scikit-learn does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.geodesic import Geodesic, angle_between, within
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.forest import (
    BINS,
    LEAF,
    ODDS_UNIT,
    Bytes,
    ScoreForest,
)
from rendezview.sensors.appearance.model.shadowed_silhouettes import (
    READING_UNIT,
    ShadowedSilhouettes,
)
from rendezview.sensors.appearance.model.signature import rebinning, roll_readings, twist
from rendezview_ground.learn.jobs.stages import Arrays
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.learn.trees.fitted_tree import BRANCHLESS, FittedTree, joined_trees
from rendezview_ground.learn.views.views import ViewSet

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesClassifier

_STREAM_OF_FOREST = 7  # of random numbers, with the node
# Chosen on held-out views and silhouettes: larger leaves and fewer bins decide worse, random
# forests (the best threshold of each bin) decide alike in twice the time.
_TRIED = 20  # bins at a split, each at one random threshold
_LEAST_SPLIT, _LEAST_LEAF = 6, 3  # samples
_LEAST_GAIN = 1.0  # nats of all samples
_MOST_LEAVES = 8192  # a leaf has a larger share of the samples, so entries are counted in 16 bits
_FAR_FRACTION = 0.1  # of the samples beyond the reach; they keep distant nodes inactive
_PRIOR = (0.15, 2.5)  # samples on and off in every leaf, before any is seen
_SHAPE_ERROR = 0.01  # one σ of a sample's readings, smooth over the outline: error of the mesh
_WAVES = 6  # of that error around the outline


@dataclass(frozen=True, slots=True, eq=False)
class ForestSamples:
    """Signatures in BINS bytes with their attitudes: whole silhouettes, then sunlit ones."""

    order: int
    node_rotations: Array  # (nodes, 3, 3)
    readings: Bytes  # (K, BINS) in READING_UNIT
    centred_from_target: npt.NDArray[np.float32]  # (K, 3, 3)
    direction: npt.NDArray[np.float32]  # (K, 3) unit, view centre → camera

    @classmethod
    def of(
        cls, order: int, lattice: ViewSet, perturbed: ViewSet | None, lit: ShadowedSilhouettes
    ) -> ForestSamples:
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
        widest = max(options.reach_edges, options.far_edges) * sphere.mean_edge_rad
        chosen = within(self.direction, sphere.nodes[node], widest)
        distance = angle_between(self.direction[chosen], sphere.nodes[node]) / sphere.mean_edge_rad
        near = distance <= options.reach_edges
        taken = near | (rng.random(len(near)) < _FAR_FRACTION)
        chosen, distance = chosen[taken], distance[taken]
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
        return out, distance <= options.label_edges


def stream_of(options: TrainingOptions, node: int) -> np.random.Generator:
    """The random numbers of a node."""
    return np.random.default_rng([options.seed, _STREAM_OF_FOREST, node])


def forest_of(
    readings: Bytes,
    labels: npt.NDArray[np.bool_],
    options: TrainingOptions,
    rng: np.random.Generator,
) -> ExtraTreesClassifier:
    """Fit scikit-learn's forest to the samples of a node: readings (K, BINS) and labels (K,)."""
    from sklearn.ensemble import ExtraTreesClassifier  # slow to import

    return ExtraTreesClassifier(
        options.forest_trees,
        criterion="entropy",
        max_features=_TRIED,
        min_samples_split=_LEAST_SPLIT,
        min_samples_leaf=max(_LEAST_LEAF, len(labels) // _MOST_LEAVES),
        min_impurity_decrease=_LEAST_GAIN / np.log(2.0) / len(labels),  # bits per sample
        n_jobs=1,  # the shards are the parallelism
        random_state=int(rng.integers(2**32)),
    ).fit(readings, labels)


def learn_forest(samples: ForestSamples, options: TrainingOptions, nodes: range) -> Arrays:
    """The fields of `ScoreForest` of some nodes; ``roots`` count from the first entry of them."""
    grown: list[FittedTree] = []
    roots = np.empty((len(nodes), options.forest_trees), dtype=np.int32)
    entries = 0
    for k, node in enumerate(nodes):
        rng = stream_of(options, node)
        forest = forest_of(*samples.of_node(node, options, rng), options, rng)
        for t, tree in enumerate(forest.estimators_):
            grown.append(FittedTree.of(tree, forest.classes_))
            roots[k, t] = entries
            entries += len(grown[-1].component)
    component, threshold, right, on, off = (np.concatenate(c) for c in zip(*grown, strict=True))
    odds = np.log((on + _PRIOR[0]) / (off + _PRIOR[1])) / ODDS_UNIT
    leaf = component == BRANCHLESS
    return {
        "roots": roots,
        "component": np.where(leaf, LEAF, component).astype(np.uint8),
        "threshold": threshold.astype(np.uint8),
        "right": right.astype(np.uint16),
        "odds": np.where(leaf, np.clip(np.rint(odds), -127, 127), 0).astype(np.int8),
    }


def joined(parts: list[Arrays]) -> ScoreForest:
    """The forest of all nodes, in order."""
    return ScoreForest(**joined_trees(parts, ("roots",)))


@njit(cache=True, nogil=True, error_model="numpy")
def _rolled_bytes(
    readings: Bytes, rows: npt.NDArray[np.intp], rolls_rad: Array,
    strain: npt.NDArray[np.float32], out: Bytes,
) -> None:  # fmt: skip
    """Rows of readings at rolls, each reading times its strain, rounded up."""
    row = np.empty(readings.shape[1], dtype=np.float32)
    turned = np.empty(readings.shape[1], dtype=np.float32)
    for k in range(len(rows)):
        row[:] = readings[rows[k]]
        roll_readings(row, rolls_rad[k], turned)
        for b in range(len(row)):
            out[k, b] = np.uint8(min(max(np.ceil(turned[b] * strain[k, b]), 0.0), 255.0))
