"""BOP scenes: ``scene_camera.json``, ``scene_gt.json`` and ``gray/`` or ``rgb/``.

Lengths are millimetres in the files, metres here. Our own scenes also have a ``camera.json``
with the image size and the lens distortion, which BOP does not have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera, intrinsics_of
from rendezview.geometry.pose import Pose, nearest_rotation
from rendezview.io.camera_files import load_camera
from rendezview.io.files import checked, read_json
from rendezview.io.plausible import questioned
from rendezview.io.sequences.fitting import fitted
from rendezview.io.sequences.frame import Frame, GreyImage, Sequence
from rendezview.io.sequences.images import list_images, read_grey

Listed = TypeVar("Listed")
_Nine = Annotated[list[FiniteFloat], Field(min_length=9, max_length=9)]
_Three = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class SceneCamera(BaseModel):
    """A frame's camera."""

    model_config = ConfigDict(strict=True)

    cam_K: _Nine  # row-wise, px
    timestamp_s: FiniteFloat | None = None


class SceneTruth(BaseModel):
    """An object in a frame."""

    model_config = ConfigDict(strict=True)

    cam_R_m2c: _Nine  # row-wise
    cam_t_m2c: _Three  # mm
    obj_id: int


@dataclass(frozen=True, slots=True)
class Entry:
    """What a scene says of a frame."""

    im_id: int
    name: str
    fetch: Callable[[], GreyImage]
    camera: SceneCamera | None
    camera_at: str  # where that is said, for messages
    truth: list[SceneTruth]
    truth_at: str


_SCENE_CAMERA = TypeAdapter(dict[str, SceneCamera])
_SCENE_TRUTH = TypeAdapter(dict[str, list[SceneTruth]])
_CAMERA_EXTRA = TypeAdapter(dict[str, object])


def open_bop_scene(
    folder: Path, camera: Camera | None = None, obj_id: int | None = None
) -> Sequence:
    """Open a BOP scene; frames are in ascending order.

    Focal lengths and principal point come from ``scene_camera.json``; image size and distortion
    from the scene's ``camera.json``. Without it, the size is that of the first image and there is
    no distortion. The scene's number is the folder's name if that is a number, else ``scene_id`` of
    ``camera.json``, else 1.

    Args:
        folder: has ``scene_camera.json``.
        camera: used for all frames instead of the scene's own.
        obj_id: the object that is the target, if frames show several. Frames with several
            instances of it have no truth.

    Raises:
        RendezviewError: a file is missing or wrong, or frames show several objects
            and ``obj_id`` is not given.
    """
    cameras_path, truth_path = folder / "scene_camera.json", folder / "scene_gt.json"
    cameras = _by_number(_SCENE_CAMERA, cameras_path, "a BOP scene")
    if not cameras:
        raise RendezviewError(f"{cameras_path}: lists no frames: write the scene again")
    truth: dict[int, list[SceneTruth]] = {}
    if truth_path.is_file():
        truth = _by_number(_SCENE_TRUTH, truth_path, "BOP truth")
    images_folder, images = _images(folder)
    base = camera if camera is not None else _scene_camera(folder, next(iter(images.values())))
    bits, notes = fitted(list(images.values()), base, images_folder)

    def entries() -> Iterator[Entry]:
        for im_id, entry in sorted(cameras.items()):
            path = images.get(im_id, images_folder / f"{im_id:06d}.png")
            yield Entry(
                im_id, path.name, partial(read_grey, path, bits), entry,
                f"{cameras_path}: {im_id}.cam_K", truth.get(im_id, []), f"{truth_path}: {im_id}",
            )  # fmt: skip

    return scene_of(folder, entries(), base, camera, obj_id, notes, _scene_id(folder))


