"""The fit of the light beside plain numpy: the same samples, Sun and brightness."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.geodesic import Geodesic
from rendezview.sensors.appearance.edges.lighting import fit_light, sample_surfaces, search_sun
from rendezview.sensors.appearance.edges.predicted import COLUMNS, NX, NY, U, V
from rendezview.sensors.appearance.model.contours import (
    OUTLINE,
    STEP,
    SURFACES,
    packed_start,
    start_radii,
)
from rendezview.sensors.appearance.model.view_tables import read_only

RADIUS_PX = 200.0
REACH = 12.0 / 196.0  # of the radius
KINDS = 12
DARK = np.array([2.0, 9.0, 1.0, 0.0, 0.0, 0.0])  # noise, sky, dark sky, no direction to the Sun
Samples = tuple[np.ndarray, np.ndarray]


def test_places_are_kept_as_signed_square_roots():
    kept = np.arange(-127, 128)
    places = np.array([start_radii(k) for k in kept])
    assert places == pytest.approx(np.sign(kept) * (kept / 127.0) ** 2 * REACH, rel=1e-12)
    assert packed_start(places) == pytest.approx(kept, abs=1e-9)


class Scene:
    """A frame of noise, contour points all over it, and random surfaces beside them."""

    def __init__(self, rng: np.random.Generator, count: int = 90) -> None:
        self.image = rng.integers(0, 255, (300, 400)).astype(np.uint8)
        self.count = count
        self.edges = np.zeros((count + 3, COLUMNS))
        angle = rng.uniform(0.0, 2.0 * np.pi, count)
        self.edges[:count, U] = rng.uniform(-10.0, 410.0, count)
        self.edges[:count, V] = rng.uniform(-10.0, 310.0, count)
        self.edges[:count, NX], self.edges[:count, NY] = np.cos(angle), np.sin(angle)
        self.edges[:count:9, [NX, NY]] = 0.0  # not projected
        kind = np.where(rng.random(count) < 0.5, OUTLINE, STEP).astype(np.uint8)
        strip = rng.integers(0, KINDS, (count, SURFACES)).astype(np.uint8)
        start = np.sort(rng.integers(-60, 128, (count, SURFACES - 1, 2)), axis=1)
        palette = rng.normal(size=(KINDS, 4)).astype(np.float32)
        palette[:, :3] /= np.linalg.norm(palette[:, :3], axis=1, keepdims=True)
        palette[:, 3] = rng.uniform(0.2, 0.9, KINDS)
        model = kind, strip, start.astype(np.int8), palette
        self.kind, self.strip, self.start, self.palette = map(read_only, model)
        self.rotation = np.ascontiguousarray(Rotation.random(random_state=rng).as_matrix())
        self.centre = np.array([0.3, -0.4, 9.0])

    @property
    def away(self) -> np.ndarray:
        return self.centre / np.linalg.norm(self.centre)

    @property
    def normals(self) -> np.ndarray:
        turned = self.palette[:, :3].astype(float) @ self.rotation.T
        return turned * np.where(turned @ self.away > 0.0, -1.0, 1.0)[:, None]

    def samples(self, black: float) -> Samples:
        """Grey levels at three places of each surface, and its kind."""
        levels, which = [], []
        for j in range(self.count):
            u, v, *normal = self.edges[j, [U, V, NX, NY]]
            if not any(normal):
                continue
            kept = self.start[j, :, 0] / 127.0
            first = 0.0 if self.kind[j] == OUTLINE else -REACH
            limits = RADIUS_PX * np.minimum([first, *(np.abs(kept) * kept * REACH), REACH], REACH)
            for k, (near, far) in enumerate(pairwise(limits)):
                half = 0.5 * (far - near) - 0.5
                if self.strip[j, k] == 0 or half <= 0.0:
                    continue
                for inside in 0.5 * (near + far) + half * np.array([-1.0, 0.0, 1.0]):
                    place = np.array([u, v]) - inside * np.array(normal)
                    column, row = np.trunc(place + 0.5).astype(int)
                    if abs(inside) >= 1.8 and 0 <= column < 400 and 0 <= row < 300:
                        levels.append(float(self.image[row, column]) - black)
                        which.append(self.strip[j, k])
        return np.array(levels), np.array(which)

    def fitted(self, frame: np.ndarray, sun: np.ndarray) -> tuple[float, np.ndarray]:
        """What ``fit_light`` answers, and the brightness of every kind."""
        shade = np.full(KINDS, np.nan)
        explained = fit_light(
            self.image, self.edges, self.count, self.kind, self.strip, self.start, self.palette,
            self.rotation, self.centre, RADIUS_PX, frame, sun, shade,
        )  # fmt: skip
        return explained, shade


def test_three_samples_lie_on_each_surface_away_from_its_ends():
    scene = Scene(np.random.default_rng(1))
    most = scene.count * SURFACES * 3
    levels, which = np.empty(most), np.empty(most, dtype=np.int64)
    found = sample_surfaces(
        scene.image, scene.edges, scene.count, scene.kind, scene.strip, scene.start, RADIUS_PX,
        9.0, levels, which,
    )  # fmt: skip
    expected, kinds = scene.samples(9.0)
    assert found == len(expected) > 300
    assert levels[:found].tolist() == expected.tolist()
    assert which[:found].tolist() == kinds.tolist()


def misfit(
    samples: Samples, normals: np.ndarray, albedo: np.ndarray, sun: np.ndarray, tolerance: float
) -> tuple[float, np.ndarray]:
    """Cost of Geman and McClure and the two strengths, which are not negative."""
    levels, which = samples
    x = np.stack([albedo * np.maximum(normals @ sun, 0.0), albedo], axis=1)[which]
    weight = np.maximum(levels, 0.0)
    for _ in range(3):
        normal, right = x.T * weight @ x + 1e-9 * np.eye(2), x.T @ (weight * levels)
        normal[1, 1] *= 1.001
        strengths = np.linalg.solve(normal, right)
        if strengths[1] < 0.0:
            strengths = np.array([right[0] / normal[0, 0], 0.0])
        elif strengths[0] < 0.0:
            strengths = np.array([0.0, right[1] / normal[1, 1]])
        share = 1.0 / (1.0 + ((levels - x @ strengths) / tolerance) ** 2)
        weight = share**2
    return float(np.sum(1.0 - share)), strengths


def searched(
    samples: Samples, scene: Scene, albedo: np.ndarray, tolerance: float, sun: np.ndarray
) -> np.ndarray:
    """The best of 42 directions in front of the camera, then of six around it at 18, 9, 4.5°."""

    def cost(direction: np.ndarray, every: int = 1) -> float:
        some = samples[0][::every], samples[1][::every]
        return misfit(some, scene.normals, albedo, direction, tolerance)[0]

    if not sun.any():
        nodes = Geodesic.of_order(1).nodes
        sun = min(nodes[-nodes @ scene.away > -0.3], key=lambda node: cost(node, 3))
    for step in np.deg2rad([18.0, 9.0, 4.5]):
        axis = np.eye(3)[0 if abs(sun[0]) < 0.7 else 1]
        across = np.cross(sun, axis)
        across /= np.linalg.norm(across)
        around = np.deg2rad(60.0) * np.arange(6)[:, None]
        ring = np.cos(around) * across + np.sin(around) * np.cross(sun, across)
        sun = min([sun, *(np.cos(step) * sun + np.sin(step) * ring)], key=cost)
    return sun


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("given", [False, True])
def test_the_sun_is_the_best_of_a_coarse_sphere_and_three_rings(seed, given):
    rng = np.random.default_rng(seed)
    scene = Scene(rng)
    albedo = scene.palette[:, 3].astype(float)
    truth = -scene.away + rng.normal(0.0, 0.4, 3)
    truth /= np.linalg.norm(truth)
    which = rng.integers(1, KINDS, 250)
    levels = (albedo * (190.0 * np.maximum(scene.normals @ truth, 0.0) + 12.0))[which]
    levels += rng.normal(0.0, 3.0, 250)
    levels[:40] = 0.0  # cast shadows
    start = np.zeros(3)
    if given:
        start = truth + rng.normal(0.0, 0.2, 3)
        start /= np.linalg.norm(start)
    expected = searched((levels, which), scene, albedo, 12.0, start)
    sun = start.copy()
    search_sun(
        levels, which, scene.normals, scene.palette, scene.away, 12.0, False, np.empty(2), sun
    )
    assert sun == pytest.approx(expected, abs=1e-9)
    assert not np.allclose(sun, start)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("dark", [False, True])
def test_the_light_of_a_frame_shades_every_kind(known, dark):
    scene = Scene(np.random.default_rng(2))
    frame = DARK.copy()
    frame[2] = float(dark)
    if known:
        frame[3:] = Rotation.from_euler("x", 0.5).apply(-scene.away)
    levels, which = scene.samples(9.0 if dark else 0.0)
    every = 1 + len(levels) // 300
    samples = levels[::every], which[::every]
    tolerance = 0.1 * np.percentile(samples[0], 80) + 2.0
    albedo = scene.palette[:, 3].astype(float)
    light = frame[3:] if known else searched(samples, scene, albedo, tolerance, np.zeros(3))
    cost, (strength, around) = misfit(samples, scene.normals, albedo, light, tolerance)
    expected = albedo * (strength * np.maximum(scene.normals @ light, 0.0) + around)
    sun = np.zeros(3)
    explained, shade = scene.fitted(frame, sun)
    assert every > 1
    assert explained == pytest.approx(1.0 - cost / len(samples[0]), abs=1e-9)
    assert sun == pytest.approx(light, abs=1e-9)
    assert shade[1:] == pytest.approx(np.maximum(expected[1:], 0.0), rel=1e-9)
    assert shade[0] == 0.0


def test_few_samples_give_no_light():
    scene = Scene(np.random.default_rng(3), 5)
    assert len(scene.samples(9.0)[0]) < 40
    sun = np.zeros(3)
    explained, shade = scene.fitted(DARK, sun)
    assert explained == -1.0
    assert not shade.any()
    assert not sun.any()
