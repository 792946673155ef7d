"""Atomic writing, and errors of reading that name the file."""

import os
import stat
import subprocess
import sys

import pytest
from pydantic import TypeAdapter

from rendezview.errors import RendezviewError
from rendezview.io.files import (
    atomic_write,
    atomic_write_text,
    checked,
    make_folder,
    read_json,
    read_text,
    read_toml,
)  # fmt: skip


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.requirement("RV-FILE-2")
def test_content_appears_only_when_all_is_written(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with atomic_write(path) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old"
        assert len(names(tmp_path)) == 2  # beside it, in the same folder
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_any_exception_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def write_half() -> None:
        with atomic_write(path) as file:
            file.write(b"half")
            raise error

    with pytest.raises(error):
        write_half()
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


def test_permissions_follow_the_umask(tmp_path):
    old = os.umask(0o027)
    try:
        atomic_write_text(tmp_path / "a", "x")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_a_symbolic_link_is_followed(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "real")
    atomic_write_text(tmp_path / "link", "x")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "x"


def test_a_long_name_still_leaves_room_for_the_temporary_one(tmp_path):
    path = tmp_path / ("n" * 250)
    atomic_write_text(path, "x", durable=False)
    assert path.read_text() == "x"


def test_a_device_is_written_to_and_not_replaced():
    atomic_write_text("/dev/null", "x")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(RendezviewError, match=r"absent/a\.txt.*folder .*absent does not exist"):
        atomic_write_text(tmp_path / "absent" / "a.txt", "x")


def test_a_folder_in_place_of_the_file_is_named(tmp_path):
    with pytest.raises(RendezviewError, match="is a folder"):
        atomic_write_text(tmp_path, "x")


def test_a_file_in_place_of_the_folder_is_named(tmp_path):
    (tmp_path / "a").write_text("")
    with pytest.raises(RendezviewError, match="a/b: cannot be written"):
        atomic_write_text(tmp_path / "a" / "b", "x")
    with pytest.raises(RendezviewError, match="cannot be created"):
        make_folder(tmp_path / "a" / "b")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_named(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(RendezviewError, match="Permission"):
        atomic_write_text(tmp_path / "a", "x")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_device_is_named_with_the_reason():
    with pytest.raises(RendezviewError, match=r"/dev/full: cannot be written .*No space left"):
        atomic_write_text("/dev/full", "x" * 100_000)


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX limits")
@pytest.mark.parametrize("size", [5_000, 500_000])  # fails in the last flush; in the write
def test_a_file_that_cannot_grow_leaves_the_old_one_and_nothing_else(tmp_path, size):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    program = f"""
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
from rendezview.errors import RendezviewError
from rendezview.io.files import atomic_write
try:
    with atomic_write({str(path)!r}) as file:
        file.write(b"x" * {size})
except RendezviewError as error:
    assert "a.bin: cannot be written (File too large)" in str(error), error
else:
    raise SystemExit("wrote past the limit")
"""
    # The parent's own import path, so that it works installed and from the source tree.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr + done.stdout
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


def test_an_error_of_another_file_is_not_blamed_on_this_one(tmp_path):
    def copy_missing() -> None:
        with atomic_write(tmp_path / "a") as file, open(tmp_path / "missing", "rb") as source:
            file.write(source.read())

    with pytest.raises(FileNotFoundError, match="missing"):
        copy_missing()
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1,}', r"a\.json: not valid JSON .*line 1"),
        (b'{"a": NaN}', "NaN is not a JSON number"),
        (b'[{"fx": 600, "cx": 320, "fx": 900}]', "the key 'fx' is there twice"),
        (b"\xff\xfe", "not text in UTF-8"),
        (b"[" * 200_000, "not valid JSON"),
        (b"", "not valid JSON"),
    ],
)
def test_bad_json_is_named(tmp_path, content, message):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(RendezviewError, match=message):
        read_json(path, "a thing")


@pytest.mark.parametrize("content", ["a = [1, 2", "a = " + "[" * 200_000, "a = " + "1" * 6000])
def test_bad_toml_is_named(tmp_path, content):
    path = tmp_path / "a.toml"
    path.write_text(content)
    with pytest.raises(RendezviewError, match=r"a\.toml: not valid TOML"):
        read_toml(path, "a thing")


def test_a_message_shortens_the_values_that_it_quotes():
    said = str(RendezviewError(f"/here/{'a' * 255}: not {'9' * 400}, nor {'x' * 999}"))
    assert said == (
        f"/here/{'a' * 255}: not {'9' * 20}… (400 characters), nor {'x' * 20}… (999 characters)"
    )


def test_a_number_is_read_from_a_number_only_and_a_tuple_from_a_list():
    numbers = TypeAdapter(tuple[float, ...])
    assert checked(numbers, [1, 2.5], "here") == (1.0, 2.5)
    for wrong in ("12.5", True, None):
        with pytest.raises(RendezviewError, match=r"here: 1: input should be a valid number"):
            checked(numbers, [1, wrong], "here")


def test_a_whole_number_may_be_written_with_a_point():
    assert checked(TypeAdapter(dict[str, int]), {"a": 3.0, "b": 2}, "here") == {"a": 3, "b": 2}
    for wrong in (3.5, 1e300, "3"):
        with pytest.raises(RendezviewError, match="here: a:"):
            checked(TypeAdapter(dict[str, int]), {"a": wrong}, "here")


def test_reading_names_what_is_missing_a_folder_or_too_long(tmp_path):
    with pytest.raises(RendezviewError, match=r"none: no such file; expected a thing"):
        read_text(tmp_path / "none", "a thing")
    with pytest.raises(RendezviewError, match="is a folder"):
        read_text(tmp_path, "a thing")
    (tmp_path / "long").write_text("x" * 11)
    assert read_text(tmp_path / "long", "a thing", limit_bytes=11) == "x" * 11
    with pytest.raises(RendezviewError, match="longer than 10"):
        read_text(tmp_path / "long", "a thing", limit_bytes=10)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "key 'c' is there twice"),
        ('{"a": 1e400}', "a number of 5 characters, 1e400, is too large"),
        ('{"a": -1' + "0" * 309 + "}", "a number of 311 characters, -10+, is too large"),
    ],
)
def test_json_that_readers_understand_differently_is_refused(tmp_path, content, message):
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(RendezviewError, match=message):
        read_json(tmp_path / "a.json", "a thing")


def test_the_largest_numbers_of_json_are_kept(tmp_path):
    (tmp_path / "a").write_text('{"a": 9007199254740993, "b": [1.7e308, -0.0], "c": {"a": 2}}')
    read = read_json(tmp_path / "a", "a thing")
    assert read == {"a": 2**53 + 1, "b": [1.7e308, 0.0], "c": {"a": 2}}


def test_a_named_pipe_and_a_device_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path / "link", "/dev/zero"):
        with pytest.raises(RendezviewError, match="is no regular file; expected a thing"):
            read_text(path, "a thing")


def test_a_pipe_of_a_shell_is_read():
    reading, writing = os.pipe()
    os.write(writing, b"[1]")
    os.close(writing)
    assert read_json(f"/dev/fd/{reading}", "a thing") == [1]
    os.close(reading)


def test_a_byte_order_mark_is_dropped(tmp_path):
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbf{}")
    assert read_json(tmp_path / "a", "a thing") == {}
