"""The choice among the poses of a sketch and its confidence, fitted to frames in hard light.

The frames show the target with its mesh deformed, lit and exposed as real photographs are, before
random skies. None of them is a photograph.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from joblib import Parallel, delayed
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import expit
from scipy.stats import chi2
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression

from experiments.frame import nees
from rendezview import Camera, Pose, Recognizer, TrainingOptions, ViewModel, load_mesh
from rendezview.estimation.motion import extrapolate
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry, angle_between
from rendezview.sensors.appearance.judge import sketch_choice
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.judge.probability_forest import ProbabilityForest
from rendezview.sensors.appearance.search.sketch_search import SketchSearch
from rendezview.sensors.appearance.sky import Sky
from rendezview_ground.learn.job import train
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.symmetries import find_symmetries
from rendezview_ground.simulate.cloudy_skies import cloudy_sky
from rendezview_ground.simulate.hard_light import photograph
from rendezview_ground.simulate.mesh_error import deformed
from rendezview_ground.simulate.random_craft import any_craft
from rendezview_ground.simulate.scene import sun_at_phase
from rendezview_ground.simulate.shading import ShadingOptions, render

SIDE = 320  # px of a frame
RADIUS_PX = (35.0, 240.0)  # of the target, log; large ones are cut by the border
FIELD = (0.8, 6.0)  # focal length over the side, log
MESH_ERRORS = (0.0, 0.008, 0.02)  # of the radius
PRIOR_DEG, PRIOR_SHARE, SEARCH_DEG = 12.0, 0.03, 10.0
RIGHT_DEG, RIGHT_SHARE, WRONG_DEG = 5.0, 0.1, 8.0
NEES_DEG = 8.0  # larger errors are wrong poses, not inaccurate ones
WEIGHT_OF_WRONG = 2.0  # a wrong answer costs more than one that is not given
TREES, LEAST_IN_LEAF = 100, 10
RIDGE = 0.02  # of the weights of the merit
UNKNOWNS = 6
WIDER = 2.0  # of the inflation: real craft differ more from their meshes than drawn ones
CRAFT = 12  # random ones besides
FOLDS = 5  # of the targets; the frames of each are judged by a fit to those of the others
# Of random craft: what the search on sketches reads, and next to no trees.
CRAFT_OPTIONS = TrainingOptions(
    perturbed_views=200, held_out_views=50, forest_trees=0, shadowed_silhouettes=False
)
LEAST_CONFIDENCE = 0.6  # of the recognizer


def frame(mesh: Mesh, rng: np.random.Generator) -> tuple[np.ndarray, Camera, Pose]:
    """One picture in hard light, with its camera and its pose."""
    mesh = deformed(mesh, float(rng.choice(MESH_ERRORS)), rng)
    centre_m, radius_m = mesh.bounding_sphere
    focal, middle = SIDE * np.exp(rng.uniform(*np.log(FIELD))), 0.5 * (SIDE - 1)
    camera = Camera(width=SIDE, height=SIDE, fx=focal, fy=focal, cx=middle, cy=middle)
    radius_px = np.exp(rng.uniform(*np.log(RADIUS_PX)))
    room = max(0.5 * SIDE - radius_px * rng.uniform(0.55, 1.0), 8.0) / focal
    line = np.array([*rng.uniform(-1.0, 1.0, 2) * room, 1.0])
    centre = line * max(focal * radius_m / radius_px, 1.6 * radius_m)
    rotation = Rotation.random(random_state=rng).as_matrix()
    pose = Pose(rotation, centre - rotation @ centre_m)
    sun = sun_at_phase(centre, np.deg2rad(rng.uniform(0.0, 150.0)), rng.uniform(0.0, 2.0 * np.pi))
    plain = ShadingOptions(samples=2, ambient=0.0, earthshine=0.0, shadow_texels_max=1024)
    sunlit = render(mesh, camera, pose, sun, plain)
    glow = ShadingOptions(samples=2, ambient=0.25, specular=0.0, earthshine=0.75, shadows=False)
    up = rng.standard_normal(3)
    ambient = render(mesh, camera, pose, up, glow, -up)
    light = (sunlit.radiance, ambient.radiance, sunlit.coverage)
    grey = photograph(*light, cloudy_sky(SIDE, rng), rng)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), camera, pose


@lru_cache(maxsize=1)
def stored(path: Path) -> ViewModel:
    """The model of a file, read once by each process: the frames come target by target."""
    return ViewModel.load(path)


def random_target(folder: Path, seed: int, k: int) -> tuple[Path, Mesh]:
    """A random craft and the model of it, on which the sketch network was not trained."""
    mesh, path = any_craft(np.random.default_rng([901, seed, k])), folder / f"craft{k}.rvm"
    alike = find_symmetries(mesh)
    train(mesh, path, name=path.stem, options=CRAFT_OPTIONS, jobs=1, symmetries=alike)
    return path, mesh


@dataclass(frozen=True, slots=True, eq=False)
class Searched:
    """What a search on a sketch found in a frame of known pose."""

    passes: sketch_choice.Passes
    truth: Pose
    centre_m: Array  # (3,) of the views
    symmetries: tuple[Symmetry, ...]
    prior: bool
    best: Pose
    given: Pose  # the mean of those that the best leads to
    nees: float | None
    target: int  # which of the targets
    second: Searched | None = None  # of the frame upside down

    @property
    def pose(self) -> Pose:
        """What the present merit chooses; where that is the same, the one that was given."""
        now = self.passes.chosen()
        assert now is not None  # a frame without any pose is none of those searched
        return self.given if now[0].pose is self.best else now[0].pose

    def error_deg(self, pose: Pose) -> float:
        return float(np.rad2deg(angle_between(pose, self.truth, self.symmetries)))

    def right(self, pose: Pose) -> bool:
        centre, place = (p.apply(self.centre_m) for p in (self.truth, pose))
        aside = np.linalg.norm(place - centre) / np.linalg.norm(centre)
        return self.error_deg(pose) < RIGHT_DEG and bool(aside < RIGHT_SHARE)


def look(path: Path, mesh: Mesh, target: int, seed: int, k: int) -> list[Searched]:
    """All poses of a frame that were looked at, without and with a prior."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng([55, seed, k])
    picture, camera, truth = frame(mesh, rng)
    model = stored(path)
    search = Recognizer(model, camera).sketch
    if search is None:
        raise SystemExit("the model has no sketches: train it again")
    turn, move = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    turn = np.deg2rad(rng.uniform(0.0, PRIOR_DEG)) * turn
    move = PRIOR_SHARE * np.linalg.norm(truth.apply(model.centre_m)) * move
    prior = extrapolate(truth, np.append(turn, move), 1.0, model.centre_m)
    first = _searched(search, picture, truth, None, target)
    if first is not None:
        second = _searched(search, picture, truth, None, target, turned=True)
        first = replace(first, second=second)
    near = _searched(search, picture, truth, prior, target)
    return [one for one in (first, near) if one is not None]


