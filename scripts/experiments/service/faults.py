"""The service under faults: kills, sick disks, malformed and hostile requests, by the thousand."""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from experiments.frame import tests_module
from experiments.service import hostile, kills
from experiments.service.serving import serve


def run(
    kind: Literal["kills", "disks", "fuzz", "pictures", "hostile"],
    model: Annotated[Path | None, "of all kinds but disks and pictures"] = None,
    scene: Annotated[Path | None, "of kills: frames of the model's target"] = None, *,
    count: Annotated[int, "kills, faults, cases, or seconds of each hostile client"] = 100,
    minutes: Annotated[float, "after which no block of cases begins"] = 600.0, seed: int = 0,
) -> None:  # fmt: skip
    """What must not be lost, fail, hang or leak, with the cases of tests/service.

    kills: kill -9 while two clients send frames; every acknowledged pose must be in the log. disks:
    faults of disks, files and processes under the writer of a log, all kinds in turns. fuzz:
    malformed frames, requests and messages. pictures: damaged ones into the decoders themselves.
    hostile: clients that take what they can, beside an innocent one. The exit status is 1 where
    something was lost or failed.
    """
    if kind == "disks":
        sys.exit(not tests_module("service.log_faults").campaign(count, seed))
    if kind == "pictures":
        sys.exit(bool(tests_module("service.fuzz_pictures").campaign(seed, count)))
    if model is None or (kind == "kills" and scene is None):
        sys.exit(f"{kind} needs a model{', and a scene' * (kind == 'kills')}")
    if kind == "kills":
        sys.exit(not kills.campaign(partial(serve, model), scene, count, seed))
    if kind == "fuzz":
        served = serve(model, spare_worker="false", sender_hold_s=0.0)  # nobody else's session
        found = tests_module("service.fuzz").campaign(served, seed, count, minutes=minutes)
        served.stop()
        sys.exit(bool(found.failures))
    with tempfile.TemporaryDirectory() as logs:
        served = serve(model, "--record", logs, record_all="false")
        for line in hostile.campaign(served, Path(logs), float(count)):
            print(line, flush=True)
        served.stop()
