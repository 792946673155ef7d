"""Shared parts of all experiments: arguments from a signature, tables, targets, pictures."""

from __future__ import annotations

import argparse
import importlib
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from rendezview_ground.mesh.mesh import Mesh

ROOT = Path(__file__).resolve().parents[2]  # the checkout
MODELS_CAD = ROOT / "models_cad"
CLIENT = MODELS_CAD / "client"
PICTURES = ROOT / "docs" / "pictures"


def run(name: str, experiment: Callable[..., object], words: Sequence[str]) -> object:
    """Call an experiment with the arguments of a command line.

    Positional parameters are positional arguments, keyword-only ones are options. Their types
    are those of the signature; ``Annotated[type, "help"]`` adds the help.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments {name}",
        description=inspect.getdoc(experiment),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    hints = get_type_hints(experiment, include_extras=True)
    for parameter in inspect.signature(experiment).parameters.values():
        settings = _settings(hints[parameter.name])
        option = parameter.kind is inspect.Parameter.KEYWORD_ONLY
        label = parameter.name
        if option:
            label = "--" + parameter.name.rstrip("_").replace("_", "-")
            settings["dest"] = parameter.name
            settings["required"] = parameter.default is inspect.Parameter.empty
        if parameter.default is not inspect.Parameter.empty:
            settings["default"] = parameter.default
            if not option:
                settings["nargs"] = "*" if settings.get("nargs") == "+" else "?"
        parser.add_argument(label, **settings)
    return experiment(**vars(parser.parse_args(words)))


def _settings(hint: Any) -> dict[str, Any]:
    """What `argparse` needs to know of a type."""
    settings: dict[str, Any] = {}
    if get_origin(hint) is Annotated:
        hint, settings["help"] = get_args(hint)
    if isinstance(hint, UnionType):  # X | None
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if hint is bool:
        return settings | {"action": "store_true"}
    if get_origin(hint) is list:
        (hint,) = get_args(hint)
        settings["nargs"] = "+"
    elif get_origin(hint) is tuple:
        hint, *others = get_args(hint)
        settings["nargs"] = 1 + len(others)
    if get_origin(hint) is Literal:
        return settings | {"choices": get_args(hint)}
    return settings | {"type": hint}


def table_of(title: str, columns: str | Sequence[str], *, left: int = 1) -> Table:
    """An empty table; all columns but the first ``left`` ones are on the right.

    Columns may be one string with " | " between the names.
    """
    made = Table(title=title)
    for k, column in enumerate(columns.split(" | ") if isinstance(columns, str) else columns):
        made.add_column(column, justify="left" if k < left else "right")
    return made


def show(*tables: Table, width: int | None = None) -> None:
    """Print tables, in as many columns as they need."""
    for one in tables:
        Console(width=width).print(one)


def two(values: npt.ArrayLike, high: float = 95, form: str = "{:.3f} / {:.3f}") -> str:
    """Median and a high percentile."""
    return form.format(np.median(values), np.percentile(values, high))


def unit(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """(3,) random direction."""
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def nees(error: npt.ArrayLike, covariance: npt.ArrayLike) -> float:
    """Normalised estimation error squared."""
    off = np.asarray(error)
    return float(np.dot(off, np.linalg.solve(np.asarray(covariance), off)))


def kept(path: Path, make: Callable[[], Mapping[str, npt.ArrayLike]]) -> dict[str, Any]:
    """The arrays of a file .npz; where it is not there, they are made and written."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial.npz")
        np.savez_compressed(partial, **make())
        partial.replace(path)
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def tests_module(name: str) -> Any:
    """A module of the tests' folder: simulators that share no code with the product."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    return importlib.import_module(f"tests.{name}")


def mesh_of(target: str | Path) -> tuple[str, Mesh]:
    """Name and mesh of a bundled target, a target file, a bare mesh or a near-symmetric craft."""
    from rendezview.io.bundled import find_target
    from rendezview_ground.mesh.mesh import load_mesh
    from rendezview_ground.simulate.near_symmetric_craft import CRAFT

    if str(target) in CRAFT:
        return str(target), CRAFT[str(target)]()
    found = find_target(str(target))
    return found.name, load_mesh(found.mesh_path, found.unit)
