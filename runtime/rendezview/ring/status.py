"""Why a frame gave a ring's pose, or why it did not."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """Outcome of one frame; every one but ``OK`` comes with a reason in words."""

    OK = "ok"  # a pose is chosen (or, without a radius, an ellipse is found)
    AMBIGUOUS = "ambiguous"  # both poses of the circle fit what is known: neither is chosen
    NOT_FOUND = "not found"  # no ellipse that is a ring's
    UNREADABLE = "unreadable"  # the picture could not be read
