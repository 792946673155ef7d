"""Writing BOP scenes."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera, LensModel
from rendezview.geometry.pose import Pose
from rendezview.io.file_lock import FolderLock
from rendezview.io.files import StrPath, atomic_write_text, make_folder
from rendezview.io.sequences.images import write_png

_SCENE_FILES = ("scene_gt.json", "scene_camera.json", "camera.json")  # in order of removal
_PICTURE_FOLDERS = ("gray", "rgb", "mask_visib")


class BopSceneWriter:
    """Writes a BOP scene: ``gray/``, ``mask_visib/`` and, when closed, the JSON files.

    Use it as a context manager. An exception (Ctrl-C too) removes the pictures written so far, so a
    folder has a complete scene or none. ``scene_gt.json`` is written last: if it exists, the scene
    is complete.

    Args:
        folder: of the scene; created if it does not exist.
        camera: of all frames; saved with its distortion as ``camera.json``.
        scene_id: saved in ``camera.json``, default 1. If the folder's name is a number, that is the
            scene's number, and ``scene_id`` must equal it.
        overwrite: remove a scene that is already there.

    Raises:
        RendezviewError: the folder already has a scene, another run writes one there, or it cannot
            be written.
        ValueError: ``scene_id`` is negative or contradicts the folder's name.
    """

    def __init__(
        self,
        folder: StrPath,
        camera: Camera,
        scene_id: int | None = None,
        *,
        overwrite: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self.camera = camera
        name = self.folder.resolve().name
        named = int(name) if name.isascii() and name.isdigit() else None
        if scene_id is not None and (scene_id < 0 or named not in (None, scene_id)):
            raise ValueError(f"scene_id {scene_id} contradicts the folder {self.folder}")
        self.scene_id = next((n for n in (scene_id, named) if n is not None), 1)
        self._cameras: dict[str, dict[str, Any]] = {}
        self._truth: dict[str, list[dict[str, Any]]] = {}
        self._written: list[Path] = []
        self._closed = False
        self._lock = FolderLock(self.folder)
        try:
            if _holds_scene(self.folder):
                if not overwrite:
                    raise RendezviewError(
                        f"{self.folder}: already has a scene: choose another folder, or "
                        f"overwrite it (--overwrite)"
                    )
                _remove_scene(self.folder)
            make_folder(self.folder / "gray")
        except BaseException:
            self._lock.release()
            raise

    def add(
        self,
        im_id: int,
        image: npt.NDArray[np.uint8],
        camera_from_target: Pose | None,
        time_s: float | None,
        obj_id: int = 1,
        mask: npt.NDArray[Any] | None = None,
    ) -> None:
        """Write one frame.

        Args:
            im_id: its number, 0 or more, used once.
            image: uint8 (height, width) of the camera.
            camera_from_target: the truth, or None if unknown.
            time_s: the time, or None.
            obj_id: the object's number in ``scene_gt.json``.
            mask: (height, width), nonzero at the target's visible pixels.

        Raises:
            RendezviewError: a picture cannot be written.
            ValueError: wrong shape or type, number used twice, or already closed.
        """
        shape = (self.camera.height, self.camera.width)
        if self._closed:
            raise ValueError("this scene is closed")
        if im_id < 0 or str(int(im_id)) in self._cameras:
            raise ValueError(f"im_id must not be negative or used twice: {im_id}")
        if image.shape != shape or image.dtype != np.uint8:
            raise ValueError(f"image must be uint8 {shape}, not {image.dtype} {image.shape}")
        if mask is not None and mask.shape != shape:
            raise ValueError(f"mask must be {shape}, not {mask.shape}")
        if time_s is not None and not math.isfinite(time_s):
            raise ValueError(f"time_s must be finite or None, not {time_s}")
        self._write_png(Path("gray") / f"{im_id:06d}.png", image)
        if mask is not None:
            visible = np.where(mask, 255, 0).astype(np.uint8)
            self._write_png(Path("mask_visib") / f"{im_id:06d}_000000.png", visible)
        entry: dict[str, Any] = {"cam_K": self.camera.matrix.ravel().tolist(), "depth_scale": 1.0}
        if time_s is not None:
            entry["timestamp_s"] = float(time_s)
        self._cameras[str(int(im_id))] = entry
        self._truth[str(int(im_id))] = (
            []
            if camera_from_target is None
            else [
                {
                    "cam_R_m2c": camera_from_target.rotation.ravel().tolist(),
                    "cam_t_m2c": (camera_from_target.translation_m * 1000.0).tolist(),
                    "obj_id": int(obj_id),
                }
            ]
        )

    def close(self) -> None:
        """Write the JSON files; the scene is complete. Closing again does nothing.

        Raises:
            RendezviewError: they cannot be written, or no frame was added.
        """
        if self._closed:
            return
        if not self._cameras:
            self.abort()
            raise RendezviewError(f"{self.folder}: a scene needs at least one frame: add one")
        camera = self.camera
        files: dict[str, Any] = {
            "camera.json": {
                "width": camera.width,
                "height": camera.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "distCoeffs": list(camera.distortion),
                **({"fisheye_model": 1} if camera.lens_model is LensModel.FISHEYE else {}),
                **({"intrinsics_covariance": camera.covariance} if camera.covariance else {}),
                "depth_scale": 1.0,
                "scene_id": self.scene_id,
            },
            "scene_camera.json": self._cameras,
            "scene_gt.json": self._truth,
        }
        try:
            for name, content in files.items():
                self._written.append(self.folder / name)
                atomic_write_text(self.folder / name, _lines(content))
        except BaseException:
            self.abort()
            raise
        self._closed = True
        self._lock.release()

    def abort(self) -> None:
        """Remove the written files; nothing more can be added."""
        if self._closed:
            return
        self._closed = True
        for path in self._written:
            with contextlib.suppress(OSError):
                path.unlink()
        for folder in ("gray", "mask_visib", "."):
            with contextlib.suppress(OSError):  # not empty: it has files of the user
                (self.folder / folder).rmdir()
        self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _write_png(self, name: Path, image: npt.NDArray[np.uint8]) -> None:
        path = self.folder / name
        make_folder(path.parent)
        self._written.append(path)
        write_png(path, image)


def _lines(content: dict[str, Any]) -> str:
    """JSON with one top-level entry per line, as the BOP toolkit writes it."""
    entries = (f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
    return "{\n" + ",\n".join(entries) + "\n}\n"


def _holds_scene(folder: Path) -> bool:
    pictures = any(any((folder / name).glob("*")) for name in ("gray", "rgb"))
    return pictures or any((folder / name).exists() for name in _SCENE_FILES[:2])


def _remove_scene(folder: Path) -> None:
    """Remove only the files of a scene: numbered pictures and the JSON files."""
    pictures = [
        path
        for name in _PICTURE_FOLDERS
        for path in (folder / name).glob("[0-9]*")
        if path.is_file()
    ]
    try:
        for path in [folder / name for name in _SCENE_FILES] + pictures:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise RendezviewError(
            f"{error.filename}: cannot be removed ({error.strerror}): remove the scene yourself"
        ) from error