def _searched(
    search: SketchSearch, picture: np.ndarray, truth: Pose, prior: Pose | None, target: int, *,
    turned: bool = False,
) -> Searched | None:  # fmt: skip
    sky = Sky.of(picture)
    if prior is None:
        choice = search.anywhere(picture, sky, turned=turned)
    else:
        near = Near(prior, np.deg2rad(SEARCH_DEG), search.model.centre_m)
        choice = search.near(picture, sky, near)
    chosen = None if choice is None or choice.passes is None else choice.passes.chosen()
    if choice is None or choice.passes is None or chosen is None:
        return None
    squared, best, model = None, choice.best, search.model
    error = best.pose.delta_from(truth)
    if np.rad2deg(np.linalg.norm(error[:3])) < NEES_DEG and best.covariance is not None:
        squared = nees(error, best.covariance)
    return Searched(
        choice.passes, truth, model.centre_m, model.symmetries, prior is not None,
        chosen[0].pose, best.pose, squared, target,
    )  # fmt: skip


def fitted_merit(searches: list[Searched]) -> np.ndarray:
    """(7,) weights that put right poses of a frame before wrong ones (conditional logit).

    Of both passes: those of the closer one were chosen by a merit, which cannot separate them.
    """
    groups = []
    each = [(s, poses) for s in searches for poses in (s.passes.first, s.passes.closer)]
    for search, poses in each:
        clear = [p for p in poses if search.right(p.pose) or search.error_deg(p.pose) > WRONG_DEG]
        good = np.array([search.right(p.pose) for p in clear], dtype=bool)
        if good.any() and not good.all():
            groups.append((np.array([p.sketch for p in clear]), good))

    def unlikely(weights: np.ndarray) -> tuple[float, np.ndarray]:
        loss, slope = RIDGE * weights @ weights, 2.0 * RIDGE * weights
        for features, good in groups:
            odds = np.exp(features @ weights - np.max(features @ weights))
            among, of_right = odds / odds.sum(), odds * good / (odds * good).sum()
            loss -= np.log((odds * good).sum() / odds.sum())
            slope = slope + features.T @ (among - of_right)
        return float(loss), slope

    return minimize(
        unlikely, np.zeros(len(sketch_choice.POSE_FEATURES)), jac=True, method="L-BFGS-B"
    ).x


