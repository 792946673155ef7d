"""Image files: reading one, listing a folder, finding its camera file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import load_camera
from rendezview.io.files import atomic_write, read_bytes
from rendezview.io.sequences.decoding import decode_grey, is_animated
from rendezview.io.sequences.frame import GreyImage
from rendezview.io.sequences.stacks import first_levels, has_format

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".jfif", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp"}
)
CAMERA_NAMES = ("camera.json", "camera.yaml", "camera.yml", "cam_K.txt")


def read_grey(path: Path, bits: int | None = None) -> GreyImage:
    """An image file as grey uint8 (height, width), not rotated by its EXIF tag.

    Args:
        path: the file.
        bits: in use of 16-bit levels; None: all.

    Raises:
        RendezviewError: missing, unreadable, not an image, cut short, or a level needs more bits.
    """
    content = read_bytes(path, "an image")
    with explained(f"{path}: ", faults=RendezviewError):
        image = decode_grey(content, bits or 16)
    if image is None:
        why = "animated" if is_animated(content) else "damaged, cut short or of another kind"
        raise RendezviewError(f"{path}: not an image that can be read ({why}): replace the file")
    return image


def write_png(path: Path, picture: npt.NDArray[np.uint8]) -> None:
    """Write a picture, (H, W) grey or (H, W, 3) blue, green, red, as PNG.

    Raises:
        RendezviewError: it cannot be encoded or written.
    """
    encoded, content = cv2.imencode(".png", picture)
    if not encoded:
        raise RendezviewError(f"{path}: the picture cannot be encoded as PNG")
    with atomic_write(path, durable=False) as file:
        file.write(content.tobytes())


def list_images(
    folder: Path,
    wanted: Callable[[Path], bool] = lambda path: path.suffix.lower() in IMAGE_SUFFIXES,
) -> list[Path]:
    """The image files of a folder in natural order (2.png before 10.png), without hidden files."""
    try:
        found = [
            path
            for path in folder.iterdir()
            if wanted(path) and not path.name.startswith(".") and path.is_file()
        ]
    except OSError as error:
        raise RendezviewError(
            f"{folder}: this folder cannot be read ({error.strerror}): check its permissions"
        ) from error
    return sorted(found, key=lambda path: natural_key(path.name))


def natural_key(name: str) -> tuple[list[tuple[int, str]], str]:
    """Sort key that compares runs of digits as numbers."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(int(p), "") if p[0] in "0123456789" else (-1, p.lower()) for p in parts], name


def camera_beside(folder: Path, image: Path | None = None) -> Camera | None:
    """The camera of one of `CAMERA_NAMES` in a folder, if any; an image has the size it lacks."""

    def size() -> tuple[int, int]:
        assert image is not None
        levels = first_levels(image) if has_format(image) else read_grey(image)
        return levels.shape[1], levels.shape[0]

    for name in CAMERA_NAMES:
        if (folder / name).is_file():
            return load_camera(folder / name, None if image is None else size)
    return None


def required_camera(
    camera: Camera | None, folder: Path, source: Path, image: Path | None = None
) -> Camera:
    """The camera given, else the one found in ``folder``; ``image`` as for `camera_beside`.

    Raises:
        RendezviewError: there is none.
    """
    found = camera if camera is not None else camera_beside(folder, image)
    if found is None:
        raise RendezviewError(
            f"{source}: no camera: give a camera file, or put one into {folder} "
            f"as {' or '.join(CAMERA_NAMES)}"
        )
    return found
