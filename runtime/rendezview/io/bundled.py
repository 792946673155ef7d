"""Targets by path, or by the name of a bundled vehicle."""

from __future__ import annotations

from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.io.target import Target, split_node

_HERE = Path(__file__).resolve()
# Vehicles are in the installed package, or at the top of a checkout.
_FOLDERS = (_HERE.parents[1] / "models_cad", _HERE.parents[3] / "models_cad")


def bundled_names() -> list[str]:
    """Names of the bundled vehicles."""
    return sorted({p.parent.name for f in _FOLDERS for p in f.glob("*/target.toml")})


def find_target(text: str) -> Target:
    """The target of a path (``target.toml``, its folder, a mesh) or of a bundled name.

    Raises:
        RendezviewError: neither; the message lists the bundled names.
    """
    path = split_node(Path(text))[0]
    named = [f / text for f in _FOLDERS if text.isidentifier() and (f / text).is_dir()]
    # A folder of results may have the name of a bundled vehicle.
    if path.exists() and not (named and path.is_dir() and not (path / "target.toml").is_file()):
        return Target.load(Path(text))
    for folder in named:
        return Target.load(folder)
    raise RendezviewError(
        f"{text}: no such target; give a mesh, a target.toml or its folder, or one of "
        f"{', '.join(bundled_names())}"
    )
