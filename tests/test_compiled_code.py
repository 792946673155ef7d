"""Compiled functions give the same bits in the process that compiled them and in the next one.

A function that compiled code calls is kept twice: on its own and within its caller, optimised
apart. Which copy runs hangs on what the cache on disk held. Where the compiler may not reorder
sums both give the same bits; with ``fastmath`` only one copy may be left, that within the caller.
"""

from __future__ import annotations

import ast
from pathlib import Path

import rendezview.geometry.pose

RUNTIME = Path(rendezview.geometry.pose.__file__).parents[1]


def _compiled(tree: ast.Module) -> dict[str, tuple[ast.FunctionDef, set[str | None]]]:
    """Functions of a module that numba compiles, and the names of the options given."""
    return {
        node.name: (node, {option.arg for option in decorator.keywords})
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        for decorator in node.decorator_list
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "njit"
    }


def test_fast_code_called_by_compiled_code_is_part_of_it():
    fast: dict[tuple[str, str], bool] = {}  # module and name: is it always inlined
    called = set()
    for file in RUNTIME.rglob("*.py"):
        module = ".".join(("rendezview", *file.relative_to(RUNTIME).with_suffix("").parts))
        tree = ast.parse(file.read_text())
        home = {
            alias.asname or alias.name: (node.module, alias.name)
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for name, (function, options) in _compiled(tree).items():
            if "fastmath" in options:
                fast[module, name] = bool(options & {"inline", "forceinline"})
            called |= {
                home.get(call.func.id, (module, call.func.id))
                for call in ast.walk(function)
                if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
            }
    assert (
        "rendezview.sensors.appearance.edges.profile_fit",
        "fit_profile",
    ) in fast.keys() & called
    assert [name for name in fast.keys() & called if not fast[name]] == []
