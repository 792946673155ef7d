"""The house: rooms of a size, no circles, numbers with a source, compiled loops with a twin."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from experiments.__main__ import EXPERIMENTS

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("runtime", "training", "scripts")
MOST_LINES = 400
MOST_KERNEL_LINES = 60
MOST_EXPERIMENTS = 30
MOST_FLAT_FILES = 12
_SOURCE = re.compile(r"[Ss]ources?:")


def _files(*folders: str, suffixes: tuple[str, ...] = (".py",)) -> list[Path]:
    return [
        path
        for folder in folders
        for path in sorted((ROOT / folder).rglob("*"))
        if path.suffix in suffixes and "vendor" not in path.parts
    ]


def test_no_file_is_longer_than_a_room():
    long = {
        str(path.relative_to(ROOT)): count
        for path in _files(*SOURCES, "tests", "examples", suffixes=(".py", ".js", ".c", ".cpp"))
        if (count := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES
    }
    assert long == {}


def _module(path: Path, root: Path) -> str:
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def _imports(tree: ast.AST) -> Iterator[str]:
    """Modules that are imported, wherever the import stands, also for types only."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        else:
            yield from _imports(node)


def test_no_files_import_each_other_in_a_circle():
    paths = {_module(p, ROOT / s): p for s in SOURCES for p in _files(s)}
    graph = {
        name: {
            other
            for other in _imports(ast.parse(path.read_text(encoding="utf-8")))
            if other in paths and other != name and paths[other].name != "__init__.py"
        }
        for name, path in paths.items()
    }
    order: dict[str, int] = {}  # 1: on the way, 2: done
    circles: list[list[str]] = []

    def visit(name: str, way: list[str]) -> None:
        order[name] = 1
        for other in sorted(graph[name]):
            if order.get(other) == 1:
                circles.append([*way[way.index(other) :], other] if other in way else [name, other])
            elif other not in order:
                visit(other, [*way, other])
        order[name] = 2

    for name in sorted(graph):
        if name not in order:
            visit(name, [name])
    assert circles == []


def test_a_folder_of_the_service_has_at_most_a_screen_of_files():
    """Sub-folders are rooms: messages, tracker, logs, worker, hub, http, cluster."""
    service = ROOT / "runtime" / "rendezview_service"
    assert len(list(service.glob("*.py"))) <= MOST_FLAT_FILES


def test_the_laboratory_stays_thin():
    assert sum(len(group) for group in EXPERIMENTS.values()) <= MOST_EXPERIMENTS
    modules = {entry.partition(":")[0] for g in EXPERIMENTS.values() for entry, _ in g.values()}
    for module in modules:
        path = ROOT / "scripts" / "experiments" / Path(*module.split("."))
        assert path.with_suffix(".py").is_file(), module


def _is_number(node: ast.expr | None) -> bool:
    """Whether a value is a literal number, or a tuple or array of them."""
    if node is None:
        return False
    numbers = [
        n.value
        for n in ast.walk(node)
        if isinstance(n, ast.Constant) and isinstance(n.value, int | float)
        and not isinstance(n.value, bool)
    ]  # fmt: skip
    words = [n for n in ast.walk(node) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    return bool(numbers) and not words


def _block(lines: list[str], first: int, last: int) -> str:
    """A statement with the comment lines above it."""
    while first > 1 and lines[first - 2].lstrip().startswith("#"):
        first -= 1
    return "\n".join(lines[first - 1 : last])


def _tuned(path: Path) -> Iterator[tuple[str, str]]:
    """Names of tuned numbers of a file, each with its statement and comment.

    Constants in capitals at the top of a module, and defaults of options.
    """
    text = path.read_text(encoding="utf-8")
    lines, tree = text.splitlines(), ast.parse(text)
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if isinstance(target, ast.Name) and target.id.isupper() and _is_number(node.value):
                yield target.id, _block(lines, node.lineno, node.end_lineno or node.lineno)
        elif isinstance(node, ast.ClassDef) and node.name.endswith("Options"):
            for line in node.body:
                if isinstance(line, ast.AnnAssign) and _is_number(line.value):
                    name = f"{node.name}.{ast.unparse(line.target)}"
                    yield name, _block(lines, line.lineno, line.end_lineno or line.lineno)


def numbers_without_source() -> list[str]:
    """``file: name`` of every tuned number of what flies whose comment names no source."""
    return [
        f"{path.relative_to(ROOT / 'runtime')}: {name}"
        for path in _files("runtime")
        for name, block in _tuned(path)
        if not _SOURCE.search(block)
    ]


def test_every_number_has_a_source():
    assert numbers_without_source() == [], "say in the comment where it is from: 'Source: …'"


def _kernels(path: Path) -> Iterator[ast.FunctionDef]:
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and any(
            isinstance(d, ast.Call) and ast.unparse(d.func) == "njit" for d in node.decorator_list
        ):
            yield node


@pytest.mark.parametrize("folder", ["runtime", "training"])
def test_compiled_functions_are_short(folder: str):
    long = {
        f"{path.relative_to(ROOT)}: {kernel.name}": count
        for path in _files(folder)
        for kernel in _kernels(path)
        if (count := (kernel.end_lineno or 0) - kernel.lineno + 1) > MOST_KERNEL_LINES
    }
    assert long == {}


def _used_in_tests() -> set[tuple[str, str]]:
    """Module and name of all that tests import, or read from a module that they import."""
    used: set[tuple[str, str]] = set()
    for path in _files("tests"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        modules: dict[str, str] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                used |= {(node.module, alias.name) for alias in node.names}
                modules |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
        used |= {
            (modules[node.value.id], node.attr)
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id in modules
        }
    return used


def test_every_shared_compiled_function_is_called_by_a_test():
    used = _used_in_tests()
    unused = [
        f"{path.relative_to(ROOT)}: {kernel.name}"
        for path in _files("runtime")
        for kernel in _kernels(path)
        if not kernel.name.startswith("_")
        and (_module(path, ROOT / "runtime"), kernel.name) not in used
    ]
    assert unused == []
