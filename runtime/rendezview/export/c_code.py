"""A view model as C99: the code of ``c/`` and the tables of one target."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.export.tables import (
    MOST_16_BIT,
    PackedForest,
    PackedScoreForest,
    pack_forest,
    pack_score_forest,
)
from rendezview.geometry.geodesic import Geodesic
from rendezview.io.files import atomic_write_text, make_folder
from rendezview.sensors.appearance import MatchOptions, ViewModel
from rendezview.sensors.appearance.model.forest import INSIDE_EDGES, ODDS_UNIT
from rendezview.sensors.appearance.model.shadowed_silhouettes import READING_UNIT
from rendezview.sensors.appearance.model.signature import spokes_of
from rendezview.sensors.appearance.outline.votes import EVEN_ODDS, LEAST_ODDS, STEEPNESS

SOURCES = (
    "rendezview_flight.h",
    "rendezview_frame.h",
    "sky.c",
    "borders.c",
    "silhouette.c",
    "signature.c",
    "trees.c",
    "forest.c",
    "README.md",
)
MODEL = ("rendezview_model.h", "rendezview_model.c", "rendezview_forest.c")
Tables = list[tuple[str, list[str]]]  # declaration and numbers of each
_MOST_CHARACTERS = 99  # per line of a table. Source: chosen

# Floating-point operations, counted in the C code; integer work is of the same order.
_PER_BRANCH = 8  # Source: by construction
_PER_TREE = 8  # Source: by construction
_PER_NODE = 30  # nearness and roll, without atan2. Source: by construction
_PER_PAIR = 9  # operations per pair of active nodes, without exp. Source: by construction


def write_c(model: ViewModel, folder: Path) -> list[Path]:
    """Write the flight code of a model into a folder, which is created if it does not exist.

    Returns:
        The files written: headers, sources, README.md.

    Raises:
        RendezviewError: the trees do not fit the tables, or a file cannot be written.
    """
    own = dict(zip(MODEL, model_files(model), strict=True))
    make_folder(folder)
    code = resources.files("rendezview.export") / "c"
    texts = {name: (code / name).read_text(encoding="utf-8") for name in SOURCES}
    texts |= own
    for name, text in texts.items():
        atomic_write_text(folder / name, text)
    return [folder / name for name in texts]


def model_files(model: ViewModel) -> tuple[str, str, str]:
    """The texts of ``MODEL``; without a forest, the last holds no table."""
    options = MatchOptions()  # how far around an attitude nodes are asked, as in `Matcher`
    packed, scores, sphere = pack_forest(model), pack_score_forest(model), model.geodesic
    wide_index = len(packed.bins) > MOST_16_BIT or len(packed.on_leaves) > MOST_16_BIT
    step = int(np.gcd.reduce(packed.bins)) or 1
    types = {
        "bin": _shortest(packed.bins.max() // step),
        "child": _shortest(packed.children.max()),
        "index": "uint32_t" if wide_index else "uint16_t",
    }
    reach_rad = (options.margin_edges + 2.0) * sphere.mean_edge_rad
    margin_rad = options.margin_edges * sphere.mean_edge_rad
    width = (options.kernel_edges * sphere.mean_edge_rad) ** 2
    nodes = len(packed.roots)
    values = {
        "RDV_BINS": f"{model.bins}u",
        "RDV_SMOOTH_BINS": f"{model.smooth_bins}u",
        "RDV_NODES": f"{nodes}u",
        "RDV_BRANCHES": f"{len(packed.bins)}u",
        "RDV_BIN_STEP": f"{step}u /* trees ask every so many bins */",
        "RDV_ON_LEAVES": f"{max(1, len(packed.on_leaves))}u",
        "RDV_TRUSTS": f"{max(1, len(packed.trusts))}u",
        "RDV_LONGEST_STEP": f"{packed.longest_step}u",
        "RDV_REACH_RAD": f"{_hex(reach_rad)} /* {reach_rad:.4f}: around a known attitude */",
        "RDV_MARGIN_RAD": f"{_hex(margin_rad)} /* {margin_rad:.4f}: beyond the error of one */",
        "RDV_KERNEL_WIDTH": f"{_hex(width)} /* of the consensus */",
        "RDV_TABLE_BYTES": f"{_table_bytes(model, packed, types)}u",
        "RDV_DEEPEST_TREE": f"{packed.depths.max()}u /* branches */",
        "RDV_ALL_DEPTHS": f"{packed.depths.sum()}u /* branches, all trees at their worst */",
        "RDV_FOREST_TREES": "0u /* the model has no forest */",
    }
    externs = ""
    forest: Tables = []
    if scores is not None:
        more, forest = _forest(scores, sphere)
        values |= more
        externs = "".join(f"extern const {name};\n" for name, _ in forest)
    defines = "\n".join(f"#define {name} {value}" for name, value in values.items())
    header = f"""{_comment(_describe(model, packed, scores, types, reach_rad))}
