"""The former name of the public interface, kept for version 0.2: import from `rendezview`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import rendezview
from rendezview import __all__  # noqa: F401

if TYPE_CHECKING:
    from rendezview import *  # noqa: F403


def __getattr__(name: str) -> Any:
    return getattr(rendezview, name)
