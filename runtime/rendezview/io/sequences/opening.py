"""Opens image sequences of all kinds."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.files import StrPath, check_regular
from rendezview.io.plausible import time_doubts
from rendezview.io.sequences.bop import open_bop_scene
from rendezview.io.sequences.bop_shards import open_bop_shard
from rendezview.io.sequences.folder import open_image_folder, open_images
from rendezview.io.sequences.frame import Sequence
from rendezview.io.sequences.images import IMAGE_SUFFIXES, read_grey, required_camera
from rendezview.io.sequences.mcap_messages import mcap_messages
from rendezview.io.sequences.order import in_order
from rendezview.io.sequences.recordings import open_recording, split_topic
from rendezview.io.sequences.ros_messages import BAG_SUFFIXES, bag_messages, is_ros2_folder
from rendezview.io.sequences.speed import (
    find_label_files,
    is_label_file,
    open_speed,
    speed_camera_file,
)
from rendezview.io.sequences.stacks import has_format
from rendezview.io.sequences.video import VIDEO_SUFFIXES, open_video


def open_sequence(
    path: StrPath, camera: Camera | None = None, *, obj_id: int | None = None
) -> Sequence:
    """Open a BOP scene or shard, a SPEED folder, images, a video, a ROS bag or an MCAP file.

    At most five images are read (of a recording, all messages once); frames are read on demand.

    Args:
        path: the folder; or an image, a video, a ``scene_camera.json``, a SPEED labels file; or
            a recording, with ``#topic`` after it if several topics have pictures.
        camera: of all frames; takes precedence over the sequence's own. Required for a folder of
            images or a video without a ``camera.json`` or ``camera.yaml``, and for a recording
            without calibration messages.
        obj_id: the object of a BOP scene that is the target, if frames show several.

    What is odd about the frames, their times and their camera is in the notes of the sequence.

    Raises:
        RendezviewError: missing, none of these kinds, incomplete, no camera, or one from which
            nothing good can follow.
    """
    opened = _risen(_opened(path, camera, obj_id))
    cameras = dict.fromkeys(d for frame in opened.frames[:1] for d in frame.camera.doubts)
    times = time_doubts([frame.time_s for frame in opened])
    return replace(opened, notes=(*opened.notes, *cameras, *times))


def _risen(sequence: Sequence) -> Sequence:
    """A sequence whose times rise, if all its frames have one."""
    times_s = [frame.time_s for frame in sequence if frame.time_s is not None]
    if len(times_s) < len(sequence) or all(a < b for a, b in itertools.pairwise(times_s)):
        return sequence
    if len(set(times_s)) == 1:
        frames = tuple(replace(frame, time_s=None) for frame in sequence)
        said = f"all {len(frames)} frames have one time, {times_s[0]:g} s, which is left out"
        return replace(sequence, frames=frames, notes=(*sequence.notes, said))
    order, notes = in_order(times_s)
    frames = tuple(sequence.frames[k] for k in order)
    return replace(sequence, frames=frames, notes=(*sequence.notes, *notes))


def _opened(path: StrPath, camera: Camera | None, obj_id: int | None) -> Sequence:
    source, topic = Path(path), None
    if not source.exists():
        text, topic = split_topic(str(path))
        source = Path(text)
    check_regular(source, "a sequence of images")
    suffix = source.suffix.lower()
    if suffix == ".mcap" and source.is_file():
        return open_recording(source, mcap_messages, topic, camera)
    bag = suffix in BAG_SUFFIXES and source.is_file()
    if bag or (source.is_dir() and is_ros2_folder(source)):
        return open_recording(source, bag_messages, topic, camera)
    if topic is not None and source.exists():
        raise RendezviewError(f"{path}: only recordings have topics: leave out #{topic}")
    if source.is_dir():
        return _open_folder(source, camera, obj_id)
    if not source.exists():
        raise RendezviewError(
            f"{path}: no such file or folder: give a BOP scene, a folder of images, a SPEED "
            f"folder, a video, a ROS bag or an MCAP file"
        )
    if source.name in ("scene_camera.json", "scene_gt.json"):
        return open_bop_scene(source.parent, camera, obj_id)
    if suffix == ".tar":
        return open_bop_shard(source, camera, obj_id)
    if suffix == ".json" and is_label_file(source):
        return open_speed(source, camera)
    if suffix in VIDEO_SUFFIXES:
        return open_video(source, camera)
    if suffix in IMAGE_SUFFIXES or has_format(source):
        if not has_format(source):
            read_grey(source)
        return open_images([source], required_camera(camera, source.parent, source, source), source)
    raise RendezviewError(
        f"{path}: no sequence of images that is read: give a BOP scene, a folder of images (PNG, "
        f"JPEG, TIFF, FITS …), a SPEED folder, a ROS bag (.bag .db3), an .mcap file or a video "
        f"({' '.join(sorted(VIDEO_SUFFIXES))})"
    )


def _open_folder(folder: Path, camera: Camera | None, obj_id: int | None) -> Sequence:
    if (folder / "scene_camera.json").is_file():
        return open_bop_scene(folder, camera, obj_id)
    if (camera is not None or speed_camera_file(folder) is not None) and find_label_files(folder):
        return open_speed(folder, camera)
    scenes = sorted(child.parent for child in folder.glob("*/scene_camera.json"))
    if scenes:
        raise RendezviewError(
            f"{folder}: holds {len(scenes)} BOP scenes: give one of them, such as {scenes[0]}"
        )
    return open_image_folder(folder, camera)
