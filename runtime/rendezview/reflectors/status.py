"""Why a reading gave a pose, or why it did not."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """Outcome of one reading; every one but ``OK`` comes with a reason in words."""

    OK = "ok"
    NO_SPOTS = "no spots"  # fewer than three spots stand out
    NOT_FOUND = "not found"  # spots, but no three of them are the target
    AMBIGUOUS = "ambiguous"  # several sets of spots pass for the target
    CROWDED = "crowded"  # more spots than can be looked through
    PARTIAL = "partial"  # while tracking: one or two reflectors are seen, which fixes no pose
    LOST = "lost"  # while tracking: no reflector is where it was expected
    UNCONFIRMED = "unconfirmed"  # found once; a second reading must agree
    UNREADABLE = "unreadable"  # the picture could not be read
