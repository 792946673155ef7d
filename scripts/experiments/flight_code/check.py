"""Exported flight code beside the runtime: the same frames and signatures, the same bits."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import timeit
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import onnxruntime
from scipy.spatial.transform import Rotation

from experiments.frame import mesh_of, tests_module, unit
from experiments.recognition.accuracy import flight_camera, frame_of, random_pose, signature_of
from rendezview import Camera, Pose, Status, ViewModel
from rendezview.export import write_onnx
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.signature import Readings, Signature, twist
from rendezview.sensors.appearance.outline.silhouette import Missing, Silhouette, find_silhouette
from rendezview.sensors.appearance.outline.votes import Matcher, MatchOptions

PERTURBED = 9  # signatures for each that a frame gave
PRIOR_RAD = np.deg2rad(20.0)
PHASES_DEG = (0.0, 60.0)  # of the Sun
LIMIT_US, LIMIT_BYTES = 20.0, 200_000
OPTIMISE = "-O2"

driver = tests_module("export.driver")


def same_frame(c: Any, python: Silhouette, signature: Signature) -> bool:
    """Outline and readings to the last bit; numpy's products may differ in theirs."""
    if not isinstance(c, tuple) or not isinstance(c[1], Signature):
        return False
    outline, found = c
    return (
        len(outline.outlines_px) == len(python.outlines_px)
        and all(map(np.array_equal, outline.outlines_px, python.outlines_px))
        and (outline.area_px, outline.sky_grey, outline.level_grey, outline.box_px)
        == (python.area_px, python.sky_grey, python.level_grey, python.box_px)
        and np.array_equal(found.readings, signature.readings)
        and abs(found.area_sr - signature.area_sr) <= 1e-14 * signature.area_sr
        and np.abs(found.centred_from_camera - signature.centred_from_camera).max() <= 1e-14
    )


def compare_frame(
    code: Any, image: np.ndarray, camera: Camera, model: ViewModel, tally: Counter[str]
) -> Signature | None:
    """One frame through both; the signature where there is one."""
    python, c = find_silhouette(image), code.frame(image, camera)
    tally["frames"] += 1
    if isinstance(python, Missing):
        tally["frames refused"] += 1
        tally["frames identical"] += c == python.status
        return None
    signature = signature_of(python, camera, model)
    if signature is None:
        tally["frames refused"] += 1
        tally["frames identical"] += isinstance(c, tuple) and c[1] is Status.SMALL
    else:
        tally["frames identical"] += same_frame(c, python, signature)
    return signature


