"""FITS files and TIFF stacks: frames, times and levels as the files have them."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from astropy.io import fits

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import Sequence, open_sequence
from rendezview.io.sequences.picture import Picture
from rendezview.io.sequences.stacks import FORMATS, Format
from rendezview.io.sequences.tiff import Tiff

CAMERA = Camera(64, 48, 80.0, 81.0, 31.0, 24.0)
RNG = np.random.default_rng(72)
BYTES = RNG.integers(0, 256, (5, 48, 64), dtype=np.uint8)
WORDS = RNG.integers(0, 4096, (5, 48, 64)).astype(np.uint16)
WORDS[:, 0, 0] = 4095
UNIX_2026 = 1767225600.0  # 2026-01-01T00:00:00 UTC


def read_all(sequence: Sequence) -> np.ndarray[Any, Any]:
    return np.stack([frame.read() for frame in sequence])


def write_fits(path: Path, data: np.ndarray[Any, Any], **cards: Any) -> Path:
    header = fits.Header([(key.replace("_", "-"), value) for key, value in cards.items()])
    fits.PrimaryHDU(data, header).writeto(path)
    return path


@pytest.mark.parametrize(
    ("stored", "shown"),
    [
        (BYTES[0], BYTES[0]),
        (WORDS[0], WORDS[0] >> 4),  # BZERO 32768; 12 bits in use
        (WORDS[0].astype(np.int16), WORDS[0] >> 4),
        (WORDS[0].astype(np.int32) - 9, np.maximum(WORDS[0].astype(int) - 9, 0) >> 4),
        (WORDS[0].astype(np.float32), WORDS[0] >> 4),
        (WORDS[0].astype(np.float64) + 0.5, WORDS[0] >> 4),
        ((WORDS[0] / 4095).astype(np.float32), (WORDS[0] / 4095 * 65535).astype(int) >> 8),
        (WORDS[0].astype(np.int32) * 256, WORDS[0] >> 4),  # 20 bits
        (np.where(WORDS[0] == 7, np.nan, WORDS[0]).astype(np.float32),
         np.where(WORDS[0] == 7, 0, WORDS[0]).astype(int) >> 4),
    ],
)  # fmt: skip
def test_levels_of_fits_are_counts(
    tmp_path: Path, stored: np.ndarray[Any, Any], shown: np.ndarray[Any, Any]
) -> None:
    path = write_fits(tmp_path / "a.fits", stored, ROWORDER="TOP-DOWN")
    got = open_sequence(path, CAMERA).frames[0].read()
    assert np.abs(got.astype(int) - shown).max() <= (stored.dtype.kind == "f")


@pytest.mark.parametrize("name", ["a.fits", "a.fit", "A.FTS", "a.fits.gz"])
def test_fits_is_known_by_its_endings(tmp_path: Path, name: str) -> None:
    write_fits(tmp_path / name, BYTES[0], ROWORDER="TOP-DOWN")
    assert np.array_equal(open_sequence(tmp_path, CAMERA)[0].read(), BYTES[0])


def test_packed_fits_is_read(tmp_path: Path) -> None:
    unit = fits.CompImageHDU(WORDS[0].astype(np.int32), compression_type="RICE_1")
    unit.writeto(tmp_path / "a.fits.fz")
    assert np.array_equal(open_sequence(tmp_path, CAMERA)[0].read(), WORDS[0] >> 4)


def test_bscale_and_bzero_are_applied(tmp_path: Path) -> None:
    unit = fits.PrimaryHDU(WORDS[0].astype(np.float32))
    unit.scale("int16", bscale=0.5, bzero=1000)
    unit.writeto(tmp_path / "a.fits")
    got = open_sequence(tmp_path, CAMERA)[0].read()
    assert np.abs(got.astype(int) - (WORDS[0] >> 4)).max() <= 1


def test_row_order_is_that_of_the_file(tmp_path: Path) -> None:
    write_fits(tmp_path / "a.fits", BYTES[0], ROWORDER="BOTTOM-UP")
    sequence = open_sequence(tmp_path, CAMERA)
    assert np.array_equal(sequence[0].read(), BYTES[0][::-1])
    assert not sequence.notes
    write_fits(tmp_path / "b.fits", BYTES[0])
    second = open_sequence(tmp_path / "b.fits", CAMERA)
    assert np.array_equal(second[0].read(), BYTES[0])
    assert "which row is on top" in " ".join(second.notes)


@pytest.mark.parametrize(
    ("cards", "time_s"),
    [
        ({"DATE_OBS": "2026-01-01T00:00:10.250"}, 10.25),
        ({"DATE_OBS": "2026-01-01T00:00:10", "EXPTIME": 0.5}, 10.25),
        ({"DATE_BEG": "2026-01-01T00:00:10", "DATE_END": "2026-01-01T00:00:10.5"}, 10.25),
        ({"DATE_AVG": "2026-01-01T00:00:10.25", "DATE_OBS": "2026-01-01T00:00:09"}, 10.25),
        ({"DATE_OBS": "2026-01-01", "TIME_OBS": "00:00:10.25"}, 10.25),
        ({"DATE_OBS": "2026-01-01"}, None),
        ({"DATE_OBS": "yesterday"}, None),
        ({}, None),
    ],
)
def test_times_are_the_middles_of_exposures(
    tmp_path: Path, cards: dict[str, Any], time_s: float | None
) -> None:
    write_fits(tmp_path / "a.fits", BYTES[0], **cards)
    got = open_sequence(tmp_path, CAMERA)[0].time_s
    assert got == (None if time_s is None else pytest.approx(UNIX_2026 + time_s, abs=1e-6))


def test_a_cube_is_a_sequence_with_its_step(tmp_path: Path) -> None:
    write_fits(tmp_path / "a.fits", WORDS, CTYPE3="TIME", CDELT3=0.25, CUNIT3="s",
               DATE_AVG="2026-01-01T00:00:00")  # fmt: skip
    sequence = open_sequence(tmp_path, CAMERA)
    assert np.array_equal(read_all(sequence), WORDS >> 4)
    assert [f.time_s - UNIX_2026 for f in sequence] == [0.0, 0.25, 0.5, 0.75, 1.0]


def test_errors_and_masks_of_the_same_file_are_no_frames(tmp_path: Path) -> None:
    units = [fits.PrimaryHDU()]
    units += [fits.ImageHDU(BYTES[k], name=name) for k, name in enumerate(["SCI", "ERR", "DQ"])]
    units.append(fits.ImageHDU(BYTES[3], name="SCI"))
    fits.HDUList(units).writeto(tmp_path / "a.fits")
    sequence = open_sequence(tmp_path, CAMERA)
    assert np.array_equal(read_all(sequence), BYTES[[0, 3]])
    assert "left out: DQ, ERR" in " ".join(sequence.notes)


@pytest.mark.parametrize(
    ("data", "cards", "word"),
    [
        (BYTES[:3], {}, "3 planes"),
        (BYTES[0], {"BAYERPAT": "RGGB"}, "mosaics"),
        (BYTES[0], {"TIMESYS": "TAI", "DATE_OBS": "2026-01-01T00:00:00"}, "TAI"),
    ],
)
def test_what_is_odd_about_fits_is_told(
    tmp_path: Path, data: np.ndarray[Any, Any], cards: dict[str, Any], word: str
) -> None:
    write_fits(tmp_path / "a.fits", data, ROWORDER="TOP-DOWN", **cards)
    assert word in " ".join(open_sequence(tmp_path, CAMERA).notes)


def test_wrong_fits_files_are_named(tmp_path: Path) -> None:
    path = write_fits(tmp_path / "a.fits", WORDS[0])
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(RendezviewError, match=r"a\.fits: not a FITS file .* replace it"):
        open_sequence(path, CAMERA)
    path.write_bytes(b"no FITS")
    with pytest.raises(RendezviewError, match="not a FITS file"):
        open_sequence(path, CAMERA)
    write_fits(tmp_path / "b.fits", np.zeros((2, 2, 48, 64), np.uint8))
    with pytest.raises(RendezviewError, match="64 × 48 × 2 × 2"):
        open_sequence(tmp_path / "b.fits", CAMERA)
    columns = [fits.Column("x", "E", array=np.zeros(3))]
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "c.fits")
    with pytest.raises(RendezviewError, match="only tables"):
        open_sequence(tmp_path / "c.fits", CAMERA)


def test_a_missing_astropy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_fits(tmp_path / "a.fits", BYTES[0])
    monkeypatch.setitem(sys.modules, "astropy.io", None)
    with pytest.raises(RendezviewError, match=r"pip install 'rendezview\[fits\]'"):
        open_sequence(tmp_path, CAMERA)


def test_a_damaged_file_among_others_is_a_frame_that_fails(tmp_path: Path) -> None:
    for k in range(3):
        write_fits(tmp_path / f"{k}.fits", BYTES[k], ROWORDER="TOP-DOWN")
    (tmp_path / "1.fits").write_bytes(b"")
    sequence = open_sequence(tmp_path, CAMERA)
    assert np.array_equal(sequence[2].read(), BYTES[2])
    with pytest.raises(RendezviewError, match=r"1\.fits"):
        sequence[1].read()


def test_pictures_of_a_usual_kind_win_over_fits(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), BYTES[0])
    write_fits(tmp_path / "a.fits", BYTES[1])
    assert np.array_equal(read_all(open_sequence(tmp_path, CAMERA)), BYTES[:1])


def big_tiff(pages: np.ndarray[Any, Any], order: str = "<") -> bytes:
    """A BigTIFF of uint8 pages (N, H, W)."""
    content = bytearray(
        (b"II" if order == "<" else b"MM") + struct.pack(order + "HHHQ", 43, 8, 0, 0)
    )
    link = 8
    for page in pages:
        data = len(content)
        content += page.tobytes()
        struct.pack_into(order + "Q", content, link, len(content))
        height, width = page.shape
        tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, data), (277, 1),
                (278, height), (279, page.size)]  # fmt: skip
        content += struct.pack(order + "Q", len(tags))
        for tag, value in tags:
            content += struct.pack(order + "HHQQ", tag, 16, 1, value)
        link = len(content)
        content += struct.pack(order + "Q", 0)
    return bytes(content)


@pytest.mark.parametrize("pages", [BYTES, WORDS, WORDS.astype(np.float32)])
def test_every_page_of_a_stack_is_a_frame(tmp_path: Path, pages: np.ndarray[Any, Any]) -> None:
    cv2.imwritemulti(str(tmp_path / "a.tif"), list(pages))
    sequence = open_sequence(tmp_path, CAMERA)
    assert np.array_equal(read_all(sequence), BYTES if pages is BYTES else WORDS >> 4)
    assert sequence[1].name == "a.tif, page 1"


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_large_stack_is_read(tmp_path: Path, order: str) -> None:
    (tmp_path / "a.tif").write_bytes(big_tiff(BYTES, order))
    assert np.array_equal(read_all(open_sequence(tmp_path, CAMERA)), BYTES)


def with_text(path: Path, about: str) -> None:
    """Give the first page of a classic TIFF of this machine's order an ImageDescription."""
    content = bytearray(path.read_bytes())
    first = next(Tiff(content).pages())
    (count,) = struct.unpack_from("<H", content, first)
    place = len(content) + len(content) % 2
    content += b"\0" * (place - len(content))
    entries = [bytes(content[first + 2 + 12 * k : first + 14 + 12 * k]) for k in range(count)]
    text = about.encode() + b"\0"
    entries = sorted([*entries, struct.pack("<HHII", 270, 2, len(text), place)],
                     key=lambda entry: struct.unpack("<H", entry[:2]))  # fmt: skip
    following = bytes(content[first + 2 + 12 * count : first + 6 + 12 * count])
    content += text + b"\0" * (len(text) % 2)
    struct.pack_into("<I", content, 4, len(content))
    content += struct.pack("<H", len(entries)) + b"".join(entries) + following
    path.write_bytes(content)


