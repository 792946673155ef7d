"""The paper's own trees: its Table I, its figures 3 and 4, and how many features a node needs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from rendezview.sensors.appearance.outline.trees import Forest, split_entropy
from rendezview.training.job import train
from rendezview.training.neighbourhood import neighbourhood
from rendezview.training.options import Neighbourhood, TrainingOptions
from rendezview.training.views import look_from

from experiments.frame import mesh_of, show, table_of
from rendezview.geometry.geodesic import Geodesic, angle_between
from rendezview.geometry.pose import Array

# Cleghorn & Sternberg 1991, Table I; category 1 is the left one.
TABLE_I = np.array(
    [[0.6, 1.0, 1.0], [0.4, 1.0, 0.8], [0.6, 1.0, 0.8], [0.6, 1.2, 0.8], [0.6, 4.4, 0.8]]
)
CATEGORY = np.array([2, 1, 2, 1, 2])
# The tree of figure 4, as the listing beside it: component, threshold, left, right, category.
FIGURE_4 = (
    (1, 1.1, 1, 6, 0), (2, 0.9, 2, 5, 0), (0, 0.5, 3, 4, 0), (-1, 0, 0, 0, 1), (-1, 0, 0, 0, 2),
    (-1, 0, 0, 0, 2), (1, 2.3, 7, 8, 0), (-1, 0, 0, 0, 1), (-1, 0, 0, 0, 2),
)  # fmt: skip
FEW = 10  # "no more than about 10 characteristic features"
WIDTH, HEIGHT = 61, 31  # characters


def figure_4() -> Forest:
    """The paper's tree; components count from 0."""
    component, threshold, left, right, category = (np.array(c) for c in zip(*FIGURE_4, strict=True))
    return Forest(
        np.zeros(1, np.int32), component.astype(np.int16), threshold.astype(np.float32),
        left.astype(np.int32), right.astype(np.int32), category.astype(np.uint8),
    )  # fmt: skip


def table_i() -> None:
    """Table I with the answers of figure 4, and the entropy of the best first splits."""
    tree = figure_4()
    rows = table_of("Table I", "sample | r1 | r2 | r3 | category | figure 4 says")
    for k, sample in enumerate(TABLE_I):
        answer = int(tree.category[tree.leaf(0, sample.astype(np.float32))])
        rows.add_row(f"s{k + 1}", *map(str, sample), str(CATEGORY[k]), str(answer))
    show(rows)
    print("Figure 4:")
    print(tree.rules(0, "r{}").replace("r2", "r3").replace("r1", "r2").replace("r0", "r1"))
    print("First splits by equation 5 (the greatest is the best; the paper's tree is not greedy):")
    for component in range(3):
        values = np.unique(TABLE_I[:, component])
        for threshold in 0.5 * (values[1:] + values[:-1]):
            left = TABLE_I[:, component] <= threshold
            counts = [[int(np.sum(CATEGORY[side] == c)) for c in (1, 2)] for side in (left, ~left)]
            print(f"  r{component + 1} <= {threshold:.2f}: {split_entropy(*counts):.4f}")


def figure_3(node: int, order: int) -> None:
    """The training views about a node as the node's camera sees them: O in, X out."""
    lattice = Geodesic.of_order(order + 1)
    inside, outside = neighbourhood(lattice, node, Neighbourhood.DISC)
    edge = Geodesic.of_order(order).mean_edge_rad
    right, down, _ = look_from(lattice.nodes[node])
    page = [[" "] * WIDTH for _ in range(HEIGHT)]
    for views, mark in ((outside, "X"), (inside, "O")):
        for view in views:
            place = _place(lattice.nodes[view], right, down) / edge
            x, y = WIDTH // 2 + round(12.0 * place[0]), HEIGHT // 2 + round(6.0 * place[1])
            page[y][x] = mark
    print(f"Figure 3, node {node}: {len(inside)} views in (O), {len(outside)} out (X)")
    print("\n".join("".join(line).rstrip() for line in page if "".join(line).strip()))
    far = angle_between(lattice.nodes[np.concatenate([inside, outside])], lattice.nodes[node])
    print(
        f"in: up to {far[: len(inside)].max() / edge:.2f} edges, out: up to {far.max() / edge:.2f}"
    )


def _place(direction: Array, right: Array, down: Array) -> Array:
    return np.array([right @ direction, down @ direction])


def run(
    target: Annotated[str, "mesh, target.toml, or hubble, client, scole"],
    *, node: Annotated[int, "of figure 3"] = 100, bins: int = 360, seed: int = 1,
) -> None:  # fmt: skip
    """The paper's own trees: its Table I, its figures 3 and 4, and how many features a node needs.

    Trains TARGET as `rendezview train --paper` does. A feature is a bin that a tree looks at.
    Decisions are those on perturbed views, which the paper does not have.
    """
    table_i()
    print()
    name, mesh = mesh_of(target)
    options = TrainingOptions(bins=bins, seed=seed, held_out_views=1000).paper()
    figure_3(node, options.order)
    with tempfile.TemporaryDirectory() as folder:
        trained = train(mesh, Path(folder) / "paper.rvm", name=name, options=options, jobs=1)
    forest, decisions = trained.model.forest, trained.decisions
    counts = [forest.feature_count(k) for k in range(len(forest))]
    longest = [forest.depth(k) for k in range(len(forest))]
    rows = table_of(f"{name}: the paper's trees, {bins} bins", "features | nodes")
    for least, most in ((0, 3), (4, 6), (7, FEW), (FEW + 1, bins)):
        some = sum(least <= count <= most for count in counts)
        rows.add_row(f"{least}–{most}", str(some))
    show(rows)
    few = 100.0 * np.mean(np.array(counts) <= FEW)
    print(f"features of a tree: median {np.median(counts):.0f}, most {max(counts)}; "
          f"{few:.1f} % of the nodes have {FEW} at most; depth {np.mean(longest):.1f}")  # fmt: skip
    if decisions is not None:
        right = decisions.in_right.sum() + decisions.out_right.sum()
        total = decisions.in_total.sum() + decisions.out_total.sum()
        print(f"decisions right on perturbed views: {100.0 * right / total:.1f} %")
    for k in (int(np.argmin(counts)), int(np.argmax(counts))):
        print(f"Figure 5, node {k}:\n{forest.listing(k)}")
