"""Write a simulated laboratory as files for `rendezview stereo calibrate` and `track`.

    python -m experiments stereo-laboratory lab --step 2 --readings 41 --seed 1
    rendezview stereo calibrate lab/record.json -o lab/rig.json
    rendezview stereo track lab/rig.json models_cad/scole lab/readings.jsonl -o lab/poses.csv

``record.json`` is the calibration's measurements, ``readings.jsonl`` the currents of a rotary
stage that turns by ``--step`` degrees a reading, with the true angle beside them in
``truth.jsonl``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rendezview.io.files import make_folder
from rendezview.io.results import JsonLinesWriter
from rendezview.io.target import Target
from rendezview.sensors.stereo.laboratory_files import save_record
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--target", default="models_cad/scole")
    parser.add_argument("--step", type=float, default=2.0, help="degrees a reading")
    parser.add_argument("--readings", type=int, default=41)
    parser.add_argument("--rate", type=float, default=10.0, help="readings a second")
    parser.add_argument("--snr", type=float, default=200.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    leds = np.array([led.position_m for led in Target.load(arguments.target).leds])
    options = LaboratoryOptions(signal_to_noise=arguments.snr)
    laboratory = Laboratory(leds, options, arguments.seed)
    rng = np.random.default_rng(arguments.seed)
    make_folder(arguments.folder)
    save_record(laboratory.calibration(rng), arguments.folder / "record.json")
    angles = arguments.step * (np.arange(arguments.readings) - arguments.readings // 2)
    poses = laboratory.stage(np.deg2rad(angles))
    readings = JsonLinesWriter(arguments.folder / "readings.jsonl")
    truth = JsonLinesWriter(arguments.folder / "truth.jsonl")
    with readings, truth:
        for k, (pose, light) in enumerate(zip(poses, laboratory.currents(poses, rng), strict=True)):
            time_s = k / arguments.rate
            seen = [[row if np.isfinite(row).all() else None for row in one] for one in light]
            readings.write({"time_s": time_s, "currents": seen})
            truth.write({"time_s": time_s, "angle_deg": angles[k], "rig_from_target": pose})
    print(f"seed {arguments.seed}: {arguments.folder}/record.json, readings.jsonl, truth.jsonl")