OME = "<OME><Pixels>{}</Pixels></OME>".format(
    "".join(f'<Plane TheT="{k}" DeltaT="{0.5 * k}"/>' for k in range(5))
)


@pytest.mark.parametrize(
    ("about", "times_s"),
    [
        ("ImageJ=1.53\nimages=5\nframes=5\nfinterval=0.5\n", [0.0, 0.5, 1.0, 1.5, 2.0]),
        (OME, [0.0, 0.5, 1.0, 1.5, 2.0]),
        ("ImageJ=1.53\nimages=5\n", [None] * 5),
        ("a picture", [None] * 5),
    ],
)
def test_times_of_a_stack(tmp_path: Path, about: str, times_s: list[float | None]) -> None:
    cv2.imwritemulti(str(tmp_path / "a.tif"), list(BYTES))
    with_text(tmp_path / "a.tif", about)
    sequence = open_sequence(tmp_path, CAMERA)
    assert [frame.time_s for frame in sequence] == times_s
    assert np.array_equal(read_all(sequence), BYTES)


def test_a_stack_without_directories_is_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tif"), BYTES[0])
    with_text(tmp_path / "a.tif", "ImageJ=1.53\nimages=9000\n")
    with pytest.raises(RendezviewError, match="9000 pictures without directories"):
        open_sequence(tmp_path, CAMERA)


