"""The webcam tutorial with a simulated camera: board pictures, a video of the card, its poses."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np

from experiments.frame import show, table_of
from rendezview.geometry.pose import Pose

WIDTH, HEIGHT, FINE = 640, 480, 4
MATRIX = np.array([[610.0, 0.0, 322.0], [0.0, 610.0, 236.0], [0.0, 0.0, 1.0]])
LENS = np.array([-0.12, 0.05, 0.0, 0.0, 0.0])
SQUARE = 0.025  # m
DOTS = ((-0.065, 0.0, 0.016), (0.0, 0.035, 0.016), (0.065, 0.0, 0.024))  # x, z, width, m
RATE_HZ = 10.0


def rays() -> np.ndarray:
    """(H, W, 2) directions of the fine pixels, by OpenCV."""
    u, v = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (WIDTH, HEIGHT))
    grid = np.stack(np.meshgrid(u, v), -1).reshape(-1, 1, 2)
    return cv2.undistortPoints(grid, MATRIX, LENS).reshape(HEIGHT * FINE, WIDTH * FINE, 2)


def on_plane(
    ahead: np.ndarray, turn: np.ndarray, place: np.ndarray,
    grey: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Grey levels ``grey(x, y)`` of a plane z = 0 at a pose; NaN off it."""
    normal = turn[:, 2]
    far = (normal @ place) / (ahead @ normal[:2] + normal[2])
    points = np.concatenate([ahead * far[..., None], far[..., None]], -1) - place
    return grey(points @ turn[:, 0], points @ turn[:, 1])


def exposed(fine: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Blur of 0.6 px, noise of 1.5 grey, 8 bits."""
    soft = cv2.GaussianBlur(fine, (0, 0), 0.6 * FINE)
    soft = soft.reshape(HEIGHT, FINE, WIDTH, FINE).mean((1, 3))
    noisy = soft + 1.5 * rng.standard_normal(soft.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def chessboard(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    column, row = np.floor(x / SQUARE), np.floor(y / SQUARE)
    black = (column >= -1) & (column < 9) & (row >= -1) & (row < 6) & ((column + row) % 2 == 0)
    paper = (x > -0.05) & (x < 0.25) & (y > -0.05) & (y < 0.175)
    return np.where(black, 30.0, np.where(paper, 220.0, 90.0))


def boards(folder: Path, ahead: np.ndarray, rng: np.random.Generator, count: int) -> None:
    """JPEG pictures of a chessboard, whole in each."""
    folder.mkdir(parents=True)
    corners = np.array([[x, y, 0.0] for x in (-SQUARE, 0.225) for y in (-SQUARE, 0.15)])
    while count:
        turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3) * (1.0, 1.0, 0.5))[0]
        pixel, far = rng.uniform((150, 120, 1), (490, 360, 1)), rng.uniform(0.35, 0.7)
        place = np.linalg.solve(MATRIX, pixel) * far - turn @ (0.1, 0.0625, 0.0)
        seen = cv2.projectPoints(corners @ turn.T + place, np.zeros(3), np.zeros(3), MATRIX, LENS)
        if (seen[0] > 8).all() and (seen[0] < (WIDTH - 8, HEIGHT - 8)).all():
            count -= 1
            picture = exposed(on_plane(ahead, turn, place, chessboard), rng)
            cv2.imwrite(str(folder / f"{count:02d}.jpg"), picture)


def card(pose: Pose, ahead: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The folded card before a wall that is brighter below: two ends, then the raised middle."""
    fine = np.repeat(np.linspace(85.0, 135.0, HEIGHT * FINE)[:, None], WIDTH * FINE, axis=1)
    for height, half, white in ((0.0, 0.1, 215.0), (0.035, 0.03, 225.0)):

        def paper(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            grey = np.where((np.abs(x) < half) & (np.abs(y) < 0.045), white, np.nan)  # noqa: B023
            for at, z, wide in DOTS:
                if z == height:  # noqa: B023
                    grey = np.where((x - at) ** 2 + y * y < 0.25 * wide * wide, 25.0, grey)
            return grey

        place = pose.apply(np.array([0.0, 0.0, height]))
        seen = on_plane(ahead, pose.rotation, place, paper)
        fine = np.where(np.isfinite(seen), seen, fine)
    return exposed(fine, rng)


def path(t: float) -> Pose:
    """A hand that turns the card and brings it nearer, from 0.75 m."""
    turn = cv2.Rodrigues(np.array([0.0, 0.0, 0.3 * math.sin(0.4 * t)]))[0]
    lean = np.array([0.35 * math.sin(0.7 * t), 0.3 * math.cos(0.5 * t), 0.0])
    turn = turn @ cv2.Rodrigues(lean)[0] @ np.diag([1.0, -1.0, -1.0])
    place = [0.04 * math.sin(0.5 * t), 0.02 * math.cos(0.4 * t), 0.75 - 0.05 * t]
    return Pose(turn, np.array(place))


def rendezview(*words: object) -> None:
    command = [sys.executable, "-c", "from rendezview.cli.main import main; main()"]
    print("rendezview", *words)
    subprocess.run([*command, *map(str, words)], check=True)


def run(
    folder: Annotated[Path, "new, for all files"], *, readings: int = 40, seed: int = 3,
) -> None:  # fmt: skip
    """The webcam tutorial with a simulated camera: card, board pictures, a video, its poses.

    640 × 480, 610 px a radian, pin-cushion of 12 %. Drawn with numpy and OpenCV alone: 14 board
    pictures (JPEG), the folded card before a wall as an MPEG-4 video and as JPEG pictures.
    """
    rng, ahead = np.random.default_rng(seed), rays()
    boards(folder / "boards", ahead, rng, 14)
    (folder / "pictures").mkdir()
    code = cv2.VideoWriter_fourcc(*"mp4v")  # type: ignore[attr-defined]
    video = cv2.VideoWriter(str(folder / "card.mp4"), code, RATE_HZ, (WIDTH, HEIGHT), False)
    for k in range(readings):
        picture = card(path(k / RATE_HZ), ahead, rng)
        video.write(picture)
        cv2.imwrite(str(folder / "pictures" / f"{k:03d}.jpg"), picture)
    video.release()
    rendezview("calibrate", "card", "-o", folder / "card")
    camera = ("--camera", folder / "webcam.yaml")
    pitch = ("--board", "9x6", "--pitch-mm", f"{1e3 * SQUARE:g}")
    rendezview("calibrate", "camera", folder / "boards", *pitch, "-o", camera[1])
    title = f"{readings} pictures, seed {seed}; errors: median, worst"
    table = table_of(title, "pictures | poses | turn, ° | place, mm", left=1)
    for name, more in (("card.mp4", ()), ("pictures", ("--rate", f"{RATE_HZ:g}"))):
        log = folder / f"{name}.jsonl"
        target = folder / "card" / "target.toml"
        rendezview("reflectors", target, folder / name, *camera, "--invert", *more, "-o", log)
        lines = [json.loads(line) for line in log.read_text().splitlines()]
        errors = []
        for k, line in enumerate(lines):
            if line["pose"] is not None:
                truth = path(k / RATE_HZ)
                found = Pose.from_quat_wxyz(**line["pose"])
                off = np.linalg.norm(found.translation_m - truth.translation_m)
                errors.append((math.degrees(found.angle_to(truth)), 1e3 * off))
        cells = [
            f"{np.median(own):.2f}, {max(own):.2f}" for own in np.array(errors).reshape(-1, 2).T
        ]
        table.add_row(name, f"{len(errors)} of {readings}", *cells)
    show(table)
