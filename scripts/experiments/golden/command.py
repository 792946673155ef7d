"""The golden file: answers of all sensors, stored and compared."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Literal

import cv2

from experiments.frame import MODELS_CAD
from experiments.golden import appearance, sensors
from experiments.golden.answers import Answers, digests, no_worse, read, same, trained

_SEED = 49
_VEHICLES = ("hubble", "client", "shuttle")


def run(
    action: Literal["store", "compare"],
    file: Annotated[Path, "the golden file, *.jsonl.gz"], *,
    exact: Annotated[bool, "compare: every number the same, bit for bit"] = False,
    models: Annotated[Path | None, "folder of models: read, or trained into it"] = None,
) -> int:  # fmt: skip
    """Answers of about 4,000 frames and readings of all sensors, stored or compared.

        python -m experiments golden store golden.jsonl.gz
        python -m experiments golden compare golden.jsonl.gz --exact

    The simulators of the experiments draw everything; all seeds are fixed. Recognizer, sketches,
    tracker, joints, integrity, ring and its size, reflectors, stereo, filter, trajectory, spin and
    the service answer, and digests of trained models and flight code stand beside them. With
    third-party data (RENDEZVIEW_TEST_DATA) there are photographs.

    --exact finds any difference. It is for two runs on one machine: other processors and other
    versions of libraries round otherwise. Without it, runs of two machines can be compared: it
    fails where a group has more than 1 % fewer right answers, more wrong ones, or a median error
    more than 2 % larger.
    """
    if action == "compare" and not file.is_file():
        raise SystemExit(f"{file}: no such golden file; `golden store {file}` writes it")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        answers = answered(models or folder / "models", folder)
        if action == "store":
            answers.write(file)
            print(f"{file}: {len(answers.records)} records, {file.stat().st_size / 1e6:.2f} MB")
            return 0
        answers.write(folder / "new")
        fine = (same if exact else no_worse)(read(file), read(folder / "new"))
    return 0 if fine else 1


def answered(folder: Path, scratch: Path) -> Answers:
    """All groups, one after the other."""
    cv2.setNumThreads(1)
    answers = Answers()
    known = {n: trained(folder / f"{n}.rvm", MODELS_CAD / n) for n in _VEHICLES}
    for name, (_, model) in known.items():
        digests(answers, folder / f"{name}.rvm", model, scratch / name)
    appearance.service(answers, folder / "hubble.rvm", *known["hubble"], _SEED)
    appearance.sequences(answers, known, _SEED)
    appearance.hard_light(answers, known, _SEED)
    appearance.joints(answers, folder, _SEED)
    appearance.photographs(answers, folder, _SEED)
    sensors.approached(answers, known["client"][1], scratch / "run", _SEED)
    for group in (sensors.ring, sensors.sizes, sensors.reflectors, sensors.lights,
                  sensors.segments, sensors.spins):  # fmt: skip
        group(answers, _SEED)
    return answers
