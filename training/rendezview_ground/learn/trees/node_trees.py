"""One entropy decision tree for each node of the sphere."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.geodesic import Geodesic, angle_between, within
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.signature import Readings, rolled, twist
from rendezview.sensors.appearance.model.trees import Forest
from rendezview_ground.learn.jobs.stages import Arrays
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.learn.trees.fitted_tree import BRANCHLESS, FittedTree, joined_trees, seed_of
from rendezview_ground.learn.trees.neighbourhood import neighbourhood
from rendezview_ground.learn.views.views import ViewSet

if TYPE_CHECKING:
    from sklearn.tree import DecisionTreeClassifier

IN_EDGES = 1.0  # edges; a view within this distance of the node should be recognised
OUT_EDGES = (1.32, 3.0)  # edges; a view in this range should not. The lattice has none between


@dataclass(frozen=True, slots=True, eq=False)
class TreeSet:
    """Trees of consecutive nodes, with the number of training samples that reached each entry."""

    forest: Forest
    leaf_on: npt.NDArray[np.int32]  # (M,)
    leaf_off: npt.NDArray[np.int32]  # (M,)
    training_accuracy: Array  # (T,)

    def arrays(self) -> Arrays:
        """All arrays, those of the forest too, by name."""
        forest = {f.name: getattr(self.forest, f.name) for f in fields(Forest)}
        return forest | {name: getattr(self, name) for name in _OF_SAMPLES}

    @classmethod
    def joined(cls, parts: list[Arrays]) -> TreeSet:
        """Of the arrays of several sets, in order."""
        arrays = joined_trees(parts, ("roots", "left", "right"))
        own = {name: arrays.pop(name) for name in _OF_SAMPLES}
        return cls(Forest(**arrays), **own)


_OF_SAMPLES = ("leaf_on", "leaf_off", "training_accuracy")


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """The training data of the trees: the lattice's views and the perturbed views."""

    order: int
    lattice: ViewSet
    perturbed: ViewSet | None

    def of_node(
        self, node: int, options: TrainingOptions
    ) -> tuple[Readings, npt.NDArray[np.bool_]]:
        """Readings (K, N), rolled to the node's own camera, and labels (K,)."""
        lattice = Geodesic.of_order(self.order + 1)
        node_rotation = self.lattice.centred_from_target[node]
        inside, outside = neighbourhood(lattice, node, options.neighbourhood)
        chosen = np.concatenate([inside, outside])
        rolls = twist(self.lattice.centred_from_target[chosen], node_rotation)
        readings = [_rolled_rows(self.lattice.readings, chosen, rolls)]
        labels = [np.arange(len(chosen)) < len(inside)]
        if self.perturbed is not None:
            rng = np.random.default_rng([options.seed, _STREAM_OF_NODES, node])
            edge = Geodesic.of_order(self.order).mean_edge_rad
            widest = max(options.reach_edges, options.far_edges) * edge
            chosen = within(self.perturbed.direction, lattice.nodes[node], widest)
            distance = angle_between(self.perturbed.direction[chosen], lattice.nodes[node]) / edge
            taken = distance <= options.reach_edges
            taken |= rng.random(len(distance)) < options.far_fraction
            chosen, distance = chosen[taken], distance[taken]
            rolls = twist(self.perturbed.centred_from_target[chosen], node_rotation)
            rolls = rolls + options.roll_error_rad * rng.normal(size=len(chosen))
            readings.append(_rolled_rows(self.perturbed.readings, chosen, rolls))
            labels.append(distance <= options.label_edges)
        return np.concatenate(readings), np.concatenate(labels)


_STREAM_OF_NODES = 3  # of random numbers; views use 1 and 2
# Of a component: more make learning slower, and decisions on held-out views no better.
_LEVELS = 64


def learn_trees(samples: Samples, options: TrainingOptions, nodes: range) -> TreeSet:
    """Entropy trees (eq. 5) of some nodes, with the paper's three stopping rules."""
    return TreeSet.joined(
        [learned_tree(*samples.of_node(node, options), options, node).arrays() for node in nodes]
    )


class Levels(NamedTuple):
    """Steps in which a tree compares each of C components: fewer values are sorted faster."""

    low: Array  # (C,) least reading
    width: Array  # (C,) readings in a step

    @classmethod
    def of(cls, components: Readings) -> Levels:
        """Of samples (K, C)."""
        low = components.min(axis=0).astype(np.float64)
        return cls(low, np.ceil((components.max(axis=0) - low + 1.0) / _LEVELS))

    def levels(self, components: Readings) -> Array:
        """(K, C) whole steps above the least reading; readings of other samples may be outside."""
        return np.floor((components - self.low) / self.width)

    def threshold(self, component: npt.NDArray[np.int64], level: Array) -> Array:
        """(M,) the greatest whole reading at or below a whole level."""
        return self.low[component] + self.width[component] * (level + 1.0) - 1.0


