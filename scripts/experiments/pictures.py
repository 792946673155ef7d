"""The pictures of the README and the docs."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Literal

import cv2
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import rendezview as rv
from experiments.frame import CLIENT, PICTURES, mesh_of
from experiments.fusion.trials import fly, load_run
from experiments.pose.sketch_confidence import frame
from rendezview.sensors.appearance.overlay import draw_observation
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.fly.campaign import fly_once
from rendezview_ground.fly.options import FlyPlan
from rendezview_ground.fly.pictures import corridor_picture
from rendezview_ground.fly.setup import Setup
from rendezview_ground.simulate import SceneOptions, SensorOptions, render_frame, sun_at_phase
from rendezview_ground.simulate.mesh_error import deformed

matplotlib.use("Agg")

FRAMES = 4
CROP = (slice(50, 410), slice(110, 530))  # the target, without the report's status bar


def readme(demo: Path) -> None:
    """Four frames of a finished demo, side by side: a folder that ``rendezview demo -o`` wrote."""
    paths = sorted(demo.glob("frame_*.png"))
    chosen = [paths[k] for k in np.linspace(0, len(paths) - 1, FRAMES).round().astype(int)]
    strip = np.hstack([cv2.imread(str(path))[CROP] for path in chosen])
    cv2.imwrite(str(PICTURES / "approach.png"), strip)


PHOTOGRAPHS = {
    "plain": {},
    "--overexposure 6": {"overexposure": 6.0},
    "--overexposure 6 --bloom 0.3": {"overexposure": 6.0, "bloom": 0.3},
    "--sky-level 40": {"sky_level_grey": 40.0},
    "--dust 100": {"dust": 100},
    "--mesh-error 0.05": {"mesh_error": 0.05},
}


def simulation() -> None:
    """One frame with each option that photographs need."""
    _, mesh = mesh_of("hubble")
    centre_m, radius_m = mesh.bounding_sphere
    camera = rv.Camera.from_fov(240, 180, math.radians(50.0))
    rotation = rv.Pose.from_quat_wxyz([0.62, 0.45, -0.35, 0.54], [0, 0, 0]).rotation
    pose = rv.Pose(rotation, np.array([0.0, 0.0, 3.0 * radius_m]) - rotation @ centre_m)
    sun = sun_at_phase(pose.apply(centre_m), math.radians(55.0), math.radians(200.0))
    tiles = []
    for caption, options in PHOTOGRAPHS.items():
        changed = dict(options)
        bent = deformed(mesh, changed.pop("mesh_error", 0.0), np.random.default_rng(4))
        light = {k: changed.pop(k) for k in ("overexposure", "bloom") if k in changed}
        scene = SceneOptions(sensor=SensorOptions(noise_sigma_grey=1.0, **light), **changed)
        tile = render_frame(bent, camera, pose, sun, scene, np.random.default_rng(4))
        cv2.putText(tile, caption, (6, 172), cv2.FONT_HERSHEY_SIMPLEX, 0.4, 255, 1, cv2.LINE_AA)
        tiles.append(tile)
    sheet = np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])
    cv2.imwrite(str(PICTURES / "simulation.png"), sheet)


EDGES_M = np.geomspace(0.99, 60.1, 25)
COLOURS = {"appearance": "#d9731a", "ring": "#2b7bba", "laser": "#4a9a4a", "fused": "#222222"}


def curve(range_m: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each bin and median error, where at least ten frames are."""
    inside = [((range_m >= a) & (range_m < b) & np.isfinite(error)) for a, b in pairwise(EDGES_M)]
    full = [k for k, some in enumerate(inside) if some.sum() >= 10]
    middles = np.sqrt(EDGES_M[:-1] * EDGES_M[1:])[full]
    return middles, np.array([np.median(error[inside[k]]) for k in full])