#ifndef RENDEZVIEW_MODEL_H
#define RENDEZVIEW_MODEL_H

/* Included by rendezview_flight.h. */

{defines}

typedef {types["bin"]} rdv_bin; /* in steps */
typedef {types["child"]} rdv_child;
typedef {types["index"]} rdv_index;

/* Go to child[0] where the reading is at most the threshold. A child is 0, a leaf that means
 * off; up to RDV_LONGEST_STEP, a branch so many entries ahead; above, a leaf of this tree that
 * means on. */
typedef struct
{{
    rdv_bin bin;
    rdv_child child[2];
}} rdv_branch;

extern const rdv_branch rdv_branches[RDV_BRANCHES];
extern const uint16_t rdv_thresholds[RDV_BRANCHES];
extern const rdv_index rdv_roots[RDV_NODES];
extern const rdv_index rdv_first_on[RDV_NODES];    /* place of a tree's first on leaf ... */
extern const uint16_t rdv_on_leaves[RDV_ON_LEAVES]; /* ... in this: index of its trust */
extern const rdv_f64 rdv_trusts[RDV_TRUSTS];
extern const rdv_f64 rdv_directions[RDV_NODES][3]; /* from the view centre, target frame */
extern const rdv_f64 rdv_attitudes[RDV_NODES][6];  /* x and y axes of the centred camera */
extern const rdv_f64 rdv_spokes[RDV_BINS][2];      /* cosine and sine of each bin */
{externs}
#endif
"""
    pairs = zip(packed.bins // step, packed.children, strict=True)
    branches = [f"{{{b}u, {{{c[0]}u, {c[1]}u}}}}" for b, c in pairs]
    rotations = model.views.centred_from_target[:nodes, :2].reshape(nodes, 6)
    tables: Tables = [
        ("rdv_branch rdv_branches[RDV_BRANCHES]", branches),
        ("uint16_t rdv_thresholds[RDV_BRANCHES]", [f"{t}u" for t in packed.thresholds]),
        ("rdv_index rdv_roots[RDV_NODES]", [f"{k}u" for k in packed.roots]),
        ("rdv_index rdv_first_on[RDV_NODES]", [f"{k}u" for k in packed.first_on]),
        ("uint16_t rdv_on_leaves[RDV_ON_LEAVES]", [f"{k}u" for k in packed.on_leaves] or ["0u"]),
        ("rdv_f64 rdv_trusts[RDV_TRUSTS]", [_hex(t) for t in packed.trusts] or ["0.0"]),
        ("rdv_f64 rdv_directions[RDV_NODES][3]", _rows(sphere.nodes)),
        ("rdv_f64 rdv_attitudes[RDV_NODES][6]", _rows(rotations)),
        ("rdv_f64 rdv_spokes[RDV_BINS][2]", _rows(spokes_of(model.bins))),
    ]
    return header, _tables(model.name, tables), _tables(model.name, forest)


def _tables(name: str, tables: Tables) -> str:
    body = "\n".join(f"const {what} = {{\n{_wrapped(items)}\n}};\n" for what, items in tables)
    return (
        f"/* Tables of {_plain(name)}, written by `rendezview export`: do not edit. */\n"
        f'#include "rendezview_flight.h"\n\n{body}'
    )


def _forest(scores: PackedScoreForest, sphere: Geodesic) -> tuple[dict[str, str], Tables]:
    """Values of the header, and the tables, of a forest."""
    bins, window = scores.windows.shape
    trees = scores.roots.shape[1]
    cosine = float(np.cos(INSIDE_EDGES * sphere.mean_edge_rad))
    size = 4 * (scores.entries.size + scores.roots.size + scores.windows.size) + 2 * bins
    values = {
        "RDV_FOREST_TREES": f"{trees}u /* of a node */",
        "RDV_FOREST_BYTES": f"{size}u /* of tables, in rendezview_forest.c */",
        "RDV_FOREST_ENTRIES": f"{len(scores.entries)}u",
        "RDV_FOREST_DEPTH": f"{scores.depth}u /* branches */",
        "RDV_FOREST_BINS": f"{bins}u",
        "RDV_FOREST_UNIT": f"{READING_UNIT}f /* readings */",
        "RDV_FOREST_COSINE": f"{_hex(cosine)} /* a score is of the nodes within an edge */",
        "RDV_WINDOW": f"{window}u /* readings of a bin of the forest */",
        "RDV_ODDS_UNIT": _hex(ODDS_UNIT),
        "RDV_LEAST_ODDS": f"({_hex(LEAST_ODDS)}) /* log odds above which a node is active */",
        "RDV_EVEN_ODDS": f"({_hex(EVEN_ODDS)}) /* at which its trust is a half */",
        "RDV_ODDS_STEEPNESS": _hex(STEEPNESS),
    }
    weights = _rows(scores.windows, lambda weight: f"{_hex(weight)}f")
    roots = _rows(scores.roots, "{}u".format)
    return values, [
        ("uint32_t rdv_forest[RDV_FOREST_ENTRIES]", [f"{entry}u" for entry in scores.entries]),
        ("uint32_t rdv_forest_roots[RDV_NODES][RDV_FOREST_TREES]", roots),
        ("uint16_t rdv_window_starts[RDV_FOREST_BINS]", [f"{k}u" for k in scores.starts]),
        ("rdv_f32 rdv_windows[RDV_FOREST_BINS][RDV_WINDOW]", weights),
    ]


def _table_bytes(model: ViewModel, packed: PackedForest, types: dict[str, str]) -> int:
    part, child = (1 if types[name] == "uint8_t" else 2 for name in ("bin", "child"))
    aligned = max(part, child)  # the bin, so that the children start at a multiple of theirs
    index = 2 if types["index"] == "uint16_t" else 4
    nodes = len(packed.roots)
    return (
        (2 + aligned + 2 * child) * len(packed.bins)
        + 2 * index * nodes
        + 2 * max(1, len(packed.on_leaves))
        + 8 * (max(1, len(packed.trusts)) + 9 * nodes + 2 * model.bins)
    )


def _shortest(largest: int) -> str:
    return "uint8_t" if largest <= 255 else "uint16_t"


def _describe(
    model: ViewModel,
    packed: PackedForest,
    scores: PackedScoreForest | None,
    types: dict[str, str],
    reach_rad: float,
) -> list[str]:
    nodes, branches = len(packed.roots), int(packed.depths.sum())
    near = _most_within(model.geodesic, reach_rad)
    mesh = str(model.provenance.get("mesh_sha256", "unknown"))
    trees = _PER_BRANCH * branches + _PER_TREE * nodes
    local = 4 * (2 * model.bins + 1) + 14 * nodes + 18 * nodes
    lines = [
        f"The view model of {_plain(model.name)}, written by `rendezview export` of rendezview "
        f"{metadata.version('rendezview')}: do not edit. Mesh SHA-256 {_plain(mesh)}.",
        "",
        f"Size: {_table_bytes(model, packed, types)} bytes of const tables: {nodes} trees of "
        f"{len(packed.bins)} branches and {len(packed.on_leaves)} leaves that mean on. Code: about "
        "16 kB. No writable data. Stack: about "
        f"{(local + 2048) // 1000 + 1} kB in rdv_search, {(16 * model.bins + 2048) // 1000 + 1} kB "
        "in rdv_signature_of, 16 kB in rdv_silhouette.",
        "",
        "Worst case, floating-point operations (integer work is of the same order); M points of "
        "an outline, P pixels of a frame, K active nodes:",
        f"  one tree          {int(packed.depths.max())} branches of {_PER_BRANCH}",
        f"  rdv_all_trees     {trees}: {branches} branches of {_PER_BRANCH}, "
        f"{nodes} starts of {_PER_TREE}",
        f"  rdv_search        {_PER_NODE * nodes + trees} + {nodes} atan2, and {_PER_PAIR} and an "
        "exp for each of K (K + 5)",
        f"                    at RDV_REACH_RAD: at most {near} nodes, so {near} atan2 and K <= "
        f"{near}",
        f"  rdv_signature_of  90 M + 10 for each crossing of outline and bin, at most "
        f"{model.bins // 2 + 1} M; {7 * model.bins} for the readings",
        "  rdv_search_around E + 3 times rdv_search, E being the error in degrees",
        "  rdv_silhouette    9 P integer operations; 25 for each point of the outline; 10 for each "
        "pair of blobs",
    ]
    if scores is not None:
        each = 8 * scores.windows.shape[0] + 2 * scores.roots.shape[1] * scores.depth
        close = _most_within(model.geodesic, INSIDE_EDGES * model.geodesic.mean_edge_rad)
        lines += [
            f"  rdv_forest_score  at most {close} nodes of {each} and an atan2: "
            f"{scores.roots.shape[1]} trees of {scores.depth} branches each",
            f"  rdv_forest_search at RDV_REACH_RAD, {near} such nodes; then as rdv_search",
        ]
    return lines


def _most_within(sphere: Geodesic, reach_rad: float) -> int:
    """Upper bound of the nodes within reach of a direction: each lies within an edge of a node."""
    farther = reach_rad + 1.1 * sphere.mean_edge_rad
    return max(len(sphere.within(node, farther)) for node in sphere.nodes)


def _comment(lines: list[str]) -> str:
    folded = []
    for line in lines:
        start = " * "
        for word in line.split(" "):
            if len(start) + len(word) > _MOST_CHARACTERS and start.strip(" *"):
                folded.append(start.rstrip())
                start = " * " + ("                    " if line.startswith("  ") else "")
            start += word + " "
        folded.append(start.rstrip())
    return "/*" + "\n".join(folded)[2:] + "\n */"


def _plain(text: str) -> str:
    """A name that is safe in a C comment."""
    return "".join(c if c.isascii() and (c.isalnum() or c in " ._-+") else "_" for c in text)


def _hex(value: float) -> str:
    """A number as a C99 literal, exact to the last bit."""
    return float(value).hex()


def _rows(array: npt.NDArray[Any], word: Callable[[Any], str] = _hex) -> list[str]:
    """Numbers of a table of rows; the braces of a row go with its first and last number."""
    words = []
    for row in array:
        numbers = [word(value) for value in row]
        numbers[0] = f"{{{numbers[0]}"
        numbers[-1] += "}"
        words += numbers
    return words


def _wrapped(items: Iterable[str]) -> str:
    lines, line = [], "   "
    for item in items:
        if len(line) + len(item) + 2 > _MOST_CHARACTERS:
            lines.append(line)
            line = "   "
        line += f" {item},"
    return "\n".join([*lines, line])
