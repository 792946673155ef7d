"""The golden file: answers of all sensors, stored and compared."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import cv2

from experiments.golden import appearance, models, sensors, states
from experiments.golden.answers import Answers, no_worse, read, same

_SEED = 49


def run(
    action: Literal["store", "compare"],
    file: Annotated[Path, "the golden file, *.jsonl.gz"],
    *,
    exact: Annotated[bool, "compare: every number the same, bit for bit"] = False,
    statistics: Annotated[bool, "compare: no group worse; the default"] = False,
    models_: Annotated[Path | None, "folder of models: read, or trained into it"] = None,
    fresh: Annotated[Path | None, "compare: a stored run instead of a new one"] = None,
) -> int:
    """Answers of about 2,000 frames and readings of all sensors, stored or compared.

        python -m experiments golden store golden.jsonl.gz
        python -m experiments golden compare golden.jsonl.gz --exact

    Our own simulators draw everything; all seeds are fixed. Recognizer, sketches, tracker, joints,
    integrity, ring and its size, reflectors, stereo, filter, trajectory, spin and the service
    answer, and digests of trained models and flight code stand beside them. With third-party data
    (RENDEZVIEW_TEST_DATA) there are two groups more.

    --exact finds any difference. It is for two runs on one machine: other processors and other
    versions of libraries round otherwise. --statistics also compares runs of two machines. It
    fails where a group has more than 1 % fewer right answers, more wrong ones, or a median error
    more than 2 % larger. Times are processor time, medians of a group, printed and not judged.
    """
    if exact and statistics:
        raise SystemExit("give --exact or --statistics, not both")
    if action == "compare" and not file.is_file():
        raise SystemExit(f"{file}: no such golden file; `golden store {file}` writes it")
    with tempfile.TemporaryDirectory() as folder:
        new = fresh or Path(folder) / "new.jsonl.gz"
        if fresh is None:
            answered(models_ or Path(folder) / "models", Path(folder)).write(new)
        if action == "store":
            file.write_bytes(new.read_bytes())
            print(f"{file}: {len(read(file)[0])} records, {file.stat().st_size / 1e6:.2f} MB")
            return 0
        (old, old_ms), (now, now_ms) = read(file), read(new)
    fine = same(old, now) if exact else no_worse(old, now, old_ms, now_ms)
    return 0 if fine else 1


def answered(folder: Path, scratch: Path) -> Answers:
    """All groups, one after the other."""
    cv2.setNumThreads(1)
    answers, began_s = Answers(), time.perf_counter()
    known = models.bundled(folder)
    steps: dict[str, Callable[[], None]] = {
        "models": partial(models.digests, answers, known, scratch / "code"),
        "service": partial(states.service, answers, known["hubble"], _SEED),
        "first poses": partial(appearance.first_poses, answers, known, _SEED),
        "hard light": partial(appearance.hard_light, answers, known, _SEED),
        "sequences": partial(appearance.sequences, answers, known, _SEED),
        "joints": partial(appearance.joints, answers, folder, _SEED),
        "photographs": partial(appearance.photographs, answers, folder),
        "Mitsuba": partial(appearance.mitsuba_frames, answers, known["client"]),
        "ring": partial(sensors.ring, answers, _SEED),
        "ring size": partial(sensors.sizes, answers, _SEED),
        "reflectors": partial(sensors.reflectors, answers, _SEED),
        "stereo": partial(sensors.lights, answers, _SEED),
        "approach": partial(states.approached, answers, known["client"], _SEED),
        "trajectory": partial(states.segments, answers, _SEED),
        "spin": partial(states.spins, answers, _SEED),
    }
    for name, step in steps.items():
        step()
        spent = f"{time.perf_counter() - began_s:.0f} s, processor {time.process_time():.0f} s"
        print(f"{name}: {len(answers.records)} records so far, {spent}", flush=True)
    return answers