def fusion(runs: Path, model: Path) -> None:
    """Errors of sensors and filter over the range, of the runs of fusion-approach."""
    views = rv.ViewModel.load(model)
    rows = [
        sample for run in sorted(runs.iterdir()) for sample in fly(load_run(run, views)).samples
    ]
    range_m = np.array([row.range_m for row in rows])
    found = [row.single | {"fused": row.fused} for row in rows]
    figure, axes = plt.subplots(1, 2, figsize=(10.0, 3.8), constrained_layout=True)
    panels = ((0, 1e3, "ring's centre, mm"), (2, 180.0 / np.pi, "ring's axis, °"))
    for panel, (k, scale, label) in zip(axes, panels, strict=True):
        for name, colour in COLOURS.items():
            index = 1 if name == "laser" and k == 0 else k  # a ranger knows the depth only
            error = np.array([one.get(name, [np.nan] * 4)[index] for one in found])
            width = 2.2 if name == "fused" else 1.4
            panel.plot(*curve(range_m, scale * error), color=colour, lw=width, label=name)
        panel.set(xscale="log", yscale="log", xlabel="camera to ring, m", ylabel=label)
        panel.invert_xaxis()
        panel.grid(True, which="major", alpha=0.3)
    axes[0].legend(frameon=False)
    figure.savefig(PICTURES / "fusion.png", dpi=110)


# Of cover, edges and creases: blue, green, red.
MAPS_BGR = np.array([(60.0, 60.0, 60.0), (90.0, 190.0, 255.0), (200.0, 130.0, 50.0)])


def sketch(model: Path) -> None:
    """Frames in hard light, their sketches, the poses; MODEL of hubble. Prints the errors."""
    (_, mesh), views, rows = mesh_of("hubble"), rv.ViewModel.load(model), []
    for k in (9, 13, 24):
        image, camera, truth = frame(mesh, np.random.default_rng([902, k]))
        recognizer = rv.Recognizer(views, camera)
        assert recognizer.sketch is not None
        found, drawn = recognizer.recognize(image), recognizer.sketch.sketcher.find(image)
        assert found.pose is not None
        assert drawn is not None
        whole = np.array([[1.0, 0.0, -drawn.left_px], [0.0, 1.0, -drawn.top_px]]) / drawn.scale
        maps = cv2.warpAffine(np.moveaxis(drawn.maps, 0, 2), whole, image.shape) @ MAPS_BGR
        shown = draw_observation(image, found, camera, views)[: 2 * len(image)]
        tiles = cv2.merge([image] * 3), maps.clip(0, 255), cv2.resize(shown, image.shape)
        rows.append(np.hstack(tiles).astype(np.uint8))
        print(f"frame {k}: {math.degrees(found.pose.angle_to(truth)):.1f}°")
    cv2.imwrite(str(PICTURES / "sketch.png"), np.vstack(rows))


def flight() -> None:
    """`rendezview fly client`, seed 0: the corridor in three views."""
    target = rv.Target.load(CLIENT)
    setup = Setup.of(target, rv.load_mesh(target.mesh_path, target.unit), FlyPlan())
    path = PICTURES / "flight.png"
    path.write_bytes(png(corridor_picture(fly_once(setup, 0), setup)))
    few = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    small = Image.fromarray(few).quantize(32)  # colours
    small.save(path, optimize=True)


DRAWN: dict[str, Callable[..., None]] = {
    one.__name__: one for one in (readme, simulation, fusion, sketch, flight)
}


def run(
    name: Literal["readme", "simulation", "fusion", "sketch", "flight"],
    sources: list[Path] | None = None,
) -> None:
    """Draw one picture of the README or the docs again, into docs/pictures.

    readme needs the folder that rendezview demo wrote; fusion, the runs of fusion-approach and
    their model; sketch, a model of hubble. Pictures of readings are overlays of the commands.
    """
    sources = sources or []
    if len(sources) != (needed := len(inspect.signature(DRAWN[name]).parameters)):
        raise SystemExit(f"picture {name} needs {needed} SOURCES, see --help")
    DRAWN[name](*sources)
    print(PICTURES, name)
