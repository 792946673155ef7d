"""Whether the confidence of poses holds on craft that no fit has seen."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
from joblib import Parallel, delayed

from experiments.frame import kept, show, table_of, unit
from experiments.pose.frames import one_frame
from experiments.pose.sketch_confidence import frame as hard_light
from rendezview import Camera, Pose, Recognizer, TrainingOptions, ViewModel
from rendezview.estimation.motion import extrapolate
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry, angle_between
from rendezview.sensors.appearance import AppearanceObservation
from rendezview_ground.learn.job import train
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.symmetries import find_symmetries
from rendezview_ground.simulate import MitsubaOptions
from rendezview_ground.simulate.command import default_camera
from rendezview_ground.simulate.near_symmetric_craft import any_near_symmetric
from rendezview_ground.simulate.random_craft import any_craft

RIGHT_DEG, WRONG_DEG = 5.0, 10.0
PRIOR_DEG, PRIOR_RANGE = 14.0, 0.05  # errors of a prior, at most; the recognizer is given 20°
ALIKE = 4  # every so many craft nearly maps onto itself
BINS = np.linspace(0.0, 1.0, 11)
# Next to no trees: they order the starts of a search. All frames lie beyond the farthest shell.
OPTIONS = TrainingOptions(
    perturbed_views=100, held_out_views=20, min_samples_split=10_000, forest_trees=0,
    contour_radii=(3.0,), contour_resolution_px=480,
)  # fmt: skip
FAST = MitsubaOptions(samples=16)
# Condition, renderer (None: our own), and which materials. Of another craft every pose is wrong.
KINDS = (
    ("low", None, "its own"), ("high", FAST, "its own"), ("earth", None, "its own"),
    ("high", FAST, "others"), ("high", None, "its own"), ("low", FAST, "its own"),
    ("earth", FAST, "its own"), ("hard light", None, "its own"), ("high", FAST, "another craft"),
)  # fmt: skip
OTHER = 1000  # is added to the number of a craft for another one

Rows = dict[str, Array]


def craft(k: int, seed: int) -> Mesh:
    """The k-th random craft; every fourth nearly maps onto itself."""
    made = any_near_symmetric if k % ALIKE == 0 else any_craft
    return made(np.random.default_rng([902, seed, k]))


def picture(number: int, camera: Camera, k: int, seed: int) -> tuple[Any, Camera, Pose | None]:
    """The k-th frame of a craft, its camera, and the craft's pose; None: it shows another one."""
    condition, mitsuba, materials = KINDS[k % len(KINDS)]
    stream, other = [seed, number, k], materials == "another craft"
    mesh = craft(number + OTHER * other, seed)
    if condition == "hard light":
        return hard_light(mesh, np.random.default_rng(stream))
    image, pose = one_frame(
        mesh, camera, condition, stream, unknown=materials == "others", mitsuba=mitsuba
    )
    return image, camera, None if other else pose


def off(truth: Pose, centre_m: Array, rng: np.random.Generator) -> Pose:
    """A prior."""
    turn = np.deg2rad(rng.uniform(0.0, PRIOR_DEG)) * unit(rng)
    move = PRIOR_RANGE * np.linalg.norm(truth.apply(centre_m)) * unit(rng)
    return extrapolate(truth, np.append(turn, move), 1.0, centre_m)


class Look(NamedTuple):
    """What was seen in a frame of a random craft, beside the truth."""

    seen: AppearanceObservation
    truth: Pose | None  # None: the frame shows another craft
    prior: bool  # one was given
    symmetries: Sequence[Symmetry]

    def error_deg(self, pose: Pose | None) -> float:
        """Of a pose; 180 where there is none, and of another craft."""
        if pose is None or self.truth is None:
            return 180.0
        return float(np.rad2deg(angle_between(pose, self.truth, self.symmetries)))


def looks(
    number: int, seed: int, frames: int, folder: Path, *, sketch: bool = True
) -> Iterator[Look]:
    """What is seen in the frames of one craft, without a prior and with one."""
    cv2.setNumThreads(1)
    mesh, path, camera = craft(number, seed), folder / f"{number}.rvm", default_camera()
    train(mesh, path, name=path.stem, options=OPTIONS, jobs=1, symmetries=find_symmetries(mesh))
    model = ViewModel.load(path)
    path.unlink()
    for k in range(frames):
        image, its_camera, truth = picture(number, camera, k, seed)
        recognizer = Recognizer(model, its_camera, sketch=sketch)
        priors: list[Pose | None] = [None]
        if truth is not None:
            priors.append(off(truth, model.centre_m, np.random.default_rng([seed, number, k, 1])))
        for prior in priors:
            seen = recognizer.recognize(image, prior)
            yield Look(seen, truth, prior is not None, model.symmetries)
    print(f"craft {number}", flush=True)


