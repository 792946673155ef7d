"""Photographs of a craft in hard light, step by step from its radiance to grey levels.

A real photograph has what a clean rendering lacks: faces burnt out or black, mottled foil, a halo
around bright faces, a grey sky, dust like stars. The conditions are drawn far more widely than
any camera has them, so that a network trained on such pictures relies on none of them.

All pictures are square, (S, S) float32, of one crop around the craft.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.zbuffer import Float32s
from rendezview_ground.limits import check, check_rising
from rendezview_ground.simulate.dust import add_dust

Range = tuple[float, float]  # uniform

_CRAFT = 0.9  # coverage; such pixels are metered. Source: by construction of the training set
_METERED_PX = 20  # px; fewer cannot be metered. Source: by construction of the training set


@dataclass(frozen=True, slots=True, kw_only=True)
class HardLightOptions:
    """From what the conditions of a photograph are drawn.

    A ``share`` is the probability of an effect. A pair is a range, uniform; uniform in the
    logarithm where the comment says log. Source of all numbers: by construction of the training
    set, made wider than the photographs that were seen.
    """

    # Surface: reflectance varies in patches and by dirt; depths are of its logarithm, one σ.
    patches_share: float = 0.6
    patches: tuple[int, int] = (3, 48)  # knots along a side of the picture
    patches_depth: Range = (0.05, 0.6)
    wrinkles_share: float = 0.25  # foil: sharp bright lines between its folds
    wrinkles: tuple[int, int] = (4, 32)  # knots along a side of the picture
    wrinkles_depth: Range = (0.2, 1.5)
    dirt_share: float = 0.3
    dirt_size_px: Range = (0.6, 2.0)  # σ of its correlation
    dirt_depth: Range = (0.05, 0.8)
    # Sunlight or a lamp: falls off across the craft; other light comes from elsewhere.
    falloff_share: float = 0.35
    falloff: Range = (0.0, 6.0)  # change of the logarithm over the picture
    falloff_most: float = 3.0  # of the logarithm, to either side
    ambient: Range = (0.002, 0.6)  # light from the sky over sunlight, log
    shade_share: float = 0.08  # no sunlight at all
    # Exposure: grey level, before saturation, of a percentile of the craft.
    percentiles: tuple[float, ...] = (50.0, 90.0, 98.0)
    level_grey: Range = (4.0, 900.0)  # log
    dark_share: float = 0.2
    dark_level_grey: Range = (2.0, 12.0)  # log
    most_grey: float = 6000.0  # of the craft before the optics
    # Behind the craft: Earth or clouds, and glow of the sky.
    sky_share: float = 0.6
    magnified_share: float = 0.3
    magnified_part: Range = (0.3, 1.0)  # of the sky's side that fills the picture
    contrast_share: float = 0.3
    contrast: Range = (0.5, 3.0)  # exponent
    terminator_share: float = 0.35
    terminator_place: Range = (-0.4, 0.4)  # of the picture's side, from its middle
    terminator_sharpness: Range = (5.0, 40.0)  # of the logistic, 1 / side
    sky_level_grey: Range = (15.0, 400.0)  # of radiance 1, log
    glow_share: float = 0.3
    glow_grey: Range = (0.0, 8.0)
    # Dust before the camera.
    dust_share: float = 0.5
    specks: tuple[int, int] = (1, 25)  # at least, less than
    # Optics: blur, a lens out of focus, a halo around bright places, stray light.
    blur_sigma_px: Range = (0.2, 1.3)
    defocus_share: float = 0.2
    defocus_px: Range = (1.0, 4.0)  # radius of the disc that a point becomes
    bloom_share: float = 0.6
    bloom_sigma_px: Range = (2.0, 18.0)  # log
    bloom: Range = (0.005, 0.12)  # of the light, added
    bloom_most_grey: float = 2000.0  # of the light that blooms
    glare_share: float = 0.4  # halos so many times as wide as that of the bloom
    glare_widths: tuple[float, ...] = (3.0, 8.0)
    glare: Range = (0.0, 0.06)  # of the light, added by each
    stray_share: float = 0.25
    stray_grey: Range = (0.0, 12.0)
    stray_slope: Range = (-2.0, 2.0)  # along each axis, 1 / side
    # Detector: black level, response, noise.
    raised_black_share: float = 0.7
    raised_black_level_grey: Range = (0.0, 45.0)
    black_level_grey: Range = (0.0, 5.0)
    response_share: float = 0.15
    response: Range = (0.5, 1.5)  # exponent
    noise_sigma_grey: Range = (0.25, 5.0)  # log
    smooth_noise_share: float = 0.4  # noise of neighbours is correlated, as after demosaicing
    smooth_noise_sigma_px: float = 0.6
    shot_noise: Range = (0.0, 3.0)  # variance of white over that of black, less 1
    jpeg_share: float = 0.35
    jpeg_quality: tuple[int, int] = (60, 99)  # at least, less than

    def __post_init__(self) -> None:
        names = [field.name for field in fields(self)]
        check(self, 0.0, 1.0, *(name for name in names if name.endswith("_share")))
        pairs = [name for name in names if isinstance(getattr(self, name), tuple)]
        check_rising(self, *(n for n in pairs if n not in ("percentiles", "glare_widths")))


def photograph(
    sunlit: Float32s,
    ambient: Float32s,
    cover: Float32s,
    sky: Float32s,
    rng: np.random.Generator,
    options: HardLightOptions | None = None,
) -> Float32s:
    """A photograph (S, S), grey levels 0 … 255, not rounded.

    Args:
        sunlit: (S, S) radiance of the craft in sunlight alone, premultiplied by coverage.
        ambient: (S, S) the same in the light of a bright sky.
        cover: (S, S) coverage by the craft, 0 … 1.
        sky: (T, T) radiance behind it, T ≥ S; a part of it is used in most pictures.
        rng: of the conditions and the noise.
        options: ranges of the conditions.
    """
    options = options or HardLightOptions()
    reflectance = mottled_reflectance(len(cover), rng, options)
    radiance = reflectance * lit(sunlit, ambient, rng, options)
    grey = exposed(radiance, cover, rng, options)
    behind = background(sky, len(cover), rng, options)
    level = options.black_level_grey
    if _happens(options.raised_black_share, rng):
        level = options.raised_black_level_grey
    black_grey = rng.uniform(*level)
    glow_grey = rng.uniform(*options.glow_grey) if _happens(options.glow_share, rng) else 0.0
    grey = (grey + (1.0 - cover) * (behind + np.float32(glow_grey))).astype(np.float32)
    if _happens(options.dust_share, rng):
        add_dust(grey, int(rng.integers(*options.specks)), rng)
    grey = through_optics(grey, rng, options)
    return detected(grey + np.float32(black_grey), rng, options)


def mottled_reflectance(side: int, rng: np.random.Generator, options: HardLightOptions) -> Float32s:
    """(S, S) factor of the reflectance: wrinkled foil in patches, and dirt."""
    factor = np.ones((side, side), np.float32)
    if _happens(options.patches_share, rng):
        knots = rng.standard_normal(tuple(rng.integers(*options.patches, 2))).astype(np.float32)
        slow = cv2.resize(knots, (side, side), interpolation=cv2.INTER_CUBIC)
        factor *= np.exp(rng.uniform(*options.patches_depth) * slow)
    if _happens(options.wrinkles_share, rng):
        knots = rng.standard_normal(tuple(rng.integers(*options.wrinkles, 2))).astype(np.float32)
        folds = np.abs(cv2.resize(knots, (side, side), interpolation=cv2.INTER_CUBIC))
        factor *= np.exp(-rng.uniform(*options.wrinkles_depth) * folds)
    if _happens(options.dirt_share, rng):
        white = rng.standard_normal((side, side), np.float32)
        fine = cv2.GaussianBlur(white, (0, 0), rng.uniform(*options.dirt_size_px))
        factor *= np.exp(rng.uniform(*options.dirt_depth) / fine.std() * fine)
    return factor


def lit(
    sunlit: Float32s, ambient: Float32s, rng: np.random.Generator, options: HardLightOptions
) -> Float32s:
    """(S, S) radiance in sunlight that falls off across the craft, and in weak light of the sky."""
    if _happens(options.falloff_share, rng):
        across = _ramp(len(sunlit), rng) * rng.uniform(*options.falloff)
        sunlit = sunlit * np.exp(np.clip(across, -options.falloff_most, options.falloff_most))
    share = log_uniform(options.ambient, rng)
    if _happens(options.shade_share, rng):
        sunlit = np.zeros_like(sunlit)
    return np.asarray(sunlit + np.float32(share) * ambient, dtype=np.float32)


def exposed(
    radiance: Float32s, cover: Float32s, rng: np.random.Generator, options: HardLightOptions
) -> Float32s:
    """(S, S) grey levels of the craft, from all dark to mostly saturated (far above 255)."""
    craft = radiance[cover > _CRAFT]
    metered = 0.1  # radiance, where nothing can be metered
    if len(craft) > _METERED_PX:
        metered = float(np.percentile(craft, rng.choice(options.percentiles)))
    level = log_uniform(options.level_grey, rng)
    if _happens(options.dark_share, rng):
        level = log_uniform(options.dark_level_grey, rng)
    gain = level / (max(metered, 1e-3) if metered > 0.0 else 0.05)
    grey = np.minimum(radiance * np.float32(gain), options.most_grey)
    return np.asarray(grey, dtype=np.float32)


def background(
    sky: Float32s, side: int, rng: np.random.Generator, options: HardLightOptions
) -> Float32s:
    """(S, S) grey levels behind the craft: black, or a part of the sky, day or at a terminator."""
    if not _happens(options.sky_share, rng):
        return np.zeros((side, side), np.float32)
    top, left = rng.integers(0, len(sky) - side + 1, 2)
    part: npt.NDArray[Any] = sky[top : top + side, left : left + side].astype(np.float32)
    if rng.random() < 0.5:
        part = part[::-1]
    if rng.random() < 0.5:
        part = part.T
    if _happens(options.magnified_share, rng):
        count = max(1, int(rng.uniform(*options.magnified_part) * side))
        part = np.ascontiguousarray(part[:count, :count])
        part = np.asarray(cv2.resize(part, (side, side), interpolation=cv2.INTER_LINEAR))
    if _happens(options.contrast_share, rng):
        part = np.maximum(part, 0.0) ** rng.uniform(*options.contrast)
    if _happens(options.terminator_share, rng):
        beyond = _ramp(side, rng) - rng.uniform(*options.terminator_place)
        part = part / (1.0 + np.exp(-beyond * rng.uniform(*options.terminator_sharpness)))
    return np.asarray(part * log_uniform(options.sky_level_grey, rng), dtype=np.float32)


def through_optics(grey: Float32s, rng: np.random.Generator, options: HardLightOptions) -> Float32s:
    """(S, S) light on the detector: the blurred core of the PSF, its wide tails, stray light."""
    grey = _blurred(grey, rng.uniform(*options.blur_sigma_px))
    if _happens(options.defocus_share, rng):
        grey = _defocused(grey, rng.uniform(*options.defocus_px))
    if _happens(options.bloom_share, rng):
        bright = np.minimum(grey, np.float32(options.bloom_most_grey))
        sigma_px = log_uniform(options.bloom_sigma_px, rng)
        grey = grey + np.float32(rng.uniform(*options.bloom)) * _blurred(bright, sigma_px)
        if _happens(options.glare_share, rng):
            for width in options.glare_widths:
                halo = _widely_blurred(bright, width * sigma_px)
                grey = grey + np.float32(rng.uniform(*options.glare)) * halo
    if _happens(options.stray_share, rng):
        x, y = _places(len(grey))
        most = rng.uniform(*options.stray_grey)
        slope = x * rng.uniform(*options.stray_slope) + y * rng.uniform(*options.stray_slope)
        grey = grey + np.asarray(most * np.maximum(slope + 0.5, 0.0), dtype=np.float32)
    return np.asarray(grey, dtype=np.float32)


def detected(grey: Float32s, rng: np.random.Generator, options: HardLightOptions) -> Float32s:
    """(S, S) grey levels that are read out: saturation, response, noise, compression."""
    grey = np.clip(grey, 0.0, 255.0).astype(np.float32)
    if _happens(options.response_share, rng):
        grey = (255.0 * (grey / 255.0) ** rng.uniform(*options.response)).astype(np.float32)
    sigma_grey = log_uniform(options.noise_sigma_grey, rng)
    noise = rng.standard_normal(grey.shape, np.float32)
    if _happens(options.smooth_noise_share, rng):
        noise = _blurred(noise, options.smooth_noise_sigma_px)
        noise /= noise.std()
    more = grey / 255.0 * rng.uniform(*options.shot_noise)
    noisy = np.clip(grey + sigma_grey * noise * np.sqrt(1.0 + more), 0.0, 255.0)
    if _happens(options.jpeg_share, rng):
        quality = int(rng.integers(*options.jpeg_quality))
        rounded = np.rint(noisy).astype(np.uint8)
        _, packed = cv2.imencode(".jpg", rounded, [cv2.IMWRITE_JPEG_QUALITY, quality])
        noisy = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)
    return np.asarray(noisy, dtype=np.float32)


def _happens(share: float, rng: np.random.Generator) -> bool:
    return bool(rng.random() < share)


def log_uniform(bounds: Range, rng: np.random.Generator) -> float:
    """A number that is uniform in the logarithm."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


