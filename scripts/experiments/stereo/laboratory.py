"""Write a simulated laboratory as files for `rendezview stereo calibrate` and `track`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from rendezview.sensors.stereo.laboratory_files import save_record
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions

from rendezview.io.bundled import find_target
from rendezview.io.files import make_folder
from rendezview.io.results import JsonLinesWriter


def run(
    folder: Path, *, target: str = "scole",
    step: Annotated[float, "degrees a reading"] = 2.0, readings: int = 41,
    rate: Annotated[float, "readings a second"] = 10.0, snr: float = 200.0, seed: int = 1,
) -> None:  # fmt: skip
    """Write a simulated laboratory as files for `rendezview stereo calibrate` and `track`.

        rendezview stereo calibrate lab/record.json -o lab/rig.json
        rendezview stereo track lab/rig.json scole lab/readings.jsonl -o lab/poses.csv

    ``record.json`` is the calibration's measurements, ``readings.jsonl`` the currents of a rotary
    stage that turns by ``--step`` degrees a reading, with the true angle beside them in
    ``truth.jsonl``.
    """
    leds = np.array([led.position_m for led in find_target(target).leds])
    options = LaboratoryOptions(signal_to_noise=snr)
    laboratory = Laboratory(leds, options, seed)
    rng = np.random.default_rng(seed)
    make_folder(folder)
    save_record(laboratory.calibration(rng), folder / "record.json")
    angles = step * (np.arange(readings) - readings // 2)
    poses = laboratory.stage(np.deg2rad(angles))
    currents = JsonLinesWriter(folder / "readings.jsonl")
    truth = JsonLinesWriter(folder / "truth.jsonl")
    with currents, truth:
        for k, (pose, light) in enumerate(zip(poses, laboratory.currents(poses, rng), strict=True)):
            time_s = k / rate
            seen = [[row if np.isfinite(row).all() else None for row in one] for one in light]
            currents.write({"time_s": time_s, "currents": seen})
            truth.write({"time_s": time_s, "angle_deg": angles[k], "rig_from_target": pose})
    print(f"seed {seed}: {folder}/record.json, readings.jsonl, truth.jsonl")
