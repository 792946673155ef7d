"""Writes a target file again, with other places of its reflectors."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.files import StrPath, atomic_write_text, read_toml
from rendezview.io.target import Target


def write_places(target: Target, places: Mapping[str, tuple[Array, float]], path: StrPath) -> None:
    """Write a target's file with the places (3,) of some reflectors and their σ, m.

    All else stays, apart from comments; meshes are named relative to the new place.

    Raises:
        RendezviewError: the target is of no target file, or the new one cannot be written.
    """
    if target.source is None:
        raise RendezviewError(f"target {target.name!r} is a bare mesh, and has no reflectors")
    data = read_toml(target.source, "a target file")
    for reflector in data["reflectors"]:
        if reflector["name"] in places:
            place, sigma = places[reflector["name"]]
            reflector["position_m"] = [round(float(value), 7) for value in place]
            reflector["position_sigma_m"] = float(f"{sigma:.3g}")
    here, there = target.source.parent.absolute(), Path(path).parent.absolute()

    def moved(name: str) -> str:
        return Path(os.path.relpath(here / name, there)).as_posix()

    if "mesh" in data:
        data["mesh"]["path"] = moved(data["mesh"]["path"])
    for joint in data.get("joints", []):
        for hinge in (joint, *joint.get("others", [])):
            if "meshes" in hinge:
                hinge["meshes"] = [moved(name) for name in hinge["meshes"]]
    atomic_write_text(path, "\n".join(_lines(data, "")) + "\n")


def _lines(table: Mapping[str, Any], name: str) -> Iterator[str]:
    """A table's own values, then the tables in it."""
    inner = {key: value for key, value in table.items() if _tables(value)}
    for key, value in table.items():
        if key not in inner:
            yield f"{key} = {_value(value)}"
    for key, value in inner.items():
        for each in _tables(value):
            head = f"{name}{key}"
            yield ""
            yield f"[{head}]" if isinstance(value, dict) else f"[[{head}]]"
            yield from _lines(each, f"{head}.")


def _tables(value: Any) -> list[dict[str, Any]]:
    """The tables of a table or of a list of tables; none of another value."""
    if isinstance(value, dict):
        return [value]
    listed = isinstance(value, list) and value and all(isinstance(one, dict) for one in value)
    return value if listed else []


def _value(value: Any) -> str:
    """Numbers, texts and lists of them are in TOML as in JSON."""
    return json.dumps(value, ensure_ascii=False)
