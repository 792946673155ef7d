"""What a sensor says of one frame."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """Outcome of one frame, for every sensor and for the filter.

    All but ``OK`` and ``TRACKING`` come with a reason in words.
    """

    OK = "ok"  # a pose (a ring without a radius: an ellipse)
    UNREADABLE = "unreadable"  # the frame could not be read
    AMBIGUOUS = "ambiguous"  # several poses fit, none is chosen
    LOST = "lost"  # a pose was found or expected, but the frame does not confirm it
    # Silhouettes
    EMPTY = "empty"  # nothing stands out from the background
    FULL = "full"  # the target, or the glare, fills the frame
    BORDER = "border"  # the silhouette touches the border of the picture
    SMALL = "small"  # too few pixels for a signature
    RIVALS = "rivals"  # several bodies, and nothing to choose by
    UNRECOGNIZED = "unrecognized"  # a silhouette, but no node is active
    # Rings, reflectors, lights
    NOT_FOUND = "not found"  # no ellipse is the ring's; no three spots are the target
    NO_SPOTS = "no spots"  # fewer than three spots stand out
    CROWDED = "crowded"  # more spots than can be searched
    PARTIAL = "partial"  # too few reflectors or lights for a pose of their own
    UNCONFIRMED = "unconfirmed"  # found once; a second reading must agree
    FEW_LIGHTS = "few-lights"  # too few lights for a pose
    DISAGREE = "disagree"  # the lights are not the target's, or more than two are false
    # The filter
    WAITING = "waiting"  # no sensor has given a whole pose yet
    STARTING = "starting"  # a first pose, not confirmed yet
    TRACKING = "tracking"
    COASTING = "coasting"  # no accepted measurement: the rates carry the state on
