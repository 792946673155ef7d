"""Centroids of spots in a real picture of stars, beside an independent catalogue."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from experiments.frame import show, table_of
from rendezview.sensors.reflectors import LitDark, find_spots
from rendezview.sensors.reflectors.difference import ThresholdOptions
from rendezview.sensors.reflectors.spots import Centroid

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
    """(N, 3) XWIN and YWIN, from 0 at the middle of the first pixel, and FLAGS."""
    lines = path.read_text().splitlines()
    columns = {line.split()[2]: int(line.split()[1]) - 1 for line in lines if line[:1] == "#"}
    rows = np.array([[float(w) for w in line.split()] for line in lines if line[:1] != "#"])
    places = rows[:, [columns["XWIN_IMAGE"], columns["YWIN_IMAGE"]]] - 1.0
    return np.column_stack([places, rows[:, columns["FLAGS"]]])


def run(
    picture: Path, catalogue: Path, *, scale: Annotated[float, "grey levels a count"] = 0.05
) -> None:
    """Centroids of spots in a real picture of stars, beside an independent catalogue.

    PICTURE is a FITS image of stars and CATALOGUE SExtractor's list of it, with the columns
    XWIN_IMAGE and YWIN_IMAGE (its windowed centroids). Such a pair is data/image.fits and
    data/image.cat of the sources of sep (github.com/kbarbary/sep). The picture is brought to 8
    bits, as a sensor's: median subtracted, times --scale, so that its noise is a few grey levels;
    saturated spots are left out. Nothing of the method was chosen on it.
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