def _places(side: int) -> tuple[Float32s, Float32s]:
    """x and y (S, S) of the pixels, in sides from the middle."""
    y, x = np.mgrid[0:side, 0:side].astype(np.float32) / side - np.float32(0.5)
    return x, y


def _ramp(side: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """(S, S) distance from the middle along a random direction, in sides."""
    x, y = _places(side)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.asarray(x * np.cos(angle) + y * np.sin(angle), dtype=np.float32)


def _blurred(picture: Float32s, sigma_px: float) -> Float32s:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px), dtype=np.float32)


def _defocused(picture: Float32s, radius_px: float) -> Float32s:
    """The picture of a lens out of focus: each point is a disc, drawn at a quarter of a pixel."""
    reach = int(np.ceil(radius_px))
    fine = (np.arange(4 * (2 * reach + 1)) + 0.5) / 4.0 - reach - 0.5
    within = (np.hypot(fine[:, None], fine) <= radius_px).astype(np.float32)
    side = 2 * reach + 1
    disc = within.reshape(side, 4, side, 4).sum((1, 3))
    return np.asarray(cv2.filter2D(picture, -1, disc / disc.sum()), dtype=np.float32)


def _widely_blurred(picture: Float32s, sigma_px: float) -> Float32s:
    """As ``_blurred``, on a picture of a quarter of the size: no detail is left."""
    small = np.asarray(cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))
    soft = _blurred(small.astype(np.float32), 0.25 * sigma_px)
    size = picture.shape[1], picture.shape[0]
    return np.asarray(cv2.resize(soft, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
