"""Our SPEED and SPEED+ scores beside the published code of the data set's authors."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
from rendezview.evaluation import pose_errors, speed_terms
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose

ERRORS = (1e-3, 3e-3, 1e-2, 0.3, 2.0)  # rad and m


def run(metrics: Path, *, pairs: int = 2000, seed: int = 3) -> int:
    """Our SPEED and SPEED+ scores beside the published code of the data set's authors.

    METRICS is core/utils/metrics.py of a checkout of SPNv2, with its speed_score. Random truths and
    estimates, from far below the thresholds to far above, go through both. Printed: the largest
    difference. Exit 1 where it is over 1e-7, the accuracy of an arc cosine near 0.
    """
    spec = importlib.util.spec_from_file_location("spnv2_metrics", metrics)
    if spec is None or spec.loader is None:
        sys.exit(f"{metrics}: no Python file")
    theirs = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(theirs)
    rng = np.random.default_rng(seed)
    apart = {False: 0.0, True: 0.0}
    forgiven = 0
    for _ in range(pairs):
        turn = Rotation.random(random_state=rng).as_matrix()
        truth = Pose(turn, [*rng.uniform(-1.0, 1.0, 2), rng.uniform(3.0, 10.0)])
        estimate = truth.perturbed(rng.choice(ERRORS) * rng.normal(size=6))
        errors = pose_errors(truth, estimate)
        for plus in apart:
            _, _, score = theirs.speed_score(
                estimate.translation_m, estimate.quat_wxyz, truth.translation_m, truth.quat_wxyz,
                applyThreshold=plus, theta_q=0.169, theta_t=2.173e-3,
            )  # fmt: skip
            terms = speed_terms(errors.rotation_rad, errors.translation_fraction, speed_plus=plus)
            forgiven += plus and 0.0 in terms
            apart[plus] = max(apart[plus], abs(sum(terms) - score))
    print(
        f"{pairs} pairs, seed {seed}: SPEED differs by at most {apart[False]:.1e}, "
        f"SPEED+ by {apart[True]:.1e} ({forgiven} pairs with a term forgiven)"
    )
    return 0 if max(apart.values()) < 1e-7 else 1
