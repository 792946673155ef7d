"""Centroids of spots in real pictures of stars, beside SExtractor's; the pixels' S-curve."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rendezview.sensors.reflectors import LitDark, find_spots
from scipy.special import erf

from experiments.frame import show, table_of

BLOCK, CARD = 2880, 80  # bytes, of a FITS header
SKY_GREY = 20.0
MESH_PX = 24  # of the peer's background
A_WINDOW = 2.0 / 2.355  # σ of SExtractor's window, in half-light radii


def read_fits(path: Path) -> np.ndarray:
    """The first image of a FITS file (16-bit integers or floats), float; no value: the median."""
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
    pixels = np.frombuffer(content, kind, shape[0] * shape[1], first).reshape(shape).astype(float)
    pixels = float(cards.get("BZERO", "0")) + float(cards.get("BSCALE", "1")) * pixels
    return np.nan_to_num(pixels, nan=float(np.nanmedian(pixels)))


@dataclass(frozen=True, slots=True)
class Sources:
    """What SExtractor's algorithms find in one picture."""

    places: np.ndarray  # (N, 2) windowed centroids
    radii: np.ndarray  # (N,) px, half the light
    clean: np.ndarray  # (N,) no flag
    peaks: np.ndarray  # (N,) over the noise
    background: np.ndarray
    noise: float


def sources(picture: np.ndarray, factor: float) -> Sources:
    """Sources above ``factor`` times the noise, by sep, SExtractor's code as a library."""
    try:
        import sep
    except ImportError:
        sys.exit("SExtractor's code is needed: pip install sep")
    pixels = np.ascontiguousarray(picture, np.float64)
    behind = sep.Background(pixels, bw=MESH_PX, bh=MESH_PX)
    light, noise = pixels - behind.back(), float(behind.globalrms)
    found = sep.extract(light, factor, err=noise)
    radii, _ = sep.flux_radius(
        light, found["x"], found["y"], 6.0 * found["a"], 0.5, normflux=found["flux"]
    )
    radii = np.maximum(radii, 0.1)
    x, y, flags = sep.winpos(light, found["x"], found["y"], A_WINDOW * radii)
    return Sources(
        np.column_stack([x, y]), radii, (found["flag"] == 0) & (flags == 0), found["peak"] / noise,
        behind.back(), noise,
    )  # fmt: skip


def whole_stars(found: Sources, shape: tuple[int, ...]) -> tuple[np.ndarray, float]:
    """Which sources are single stars, and the half-light radius of a star.

    A star has the commonest size of the bright sources, to 15 %, and no neighbour within 6 px.
    """
    bright = found.clean & (found.peaks > 20.0)
    counts, edges = np.histogram(np.log(found.radii[bright]), bins=np.arange(-1.0, 2.0, 0.1))
    size = math.exp(edges[int(counts.argmax())] + 0.05)
    apart = [np.sort(np.hypot(*(found.places - place).T))[1] for place in found.places]
    x, y = found.places.T
    within = (np.minimum(x, y) > 8.0) & (x < shape[1] - 9.0) & (y < shape[0] - 9.0)
    alike = np.abs(np.log(found.radii / size)) < 0.15
    return np.flatnonzero(found.clean & alike & within & (np.array(apart) > 6.0)), size


def tiles(picture: np.ndarray, side: int) -> list[tuple[slice, slice]]:
    """Rows and columns of the whole tiles of a picture; one tile if it is smaller."""
    height, width = picture.shape
    side = min(side, height, width)
    starts = [range(0, size - side + 1, side) for size in (height, width)]
    return [(slice(r, r + side), slice(c, c + side)) for r in starts[0] for c in starts[1]]


def nearest(places: np.ndarray, place: np.ndarray) -> tuple[int, float]:
    """Index and distance of the nearest; distance inf where there is none."""
    if not len(places):
        return 0, math.inf
    apart = np.hypot(*(places - place).T)
    return int(apart.argmin()), float(apart.min())