def fitted_trees(features: np.ndarray, good: np.ndarray) -> ProbabilityForest:
    """Trees that tell from ``CHOICE_FEATURES`` whether the pose is right."""
    weight = np.where(good, 1.0, WEIGHT_OF_WRONG)
    fit = RandomForestClassifier(TREES, min_samples_leaf=LEAST_IN_LEAF, random_state=0)
    fit.fit(features, good, sample_weight=weight)
    return ProbabilityForest.of([tree.tree_ for tree in fit.estimators_])


def probabilities(asked: list[np.ndarray], good: np.ndarray, folds: np.ndarray) -> list[np.ndarray]:
    """(N,) of each opinion's features (N, 14), from fits to the first opinions of other folds."""
    found = [np.empty(len(good)) for _ in asked]
    for fold in np.unique(folds):
        out = folds == fold
        trees = fitted_trees(asked[0][~out], good[~out])
        for features, probability in zip(asked, found, strict=True):
            probability[out] = [trees.probability(one) for one in features[out]]
    return found


def shares(good: np.ndarray, wrong: np.ndarray, given: np.ndarray) -> str:
    """Of passes (N,) each: whether the pose is right, whether wrong, whether it is given."""
    return f"given and right {(given & good).mean():.3f}, and wrong {(given & wrong).mean():.4f}"


def opinion_weights(features: np.ndarray, good: np.ndarray) -> np.ndarray:
    """(4,) of the logistic regression."""
    weight = np.where(good, 1.0, WEIGHT_OF_WRONG)
    return LogisticRegression(fit_intercept=False).fit(features, good, weight).coef_[0]


