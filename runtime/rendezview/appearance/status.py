"""Why a frame gave a pose, or why it did not."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """Outcome of looking at one frame; every one but ``OK`` comes with a reason in words."""

    OK = "ok"
    EMPTY = "empty"  # nothing stands out from the background
    FULL = "full"  # the target, or the glare, fills the frame
    BORDER = "border"  # the silhouette touches the border of the picture
    SMALL = "small"  # too few pixels for a signature
    RIVALS = "rivals"  # several bodies, and nothing to choose by
    UNRECOGNIZED = "unrecognized"  # a silhouette, but no node is on
    AMBIGUOUS = "ambiguous"  # without a prior: two attitudes fit
    LOST = "lost"  # a pose was found, but the frame does not bear it out
    UNREADABLE = "unreadable"  # the frame could not be read
