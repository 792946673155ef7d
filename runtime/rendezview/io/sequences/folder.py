"""A bare folder of images, in natural order, with one camera."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.fitting import fitted
from rendezview.io.sequences.frame import Sequence
from rendezview.io.sequences.images import list_images, read_grey, required_camera
from rendezview.io.sequences.stacks import has_format, open_stacks

# Pictures of other formats, so that they are named.
_OTHERS = (
    ".jp2", ".j2k", ".jxl", ".gif", ".heic", ".heif", ".avif", ".exr", ".hdr", ".raw", ".dng",
    ".nef", ".cr2", ".arw", ".npy", ".svg", ".psd", ".pdf",
)  # fmt: skip


def open_image_folder(folder: Path, camera: Camera | None = None) -> Sequence:
    """The images of a folder: numbered from 0, without truth; times of FITS and TIFF stacks.

    Args:
        folder: the images, and the camera file if ``camera`` is None.
        camera: wins over a camera file in the folder.

    Raises:
        RendezviewError: no images, or no camera.
    """
    images = list_images(folder)
    if not images and (folder / "rgb").is_dir():  # with cam_K.txt beside it: FoundationPose
        images = list_images(folder / "rgb")
    if not images:
        images = list_images(folder, has_format)
    if not images:
        others = Counter(p.suffix.lower() for p in folder.iterdir() if p.suffix.lower() in _OTHERS)
        if others:
            listed = ", ".join(f"{count} {suffix}" for suffix, count in others.items())
            raise RendezviewError(
                f"{folder}: its files ({listed}) are of formats that are not read: convert them to "
                "PNG or TIFF, 8 or 16 bits a pixel"
            )
        raise RendezviewError(
            f"{folder}: no images in it, and it is no BOP scene (scene_camera.json) and no "
            f"SPEED folder (camera.json and labels): check the path"
        )
    return open_images(images, required_camera(camera, folder, folder, images[0]), folder)


def open_images(images: list[Path], camera: Camera, source: Path) -> Sequence:
    """Image files of one camera as a sequence, numbered from 0, without truth.

    Raises:
        RendezviewError: they are not of the camera's size.
    """
    if all(map(has_format, images)):
        return open_stacks(images, camera, source)
    bits, notes = fitted(images, camera, images[0].parent)
    pictures = ((path.name, None, partial(read_grey, path, bits)) for path in images)
    return Sequence.of_pictures(source, camera, pictures, notes)