def with_second_opinions(
    some: list[Searched], found: list[np.ndarray], folds: np.ndarray, good: np.ndarray,
    wrong: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The weights (4,) of the opinions; prints what is given then, by fits to the other folds.

    ``found``: probabilities (N,) of both opinions; ``good``, ``wrong``: of the first one's poses.
    """
    first, second = found
    good, wrong, given = good.copy(), wrong.copy(), first > LEAST_CONFIDENCE
    which, features = [], []
    for k, one in enumerate(some):
        if one.second is None or not sketch_choice.DOUBT[0] <= first[k] < sketch_choice.DOUBT[1]:
            continue
        pose, other = one.pose, one.second.pose
        apart = angle_between(pose, other, one.symmetries)
        low, high = sorted((first[k], second[k]))
        which.append(k)
        features.append(
            sketch_choice.opinion_features(high, low, agree=bool(apart < sketch_choice.NEAR_RAD))
        )
        if second[k] > first[k]:  # the second one is more confident
            good[k], wrong[k] = one.second.right(other), one.second.error_deg(other) > WRONG_DEG
    doubted, given_features = np.array(which), np.array(features)
    right = good[doubted]
    for fold in np.unique(folds):
        out = folds[doubted] == fold
        weights = opinion_weights(given_features[~out], right[~out])
        given[doubted[out]] = expit(given_features[out] @ weights) > LEAST_CONFIDENCE
    print(
        f"    with a second opinion in {len(right)}, {right.mean():.3f} of them right: "
        f"{shares(good, wrong, given)}"
    )
    return opinion_weights(given_features, right)


def searched(models: list[Path], meshes: list[Mesh], frames: int, seed: int) -> list[Searched]:
    """What the searches find in frames of the targets, and of as many random craft."""
    with tempfile.TemporaryDirectory() as folder, Parallel(n_jobs=-1) as parallel:
        targets = list(zip(models, meshes, strict=True))
        targets += parallel(delayed(random_target)(Path(folder), seed, k) for k in range(CRAFT))
        drawn = parallel(
            delayed(look)(path, mesh, target, seed, k)
            for target, (path, mesh) in enumerate(targets)
            for k in range(frames)
        )
    return [search for found in drawn for search in found]


def run(
    models: list[Path], *, meshes: str = "hubble.stl,client.stl",
    frames: Annotated[int, "of each target"] = 150,
    seeds: Annotated[str, "each with frames and random craft of its own"] = "3,4",
    write: Annotated[bool, "into the package"] = False,
) -> None:  # fmt: skip
    """Fit to MODELS, whose MESHES (in metres) are named in the same order, and to 12 random craft.

    The shares printed are of targets that the fit did not see (five folds).
    """
    read = [load_mesh(Path(name), "m") for name in meshes.split(",")]
    each = [int(seed) for seed in seeds.split(",")]
    searches = [s for seed in each for s in searched(models, read, frames, seed)]
    record = json.loads(sketch_choice.PACKAGED.read_text(encoding="utf-8"))
    merit = fitted_merit(searches)
    record["merit"] = dict(zip(sketch_choice.POSE_FEATURES, merit.tolist(), strict=True))
    sketch_choice.packaged().merit[:] = merit  # the features and choices are those of the new merit
    arrays: dict[str, np.ndarray] = {}
    for kind, prior in (("anywhere", False), ("near", True)):
        some = [s for s in searches if s.prior == prior]
        features = np.array([s.passes.features for s in some])
        good = np.array([s.right(s.pose) for s in some])
        wrong = np.array([s.error_deg(s.pose) > WRONG_DEG for s in some])
        asked = [features]
        if not prior:
            asked.append(np.array([(s.second or s).passes.features for s in some]))
        folds = np.array([s.target for s in some]) % FOLDS
        found = probabilities(asked, good, folds)
        trees = fitted_trees(features, good)
        arrays |= {f"{kind}_{f.name}": getattr(trees, f.name) for f in fields(trees)}
        print(f"{kind}: {len(some)} passes, the pose right {good.mean():.3f}; "
              f"{shares(good, wrong, found[0] > LEAST_CONFIDENCE)}")  # fmt: skip
        if not prior:
            weights = with_second_opinions(some, found, folds, good, wrong)
            record["opinions"] = np.round(weights, 3).tolist()
    squares = np.array([s.nees for s in searches if s.nees is not None])
    print(f"NEES: median {np.median(squares):.1f}, mean {squares.mean():.1f}, {len(squares)} poses")
    # The median: a few poses almost as wrong as NEES_DEG would decide the mean.
    record["inflation"] *= WIDER * float(np.median(squares) / chi2.median(UNKNOWNS))
    record["provenance"] = {
        "experiment": "sketch-confidence", "targets": [p.stem for p in models],
        "random_craft": CRAFT, "frames_of_each": frames, "seeds": each,
    }  # fmt: skip
    text = json.dumps(record, indent=1) + "\n"
    print(text)
    if write:
        sketch_choice.PACKAGED.write_text(text, encoding="utf-8")
        np.savez_compressed(sketch_choice.PACKAGED_TREES, **arrays)