def rows_of(number: int, seed: int, frames: int, folder: Path) -> Rows:
    """The answers for the frames of one craft: a row each, without a prior and with one."""
    rows = []
    for look in looks(number, seed, frames, folder):
        pose, found = look.seen.pose, look.seen.found
        confidence, on_sketch, best = np.nan, False, pose
        if found is not None:
            confidence, on_sketch, best = found.right, found.on_sketch, pose or found.best.pose
        rows.append((
            confidence, look.error_deg(best), pose is not None, look.prior, on_sketch,
            look.truth is None,
        ))  # fmt: skip
    names = ("confidence", "error_deg", "given", "prior", "on_sketch", "another")
    return dict(zip(names, np.array(rows, dtype=np.float64).T, strict=True))


def of_each_craft(
    rows: Callable[[int, int, int, Path], Rows], craft_count: int, seed: int, frames: int,
    keep: Path | None,
) -> tuple[Array, Rows]:  # fmt: skip
    """The rows of all craft, one after the other, and the number of the craft (N,) of each.

    Args:
        rows: of a craft, given its number, seed, frames and a folder for its model.
        keep: folder of the rows of each craft; what is there is not made again. None: a new one.
    """
    with tempfile.TemporaryDirectory() as folder, Parallel(n_jobs=-1) as parallel:
        kept_in = Path(folder) if keep is None else keep
        kept_in.mkdir(exist_ok=True)
        each = parallel(
            delayed(kept)(kept_in / f"{k}.npz", partial(rows, k, seed, frames, Path(folder)))
            for k in range(craft_count)
        )
    counts = [len(next(iter(one.values()))) for one in each]
    together = {name: np.concatenate([one[name] for one in each]) for name in each[0]}
    return np.repeat(np.arange(len(each)), counts), together


def losses(confidence: Array, right: Array) -> Array:
    """(N,) log losses."""
    return -np.log(np.clip(np.where(right, confidence, 1.0 - confidence), 1e-4, 1.0))


def run(
    *, craft_count: int = 40, frames: Annotated[int, "of each craft"] = 18, seed: int = 5,
    rows: Annotated[Path | None, "folder that keeps the answers for each craft"] = None,
) -> None:  # fmt: skip
    """How often poses of random craft are right, by their confidence, given or not.

    Half of the frames are drawn by Mitsuba, half by our own renderer: black sky with the Sun at
    0–70°, the Earth behind, materials unlike the mesh, hard light, and another craft, of which no
    pose is right. A quarter of the craft nearly map onto themselves. A pose is right if it is less
    than 5° off, wrong if it is more than 10° off. A prior is up to 14° off.
    """
    number, table = of_each_craft(rows_of, craft_count, seed, frames, rows)
    confidence, error_deg, given, prior, on_sketch, another = (
        table[name]
        for name in ("confidence", "error_deg", "given", "prior", "on_sketch", "another")
    )
    right, given, found = error_deg < RIGHT_DEG, given > 0.5, np.isfinite(confidence)
    wrong = given & (error_deg > WRONG_DEG)
    kinds = {
        "no prior": prior < 0.5,
        "no prior, grey edges": (prior < 0.5) & (on_sketch < 0.5),
        "no prior, sketch": (prior < 0.5) & (on_sketch > 0.5),
        "prior": prior > 0.5,
    }
    columns = "frames | n | right | wrong | given of another craft | log loss | worst craft"
    answers = table_of("answers", columns)
    reliability = table_of("poses; mean confidence, share right", ("confidence", *kinds))
    cells: list[list[str]] = [[] for _ in BINS[1:]]
    for name, kind in kinds.items():
        these = kind & found
        loss, at = losses(confidence[these], right[these]), number[these]
        shown = kind & (another < 0.5)
        answers.add_row(
            name, str(shown.sum()), str((shown & given & right).sum()), str((shown & wrong).sum()),
            f"{(kind & given & (another > 0.5)).sum()} of {(kind & (another > 0.5)).sum()}",
            f"{loss.mean():.3f}", f"{max(loss[at == k].mean() for k in np.unique(at)):.2f}",
        )  # fmt: skip
        bins = np.digitize(confidence, BINS[1:-1])
        for k, row in enumerate(cells):
            those = these & (bins == k)
            means = (f"{values[those].mean():.2f}" for values in (confidence, right))
            row.append(f"{those.sum()}; {', '.join(means)}" if those.any() else "")
    for k, row in enumerate(cells):
        reliability.add_row(f"{BINS[k]:.1f}–{BINS[k + 1]:.1f}", *row)
    show(answers, reliability, width=120)
    for k in np.unique(number[wrong]):
        print(f"craft {k}: wrong {np.round(confidence[wrong & (number == k)], 2).tolist()}")