def run(pictures: list[Path], *, noise: float = 2.0, seeds: int = 3, tile: int = 256) -> None:
    """Centroids of stars in real pictures, in added noise, beside SExtractor's windowed centroids.

    PICTURES are FITS images. Such are data/image.fits of github.com/kbarbary/sep, and
    data/spitzer_example_image.fits (--tile 128) and data/M6707HH.fits of
    github.com/astropy/photutils-datasets. Truth: SExtractor's windowed centroids in the whole
    picture (sep, `pip install sep`). Then a picture's noise is brought to 1 grey level, --noise
    grey levels are added, and the sum is a picture of 8 bits, in tiles of --tile px. In these both
    methods start from nothing. Stars: of the commonest size, alone within 6 px, below 250 grey,
    above 5 σ. Errors are of stars that both find. Seeds 0, 1, ... --seeds. Since the truth has the
    noise of the picture itself, 0.89 is the right ratio of error and claimed σ.
    """
    table = table_of(
        f"noise {noise:g} grey, {seeds} seeds; ours and SExtractor's (S): found %, errors px",
        "picture | FWHM | stars | found, S | median, S | rms, S | error/σ | > 3 σ, %",
        left=1,
    )
    for path in pictures:
        pixels = read_fits(path)
        truth = sources(pixels, 3.0)
        chosen, size = whole_stars(truth, pixels.shape)
        grey = SKY_GREY + (pixels - np.median(pixels)) / truth.noise
        counts, ours, theirs, ratios = np.zeros(3, int), [], [], []
        for seed in range(seeds):
            noisy = grey + np.random.default_rng(seed).normal(0.0, noise, grey.shape)
            lit = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
            for rows, columns in tiles(lit, tile):
                part = np.ascontiguousarray(lit[rows, columns])
                spots, peer = find_spots(LitDark(part, None)), sources(part, 3.0)
                for k in chosen:
                    place = truth.places[k] - (columns.start, rows.start)
                    x, y = (round(float(v)) for v in place)
                    if not (4 <= x < part.shape[1] - 4 and 4 <= y < part.shape[0] - 4):
                        continue
                    top = int(part[y - 1 : y + 2, x - 1 : x + 2].max())
                    if top > 250 or top - peer.background[y, x] < 5.0 * math.hypot(noise, 1.0):
                        continue
                    n, off = nearest(spots.centroids_px, place)
                    _, its = nearest(peer.places, place)
                    counts += (1, off < 2.0, its < 2.0)
                    if off < 2.0:
                        ratios.append((spots.centroids_px[n] - place) / spots.sigma_px[n])
                    if off < 2.0 and its < 2.0:
                        ours.append(off)
                        theirs.append(its)
        if not ours:
            table.add_row(path.stem[:7], *["–"] * 7)
            continue
        cells = [f"{f(ours):.3f}, {f(theirs):.3f}" for f in (np.median, rms)]
        shares = ", ".join(f"{100.0 * count / counts[0]:.0f}" for count in counts[1:])
        table.add_row(
            path.stem[:7], f"{2.0 * size:.1f}", str(counts[0]), shares, *cells,
            f"{rms(ratios):.2f}", f"{100.0 * np.mean(np.abs(ratios) > 3.0):.1f}",
        )  # fmt: skip
    show(table)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def s_curve() -> None:
    """Errors of the centroid over the place within a pixel, of Gaussian spots without noise.

    Spots of peak 180 grey, integrated over square pixels and rounded to 8 bits; 21 × 5 places.
    """
    table = table_of("px", "σ of the spot | largest error of x or y | rms", left=0)
    pixels, ways = np.arange(41), np.linspace(-0.5, 0.5, 21)
    for sigma in (0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5, 2.5, 4.0):

        def along(middle: float, sigma: float = sigma) -> np.ndarray:
            edges = (np.append(pixels, 41) - 0.5 - middle) / (math.sqrt(2.0) * sigma)
            return np.diff(erf(edges))

        errors = []
        for x in 20.0 + ways:
            for y in 20.0 + ways[::5]:
                light = np.outer(along(y), along(x))
                lit = np.rint(10.0 + 180.0 * light / light.max()).astype(np.uint8)
                spots = find_spots(LitDark(lit, None))
                errors.extend(spots.centroids_px[0] - (x, y) if len(spots) == 1 else (9.0, 9.0))
        table.add_row(f"{sigma:g}", f"{np.abs(errors).max():.4f}", f"{rms(errors):.4f}")
    show(table)
