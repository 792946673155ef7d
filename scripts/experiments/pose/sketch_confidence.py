"""The choice among the poses of a sketch and its confidence, fitted to frames in hard light.

The frames show the target with its mesh deformed, lit and exposed as real photographs are, before
random skies. None of them is a photograph.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from joblib import Parallel, delayed
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LogisticRegression

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.sketch import search as sketch_search
from rendezview.sensors.appearance.sketch.choice import CHOICE_FEATURES, PACKAGED, POSE_FEATURES
from rendezview.simulation.cloudy_skies import cloudy_sky
from rendezview.simulation.hard_light import photograph
from rendezview.simulation.mesh_error import deformed
from rendezview.simulation.scene import sun_at_phase
from rendezview.simulation.shading import ShadingOptions, render
from rendezview.training.mesh import Mesh, load_mesh

SIDE = 320  # px of a frame
RADIUS_PX = (35.0, 150.0)  # of the target, log
FIELD = (0.8, 6.0)  # focal length over the side, log
MESH_ERRORS = (0.0, 0.008, 0.02)  # of the radius
PRIOR_DEG, PRIOR_SHARE, SEARCH_DEG = 12.0, 0.03, 10.0
RIGHT_DEG, RIGHT_SHARE, WRONG_DEG = 5.0, 0.1, 8.0
NEES_DEG = 8.0  # larger errors are wrong poses, not inaccurate ones
WEIGHT_OF_WRONG = 1.5  # a wrong answer costs more than one that is not given
RIDGE = 0.02  # of the weights of the merit
UNKNOWNS = 6
DISTINCT_MARGIN = 4.0  # of a pose without a rival, as in ``choice``


def frame(mesh: Mesh, rng: np.random.Generator) -> tuple[np.ndarray, Camera, Pose]:
    """One picture in hard light, with its camera and its pose."""
    mesh = deformed(mesh, float(rng.choice(MESH_ERRORS)), rng)
    centre_m, radius_m = mesh.bounding_sphere
    focal = SIDE * np.exp(rng.uniform(*np.log(FIELD)))
    middle = 0.5 * (SIDE - 1)
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
    grey = photograph(
        sunlit.radiance, ambient.radiance, sunlit.coverage, cloudy_sky(SIDE, rng), rng
    )
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), camera, pose


def look(model: ViewModel, mesh: Mesh, seed: int, k: int) -> list[dict[str, Any]]:
    """All poses of a frame that were looked at closely, without and with a prior."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng([55, seed, k])
    picture, camera, truth = frame(mesh, rng)
    recognizer = Recognizer(model, camera)
    search = recognizer.sketch
    if search is None:
        raise SystemExit("the model has no sketches: train it again")
    seen: list[Any] = []
    choose = vars(sketch_search)["chosen"]

    def listen(poses, symmetries, **kind):
        seen.append(poses)
        return choose(poses, symmetries, **kind)

    vars(sketch_search)["chosen"] = listen  # all poses that it chooses from
    turn, move = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    turned = Rotation.from_rotvec(np.deg2rad(rng.uniform(0.0, PRIOR_DEG)) * turn).as_matrix()
    centre = truth.apply(model.centre_m)
    start = turned @ truth.rotation
    place = centre + PRIOR_SHARE * np.linalg.norm(centre) * move - start @ model.centre_m
    rows = []
    for prior in (False, True):
        seen.clear()
        choice = (
            search.near(picture, Pose(start, place), np.deg2rad(SEARCH_DEG))
            if prior
            else search.anywhere(picture)
        )
        nees = None
        if choice is not None:
            best = choice.best.pose
            spin = Rotation.from_matrix(best.rotation @ truth.rotation.T).as_rotvec()
            error = np.concatenate([spin, best.translation_m - truth.translation_m])
            if np.rad2deg(np.linalg.norm(spin)) < NEES_DEG:
                nees = float(error @ np.linalg.solve(choice.covariance, error))
        poses = [
            {
                "rotation_deg": float(np.rad2deg(angle_between(p.pose, truth, model.symmetries))),
                "translation": float(
                    np.linalg.norm(p.pose.apply(model.centre_m) - centre) / np.linalg.norm(centre)
                ),
                "features": p.features.tolist(),
                "pose": p.pose,
            }
            for p in (seen[0] if seen else [])
        ]
        cut = choice is not None and choice.cut
        rows.append({"prior": prior, "cut": cut, "nees": nees, "poses": poses})
    vars(sketch_search)["chosen"] = choose
    return rows


