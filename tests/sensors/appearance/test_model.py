"""The model file: what is written is read, the rest is refused in words, nothing executes."""

from __future__ import annotations

import hashlib
import json
import pickle
import struct
import subprocess
import sys
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
from tests.waiting import MOST_S

from rendezview.errors import RendezviewError
from rendezview.geometry.symmetry import Symmetry
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.container import read_container, write_container
from rendezview.sensors.appearance.model.trees import Forest
from rendezview.sensors.appearance.model.view_model import Views

ARRAYS: dict[str, np.ndarray] = {
    "a": np.arange(6, dtype=np.float32).reshape(2, 3),
    "b": np.array([1, 2, 3], dtype=np.uint8),
    "empty": np.zeros((0, 4)),
}
HEADER = {"name": "x", "value": 0.1, "list": [1, None]}


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.rvm"
    write_container(path, HEADER, ARRAYS)
    return path


def refused(path, content: bytes) -> str:
    path.write_bytes(content)
    with pytest.raises(RendezviewError) as caught:
        read_container(path)
    message = str(caught.value)
    assert str(path) in message
    return message


def test_a_container_gives_back_what_was_put_in(small):
    header, arrays = read_container(small)
    assert header == HEADER
    assert set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype
        assert np.array_equal(arrays[name], array)
        assert not arrays[name].flags.writeable


def test_arrays_start_at_multiples_of_64_bytes(small):
    data = small.read_bytes()
    length = struct.unpack_from("<4sIQ", data)[2]
    table = json.loads(data[16 : 16 + length])["arrays"]
    for entry in table:
        start = 16 + length + entry["offset"]
        assert start % 64 == 0
        array = ARRAYS[entry["name"]]
        assert data[start : start + array.nbytes] == array.tobytes()


def test_the_same_content_gives_the_same_bytes_in_any_order(small, tmp_path):
    other = tmp_path / "other.rvm"
    write_container(other, dict(reversed(HEADER.items())), {k: ARRAYS[k] for k in reversed(ARRAYS)})
    assert other.read_bytes() == small.read_bytes()


def test_a_file_cut_off_anywhere_is_refused(small):
    data = small.read_bytes()
    for length in range(len(data)):
        refused(small, data[:length])
    refused(small, data + b"\0")


