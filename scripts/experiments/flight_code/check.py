"""Exported flight code beside the runtime: the same frames and signatures, the same bits."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.flight_code.driver import (
    FlightCode,
    Outline,
    build,
    compiler,
    object_bytes,
    runtime_search,
    runtime_search_around,
    same_search,
)
from experiments.recognition.accuracy import flight_camera, frame_of, random_pose
from rendezview.export import write_onnx
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.signature import Readings, Signature, twist
from rendezview.sensors.appearance.outline.silhouette import Missing, Silhouette, find_silhouette
from rendezview.sensors.appearance.outline.votes import Matcher, MatchOptions
from rendezview.sensors.observation import Status
from rendezview_ground.mesh.mesh import load_mesh

PERTURBED = 9  # signatures for each that a frame gave
PRIOR_DEG = 20.0
LIMIT_US, LIMIT_BYTES = 20.0, 200_000


def same_outline(c: Outline, python: Silhouette) -> bool:
    """Points, area, box and levels, to the last bit."""
    return (
        len(c.outlines_px) == len(python.outlines_px)
        and all(map(np.array_equal, c.outlines_px, python.outlines_px))
        and (c.area_px, c.sky_grey, c.level_grey, c.box_px)
        == (python.area_px, python.sky_grey, python.level_grey, python.box_px)
    )


def same_signature(c: Signature, python: Signature) -> bool:
    """Readings; area and rotation may differ in the last bits, where numpy's product may."""
    return (
        np.array_equal(c.readings, python.readings)
        and abs(c.area_sr - python.area_sr) <= 1e-14 * python.area_sr
        and np.abs(c.centred_from_camera - python.centred_from_camera).max() <= 1e-14
    )


