"""SPEED and SPEED+ (Stanford's spacecraft pose data sets), read as they are.

A labels file is a JSON list of ``{"filename", "q_vbs2tango", "r_Vo2To_vbs"}`` (SPEED+:
``q_vbs2tango_true``, ``r_Vo2To_vbs_true``); test lists may have file names only.

**Direction of the quaternion.** ``r_Vo2To_vbs`` is the position of the target's
origin in the camera frame (VBS, vision-based sensor), metres: our ``translation_m``.
``q_vbs2tango`` is scalar-first and describes the passive rotation, the attitude of the Tango
frame in the camera frame: the data sets' ``quat2dcm(q)`` has ``+2 (q1 q2 + q0 q3)``
in its first row, so it is the *transpose* of the usual active matrix R(q), which has
``2 (q1 q2 - q0 q3)`` there, and maps camera coordinates to target coordinates. Their
projection (ESA's speed-utils and SPEED+'s baseline alike) is
``p_cam = quat2dcm(q)ᵀ p_target + r``. Two transposes cancel:

    camera_from_target.rotation = quat2dcm(q)ᵀ = R(q)

with R(q) the usual Hamilton matrix of `Pose.from_quat_wxyz`. The camera frame is OpenCV's.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.camera_files import load_camera
from rendezview.io.files import checked, read_json
from rendezview.io.sequences.fitting import fitted
from rendezview.io.sequences.frame import Frame, Sequence
from rendezview.io.sequences.images import read_grey


class _Label(BaseModel):
    model_config = ConfigDict(strict=True)

    filename: Annotated[str, Field(min_length=1)]
    quat_wxyz: Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)] | None = Field(
        None, validation_alias=AliasChoices("q_vbs2tango", "q_vbs2tango_true")
    )
    translation_m: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] | None = Field(
        None, validation_alias=AliasChoices("r_Vo2To_vbs", "r_Vo2To_vbs_true")
    )


_LABELS = TypeAdapter(list[_Label])


def speed_camera_file(folder: Path) -> Path | None:
    """``camera.json`` of a SPEED folder or of its parent; None if neither has one."""
    for candidate in (folder / "camera.json", folder.resolve().parent / "camera.json"):
        if candidate.is_file():
            return candidate
    return None


def find_label_files(folder: Path) -> list[Path]:
    """The SPEED label files of a folder: JSON files with a list of file names."""
    return [path for path in sorted(folder.glob("*.json")) if is_label_file(path)]


def is_label_file(path: Path) -> bool:
    """Whether a file looks like SPEED labels; only its first characters are read."""
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            head = file.read(4096)
    except OSError:
        return False
    return head.lstrip("\ufeff \t\r\n").startswith("[") and '"filename"' in head


def open_speed(path: Path, camera: Camera | None = None) -> Sequence:
    """A SPEED or SPEED+ folder with one labels file, or the labels file itself.

    Frames are numbered from 0 in the order of the labels; they have no times. Images
    are searched in ``images/``, ``images/<name of the labels file>/`` and beside the labels.

    Args:
        path: the folder (SPEED+: ``synthetic``, ``lightbox`` or ``sunlamp``) or labels file.
        camera: takes precedence over the data set's ``camera.json``.

    Raises:
        RendezviewError: no or several labels files, no camera, no images, bad labels.
    """
    labels_path = path
    if path.is_dir():
        found = find_label_files(path)
        if len(found) != 1:
            listed = ", ".join(str(file) for file in found) or "none found"
            raise RendezviewError(
                f"{path}: needs exactly one SPEED labels file ({listed}): name the one to use"
            )
        labels_path = found[0]
    folder = labels_path.parent
    if camera is None:
        camera_path = speed_camera_file(folder)
        if camera_path is None:
            raise RendezviewError(
                f"{labels_path}: no camera.json in {folder} or its parent: put the data "
                f"set's there, or give a camera file"
            )
        camera = load_camera(camera_path)
    labels = checked(_LABELS, read_json(labels_path, "SPEED labels"), str(labels_path))
    if not labels:
        raise RendezviewError(f"{labels_path}: the list of labels is empty: use another file")
    images = _images_folder(labels_path, labels[0].filename)
    bits, notes = fitted([images / label.filename for label in labels], camera, images)
    frames = tuple(
        Frame(
            im_id=index,
            name=label.filename,
            time_s=None,
            camera=camera,
            camera_from_target=_pose(label, f"{labels_path}: {index} ({label.filename})"),
            obj_id=1,
            fetch=partial(read_grey, images / label.filename, bits),
        )
        for index, label in enumerate(labels)
    )
    return Sequence(scene_id=1, frames=frames, source=path, notes=notes)


def _images_folder(labels_path: Path, first: str) -> Path:
    folder = labels_path.parent
    candidates = (folder / "images", folder / "images" / labels_path.stem, folder)
    for candidate in candidates:
        if (candidate / first).is_file():
            return candidate
    places = ", ".join(str(candidate) for candidate in candidates)
    raise RendezviewError(
        f"{labels_path}: its first image {first} is in none of {places}: unpack the images there"
    )


def _pose(label: _Label, where: str) -> Pose | None:
    if label.quat_wxyz is None and label.translation_m is None:
        return None
    if label.quat_wxyz is None or label.translation_m is None:
        missing = "q_vbs2tango" if label.quat_wxyz is None else "r_Vo2To_vbs"
        raise RendezviewError(f"{where}: {missing}: missing, add it or remove the other")
    with explained(f"{where}: ", ": correct the labels"):
        return Pose.from_quat_wxyz(label.quat_wxyz, label.translation_m)