def test_a_flipped_bit_anywhere_is_refused(small):
    data = bytearray(small.read_bytes())
    for place in range(len(data)):
        bit = 1 << (place * 5 + place // 8) % 8
        data[place] ^= bit
        refused(small, bytes(data))
        data[place] ^= bit
    small.write_bytes(bytes(data))
    read_container(small)


def test_the_messages_say_what_is_wrong(small):
    data = small.read_bytes()
    assert "cut off" in refused(small, data[:-5])
    assert "cut off" in refused(small, data[:10])
    assert "checksum" in refused(small, data[:-33] + bytes([data[-33] ^ 1]) + data[-32:])
    newer = data[:4] + struct.pack("<I", 2) + data[8:]
    assert "format 2" in refused(small, newer)
    assert "update" in refused(small, newer)
    for other in (b"", b"RVM", b"\x89PNG\r\n\x1a\n", pickle.dumps({"a": 1}), b"solid ascii"):
        assert "not a rendezview model" in refused(small, other)


def sealed(header: object, body: bytes = b"") -> bytes:
    """A file with a right checksum around any header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    data = struct.pack("<4sIQ", b"RVM\n", 1, len(text)) + text + body
    return data + hashlib.sha256(data).digest()


@pytest.mark.parametrize(
    "header",
    [
        b"[" * 100_000,
        b'{"arrays": [], "bytes": Infinity, "header": {}}',
        b'{"arrays": [], "bytes": 1e400, "header": {}}',
        b"[]",
        b"null",
        b"\xff\xfe",
        {"arrays": 3, "bytes": 0, "header": {}},
        {"arrays": [3], "bytes": 0, "header": {}},
        {"arrays": [{}], "bytes": 0, "header": {}},
        {"arrays": [{"dtype": "|u1", "shape": [0], "offset": 0}], "bytes": 0, "header": {}},
        {"arrays": [], "bytes": 0, "header": 4},
    ],
    ids=range(11),
)
def test_a_well_sealed_but_senseless_header_is_refused(tmp_path, header):
    refused(tmp_path / "m.rvm", sealed(header))


@pytest.mark.parametrize(
    "change",
    [{"dtype": "|O"}, {"shape": [-1]}, {"shape": [9]}, {"offset": -64}, {"offset": 10**9}],
    ids=str,
)
def test_a_table_that_points_outside_its_data_is_refused(tmp_path, change):
    entry = {"name": "a", "dtype": "|u1", "shape": [8], "offset": 0} | change
    header = {"arrays": [entry], "bytes": 8, "header": {}}
    refused(tmp_path / "m.rvm", sealed(header, bytes(8)))


def test_objects_cannot_be_stored(tmp_path):
    with pytest.raises(ValueError, match="cannot hold"):
        write_container(tmp_path / "m.rvm", {}, {"a": np.array([{}], dtype=object)})
    assert list(tmp_path.iterdir()) == []


def test_missing_files_and_folders_are_told_apart(tmp_path):
    with pytest.raises(RendezviewError, match="no such model"):
        read_container(tmp_path / "none.rvm")
    with pytest.raises(RendezviewError, match="directory"):
        read_container(tmp_path)


def test_a_model_comes_back_the_same(tiny_model, tmp_path):
    tiny_model.save(tmp_path / "m.rvm")
    again = ViewModel.load(tmp_path / "m.rvm")
    for part, kind in (("views", Views), ("forest", Forest)):
        for f in fields(kind):
            a, b = (getattr(getattr(m, part), f.name) for m in (tiny_model, again))
            assert np.array_equal(a, b)
            assert a.dtype == b.dtype
    for f in fields(ViewModel):
        a, b = getattr(tiny_model, f.name), getattr(again, f.name)
        if isinstance(a, np.ndarray):
            assert np.array_equal(a, b, equal_nan=True)
        elif f.name == "held_out":
            assert asdict(a) == asdict(b)
        elif f.name not in ("views", "forest"):
            assert a == b


def test_a_model_keeps_its_symmetries_and_those_of_older_files(tiny_model, tmp_path):
    """Older files have no point: their axes pass through the origin."""
    aside = Symmetry("discrete", np.array([0.0, 0.0, 1.0]), np.pi, np.array([1.5, 1.0, 0.5]))
    older = Symmetry("continuous", np.array([0.0, 1.0, 0.0]), None)
    path = tmp_path / "symmetric.rvm"
    replace(tiny_model, symmetries=(aside, older)).save(path)
    found = ViewModel.load(path).symmetries
    assert [(s.kind, s.angle_rad) for s in found] == [("discrete", np.pi), ("continuous", None)]
    assert [s.point_m.tolist() for s in found] == [[1.5, 1.0, 0.5], [0.0, 0.0, 0.0]]
    header, _ = read_container(path)
    assert [s.get("point_m") for s in header["symmetries"]] == [[1.5, 1.0, 0.5], None]


def test_saving_a_loaded_model_gives_its_bytes_again(tiny_model_path, tiny_model, tmp_path):
    tiny_model.save(tmp_path / "m.rvm")
    assert (tmp_path / "m.rvm").read_bytes() == tiny_model_path.read_bytes()


@pytest.mark.parametrize(
    "change",
    [
        {"order": 1},
        {"order": 77},
        {"order": "two"},
        {"held_out": {}},
        {"held_out": None},
        {"provenance": None},
        {"sphere_radius_m": None},
    ],
    ids=str,
)
def test_a_model_that_does_not_hold_together_is_refused(tiny_model_path, tmp_path, change):
    header, arrays = read_container(tiny_model_path)
    path = tmp_path / "m.rvm"
    write_container(path, header | change, arrays)
    with pytest.raises(RendezviewError, match="does not hold together"):
        ViewModel.load(path)


@pytest.mark.parametrize("name", ["views.readings", "forest.left", "leaf_on", "centre_m"])
def test_a_model_without_one_of_its_arrays_or_with_a_short_one_is_refused(
    tiny_model_path, tmp_path, name
):
    header, arrays = read_container(tiny_model_path)
    path = tmp_path / "m.rvm"
    for changed in (
        {k: v for k, v in arrays.items() if k != name},
        arrays | {name: arrays[name][:-1]},
    ):
        write_container(path, header, changed)
        with pytest.raises(RendezviewError, match="does not hold together"):
            ViewModel.load(path)


def test_a_tree_that_looks_at_a_bin_beyond_the_signature_is_refused(tiny_model_path, tmp_path):
    header, arrays = read_container(tiny_model_path)
    component = arrays["forest.component"].copy()
    component[np.flatnonzero(component >= 0)[3]] = 120
    write_container(tmp_path / "m.rvm", header, arrays | {"forest.component": component})
    with pytest.raises(RendezviewError, match="bin"):
        ViewModel.load(tmp_path / "m.rvm")


def test_no_pickle_is_involved_in_reading(tiny_model_path, monkeypatch):
    def refuse(*_args, **_keywords):
        raise AssertionError("pickle was used")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(np, "load", refuse)
    ViewModel.load(tiny_model_path)


FULL_DISK = """
import resource, sys
from rendezview.sensors.appearance import ViewModel
from rendezview.errors import RendezviewError
model = ViewModel.load(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    model.save(sys.argv[2])
except RendezviewError as error:
    print(error)
    sys.exit(7)
"""


def test_a_full_disk_is_told_and_leaves_no_half_file(tiny_model_path, tmp_path):
    assert tiny_model_path.stat().st_size > 20_000
    path = tmp_path / "m.rvm"
    path.write_bytes(b"the old one")
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tiny_model_path), str(path)],
        capture_output=True,
        text=True,
        timeout=MOST_S,
        check=False,
    )
    assert done.returncode == 7, done.stderr
    assert "cannot be written" in done.stdout
    assert [p.name for p in tmp_path.iterdir()] == ["m.rvm"]
    assert path.read_bytes() == b"the old one"
