"""One search in several threads: the same bits as one call after the other."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from tests.sensors.threads import assert_shared

from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.edges.refinement import Refiner
from rendezview.sensors.appearance.sky import Sky
from rendezview_ground.simulate import SceneOptions, ShadingOptions, render_frame, sun_at_phase


def test_one_refiner_serves_several_threads_with_the_same_bits(refining_model, bumpy_mesh, camera):
    refiner = Refiner(refining_model, camera)
    tasks = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rotation = Rotation.random(random_state=rng).as_matrix()
        pose = Pose(rotation, np.array([0.1, -0.2, 9.0]))
        sun = sun_at_phase(pose.translation_m, 0.3, 1.0)
        options = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=1))
        image = render_frame(bumpy_mesh, camera, pose, sun, options, rng)
        turn = Rotation.from_rotvec([0.02, 0.03, -0.02]).as_matrix()
        tasks.append((image, Sky.of(image), Pose(turn @ rotation, pose.translation_m)))

    def refined(task: tuple) -> bytes:
        found = refiner.refine(*task)
        assert found is not None
        return found.pose.rotation.tobytes() + found.covariance.tobytes()

    assert_shared(refined, tasks, times=6)
