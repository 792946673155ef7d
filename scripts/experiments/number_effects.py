"""What each tuned number does: figures of a sensor with the number halved and doubled."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import json
import os
import select
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import cv2
import numpy as np
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

from experiments import number_trials
from experiments.frame import ROOT, show, table_of

RUNTIME = ROOT / "runtime"
LONGEST_S = 240.0  # of one evaluation, compiling included
Figures = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Number:
    """A number that can be set: a constant of a module, or a default of its options."""

    module: ModuleType
    name: str  # ``CONSTANT`` or ``ClassOptions.field``
    value: Any

    def set(self, value: Any) -> None:
        """Set it everywhere it has been imported to."""
        owner, _, field = self.name.rpartition(".")
        if not owner:
            for module in list(sys.modules.values()):
                if getattr(module, self.name, None) is self.value and (
                    module is self.module or not self.name.startswith("_")
                ):
                    setattr(module, self.name, value)
            return
        start: Any = getattr(self.module, owner).__init__
        if start.__kwdefaults__ and field in start.__kwdefaults__:
            start.__kwdefaults__[field] = value
            return
        names = list(inspect.signature(start).parameters)
        first = len(names) - len(start.__defaults__)
        defaults = list(start.__defaults__)
        defaults[names.index(field) - first] = value
        start.__defaults__ = tuple(defaults)

    def loops(self) -> list[Dispatcher]:
        """The compiled loops in which it is a constant, and all that call them."""
        everywhere = {
            id(loop): loop
            for module in list(sys.modules.values())
            if getattr(module, "__name__", "").startswith("rendezview")
            for loop in vars(module).values()
            if isinstance(loop, Dispatcher)
        }
        used = {
            key: {id(loop.py_func.__globals__.get(name)) for name in _names(loop)}
            for key, loop in everywhere.items()
        }
        found = {
            key
            for key, loop in everywhere.items()
            if self.name in _names(loop) and loop.py_func.__globals__.get(self.name) is self.value
        }
        while more := {key for key, names in used.items() if names & found} - found:
            found |= more
        return [everywhere[key] for key in found]


def _names(loop: Dispatcher) -> tuple[str, ...]:
    code: Any = loop.py_func.__code__
    return tuple(code.co_names)


def numbers(folders: list[str]) -> Iterator[Number]:
    """Constants in capitals and defaults of options in files or folders of the runtime."""
    for folder in folders:
        start = RUNTIME / "rendezview" / folder
        for path in [start] if start.is_file() else sorted(start.rglob("*.py")):
            name = ".".join(path.relative_to(RUNTIME).with_suffix("").parts)
            module = importlib.import_module(name.removesuffix(".__init__"))
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                    label = node.targets[0].id
                    if label.isupper() and _scalable(value := getattr(module, label)):
                        yield Number(module, label, value)
                elif isinstance(node, ast.ClassDef) and node.name.endswith("Options"):
                    for field in dataclasses.fields(getattr(module, node.name)):
                        if _scalable(field.default):
                            yield Number(module, f"{node.name}.{field.name}", field.default)


def _scalable(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(_scalable(one) for one in value)
    return isinstance(value, int | float | np.floating) and not isinstance(value, bool)


def scaled(value: Any, factor: float) -> Any:
    """A number, or each of several, times a factor; a whole number stays one."""
    if isinstance(value, tuple):
        return tuple(scaled(one, factor) for one in value)
    if isinstance(value, int):
        return max(round(value * factor), 0)
    return float(value) * factor


def tried(number: Number, value: Any, trial: Callable[[], Figures]) -> Figures | str:
    """The figures with another value, in a process of its own; words where it fails."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        try:
            loops = number.loops()
            number.set(value)
            loop: Any  # numba's own `recompile` would delete the cache on disk
            for loop in loops:
                loop._cache = NullCache()
                loop._make_finalizer()()
                loop._reset_overloads()
                loop._can_compile = True
            answer: Figures | str = trial()
        except Exception as error:
            answer = f"{type(error).__name__}: {error}"[:80]
        os.write(writing, json.dumps(answer, default=float).encode())
        os._exit(0)
    os.close(writing)
    ready, _, _ = select.select([reading], [], [], LONGEST_S)
    said = os.read(reading, 1 << 16) if ready else b""
    if not ready:
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    os.close(reading)
    return json.loads(said) if said else f"no answer in {LONGEST_S:g} s"


def words(figures: Figures | str, usual: Figures) -> str:
    """The figures that differ from the usual ones."""
    if isinstance(figures, str):
        return figures
    return ", ".join(
        f"{name} {figures[name]:.4g}"
        for name in usual
        if abs(figures[name] - usual[name]) > 1e-9 * max(abs(usual[name]), 1e-9)
    )


def run(
    part: Annotated[str, "fusion, reflectors, ring, stereo, trajectory or appearance"], *,
    only: Annotated[list[str] | None, "names of numbers"] = None,
    compiled: Annotated[bool, "those in compiled loops too: some seconds each"] = False,
    seed: int = 1,
    log: Annotated[Path | None, "JSON lines, added to"] = None,
    model: Annotated[Path | None, "of hubble, for appearance"] = None,
) -> None:  # fmt: skip
    """What each tuned number of a part does: its figures with the number halved and doubled.

    The same small simulated data for all (see `experiments.number_trials`). An empty cell: no
    figure changes, not even in the last digit. Small data: a change of one frame is chance.
    """
    cv2.setNumThreads(1)
    folders, make = number_trials.PARTS[part]
    trial = make(seed, model) if part == "appearance" else make(seed)
    usual = trial()
    assert usual == trial(), "the same data must give the same figures"
    print(f"seed {seed}:", ", ".join(f"{name} {value:.4g}" for name, value in usual.items()))
    rows = table_of(f"{part}: what changes", "number | value | halved | doubled", left=4)
    for number in numbers(folders):
        if only and not any(name in number.name for name in only):
            continue
        if number.loops() and not compiled:
            continue
        label = f"{number.module.__name__.removeprefix('rendezview.')}: {number.name}"
        cells = [tried(number, scaled(number.value, by), trial) for by in (0.5, 2.0)]
        rows.add_row(label, f"{number.value}", *(words(cell, usual) for cell in cells))
        if log is not None:
            with log.open("a") as file:
                line = {"number": label, "usual": usual, "halved": cells[0], "doubled": cells[1]}
                file.write(json.dumps(line, default=float) + "\n")
    show(rows, width=160)