def compare_frame(
    code: FlightCode, image: np.ndarray, camera: Camera, model: ViewModel, tally: Counter[str]
) -> Signature | None:
    """One frame through both; the signature where there is one."""
    python, c = find_silhouette(image), code.frame(image, camera)
    tally["frames"] += 1
    if isinstance(python, Missing):
        tally["frames refused"] += 1
        tally["frames identical"] += c == python.status
        return None
    rays = [camera.rays(points) for points in python.outlines_px]
    signature = Signature.of_outlines(rays, model.bins, model.smooth_bins)
    if not isinstance(c, tuple) or signature is None:
        tally["frames refused"] += signature is None
        tally["frames identical"] += isinstance(c, tuple) and c[1] is Status.SMALL
        return signature
    outline, found = c
    exact = isinstance(found, Signature) and same_signature(found, signature)
    tally["frames identical"] += same_outline(outline, python) and exact
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
    optimise: Annotated[str, "flag of the C compiler"] = "-O2",
    onnx: Annotated[bool, "the ONNX graph too (needs onnxruntime)"] = False,
) -> None:  # fmt: skip
    """Exported flight code beside the runtime: the same frames and signatures, the same bits.

    Frames at random poses, 1-3 sphere radii away, with hard shadows, blur and noise of 3 grey
    levels, the Sun within 60° of behind the camera. Each frame goes to a signature in C and in
    Python. Each signature, and nine perturbed ones (readings off by up to 10 %, some cut off), goes
    through all trees, each at its own roll, and through both searches, at and around an attitude
    that is up to 20° off. Outlines, readings and trust must be equal to the last bit.

    Then the sizes of the object files and the time of all trees: every signature once in a round,
    nine rounds, each signature's fastest; the median and the worst of them, beside the runtime's
    own compiled loop. --onnx also runs the trees as an ONNX graph.
    """
    cc = compiler()
    if cc is None:
        sys.exit("no C compiler here")
    version = subprocess.run([cc, "--version"], capture_output=True, text=True, check=True)
    print(f"seed {seed}; {version.stdout.splitlines()[0]} {optimise}")
    view_model = ViewModel.load(model)
    matcher, options = Matcher(view_model), MatchOptions()
    craft = Target.load(target)
    mesh = load_mesh(craft.mesh_path, craft.unit)
    camera = flight_camera(mesh)
    rng = np.random.default_rng([seed, 9])
    nodes = np.arange(len(view_model.forest))
    rotations = view_model.views.centred_from_target[: len(nodes)]
    reach_rad = (options.margin_edges + 2.0) * view_model.geodesic.mean_edge_rad
    tally: Counter[str] = Counter()
    readings, attitudes, rolls, trusts = [], [], [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sizes = object_bytes(view_model, folder)
        with FlightCode(build(view_model, folder, [optimise]), view_model) as code:
            while len(readings) < signatures:
                _, pose = random_pose(view_model, camera, rng)
                image = frame_of(mesh, view_model, camera, pose, (0.0, 60.0), rng)
                signature = compare_frame(code, image, camera, view_model, tally)
                if signature is None:
                    continue
                for k in range(min(1 + PERTURBED, signatures - len(readings))):
                    view = perturbed(signature.readings, rng) if k else signature.readings
                    axis = rng.normal(size=3)
                    turn = np.deg2rad(PRIOR_DEG) * rng.uniform() * axis / np.linalg.norm(axis)
                    attitude = (
                        Rotation.from_rotvec(turn).as_matrix()
                        @ signature.centred_from_camera
                        @ pose.rotation
                    )
                    roll = twist(attitude, rotations)
                    trust = matcher.trust_of(view_model.forest.leaves(view, nodes, roll))
                    c = code.trees(view, roll)
                    tally["all trees identical"] += isinstance(c, np.ndarray) and np.array_equal(
                        c, trust
                    )
                    match = runtime_search(matcher, view, attitude, reach_rad)
                    found = code.search(view, attitude, reach_rad)
                    tally["searches identical"] += same_search(found, match)
                    tally["searches with active nodes"] += match is not None
                    match = runtime_search_around(matcher, view, attitude, np.deg2rad(PRIOR_DEG))
                    found = code.search_around(view, attitude, np.deg2rad(PRIOR_DEG))
                    tally["sweeps identical"] += same_search(found, match)
                    tally["sweeps with active nodes"] += match is not None
                    tally["active nodes, all spheres"] += int(np.count_nonzero(trust))
                    readings.append(view)
                    attitudes.append(attitude)
                    rolls.append(roll)
                    trusts.append(trust)
            all_us = 1e-3 * code.trees_ns(np.array(readings), np.array(rolls))
            search_us = 1e-3 * code.search_ns(np.array(readings), np.array(attitudes))
            sweep_us = 1e-3 * code.search_around_ns(
                np.array(readings[::10]), np.array(attitudes[::10])
            )
        python_us = np.full(len(readings), np.inf)
        for _ in range(3):
            for k, (view, roll) in enumerate(zip(readings, rolls, strict=True)):
                before = time.perf_counter()
                view_model.forest.leaves(view, nodes, roll)
                python_us[k] = min(python_us[k], 1e6 * (time.perf_counter() - before))
        onnx_same = ask_onnx(view_model, folder, readings, rolls, trusts) if onnx else None
    total, size = len(readings), sum(sizes.values())
    frames = tally["frames"]
    print(f"frame to signature   identical {tally['frames identical']} of {frames} "
          f"({tally['frames refused']} refused by both or one)")  # fmt: skip
    print(f"all {len(nodes)} trees        identical {tally['all trees identical']} of {total} "
          f"({tally['active nodes, all spheres'] / total:.1f} nodes on a signature)")  # fmt: skip
    print(f"node search          identical {tally['searches identical']} of {total} "
          f"({tally['searches with active nodes']} with active nodes)")  # fmt: skip
    print(f"search around 20°    identical {tally['sweeps identical']} of {total} "
          f"({tally['sweeps with active nodes']} with active nodes)")  # fmt: skip
    if onnx_same is not None:
        print(f"ONNX trees           identical {onnx_same} of {total}")
    print(f"object size          {size} bytes (limit {LIMIT_BYTES}): " + ", ".join(
        f"{name} {taken}" for name, taken in sizes.items()))  # fmt: skip
    ratio = np.median(all_us) / np.median(python_us)
    print(f"all {len(nodes)} trees        median {np.median(all_us):.1f} µs, worst "
          f"{all_us.max():.1f} µs (limit {LIMIT_US:.0f}); the runtime's loop "
          f"{np.median(python_us):.1f} µs: ratio {ratio:.2f}")  # fmt: skip
    print(f"node search          median {np.median(search_us):.1f} µs, worst "
          f"{search_us.max():.1f} µs; around 20°: median {np.median(sweep_us):.0f} µs, worst "
          f"{sweep_us.max():.0f} µs")  # fmt: skip
    right = (
        tally["frames identical"] == frames
        and tally["all trees identical"] == tally["searches identical"] == total
        and tally["sweeps identical"] == total
        and onnx_same in (None, total)
        and size <= LIMIT_BYTES
        and np.median(all_us) <= LIMIT_US
    )
    sys.exit(0 if right else 1)


def ask_onnx(
    model: ViewModel,
    folder: Path,
    readings: list[Readings],
    rolls: list[Array],
    trusts: list[Array],
) -> int:
    """How often the ONNX graph decides as the runtime does, all nodes of a signature at once."""
    import onnxruntime

    path = folder / "trees.onnx"
    write_onnx(model, path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options)
    same = 0
    for view, roll, trust in zip(readings, rolls, trusts, strict=True):
        on = session.run(["on"], {"readings": view, "rolls_rad": roll})[0]
        same += np.array_equal(on, trust > 0.0)
    return same