def scene_of(
    source: Path, entries: Iterable[Entry], base: Camera, camera: Camera | None,
    obj_id: int | None, notes: tuple[str, ...], scene_id: int = 1,
) -> Sequence:  # fmt: skip
    """The frames of a scene, by what it says of them; arguments as for `open_bop_scene`.

    Args:
        base: size and lens of the frames' cameras, where ``camera`` is None.

    Raises:
        RendezviewError: an entry is wrong, has no camera, or shows several objects.
    """
    frames, several = list[Frame](), 0
    for entry in entries:
        own, time_s = camera, None
        if entry.camera is not None:
            time_s = entry.camera.timestamp_s
            own = camera or _with_matrix(base, entry.camera.cam_K, entry.camera_at)
        if own is None:
            raise RendezviewError(f"{entry.camera_at}: missing: give a camera file")
        shown = _chosen(entry.truth, obj_id, entry.truth_at)
        several += len(shown) > 1
        pose = _pose_of(shown[0], entry.truth_at) if len(shown) == 1 else None
        of = shown[0].obj_id if shown else (obj_id or 1)
        frames.append(Frame(entry.im_id, entry.name, time_s, own, pose, of, entry.fetch))
    if several:
        said = f"{several} of {len(frames)} frames show the target several times"
        notes = (*notes, f"{said}: they have no truth")
    return Sequence(scene_id, tuple(frames), source, notes)


def _by_number(adapter: TypeAdapter[dict[str, Listed]], path: Path, what: str) -> dict[int, Listed]:
    """The entries of a file of a scene, by the number of their frame."""
    numbered: dict[int, Listed] = {}
    for key, entry in checked(adapter, read_json(path, what), str(path)).items():
        if not (key.isascii() and key.isdigit()):
            raise RendezviewError(f"{path}: {key!r} is not a frame number: correct the file")
        numbered[int(key)] = entry
    return numbered


def _images(folder: Path) -> tuple[Path, dict[int, Path]]:
    """The image folder, and its images with numbers as names; grey ones are preferred."""
    for name in ("gray", "rgb"):
        if (folder / name).is_dir():
            images = {
                int(path.stem): path
                for path in list_images(folder / name)
                if path.stem.isascii() and path.stem.isdigit()
            }
            if images:
                return folder / name, images
    raise RendezviewError(
        f"{folder}: no images named 000000.png, 000001.png … in gray/ or rgb/: add them"
    )


def _scene_camera(folder: Path, first_image: Path) -> Camera:
    if (folder / "camera.json").is_file():
        return load_camera(folder / "camera.json")
    height, width = read_grey(first_image).shape
    return Camera(width, height, 1.0, 1.0, 0.0, 0.0)  # its matrix is replaced for every frame


def _with_matrix(camera: Camera, values: list[float], where: str) -> Camera:
    """The camera with the matrix of a frame."""
    with explained(f"{where}: ", ": correct the scene"):
        fx, fy, cx, cy = intrinsics_of(values)
        if (fx, fy, cx, cy) == (camera.fx, camera.fy, camera.cx, camera.cy):
            return camera  # one object for all frames of a fixed camera
        return questioned(replace(camera, fx=fx, fy=fy, cx=cx, cy=cy), "give it by --camera")


def _chosen(entries: list[SceneTruth], obj_id: int | None, where: str) -> list[SceneTruth]:
    """The instances of the target."""
    if obj_id is not None:
        entries = [entry for entry in entries if entry.obj_id == obj_id]
    if len({entry.obj_id for entry in entries}) > 1:
        objects = ", ".join(str(entry.obj_id) for entry in entries)
        raise RendezviewError(
            f"{where}: several objects ({objects}) but one target is tracked: choose one "
            f"by its obj_id, or keep one entry per frame"
        )
    return entries


def _pose_of(entry: SceneTruth, where: str) -> Pose:
    """camera_from_target of an object."""
    with explained(f"{where}: cam_R_m2c: ", ": correct the scene"):
        rotation = nearest_rotation(np.reshape(entry.cam_R_m2c, (3, 3)))
    return Pose(rotation, np.asarray(entry.cam_t_m2c) / 1000.0)


def _scene_id(folder: Path) -> int:
    name = folder.resolve().name
    if name.isascii() and name.isdigit():
        return int(name)
    camera_path = folder / "camera.json"
    if camera_path.is_file():
        extra = checked(_CAMERA_EXTRA, read_json(camera_path, "a camera file"), str(camera_path))
        scene_id = extra.get("scene_id")
        if isinstance(scene_id, int) and not isinstance(scene_id, bool):
            return scene_id
    return 1
