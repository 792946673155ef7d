"""Our results and measures beside those of the public BOP toolkit."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rendezview.evaluation import evaluate
from rendezview.evaluation.scores import MSPD_640_PX, MSSD_FRACTIONS, scores
from rendezview.evaluation.surface import ModelPoints, alike_of
from rendezview.training.mesh import load_mesh

from rendezview.geometry.pose import Array
from rendezview.io.bundled import find_target
from rendezview.io.results import read_results
from rendezview.io.sequences import Sequence, open_sequence
from rendezview.io.target import Target

DATA_SET, OBJECTS = "icbin", (1, 2)  # its smallest of 640 × 480; the second object is not shown
FIELDS = {"mssd": "mssd_m", "mspd": "mspd_px", "add": "add_m", "adi": "add_s_m"}
EQUAL = 1e-6  # of numbers that should be one, relative


def lay_out(folder: Path, sequence: Sequence, points_m: Array, target: Target, d_m: float) -> None:
    """The scene as a data set of the toolkit."""
    models, scene = folder / DATA_SET / "models_eval", folder / DATA_SET / "test" / "000001"
    models.mkdir(parents=True)
    scene.mkdir(parents=True)
    text = "\n".join(" ".join(map(repr, p)) for p in (1000.0 * points_m).tolist())
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points_m)}\nproperty float x\n"
        "property float y\nproperty float z\nelement face 0\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    discrete = alike_of([s for s in target.symmetries if s.kind == "discrete"])[1:]
    info: dict[str, Any] = {"diameter": 1000.0 * d_m}
    if discrete:
        turns = [np.block([[t.rotation, np.zeros((3, 1))], [0, 0, 0, 1]]) for t in discrete]
        info["symmetries_discrete"] = [turn.ravel().tolist() for turn in turns]
    axes = [s.axis.tolist() for s in target.symmetries if s.kind == "continuous"]
    if axes:
        info["symmetries_continuous"] = [{"axis": axis, "offset": [0, 0, 0]} for axis in axes]
    for number in OBJECTS:
        (models / f"obj_{number:06d}.ply").write_text(header + text + "\n")
    (models / "models_info.json").write_text(json.dumps({str(n): info for n in OBJECTS}))
    shutil.copy(sequence.source / "scene_gt.json", scene)
    shutil.copy(sequence.source / "scene_camera.json", scene)
    box = {"bbox_obj": [0, 0, 1, 1], "bbox_visib": [0, 0, 1, 1], "visib_fract": 1.0}
    counts = {"px_count_all": 1, "px_count_valid": 1, "px_count_visib": 1}
    ids = [frame.im_id for frame in sequence]
    (scene / "scene_gt_info.json").write_text(json.dumps({str(i): [box | counts] for i in ids}))
    for year in ("19", "24"):
        rows = [{"im_id": i, "inst_count": 1, "obj_id": 1, "scene_id": 1} for i in ids]
        path = folder / DATA_SET / f"test_targets_bop{year}.json"
        path.write_text(json.dumps(rows))


def run(
    scene: Path, poses: Path, target: str, *, unit: str | None = None, toolkit: Path,
    python: Path = Path(sys.executable),
) -> int:  # fmt: skip
    """Our results and measures beside those of the public BOP toolkit.

    --toolkit is a checkout of it, --python an interpreter with its packages. The scene's truth
    (640 × 480, object 1) and the target are laid out as one of its data sets, and its own scripts
    evaluate POSES: errors (mssd, mspd, add, adi), recall, and the mean average precision of
    eval_bop24_pose.py. Printed: the largest difference of each error from ours, and both recalls.
    VSD is left out: it needs depth images. Exit 1 where they differ.
    """
    sequence, craft = open_sequence(scene), find_target(target)
    mesh = load_mesh(craft.mesh_path, unit or craft.unit)
    points_m = mesh.vertices_m[np.unique(mesh.faces)]
    surface = ModelPoints.of(points_m, alike_of(craft.symmetries))
    ours = evaluate(sequence, read_results(poses), (), None, surface=surface)
    with tempfile.TemporaryDirectory() as name:
        folder, results = Path(name) / "data", Path(name) / "results"
        results.mkdir()
        lay_out(folder, sequence, points_m, craft, surface.diameter_m)
        file = f"rendezview_{DATA_SET}-test.csv"
        shutil.copy(poses, results / file)
        environment = os.environ | {
            "PYTHONPATH": str(toolkit.resolve()),
            "PATH": f"{python.absolute().parent}:{os.environ['PATH']}",
            "BOP_PATH": str(folder),
            "BOP_RESULTS_PATH": str(results),
            "BOP_EVAL_PATH": str(results),
            "BOP_NUM_WORKERS": "1",
        }

        def judged(script: str, *arguments: str) -> None:
            command = [str(python), str(toolkit.resolve() / "scripts" / script)]
            ran = subprocess.run(
                [*command, *arguments], env=environment, capture_output=True, text=True
            )
            if ran.returncode:
                sys.exit(f"{script}: {ran.stderr[-2000:]}")

        def recall(kind: str, limit: float) -> float:
            place = f"rendezview_{DATA_SET}-test/error={kind}_ntop=-1"
            threshold = f"--correct_th_{kind}={limit}"
            judged("eval_calc_scores.py", f"--error_dir_paths={place}", threshold)
            found = list((results / place).glob("scores_*.json"))
            value = json.loads(found[0].read_text())["recall"]
            found[0].unlink()
            return float(value)

        worst = 0.0
        ids = {frame.im_id: frame for frame in ours.frames}
        for kind, scale in (("mssd", 1e3), ("mspd", 1.0), ("add", 1e3), ("adi", 1e3)):
            judged(
                *("eval_calc_errors.py", "--n_top=-1", f"--error_type={kind}"),
                *(f"--result_filenames={file}", "--num_workers=1"),
            )
            path = results / f"rendezview_{DATA_SET}-test/error={kind}_ntop=-1/errors_000001.json"
            pairs = []
            for entry in json.loads(path.read_text()):
                frame = ids[entry["im_id"]]
                assert frame.surface is not None
                value = getattr(frame.surface, FIELDS[kind])
                theirs = float(entry["errors"]["0"][0])
                if math.isfinite(theirs):  # theirs is infinite where the spheres are apart
                    pairs.append((scale * value, theirs))
            found = np.array(pairs)
            apart = np.abs(found[:, 0] - found[:, 1]) / np.maximum(found[:, 1], 1e-3)
            worst = max(worst, float(apart.max()))
            print(
                f"{kind:5} {len(found)} frames, theirs {found[:, 1].min():.4g} … "
                f"{found[:, 1].max():.4g}, largest difference {np.abs(np.diff(found)).max():.1e}"
                f" ({apart.max():.1e} of it)"
            )
        mine = scores(ours)
        for kind, limits, value in (
            ("mssd", MSSD_FRACTIONS, mine.mssd_recall),
            ("mspd", MSPD_640_PX, mine.mspd_recall),
            ("add", np.array([0.1]), mine.add_share),
            ("adi", np.array([0.1]), mine.add_s_share),
        ):
            theirs = float(np.mean([recall(kind, float(limit)) for limit in limits]))
            worst = max(worst, abs((value or 0.0) - theirs))
            print(f"recall by {kind}: ours {value:.6f}, theirs {theirs:.6f}")
        judged("eval_bop24_pose.py", f"--result_filenames={file}", "--num_workers=1")
        final = json.loads((results / f"rendezview_{DATA_SET}-test/scores_bop24.json").read_text())
        print("eval_bop24_pose.py:", ", ".join(f"{k} {v:.4f}" for k, v in final.items()))
    agree = worst < EQUAL
    print("they agree" if agree else f"THEY DIFFER by {worst:.1e}")
    return 0 if agree else 1