def fitted(
    readings: Readings, labels: npt.NDArray[np.bool_], options: TrainingOptions, node: int
) -> tuple[DecisionTreeClassifier, Levels]:
    """Fit scikit-learn's tree of a node, to levels of every ``component_step``-th bin.

    Args:
        readings: (K, N) whole.
        labels: (K,) whether the node is active.
        options: the stopping rules, and which bins are components.
        node: decides which of two equal splits is taken.
    """
    from sklearn.tree import DecisionTreeClassifier  # slow to import

    components = readings[:, :: options.component_step]
    levels = Levels.of(components)
    classifier = DecisionTreeClassifier(
        criterion="entropy",
        min_samples_split=options.min_samples_split,
        min_impurity_decrease=options.min_gain / np.log(2.0),  # bits
        random_state=seed_of(options.seed, _STREAM_OF_NODES, node),
    )
    return classifier.fit(levels.levels(components), labels), levels


def learned_tree(
    readings: Readings, labels: npt.NDArray[np.bool_], options: TrainingOptions, node: int
) -> TreeSet:
    """Learn one tree; see ``fitted``.

    Thresholds are whole numbers, so that a listing reproduces the tree exactly.
    """
    classifier, levels = fitted(readings, labels, options, node)
    tree = FittedTree.of(classifier, classifier.classes_)
    inner, entries = tree.component != BRANCHLESS, np.arange(len(tree.component))
    threshold = np.where(inner, levels.threshold(tree.component, tree.threshold), 0.0)
    leaf_on = np.where(inner, 0, tree.on).astype(np.int32)
    leaf_off = np.where(inner, 0, tree.off).astype(np.int32)
    forest = Forest(
        np.zeros(1, dtype=np.int32),
        np.where(inner, tree.component * options.component_step, BRANCHLESS).astype(np.int16),
        threshold.astype(np.float32),
        np.where(inner, entries + 1, 0).astype(np.int32),
        np.where(inner, entries + tree.right, 0).astype(np.int32),
        (leaf_on > leaf_off).astype(np.uint8),
    )
    right = np.maximum(leaf_on, leaf_off).sum() / len(labels)
    return TreeSet(forest, leaf_on, leaf_off, np.array([right]))


@dataclass(frozen=True, slots=True, eq=False)
class Decisions:
    """Correct and wrong decisions of each node (T,) on held-out views."""

    in_right: npt.NDArray[np.int64]
    in_total: npt.NDArray[np.int64]
    out_right: npt.NDArray[np.int64]
    out_total: npt.NDArray[np.int64]

    @property
    def accuracy(self) -> Array:
        """(T,) share of correct decisions; NaN for a node without views."""
        total = self.in_total + self.out_total
        right = self.in_right + self.out_right
        share = np.full(len(total), np.nan)
        np.divide(right, total, out=share, where=total > 0)
        return share


def decide(
    forest: Forest,
    node_rotations: Array,
    sphere: Geodesic,
    views: ViewSet,
    roll_error_rad: float,
    rng: np.random.Generator,
) -> Decisions:
    """Test every node on all views within three edges of it.

    In-views lie within one edge of the node, out-views between 1.32 and 3 edges. Views between have
    no correct answer, because the paper's lattice has none there. The roll of each view is given
    with a Gaussian error of ``roll_error_rad``.
    """
    count = len(sphere.nodes)
    in_right, in_total = np.zeros(count, np.int64), np.zeros(count, np.int64)
    out_right, out_total = np.zeros(count, np.int64), np.zeros(count, np.int64)
    edge = sphere.mean_edge_rad
    for k in range(len(views)):
        nodes = sphere.within(views.direction[k], OUT_EDGES[1] * edge)
        distance = angle_between(sphere.nodes[nodes], views.direction[k]) / edge
        rolls = twist(views.centred_from_target[k], node_rotations[nodes])
        rolls = rolls + roll_error_rad * rng.normal()
        on = forest.category[forest.leaves(views.readings[k], nodes, rolls)] == 1
        inside, outside = distance <= IN_EDGES, distance >= OUT_EDGES[0]
        in_total[nodes[inside]] += 1
        in_right[nodes[inside & on]] += 1
        out_total[nodes[outside]] += 1
        out_right[nodes[outside & ~on]] += 1
    return Decisions(in_right, in_total, out_right, out_total)


def _rolled_rows(readings: Readings, rows: npt.NDArray[np.intp], rolls_rad: Array) -> Readings:
    out = np.empty((len(rows), readings.shape[1]), dtype=np.float32)
    _roll_rows(readings, rows, rolls_rad, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _roll_rows(
    readings: Readings, rows: npt.NDArray[np.intp], rolls_rad: Array, out: Readings
) -> None:
    for i in range(rows.shape[0]):
        out[i] = rolled(readings[rows[i]], rolls_rad[i])
