"""The golden file: answers of all sensors, stored and compared."""

from __future__ import annotations

import tempfile
import time
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

    def told(what: str) -> None:
        spent_s = time.perf_counter() - began_s
        print(f"{spent_s:6.0f} s, {time.process_time():4.0f} s of processor: {what}", flush=True)

    known = models.bundled(folder)
    models.digests(answers, known, scratch / "code")
    told("models")
    appearance.first_poses(answers, known, _SEED)
    told("first poses")
    appearance.hard_light(answers, known, _SEED)
    told("hard light")
    appearance.sequences(answers, known, _SEED)
    told("sequences")
    appearance.joints(answers, folder, _SEED)
    told("joints")
    appearance.photographs(answers, folder)
    appearance.mitsuba_frames(answers, known)
    told("third-party frames")
    sensors.ring(answers, _SEED)
    sensors.sizes(answers, _SEED)
    told("ring")
    sensors.reflectors(answers, _SEED)
    told("reflectors")
    sensors.lights(answers, _SEED)
    told("stereo")
    states.approached(answers, known["client"], _SEED)
    states.fusion(answers, _SEED)
    told("fusion")
    states.segments(answers, _SEED)
    states.spins(answers, _SEED)
    told("trajectory")
    states.service(answers, known["hubble"], _SEED)
    told("service")
    return answers
