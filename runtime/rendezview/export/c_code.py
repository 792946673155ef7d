"""A view model as C99: the code of ``c/`` and the tables of one target."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import metadata, resources
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rendezview.export.tables import MOST_16_BIT, PackedForest, pack_forest
from rendezview.geometry.geodesic import Geodesic
from rendezview.io.files import atomic_write_text, make_folder
from rendezview.sensors.appearance import MatchOptions, ViewModel
from rendezview.sensors.appearance.model.signature import spokes_of

SOURCES = (
    "rendezview_flight.h",
    "rendezview_frame.h",
    "sky.c",
    "borders.c",
    "silhouette.c",
    "signature.c",
    "trees.c",
    "README.md",
)
MODEL = ("rendezview_model.h", "rendezview_model.c")
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
    header, tables = model_files(model)
    make_folder(folder)
    code = resources.files("rendezview.export") / "c"
    texts = {name: (code / name).read_text(encoding="utf-8") for name in SOURCES}
    texts |= dict(zip(MODEL, (header, tables), strict=True))
    for name, text in texts.items():
        atomic_write_text(folder / name, text)
    return [folder / name for name in texts]


def model_files(model: ViewModel, options: MatchOptions | None = None) -> tuple[str, str]:
    """``rendezview_model.h`` and ``rendezview_model.c`` of a model.

    Args:
        options: how far around an attitude nodes are asked, as in `Matcher`.
    """
    options = options or MatchOptions()
    packed, sphere = pack_forest(model), model.geodesic
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
    }
    defines = "\n".join(f"#define {name} {value}" for name, value in values.items())
    header = f"""{_comment(_describe(model, packed, types, reach_rad))}
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

#endif
"""
    pairs = zip(packed.bins // step, packed.children, strict=True)
    branches = [f"{{{b}u, {{{c[0]}u, {c[1]}u}}}}" for b, c in pairs]
    rotations = model.views.centred_from_target[:nodes, :2].reshape(nodes, 6)
    tables = [
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
    body = "\n".join(f"const {name} = {{\n{_wrapped(items)}\n}};\n" for name, items in tables)
    return header, (
        f"/* Tables of {_plain(model.name)}, written by `rendezview export`: do not edit. */\n"
        f'#include "rendezview_flight.h"\n\n{body}'
    )


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
    model: ViewModel, packed: PackedForest, types: dict[str, str], reach_rad: float
) -> list[str]:
    nodes, branches = len(packed.roots), int(packed.depths.sum())
    near = _most_within(model.geodesic, reach_rad)
    mesh = str(model.provenance.get("mesh_sha256", "unknown"))
    trees = _PER_BRANCH * branches + _PER_TREE * nodes
    local = 4 * (2 * model.bins + 1) + 14 * nodes + 18 * nodes
    return [
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


def _rows(array: npt.NDArray[np.float64]) -> list[str]:
    """Numbers of a table of rows; the braces of a row go with its first and last number."""
    words = []
    for row in array:
        numbers = [_hex(value) for value in row]
        words += [f"{{{numbers[0]}", *numbers[1:-1], f"{numbers[-1]}}}"]
    return words


def _hex(value: float) -> str:
    """A number as a C99 literal, exact to the last bit."""
    return float(value).hex()


def _wrapped(items: Iterable[str]) -> str:
    lines, line = [], "   "
    for item in items:
        if len(line) + len(item) + 2 > _MOST_CHARACTERS:
            lines.append(line)
            line = "   "
        line += f" {item},"
    return "\n".join([*lines, line])
