"""Acquisition among glints and foil: rate of finds, false finds and false locks."""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import Annotated

import numpy as np
from rendezview.sensors.reflectors import Acquirer, LitDark, find_spots, patterns_of, predict_spots
from rendezview.simulation.reflector_frames import (
    Clutter,
    ReflectorFrameOptions,
    foil,
    glints,
    render_pair,
    sky,
)
from scipy.spatial.transform import Rotation

from experiments.reflectors.accuracy import random_pose
from experiments.reflectors.run import CAMERA, CLIENT
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.observation import Status


def clear_of(places: np.ndarray, clutter: tuple[Clutter, ...], radius_px: float) -> bool:
    """Whether no light but its own is in any reflector's spot; see the module's text."""
    for item in clutter:
        for x, y, along, _, _, lit, dark, _, _ in item.spots:
            light = max(lit, dark) if max(lit, dark) > 235.0 else max(abs(lit - dark), 0.15 * lit)
            for place in places:
                off = max(math.hypot(x - place[0], y - place[1]) - radius_px - 1.5, 0.0)
                if light * math.exp(-0.5 * (off / along) ** 2) > 7.0:
                    return False
    return True


def agrees_again(rng, acquirer, pattern, pose, options, hidden, clutter, first) -> bool:
    """Whether a second reading finds the same false target."""
    step = Pose(Rotation.from_rotvec(rng.normal(0.0, 0.01, 3)).as_matrix(), np.zeros(3))
    moved = step @ Pose(pose.rotation, 0.99 * pose.translation_m)
    shift = predict_spots(CAMERA, pattern, moved).mean(axis=0) - predict_spots(
        CAMERA, pattern, pose
    ).mean(axis=0)
    sheet, false, *rest = clutter
    foils, spots = sheet.spots.copy(), false.spots.copy()
    foils[:, :2] += shift
    foils[:, 5:7] *= np.clip(1.0 + rng.normal(0.0, 0.3, (len(foils), 1)), 0.0, None)
    spots[:, :2] += shift
    new = rng.random(len(spots)) < 0.5
    spots[new, :2] = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (int(new.sum()), 2))
    lit, dark = render_pair(
        CAMERA, pattern, moved, options, rng, hidden=hidden,
        clutter=(Clutter(foils), Clutter(spots), *rest),
    )  # fmt: skip
    again = acquirer.acquire(find_spots(LitDark(lit, dark)))
    if again.refined is None:
        return False
    a = first.refined.camera_from_target.apply(pattern.centre_m)
    b = again.refined.camera_from_target.apply(pattern.centre_m)
    return bool(np.linalg.norm(a - b) < 0.1 * np.linalg.norm(a))


def run(
    *, frames: int = 2500, seed: int = 39,
    tell: Annotated[bool, "print missed and false finds"] = False,
) -> None:  # fmt: skip
    """Acquisition among glints and foil: rate of finds, false finds and false locks.

    Every pair is searched on its own. In a tenth of the pairs one or more reflectors are hidden, or
    there is no target: nothing may be found there. All have a crumpled sheet of sunlit foil (12 to
    40 facets, some saturated, moving and flickering between the pictures), half of them the Earth
    or stars, and up to six false spots that only the lit picture has, as large and bright as
    reflectors. A reflector is visible if neither foil nor a false spot adds more than 4 % of its
    own light within its spot.

    A false find is read again, as the sensor does before it locks: half a second later, the target
    1 % nearer and turned by a degree, the foil's facets as bright in their places or 30 % off, a
    false spot in its place with probability ½ and elsewhere otherwise. A find that agrees with the
    first is a lock. A find is false if its pose is off by more than 3 % of range, or a spot is
    assigned to the wrong reflector; half a turn of roll is no error: three reflectors look alike.
    """
    rng = np.random.default_rng(seed)
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    acquirer = Acquirer(CAMERA, [pattern])
    options = ReflectorFrameOptions()
    counts: Counter[str] = Counter()
    spots_seen, spent = [], []
    skies = [
        sky(CAMERA, rng, earth_grey=150.0) if k % 2 else sky(CAMERA, rng, star_grey=120.0)
        for k in range(8)
    ]
    for n in range(frames):
        range_m = math.exp(rng.uniform(math.log(1.0), math.log(12.0)))
        pose, _ = random_pose(rng, pattern, range_m)
        clutter: tuple[Clutter, ...] = (
            foil(CAMERA, rng, int(rng.integers(12, 41))),
            glints(CAMERA, rng, int(rng.integers(0, 7))),
        )
        if n % 2:
            clutter = (*clutter, Clutter(background=skies[int(rng.integers(8))]))
        hidden: tuple[int, ...] = ()
        if rng.random() < 0.1:
            hidden = ((0,), (1,), (2,), (0, 2), (0, 1, 2))[int(rng.integers(5))]
        lit, dark = render_pair(CAMERA, pattern, pose, options, rng, hidden=hidden, clutter=clutter)
        places = predict_spots(CAMERA, pattern, pose)
        radius = 0.5 * 0.025 * CAMERA.fx / range_m
        visible = not hidden and clear_of(places, clutter, radius)
        start = time.perf_counter()
        spots = find_spots(LitDark(lit, dark))
        found = acquirer.acquire(spots)
        spent.append(1e3 * (time.perf_counter() - start))
        spots_seen.append(len(spots))
        kind = "hidden" if hidden else "visible" if visible else "touched by clutter"
        if found.status is not Status.OK:
            counts[f"{kind}: {found.status}"] += 1
            if visible and tell:
                print(n, f"{range_m:.2f} m", found.status, found.reason)
            continue
        off = np.linalg.norm(
            found.refined.camera_from_target.apply(pattern.centre_m) - pose.apply(pattern.centre_m)
        )
        wanted = places[found.reflectors]
        seen = spots.centroids_px[found.spot_indices]
        turned = places[::-1][found.reflectors]  # left and right exchanged
        apart = min(np.abs(seen - wanted).max(), np.abs(seen - turned).max())
        true = not hidden and off < 0.03 * range_m and apart < 2.0 + 0.3 * radius
        if true:
            counts[f"{kind}: found"] += 1
        else:
            locked = agrees_again(rng, acquirer, pattern, pose, options, hidden, clutter, found)
            counts[f"{kind}: {'FALSE LOCK' if locked else 'false first find'}"] += 1
        if not true and tell:
            print(n, f"{range_m:.2f} m", kind, "FALSE", off, apart, found.score)
    print(f"{frames} pairs, seed {seed}, median {np.median(spots_seen):.0f} "
          f"spots (most {max(spots_seen)}), median {np.median(spent):.2f} ms a pair")  # fmt: skip
    for name, count in sorted(counts.items()):
        print(f"{count:6d}  {name}")
    seen_whole = sum(c for name, c in counts.items() if name.startswith("visible"))
    print(f"found when visible: {counts['visible: found'] / max(seen_whole, 1):.5f}")
    print(f"false first finds: {sum(c for name, c in counts.items() if 'false' in name)}")
    print(f"false locks: {sum(c for name, c in counts.items() if 'FALSE' in name)}")
