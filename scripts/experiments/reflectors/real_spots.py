"""Centroids of spots in a real picture of stars, beside an independent catalogue."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from experiments.frame import show, table_of
from rendezview.sensors.reflectors import Centroid, LitDark, ThresholdOptions, find_spots

BLOCK, CARD = 2880, 80  # bytes, of a FITS header
SKY_GREY = 20.0


def read_fits(path: Path) -> np.ndarray:
    """The first image of a FITS file (16-bit integers or floats), float."""
    content = path.read_bytes()
    cards: dict[str, str] = {}
    for start in range(0, len(content), CARD):
        card = content[start : start + CARD].decode("ascii")
        if card.rstrip() == "END":
            break
        if card[8] == "=":
            cards[card[:8].strip()] = card[10:].split("/")[0].strip()
    first = -(-(start + CARD) // BLOCK) * BLOCK
    kind = {"16": ">i2", "32": ">i4", "-32": ">f4", "-64": ">f8"}[cards["BITPIX"]]
    shape = int(cards["NAXIS2"]), int(cards["NAXIS1"])
    pixels = np.frombuffer(content, kind, shape[0] * shape[1], first).reshape(shape)
    return float(cards.get("BZERO", "0")) + float(cards.get("BSCALE", "1")) * pixels.astype(float)


def read_catalogue(path: Path) -> np.ndarray:
    """(N, 4) XWIN and YWIN, from 0 at the middle of the first pixel, FLAGS and FLUX_RADIUS."""
    lines = path.read_text().splitlines()
    columns = {line.split()[2]: int(line.split()[1]) - 1 for line in lines if line[:1] == "#"}
    rows = np.array([[float(w) for w in line.split()] for line in lines if line[:1] != "#"])
    places = rows[:, [columns["XWIN_IMAGE"], columns["YWIN_IMAGE"]]] - 1.0
    return np.column_stack([places, rows[:, columns["FLAGS"]], rows[:, columns["FLUX_RADIUS"]]])


def windowed(grey: np.ndarray, x: float, y: float, sigma: float) -> tuple[float, float]:
    """SExtractor's windowed centroid: a Gaussian window of fixed width, moved until centred."""
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    for _ in range(16):
        weight = np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / sigma**2)
        weight[np.hypot(columns - x, rows - y) > 4.0 * sigma] = 0.0
        light = weight * grey
        if not light.sum() > 0.0:
            break
        step = 2.0 * np.array([(light * (columns - x)).sum(), (light * (rows - y)).sum()])
        step /= light.sum()
        x, y = x + step[0], y + step[1]
        if np.hypot(*step) < 2e-4:
            break
    return x, y


def run(
    picture: Path, catalogue: Path, *, scale: Annotated[float, "grey levels a count"] = 0.05,
    noise: Annotated[float, "grey levels added"] = 2.0, seed: int = 0,
) -> None:  # fmt: skip
    """Centroids of spots in a real picture of stars, beside an independent catalogue.

    PICTURE is a FITS image of stars and CATALOGUE SExtractor's list of it, with the columns
    XWIN_IMAGE and YWIN_IMAGE (its windowed centroids). Such a pair is data/image.fits and
    data/image.cat of the sources of sep (github.com/kbarbary/sep). The picture is brought to 8
    bits, as a sensor's: median subtracted, times --scale, so that its noise is a few grey levels;
    saturated spots are left out. Nothing of the method was chosen on it but the narrowest window.

    The second table adds noise (--noise, --seed) before the 8 bits, and measures the same stars in
    the same picture with this centroid, with SExtractor's algorithm (its window from FLUX_RADIUS)
    and with a Gaussian window of 1.2 px; truth is the catalogue, of the picture without the noise.
    """
    pixels = read_fits(picture)
    known = read_catalogue(catalogue)
    grey = SKY_GREY + scale * (pixels - np.median(pixels))
    lit = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    spread = 1.4826 * np.median(np.abs(grey - np.median(grey)))
    print(f"{lit.shape[1]} × {lit.shape[0]}, noise {spread:.2f} grey levels, {len(known)} listed")
    table = table_of(
        "distance from the catalogue's windowed centroid, px",
        "centroid | spots | peak over 100 | median | 90 % | worst",
        left=0,
    )
    for method in Centroid:
        spots = find_spots(LitDark(lit, None), ThresholdOptions(), method)
        for least in (0.0, 100.0):
            apart = []
            for k in range(len(spots)):
                if spots.saturated_px[k] or spots.peak_grey[k] - SKY_GREY < least:
                    continue
                off = np.hypot(*(known[:, :2] - spots.centroids_px[k]).T)
                near = int(np.argmin(off))
                # One spot of one whole star: not blended (2), saturated (4) or cut (8 and above).
                alone = np.sum(off < 2.0 * spots.size_px[k] + 2.0) == 1
                if off[near] < 2.0 and known[near, 2] < 2 and alone:
                    apart.append(off[near])
            table.add_row(
                method, str(len(apart)), "yes" if least else "no",
                *(f"{v:.3f}" for v in (np.median(apart), np.quantile(apart, 0.9), max(apart))),
            )  # fmt: skip
    show(table)
    noisy = grey + np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    degraded(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), known)


def degraded(lit: np.ndarray, known: np.ndarray) -> None:
    """How many stars above 5 σ are found, and the errors of three centroids of the same stars."""
    spots, sky = find_spots(LitDark(lit, None)), float(np.median(lit))
    spread = 1.4826 * float(np.median(np.abs(lit - sky)))
    bright = listed = 0
    errors: dict[str, list[float]] = {"this one": [], "SExtractor's": [], "window 1.2 px": []}
    claimed = []
    for x, y, flags, radius in known:
        column, row = round(x), round(y)
        patch = lit[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].astype(float)
        if patch.size < 9 or patch.max() - sky < 5.0 * spread:
            continue
        bright += 1
        off = np.hypot(*(spots.centroids_px - (x, y)).T)
        near = int(np.argmin(off))
        listed += off[near] < 2.0
        alone = np.sum(np.hypot(*(known[:, :2] - (x, y)).T) < 8.0) == 1
        if off[near] > 2.0 or flags >= 2 or not alone or patch.max() > 250.0:
            continue
        errors["this one"].append(off[near])
        claimed.append(off[near] / spots.sigma_px[near] / np.sqrt(2.0))
        for name, sigma in (("SExtractor's", 2.0 * radius / 2.355), ("window 1.2 px", 1.2)):
            at = spots.centroids_px[near]
            found = windowed(lit - sky, float(at[0]), float(at[1]), sigma)
            errors[name].append(float(np.hypot(found[0] - x, found[1] - y)))
    table = table_of(
        f"{bright} stars above 5 σ, {listed} found ({100.0 * listed / max(bright, 1):.0f} %)",
        "centroid | stars | median px | r.m.s. px", left=1,
    )  # fmt: skip
    for name, values in errors.items():
        rms = float(np.sqrt(np.mean(np.square(values))))
        table.add_row(name, str(len(values)), f"{np.median(values):.3f}", f"{rms:.3f}")
    show(table)
    print(f"error over claimed σ, r.m.s.: {np.sqrt(np.mean(np.square(claimed))):.2f}")