def perturbed(readings: Readings, rng: np.random.Generator) -> Readings:
    """Readings each off by up to 10 %; in half of them an arc is cut off by shadow."""
    out = readings * (1.0 + 0.1 * rng.uniform() * rng.normal(size=len(readings)))
    if rng.uniform() < 0.5:
        arc = (rng.integers(len(out)) + np.arange(rng.integers(1, len(out) // 4))) % len(out)
        out[arc] = np.minimum(out[arc], rng.uniform(0.3, 1.0) * out[arc].max())
    return np.rint(np.maximum(out, 0.0)).astype(np.float32)


def run(
    model: Path, target: Annotated[Path, "target of the model: folder or target.toml"], *,
    signatures: int = 10000, seed: int = 77,
    onnx: Annotated[bool, "the ONNX graph too"] = False,
) -> None:  # fmt: skip
    """Exported flight code beside the runtime: the same frames and signatures, the same bits.

    Frames at random poses, 1-3 sphere radii away, with hard shadows, blur and noise of 3 grey
    levels, the Sun within 60° of behind the camera. Each frame goes to a signature in C and in
    Python. Each signature, and nine perturbed ones (readings off by up to 10 %, some cut off), goes
    through all trees, each at its own roll, and through both searches, at and around an attitude
    that is up to 20° off. Outlines, readings and trust must be equal to the last bit. Times are
    each signature's fastest of nine rounds, beside the runtime's own compiled loop.
    """
    cc = driver.compiler()
    if cc is None:
        sys.exit("no C compiler here")
    version = subprocess.run([cc, "--version"], capture_output=True, text=True, check=True)
    print(f"seed {seed}; {version.stdout.splitlines()[0]} {OPTIMISE}")
    views, (_, mesh) = ViewModel.load(model), mesh_of(target)
    matcher = Matcher(views)
    camera, rng = flight_camera(mesh), np.random.default_rng([seed, 9])
    nodes, scores = np.arange(len(views.forest)), views.forest_scores()
    rotations = views.views.centred_from_target[: len(nodes)]
    reach_rad = (MatchOptions().margin_edges + 2.0) * views.geodesic.mean_edge_rad
    tally: Counter[str] = Counter()
    asked: list[tuple[Array, Array, Array, Array]] = []  # readings, attitude, rolls, trust
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sizes = driver.object_bytes(views, folder)
        size = sum(sizes[name] for name in sizes if "forest" not in name)
        with driver.FlightCode(driver.build(views, folder, [OPTIMISE]), views) as code:
            while len(asked) < signatures:
                _, pose = random_pose(views, camera, rng)
                image = frame_of(mesh, views, camera, pose, PHASES_DEG, rng)
                signature = compare_frame(code, image, camera, views, tally)
                if signature is None:
                    continue
                for k in range(min(1 + PERTURBED, signatures - len(asked))):
                    view = perturbed(signature.readings, rng) if k else signature.readings
                    turn = unit(rng) * PRIOR_RAD * rng.uniform()
                    turned = Rotation.from_rotvec(turn).as_matrix()
                    attitude = turned @ signature.centred_from_camera @ pose.rotation
                    roll = twist(attitude, rotations)
                    trust = matcher.trust_of(views.forest.leaves(view, nodes, roll))
                    tally["trees"] += np.array_equal(code.trees(view, roll), trust)
                    for name, reach in (("search", reach_rad), ("search_around", PRIOR_RAD)):
                        here = getattr(driver, f"runtime_{name}")(matcher, view, attitude, reach)
                        in_c = getattr(code, name)(view, attitude, reach)
                        tally[name] += driver.same_search(in_c, here)
                    if scores is not None:
                        centred = Signature(view, signature.area_sr, np.eye(3))
                        score = scores.scores(centred, attitude[None])[0]
                        tally["scores"] += code.forest_score(view, attitude) == score
                        found = code.forest_search(view, attitude, reach_rad)
                        match = matcher.at(centred, Pose(attitude, np.zeros(3)))
                        tally["forest searches"] += driver.same_match(found, match)
                    asked.append((view, attitude, roll, trust))
            every, where, rolls, trusts = map(np.array, zip(*asked, strict=True))
            all_us = 1e-3 * code.trees_ns(every, rolls)
            search_us = 1e-3 * code.search_ns(every, where)
            score_us = 1e-3 * code.forest_score_ns(every, where) if scores else np.zeros(1)
            sweep_us = 1e-3 * code.search_around_ns(every[::10], where[::10])
        python_us = 1e6 * np.array([
            min(timeit.repeat(partial(views.forest.leaves, view, nodes, roll), number=1, repeat=3))
            for view, roll in zip(every, rolls, strict=True)
        ])  # fmt: skip
        if onnx:
            tally["ONNX"] = ask_onnx(views, folder / "trees.onnx", every, rolls, trusts)
    total, frames = len(asked), tally["frames"]
    print(f"frame to signature: identical {tally['frames identical']} of {frames} "
          f"({tally['frames refused']} refused); object size: {size} bytes, "
          f"{sum(sizes.values()) - size} more with the forest")  # fmt: skip
    checked = ["trees", "search", "search_around", *(["ONNX"] if onnx else [])]
    checked += ["scores", "forest searches"] if scores else []
    for name in checked:
        print(f"{name}: identical {tally[name]} of {total}")
    for name, us in (("all trees", all_us), ("the runtime's loop", python_us),
                     ("node search", search_us), ("search around 20°", sweep_us),
                     ("score of the forest", score_us)):  # fmt: skip
        print(f"{name}: median {np.median(us):.1f} µs, worst {us.max():.1f} µs")
    right = (
        tally["frames identical"] == frames
        and all(tally[name] == total for name in checked)
        and size <= LIMIT_BYTES
        and np.median(all_us) <= LIMIT_US
    )
    sys.exit(0 if right else 1)


def ask_onnx(model: ViewModel, path: Path, *asked: Array) -> int:
    """How often the ONNX graph decides as the runtime does; readings, rolls and trusts."""
    write_onnx(model, path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session, same = onnxruntime.InferenceSession(path, options), 0
    for view, roll, trust in zip(*asked, strict=True):
        on = session.run(["on"], {"readings": view, "rolls_rad": roll})[0]
        same += np.array_equal(on, trust > 0.0)
    return same
