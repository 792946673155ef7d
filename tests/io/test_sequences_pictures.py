"""Levels of pictures are those that are stored; what a file asks for beside them is told."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from tests.service.hostile_pictures import chunk

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.plausible import comb_doubts
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.decoding import decode_grey, decode_levels
from rendezview.io.sequences.picture_marks import marks_of

CAMERA = Camera(64, 48, 80.0, 81.0, 31.0, 24.0)
RNG = np.random.default_rng(71)
COLOUR = RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8)


GAMMAS = {
    "gamma of screens": chunk(b"gAMA", struct.pack(">I", 45455)),
    "gamma of light": chunk(b"gAMA", struct.pack(">I", 100000)),
    "another gamma": chunk(b"gAMA", struct.pack(">I", 70000)),
    "sRGB": chunk(b"sRGB", b"\0") + chunk(b"gAMA", struct.pack(">I", 45455)),
    "white point": chunk(b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000,
                                              15000, 6000)),
    "profile": chunk(b"iCCP", b"p\0\0" + zlib.compress(RNG.bytes(200_000))),
    "text": chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + b"x" * 120_000),
    "packed text": chunk(b"zTXt", b"a\0\0" + zlib.compress(RNG.bytes(120_000))),
    "background": chunk(b"bKGD", struct.pack(">3H", 9, 9, 9)),
    "private": chunk(b"prVt", RNG.bytes(100)),
}  # fmt: skip


@pytest.mark.parametrize("name", GAMMAS)
@pytest.mark.parametrize("bits", [8, 16])
def test_chunks_beside_the_levels_change_nothing(name: str, bits: int) -> None:
    pixels = COLOUR if bits == 8 else COLOUR.astype(np.uint16) * 257
    png = cv2.imencode(".png", pixels)[1].tobytes()
    with_chunk = png[:33] + GAMMAS[name] + png[33:]
    np.testing.assert_array_equal(decode_levels(with_chunk), decode_levels(png))
    weighted = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY).astype(float)
    assert np.abs(decode_levels(with_chunk) - weighted).max() <= 4  # libpng rounds otherwise


@pytest.mark.parametrize("suffix", [".png", ".webp"])
@pytest.mark.parametrize("bits", [8, 16])
def test_transparent_pixels_lie_over_black(suffix: str, bits: int) -> None:
    if suffix == ".webp" and bits == 16:
        bits = 8
    alpha = np.zeros((48, 64), np.uint8)
    alpha[:, 16:] = 255
    alpha[:, 40:] = 128
    pixels = np.dstack([np.full((48, 64, 3), 200, np.uint8), alpha])
    if bits == 16:
        pixels = pixels.astype(np.uint16) * 257
    grey = decode_grey(cv2.imencode(suffix, pixels, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes())
    assert (grey[:, :16] == 0).all()
    assert np.abs(grey[:, 16:40].astype(int) - 200).max() <= 1
    assert np.abs(grey[:, 40:].astype(int) - 100).max() <= 1


@pytest.mark.parametrize("mode", ["LA", "P", "RGBA"])
def test_every_kind_of_transparency_of_a_png_counts(tmp_path: Path, mode: str) -> None:
    image = Image.new("RGBA", (64, 48), (255, 255, 255, 0))
    image.paste((90, 90, 90, 255), (8, 8, 56, 40))
    if mode == "P":
        image = image.convert("RGB").quantize(4)
        image.save(tmp_path / "a.png", transparency=image.getpixel((0, 0)))
    else:
        image.convert(mode).save(tmp_path / "a.png")
    grey = open_sequence(tmp_path / "a.png", CAMERA).frames[0].read()
    assert (grey[0, 0], grey[20, 30]) == (0, 90)


def test_an_opaque_channel_of_transparency_changes_nothing() -> None:
    whole = np.dstack([COLOUR, np.full((48, 64), 255, np.uint8)])
    opaque = cv2.imencode(".png", whole)[1].tobytes()
    plain = cv2.imencode(".png", COLOUR)[1].tobytes()
    np.testing.assert_array_equal(decode_grey(opaque), decode_grey(plain))


@pytest.mark.parametrize("suffix", ["jpg", "png", "tiff", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turn_that_a_file_asks_for_is_told_and_not_done(
    tmp_path: Path, suffix: str, orientation: int
) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif[0x010F] = "a maker of cameras"
    path = tmp_path / f"a.{suffix}"
    more = {"lossless": True} if suffix == "webp" else {}
    slope = np.add.outer(np.arange(48), 3 * np.arange(64)).astype(np.uint8)
    Image.fromarray(slope).save(path, exif=exif, **more)
    sequence = open_sequence(path, CAMERA)
    assert np.abs(sequence.frames[0].read().astype(int) - slope).mean() < 3.0
    assert len(sequence.notes) == (orientation > 1)
    if orientation > 1:
        assert f"EXIF orientation {orientation}" in sequence.notes[0]


@pytest.mark.parametrize(("suffix", "pages"), [("tiff", 3), ("webp", 4)])
def test_further_pictures_of_a_file_are_told(tmp_path: Path, suffix: str, pages: int) -> None:
    images = [Image.fromarray(np.full((48, 64), 40 * k, np.uint8)) for k in range(1, pages + 1)]
    path = tmp_path / f"a.{suffix}"
    more = {"lossless": True} if suffix == "webp" else {}
    images[0].save(path, save_all=True, append_images=images[1:], **more)
    images[0].save(tmp_path / "b.png")  # beside other pictures, a stack is one
    sequence = open_sequence(tmp_path, CAMERA)
    assert sequence.notes == (
        f"files hold {pages} pictures each: the first is read; split them into files",
    )
    assert abs(int(sequence.frames[0].read()[0, 0]) - 40) <= 1


def test_an_animated_png_is_refused_as_that(tmp_path: Path) -> None:
    images = [Image.fromarray(np.full((48, 64), 40 * k, np.uint8)) for k in (1, 2)]
    images[0].save(tmp_path / "a.png", save_all=True, append_images=images[1:])
    with pytest.raises(RendezviewError, match=r"not an image that can be read \(animated\)"):
        open_sequence(tmp_path / "a.png", CAMERA)


@pytest.mark.parametrize(
    "suffix", ["psd", "JP2", "gif", "heic", "exr", "dng", "npy", "jxl", "avif"]
)
def test_pictures_of_other_formats_are_named(tmp_path: Path, suffix: str) -> None:
    for k in range(3):
        (tmp_path / f"{k}.{suffix}").write_bytes(b"content")
    with pytest.raises(RendezviewError, match=rf"\(3 \.{suffix.lower()}\) are of formats that"):
        open_sequence(tmp_path, CAMERA)


@pytest.mark.parametrize("start", [b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe1", b"II*\0", b"MM\0*",
                                   b"RIFF....WEBP", b"", b"BM"])  # fmt: skip
def test_marks_of_damaged_files_are_read_without_a_fault(start: bytes) -> None:
    rng = np.random.default_rng(5)
    for length in (0, 1, 7, 30, 300):
        for _ in range(20):
            assert marks_of(start + rng.bytes(length)).pages >= 1


def scene(shift: float) -> np.ndarray:
    """Bright bars on black that move to the right."""
    x = np.arange(320)[None, :] - shift
    y = np.arange(240)[:, None]
    bars = 200.0 * ((np.floor((x + 0.2 * y) / 23.0) % 3) == 0)
    noise = np.random.default_rng(int(10 * shift)).normal(10.0, 4.0, bars.shape)
    return np.clip(bars + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shift", [2.0, 3.0, 5.0, 9.0])
@pytest.mark.parametrize("bits", [8, 16])
def test_the_comb_of_interlaced_video_is_told(shift: float, bits: int) -> None:
    woven = scene(0.0)
    woven[1::2] = scene(shift)[1::2]
    pictures = [woven, woven[:, ::-1], woven] if bits == 8 else [woven.astype(np.uint16) * 257]
    (doubt,) = comb_doubts(pictures)
    assert "interlaced" in doubt


def test_pictures_without_a_comb_are_not_doubted() -> None:
    noise = np.random.default_rng(3).integers(0, 256, (200, 300), dtype=np.uint8)
    checks = (np.indices((200, 300)).sum(axis=0) % 2 * 255).astype(np.uint8)
    lines = np.tile((np.arange(300) % 2 * 255).astype(np.uint8), (200, 1))
    for picture in (scene(0.0), noise, checks, lines, np.zeros((2, 2), np.uint8)):
        assert comb_doubts([picture]) == []
    assert comb_doubts([]) == []


@pytest.mark.parametrize("seed", range(4))
def test_single_stars_and_hot_pixels_are_no_interlaced_rows(seed: int) -> None:
    rng = np.random.default_rng([74, seed])
    stars = rng.normal(100.0, 3.0, (300, 300))
    for row, column in rng.integers(2, 298, (10, 2)):
        stars[row, column : column + 2] += 120.0  # wider than high: none of them in a column
    assert comb_doubts([stars.astype(np.uint8)]) == []
