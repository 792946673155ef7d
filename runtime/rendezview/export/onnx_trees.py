"""The trees of a model as an ONNX graph, for runtimes and accelerators that read it.

One signature and a roll for every node in, the trust of every node out. The graph rolls the
signature for each tree as the flight code does, and asks all trees in one
``TreeEnsembleRegressor``, each tree a target of its own with features of its own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import optional
from rendezview.io.files import atomic_write
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.outline.votes import Matcher

_OPSET, _ML_OPSET = 17, 3  # supported by recent runtimes
_IR_VERSION = 8  # of the ONNX format that goes with the opset. Source: ONNX's table of versions


def write_onnx(model: ViewModel, path: Path) -> None:
    """Write the trees as an ONNX graph, atomically.

    Inputs: ``readings`` float (N,), a signature; ``rolls_rad`` double (T,), of the view against
    each node, see `twist` of the signature. Outputs: ``trust`` float (T,), how reliably each
    node means on; ``on`` bool (T,).

    Raises:
        RendezviewError: the package onnx is not installed, or the file cannot be written.
    """
    with optional("writing ONNX needs the package", "onnx"):
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    bins, trees = model.bins, len(model.forest)

    def constant(name: str, values: npt.ArrayLike, kind: type) -> Any:
        return numpy_helper.from_array(np.asarray(values, dtype=kind), name)

    constants = [
        constant("bins", bins, np.int64),
        constant("bins_double", bins, np.float64),
        constant("turn", 2.0 * np.pi, np.float64),
        constant("one", 1.0, np.float32),
        constant("zero", 0.0, np.float32),
        constant("next", 1, np.int64),
        constant("first", [0], np.int64),
        constant("column", [-1, 1], np.int64),
        constant("row", [1, trees * bins], np.int64),
        constant("flat", [trees], np.int64),
        constant("every_bin", np.arange(bins)[None], np.int64),
    ]
    steps: list[tuple[Any, ...]] = [  # as in `rolled`: floats of the same size in the same order
        ("Neg", ["rolls_rad"], "unroll"),
        ("Mul", ["unroll", "bins_double"], "unroll_bins"),
        ("Div", ["unroll_bins", "turn"], "shift"),
        ("Floor", ["shift"], "whole"),
        ("Sub", ["shift", "whole"], "part_double"),
        ("Cast", ["part_double"], "part_flat", {"to": TensorProto.FLOAT}),
        ("Reshape", ["part_flat", "column"], "part"),
        ("Sub", ["one", "part"], "rest"),
        ("Cast", ["whole"], "whole_bins", {"to": TensorProto.INT64}),
        ("Mod", ["whole_bins", "bins"], "start_flat"),
        ("Reshape", ["start_flat", "column"], "start"),
        ("Add", ["start", "every_bin"], "here"),
        ("Add", ["here", "next"], "there"),
        ("Gather", ["readings", "first"], "again"),
        ("Concat", ["readings", "readings", "again"], "twice", {"axis": 0}),
        ("Gather", ["twice", "here"], "reading_here"),
        ("Gather", ["twice", "there"], "reading_there"),
        ("Mul", ["rest", "reading_here"], "share_here"),
        ("Mul", ["part", "reading_there"], "share_there"),
        ("Add", ["share_here", "share_there"], "between"),
        ("Round", ["between"], "rolled"),
        ("Reshape", ["rolled", "row"], "features"),
    ]
    nodes = [
        helper.make_node(kind, inputs, [output], **(more[0] if more else {}))
        for kind, inputs, output, *more in steps
    ]
    nodes.append(
        helper.make_node(
            "TreeEnsembleRegressor",
            ["features"],
            ["trust_row"],
            domain="ai.onnx.ml",
            **_ensemble(model),
        )
    )
    nodes.append(helper.make_node("Reshape", ["trust_row", "flat"], ["trust"]))
    nodes.append(helper.make_node("Greater", ["trust", "zero"], ["on"]))
    graph = helper.make_graph(
        nodes,
        "trees",
        [
            helper.make_tensor_value_info("readings", TensorProto.FLOAT, [bins]),
            helper.make_tensor_value_info("rolls_rad", TensorProto.DOUBLE, [trees]),
        ],
        [
            helper.make_tensor_value_info("trust", TensorProto.FLOAT, [trees]),
            helper.make_tensor_value_info("on", TensorProto.BOOL, [trees]),
        ],
        constants,
    )
    made = helper.make_model(
        graph,
        producer_name="rendezview",
        ir_version=_IR_VERSION,
        opset_imports=[
            helper.make_opsetid("", _OPSET),
            helper.make_opsetid("ai.onnx.ml", _ML_OPSET),
        ],
        doc_string=f"Decision trees of the view model of {model.name}",
    )
    onnx.checker.check_model(made)
    with atomic_write(path) as file:
        file.write(made.SerializeToString(deterministic=True))


def _ensemble(model: ViewModel) -> dict[str, Any]:
    """Attributes of the ensemble: tree t reads features t N … and adds its trust to target t."""
    forest, bins = model.forest, model.bins
    trust = Matcher(model).trust_of(np.arange(len(forest.component), dtype=np.int32))
    owner, entry, number = [], [], np.zeros(len(forest.component), dtype=np.int64)
    for tree in range(len(forest)):
        own = [e for e, _ in forest.entries(tree)]
        number[own] = np.arange(len(own))  # the root is 0
        owner += [tree] * len(own)
        entry += own
    owners, entries = np.array(owner), np.array(entry)
    inner = forest.component[entries] >= 0
    leaf = ~inner
    component = np.where(inner, forest.component[entries], 0)
    return {
        "n_targets": len(forest),
        "aggregate_function": "SUM",
        "post_transform": "NONE",
        "nodes_treeids": owners.tolist(),
        "nodes_nodeids": number[entries].tolist(),
        "nodes_modes": ["BRANCH_LEQ" if i else "LEAF" for i in inner],
        "nodes_featureids": (owners * bins * inner + component).tolist(),
        "nodes_values": np.where(inner, forest.threshold[entries], 0.0).tolist(),
        "nodes_truenodeids": np.where(inner, number[forest.left[entries]], 0).tolist(),
        "nodes_falsenodeids": np.where(inner, number[forest.right[entries]], 0).tolist(),
        "target_treeids": owners[leaf].tolist(),
        "target_nodeids": number[entries][leaf].tolist(),
        "target_ids": owners[leaf].tolist(),
        "target_weights": trust[entries][leaf].tolist(),
    }