def right(pose: dict[str, Any]) -> bool:
    return pose["rotation_deg"] < RIGHT_DEG and pose["translation"] < RIGHT_SHARE


def fitted_merit(looks: list[dict[str, Any]]) -> np.ndarray:
    """(7,) weights that put right poses of a frame before wrong ones (conditional logit)."""
    groups = []
    for row in looks:
        clear = [p for p in row["poses"] if right(p) or p["rotation_deg"] > WRONG_DEG]
        good = np.array([right(p) for p in clear], dtype=bool)
        if good.any() and not good.all():
            groups.append((np.array([p["features"] for p in clear]), good))

    def unlikely(weights: np.ndarray) -> tuple[float, np.ndarray]:
        loss, slope = RIDGE * weights @ weights, 2.0 * RIDGE * weights
        for features, good in groups:
            odds = np.exp(features @ weights - np.max(features @ weights))
            among, of_right = odds / odds.sum(), odds * good / (odds * good).sum()
            loss -= np.log((odds * good).sum() / odds.sum())
            slope = slope + features.T @ (among - of_right)
        return float(loss), slope

    return minimize(unlikely, np.zeros(len(POSE_FEATURES)), jac=True, method="L-BFGS-B").x


def choices(looks: list[dict[str, Any]], merit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 11) ``CHOICE_FEATURES`` of the best pose of each look; and its row of the poses."""
    features, best = [], []
    for row in looks:
        if not row["poses"]:
            continue
        merits = [float(np.dot(p["features"], merit)) for p in row["poses"]]
        k = int(np.argmax(merits))
        chosen = row["poses"][k]
        rivals = [
            m
            for p, m in zip(row["poses"], merits, strict=True)
            if np.rad2deg(p["pose"].angle_to(chosen["pose"])) > WRONG_DEG
        ]
        margin = min(merits[k] - max(rivals), DISTINCT_MARGIN) if rivals else DISTINCT_MARGIN
        features.append([1.0, margin, float(row["cut"]), float(row["prior"]), *chosen["features"]])
        best.append(chosen)
    return np.array(features), np.array(best, dtype=object)


def run(
    models: list[Path],
    *,
    meshes: str = "hubble.stl,client.stl",
    frames: int = 420,
    seed: int = 1,
    write: bool = False,
) -> None:
    """Fit to MODELS, whose MESHES (in metres) are named in the same order, and say how well."""
    looks: list[dict[str, Any]] = []
    for path, name in zip(models, meshes.split(","), strict=True):
        model, mesh = ViewModel.load(path), load_mesh(Path(name), "m")
        drawn = Parallel(n_jobs=-1)(delayed(look)(model, mesh, seed, k) for k in range(frames))
        looks += [row for rows in drawn for row in rows]
    merit = fitted_merit(looks)
    features, best = choices(looks, merit)
    good = np.array([right(p) for p in best])
    weight = np.where(good, 1.0, WEIGHT_OF_WRONG)
    fit = LogisticRegression(C=3.0, max_iter=5000, fit_intercept=False)
    odds = fit.fit(features, good, sample_weight=weight).coef_[0]
    given = 1.0 / (1.0 + np.exp(-features @ odds)) > 0.6
    wrong = np.array([p["rotation_deg"] > WRONG_DEG for p in best])
    for prior in (False, True):
        some = features[:, CHOICE_FEATURES.index("prior")] == float(prior)
        print(
            f"{'prior' if prior else 'no prior'}: {some.sum()} looks, best pose right "
            f"{good[some].mean():.3f}; given and right {(given & good)[some].mean():.3f}, "
            f"given and wrong {(given & wrong)[some].mean():.4f}"
        )
    nees = np.array([row["nees"] for row in looks if row["nees"] is not None])
    kept = json.loads(PACKAGED.read_text(encoding="utf-8"))
    print(f"NEES: median {np.median(nees):.1f}, mean {nees.mean():.1f}, {len(nees)} poses")
    record = {
        "merit": dict(zip(POSE_FEATURES, merit.tolist(), strict=True)),
        "log_odds": dict(zip(CHOICE_FEATURES, odds.tolist(), strict=True)),
        "inflation": kept["inflation"] * float(nees.mean()) / UNKNOWNS,
        "provenance": {
            "experiment": "sketch-confidence",
            "targets": [p.stem for p in models],
            "frames": frames * len(models),
            "seed": seed,
        },
    }
    text = json.dumps(record, indent=1) + "\n"
    print(text)
    if write:
        PACKAGED.write_text(text, encoding="utf-8")
