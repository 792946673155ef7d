"""Shards of BOP data sets: tar files with ``KEY.rgb.jpg``, ``KEY.camera.json``, ``KEY.gt.json``.

This is the form of WebDataset in which BOP's training data and HOT3D are published.
"""

from __future__ import annotations

import tarfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pydantic import TypeAdapter

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera
from rendezview.io.files import Checked, checked, parse_json
from rendezview.io.sequences.bop import Entry, SceneCamera, SceneTruth, scene_of
from rendezview.io.sequences.decoding import decode_grey
from rendezview.io.sequences.fitting import decoded, fitted_levels, sampled
from rendezview.io.sequences.frame import GreyImage, Sequence

_IMAGES = ("gray.png", "gray.tif", "gray.jpg", "rgb.png", "rgb.jpg", "rgb.jpeg")  # as preferred
_CAMERA, _TRUTH = TypeAdapter(SceneCamera), TypeAdapter(list[SceneTruth])


@dataclass(frozen=True, slots=True)
class _Part:
    """A file in a shard."""

    shard: Path
    name: str
    start: int
    size: int

    def read(self) -> bytes:
        """Its content.

        Raises:
            RendezviewError: the shard is gone or shorter than it was.
        """
        try:
            with self.shard.open("rb") as stream:
                stream.seek(self.start)
                content = stream.read(self.size)
        except OSError as error:
            raise RendezviewError(f"{self.shard}: cannot be read ({error.strerror})") from error
        if len(content) < self.size:
            raise RendezviewError(f"{self.shard}: {self.name} is cut short: replace the shard")
        return content

    def content(self, adapter: TypeAdapter[Checked]) -> Checked:
        """Its JSON as the type of an adapter; errors of `checked` and `parse_json`."""
        where = f"{self.shard}: {self.name}"
        return checked(adapter, parse_json(self.read(), where), where)


def open_bop_shard(path: Path, camera: Camera | None = None, obj_id: int | None = None) -> Sequence:
    """The frames of a shard, in the order of their keys.

    A frame's number is the last one of its key, or its place where these repeat. Size and truth are
    as for `open_bop_scene`, without distortion.

    Raises:
        RendezviewError: no shard, a frame without image or camera, or several objects without
            ``obj_id``.
    """
    samples = _samples(path)
    images: dict[str, _Part] = {}
    for key, parts in samples.items():
        for name in _IMAGES:
            if name in parts:
                images.setdefault(key, parts[name])
    if not images:
        raise RendezviewError(
            f"{path}: no pictures of a BOP shard (KEY.rgb.jpg, KEY.rgb.png or KEY.gray.png) in it: "
            "give one, or unpack the archive and give its folder"
        )
    keys = sorted(images)
    pictures, marks = decoded(images[keys[k]].read() for k in sampled(len(keys)))
    if not pictures:
        raise RendezviewError(f"{path}: none of its pictures can be read: replace the shard")
    height, width = pictures[0].shape
    base = camera if camera is not None else Camera(width, height, 1.0, 1.0, 0.0, 0.0)
    bits, notes = fitted_levels(pictures, marks, base, path)
    numbers = [_number(key) for key in keys]
    if None in numbers or len(set(numbers)) < len(numbers):
        numbers = list(range(len(keys)))

    def entries() -> Iterator[Entry]:
        for number, key in zip(numbers, keys, strict=True):
            at, truth_at = f"{path}: {key}.camera.json", f"{path}: {key}.gt.json"
            said, truth = (samples[key].get(name) for name in ("camera.json", "gt.json"))
            yield Entry(
                int(number or 0), images[key].name, partial(_grey, images[key], bits or 16),
                None if said is None else said.content(_CAMERA), f"{at}: cam_K",
                [] if truth is None else truth.content(_TRUTH), truth_at,
            )  # fmt: skip

    return scene_of(path, entries(), base, camera, obj_id, notes)


def _samples(path: Path) -> dict[str, dict[str, _Part]]:
    """Parts by key and by what follows the key's first dot."""
    found: dict[str, dict[str, _Part]] = defaultdict(dict)
    unread, why = f"{path}: not a tar file that can be read (", "): damaged, packed or cut short"
    faults = (tarfile.TarError, OSError, ValueError)
    with explained(unread, why, faults), tarfile.open(path, "r:") as archive:
        for member in archive:
            kind = member.name.rpartition("/")[2].partition(".")[2]
            if member.isreg() and kind:
                key = member.name.removesuffix(f".{kind}")
                part = _Part(path, member.name, member.offset_data, member.size)
                found[key][kind.lower()] = part
    return found


def _number(key: str) -> int | None:
    last = key.rpartition("/")[2].rpartition("_")[2]
    return int(last) if last.isascii() and last.isdigit() else None


def _grey(part: _Part, bits: int) -> GreyImage:
    image = decode_grey(part.read(), bits)
    if image is None:
        raise RendezviewError(f"{part.shard}: {part.name}: not an image that can be read")
    return image
