"""Settings of logs, and the states of a log by another reader than ours."""

from __future__ import annotations

import json
from pathlib import Path

from mcap.reader import make_reader

from rendezview_service.settings import Settings


def settings_of(**changes: object) -> Settings:
    """Settings beyond the limits that a user's are held to, such as parts of a kilobyte."""
    return Settings().model_copy(update=changes)


def states_of(path: Path) -> dict[int, dict]:
    """The states of a log by frame, by the reader of the mcap package."""
    with open(path, "rb") as file:
        messages = make_reader(file).iter_messages(topics=["/rendezview/state"])
        states = [json.loads(message.data) for *_, message in messages]
    return {state["frame"]: state for state in states}
