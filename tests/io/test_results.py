"""BOP results CSV and JSON lines."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.io import file_lock
from rendezview.io.results import (
    JsonLinesWriter,
    ResultRow,
    read_json_lines,
    read_results,
    write_results,
)

HEADER = "scene_id,im_id,obj_id,score,R,t,time\n"
IDENTITY = "1 0 0 0 1 0 0 0 1"


def rows(count=20):
    rng = np.random.default_rng(0)
    return [
        ResultRow(
            scene_id=1,
            im_id=index,
            obj_id=2,
            score=float(rng.normal()),
            camera_from_target=Pose.from_quat_wxyz(rng.normal(size=4), 10 * rng.normal(size=3)),
            time_s=None if index % 5 == 0 else float(rng.uniform()),
        )
        for index in range(count)
    ]


@pytest.mark.requirement("RV-FILE-1")
def test_written_rows_are_read_back_in_full_precision(tmp_path):
    written = rows()
    write_results(tmp_path / "r.csv", written)
    read = read_results(tmp_path / "r.csv")
    for a, b in zip(written, read, strict=True):
        assert (a.scene_id, a.im_id, a.obj_id, a.score, a.time_s) == (
            b.scene_id, b.im_id, b.obj_id, b.score, b.time_s,
        )  # fmt: skip
        assert (a.camera_from_target.rotation == b.camera_from_target.rotation).all()
        np.testing.assert_allclose(
            a.camera_from_target.translation_m, b.camera_from_target.translation_m, rtol=1e-15
        )


@pytest.mark.requirement("RV-FILE-1")
def test_the_file_is_the_one_bop_describes(tmp_path):
    quarter = Pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.001, 0.002, 3.0])
    write_results(tmp_path / "r.csv", [ResultRow(1, 7, 2, 0.5, quarter, 0.25)])
    assert (tmp_path / "r.csv").read_text() == (
        HEADER + "1,7,2,0.5,0.0 -1.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0,1.0 2.0 3000.0,0.25\n"
    )


def test_an_unknown_time_is_minus_one(tmp_path):
    write_results(tmp_path / "r.csv", [ResultRow(1, 0, 1, 0.0, Pose.identity())])
    assert (tmp_path / "r.csv").read_text().endswith(",-1\n")
    assert read_results(tmp_path / "r.csv")[0].time_s is None


def test_no_rows_is_a_file_with_a_header(tmp_path):
    write_results(tmp_path / "r.csv", [])
    assert read_results(tmp_path / "r.csv") == []


def test_rotations_rounded_by_another_program_are_accepted(tmp_path):
    exact = rows(1)[0].camera_from_target.rotation
    rounded = " ".join(f"{value:.4f}" for value in exact.ravel())
    (tmp_path / "r.csv").write_text(HEADER + f"1,0,1,1,{rounded},0 0 1000,0.1\r\n")
    read = read_results(tmp_path / "r.csv")[0].camera_from_target
    np.testing.assert_allclose(read.rotation, exact, atol=1e-4)
    np.testing.assert_allclose(read.translation_m, [0, 0, 1])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (f"1,0,1,1,{IDENTITY},0 0 1", "6 values, expected 7"),
        (f"1,x,1,1,{IDENTITY},0 0 1,0", "im_id: 'x' is not a whole number"),
        (f"1,0,1,high,{IDENTITY},0 0 1,0", "score: 'high'"),
        ("1,0,1,1,1 0 0 0 1 0 0 0,0 0 1,0", "R: needs 9 finite numbers"),
        ("1,0,1,1,2 0 0 0 2 0 0 0 2,0 0 1,0", "R: not a rotation"),
        ("1,0,1,1,1 0 0 0 1 0 0 0 -1,0 0 1,0", "R: not a rotation"),
        (f"1,0,1,1,{IDENTITY},0 nan 1,0", "t: needs 3 finite numbers"),
        (f"1,0,1,nan,{IDENTITY},0 0 1,0", "score: needs 1 finite"),
        (f"1,0,1,1,{IDENTITY},0 0 1,", "time: needs 1"),
    ],
)
def test_a_wrong_row_is_named_with_its_line(tmp_path, line, message):
    good = f"1,0,1,1,{IDENTITY},0 0 1,0\n"
    (tmp_path / "r.csv").write_text(HEADER + good + line + "\n" + good)
    with pytest.raises(RendezviewError, match=rf"r\.csv: line 3: {message}"):
        read_results(tmp_path / "r.csv")


@pytest.mark.parametrize("content", ["", "a,b\n", "im_id,scene_id,obj_id,score,R,t,time\n"])
def test_another_header_is_refused(tmp_path, content):
    (tmp_path / "r.csv").write_text(content)
    with pytest.raises(RendezviewError, match="line 1: the header must be scene_id"):
        read_results(tmp_path / "r.csv")


@pytest.mark.parametrize("bad", [{"score": float("nan")}, {"time_s": -1.0}, {"time_s": np.inf}])
def test_a_row_refuses_numbers_that_are_none(bad):
    with pytest.raises(ValueError, match="finite"):
        dataclasses.replace(rows(1)[0], **bad)


@dataclasses.dataclass
class Part:
    size_m: float
    pose: Pose


def test_json_lines_hold_arrays_poses_and_no_nan(tmp_path):
    path = tmp_path / "log.jsonl"
    with JsonLinesWriter(path) as writer:
        writer.write(
            {
                "pose": Pose.from_quat_wxyz([-2, 0, 0, 0], [1, 2, 3]),
                "covariance": np.array([[1.0, np.nan], [np.inf, 2.0]]),
                "count": np.int64(3),
                "flag": np.bool_(True),
                "half": np.float32(0.5),
                "bad": float("-inf"),
                "path": Path("a/b"),
                "part": Part(1.5, Pose.identity()),
                "text": "é\u2028\n",
                "none": None,
                3: (1, 2),
            }
        )
        writer.write({})
    text = path.read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    assert text.count("\n") == 2
    first, second = read_json_lines(path)
    assert second == {}
    assert first["pose"] == {"quat_wxyz": [1, 0, 0, 0], "translation_m": [1, 2, 3]}
    assert first["covariance"] == [[1.0, None], [None, 2.0]]
    assert (first["count"], first["flag"], first["half"], first["bad"]) == (3, True, 0.5, None)
    assert first["path"] == "a/b"
    assert first["part"]["pose"]["translation_m"] == [0, 0, 0]
    assert first["text"] == "é\u2028\n"
    assert first["3"] == [1, 2]


def test_every_line_is_on_disk_when_written_and_the_name_comes_last(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"old": 1}\n')
    writer = JsonLinesWriter(path)
    writer.write({"a": 1})
    assert json.loads(writer.partial_path.read_text()) == {"a": 1}
    assert read_json_lines(path) == [{"old": 1}]
    writer.close()
    writer.close()
    assert read_json_lines(path) == [{"a": 1}]
    assert not writer.partial_path.exists()
    with pytest.raises(ValueError, match="closed"):
        writer.write({})


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_keeps_the_computed_lines_aside(tmp_path, error):
    path = tmp_path / "log.jsonl"

    def abort() -> None:
        with JsonLinesWriter(path) as writer:
            writer.write({"a": 1})
            raise error

    with pytest.raises(error):
        abort()
    assert not path.exists()
    assert read_json_lines(tmp_path / "log.jsonl.partial") == [{"a": 1}]


def test_what_has_no_json_form_is_a_programmers_error_and_writes_nothing(tmp_path):
    with JsonLinesWriter(tmp_path / "log.jsonl") as writer:
        with pytest.raises(TypeError, match="object has no JSON form"):
            writer.write({"a": object()})
        writer.write({"b": 1})
    assert read_json_lines(tmp_path / "log.jsonl") == [{"b": 1}]


def test_a_log_that_cannot_be_opened_is_named(tmp_path):
    with pytest.raises(RendezviewError, match="absent does not exist"):
        JsonLinesWriter(tmp_path / "absent" / "log.jsonl")
    with pytest.raises(RendezviewError, match="no regular file"):
        JsonLinesWriter(tmp_path)


def test_two_runs_do_not_write_into_one_log(tmp_path):
    path = tmp_path / "log.jsonl"
    with JsonLinesWriter(path) as first:
        first.write({"a": 1})
        with pytest.raises(RendezviewError, match="another run is writing it"):
            JsonLinesWriter(path)
        first.write({"a": 2})
    assert read_json_lines(path) == [{"a": 1}, {"a": 2}]
    with JsonLinesWriter(path) as second:
        second.write({"a": 3})
    assert read_json_lines(path) == [{"a": 3}]


def test_a_log_that_gets_its_name_while_another_run_opens_it_stays(tmp_path, monkeypatch):
    path, locked = tmp_path / "log.jsonl", file_lock.lock
    (tmp_path / "log.jsonl.partial").write_text('{"a": 1}\n')

    def late(descriptor: int) -> bool:
        if not path.exists():
            (tmp_path / "log.jsonl.partial").rename(path)
        return locked(descriptor)

    monkeypatch.setattr(file_lock, "lock", late)
    writer = JsonLinesWriter(path)
    writer.write({"a": 2})
    writer.keep(ended=False)
    assert read_json_lines(path) == [{"a": 1}]
    assert read_json_lines(tmp_path / "log.jsonl.partial") == [{"a": 2}]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_is_named(tmp_path):
    (tmp_path / "log.jsonl.partial").symlink_to("/dev/full")
    writer = JsonLinesWriter(tmp_path / "log.jsonl")
    with pytest.raises(RendezviewError, match=r"log\.jsonl: cannot be written .*No space"):
        writer.write({"a": 1})
    with pytest.raises(RendezviewError, match="No space"):
        writer.close()
    assert not (tmp_path / "log.jsonl").exists()


@pytest.mark.parametrize("line", ['{"a": 1', "[1]", '{"a": NaN}'])
def test_a_bad_json_line_is_named(tmp_path, line):
    (tmp_path / "log.jsonl").write_text('{"a": 1}\n\n' + line)
    with pytest.raises(RendezviewError, match=r"log\.jsonl: line 3"):
        read_json_lines(tmp_path / "log.jsonl")


def test_a_file_without_the_header_is_read(tmp_path):
    row = "3,12,1,0.5,1 0 0 0 1 0 0 0 1,0 0 5000,-1"
    path = tmp_path / "peer.csv"
    path.write_text(f"{row}\n{row.replace(',12,', ',13,')}\n")
    assert [r.im_id for r in read_results(path)] == [12, 13]
    assert read_results(path)[0].camera_from_target.translation_m[2] == 5.0