def test_stacks_and_single_pictures_are_one_sequence(tmp_path: Path) -> None:
    cv2.imwritemulti(str(tmp_path / "run_2.tif"), list(BYTES[:3]))
    cv2.imwrite(str(tmp_path / "run_10.tif"), BYTES[3])
    assert np.array_equal(read_all(open_sequence(tmp_path, CAMERA)), BYTES[:4])


def test_a_higher_float_than_the_samples_have_is_an_error(tmp_path: Path) -> None:
    pages = np.full((9, 48, 64), 0.5, np.float32)
    pages[1, 3, 3] = 70_000.0
    cv2.imwritemulti(str(tmp_path / "a.tif"), list(pages))
    with pytest.raises(RendezviewError, match="page 1: a level of 70000"):
        open_sequence(tmp_path, CAMERA)[1].read()


@pytest.mark.parametrize(
    ("seconds", "order", "word"),
    [
        ([0, 1, 2, 3, 4], [0, 1, 2, 3, 4], None),
        ([0, 2, 1, 3, 4], [0, 2, 1, 3, 4], "1 of 5 pictures come after pictures of a later stamp"),
        ([4, 3, 2, 1, 0], [4, 3, 2, 1, 0], "4 of 5 pictures come after"),
        ([0, 1, 1, 3, 4], [0, 1, 3, 4], "1 of 5 pictures have the stamp of another one"),
        ([1, 2, 3, 4, 0], [4, 0, 1, 2, 3], "1 of 5 pictures come after"),
        ([7, 7, 7, 7, 7], [0, 1, 2, 3, 4], "all 5 frames have one time"),
    ],
)
def test_frames_come_in_the_order_of_their_times(
    tmp_path: Path, seconds: list[int], order: list[int], word: str | None
) -> None:
    for k, second in enumerate(seconds):
        date = f"2026-01-01T00:00:0{second}"
        write_fits(tmp_path / f"{k}.fits", BYTES[k], DATE_OBS=date, ROWORDER="TOP-DOWN")
    sequence = open_sequence(tmp_path, CAMERA)
    assert np.array_equal(read_all(sequence), BYTES[order])
    times_s = [frame.time_s for frame in sequence]
    assert times_s == ([None] * 5 if len(set(seconds)) == 1 else sorted(times_s))
    assert (word or "") in " ".join(sequence.notes)
    assert word or not sequence.notes


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("place", [0, 10**6, 2**63 - 1, 2**64 - 1])
def test_a_directory_beyond_the_end_is_named(tmp_path: Path, order: str, place: int) -> None:
    content = bytearray(big_tiff(BYTES[:1], order))
    struct.pack_into(order + "Q", content, 8, place)
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(RendezviewError, match=r"a\.tif: not a picture that can be read"):
        open_sequence(tmp_path, CAMERA)


def test_directories_in_a_circle_end(tmp_path: Path) -> None:
    content = bytearray(big_tiff(BYTES[:1]))
    struct.pack_into("<Q", content, len(content) - 8, struct.unpack_from("<Q", content, 8)[0])
    (tmp_path / "a.tif").write_bytes(content)
    assert len(open_sequence(tmp_path, CAMERA)) == 1


def test_a_new_format_is_one_line_of_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = Format(
        lambda path: ([Picture(path, path.name, k, 0.5 * k) for k in range(5)], ["of NumPy"]),
        lambda path, place: np.load(path)[place],
    )
    monkeypatch.setitem(FORMATS, ".npy", arrays)
    np.save(tmp_path / "a.npy", WORDS)
    for path in (tmp_path, tmp_path / "a.npy"):
        sequence = open_sequence(path, CAMERA)
        assert np.array_equal(read_all(sequence), WORDS >> 4)
        assert sequence[4].time_s == 2.0
        assert "of NumPy" in sequence.notes
