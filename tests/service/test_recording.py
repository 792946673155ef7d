"""Logs: read by another reader, whole after a kill, and repeated bit for bit."""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, MessageIndex
from mcap_protobuf.decoder import DecoderFactory
from tests.processes import python
from tests.service.logged import settings_of
from tests.waiting import MOST_S

from rendezview.cli.main import main
from rendezview.errors import RendezviewError
from rendezview.io.sequences import open_sequence
from rendezview_service.client import ServiceTimeout
from rendezview_service.logs.log_file import records
from rendezview_service.logs.log_repair import mend
from rendezview_service.logs.recording import RECORDED, LogWriter
from rendezview_service.logs.replay import model_of, read_log, repeat
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.tracker.tracking import (
    SessionTracker,
    camera_message,
    session_notes,
)
from rendezview_service.viewers.runs import moments

PATIENT = settings_of(log_wait_s=MOST_S)


@pytest.fixture
def request_of(camera, tour):
    return SessionRequest.model_validate(
        {"camera": camera_message(camera).model_dump(), "prior": tour[0][1].as_dict()}
    )


@pytest.fixture
def recorded(tmp_path, refining_model, model_path, camera, tour, request_of):
    """A log that is still open, its writer, and the states in it."""
    from pydantic_core import to_json

    follower = SessionTracker("bench", refining_model, request_of)
    notes = session_notes("bench", request_of, "bumpy", model_path)
    path = tmp_path / "run.mcap"
    writer = LogWriter(path, camera, notes, model_path.read_bytes(), PATIENT)
    states = []
    for time_s, _, image in tour:
        state, _ = follower.track(image, time_s, 1.7e9 + time_s)
        state["recorded"] = True
        assert writer.write(state, to_json(state), image.tobytes()) == RECORDED
        states.append(state)
    yield path, writer, states
    writer.close()


def _messages(path: Path) -> dict[str, list]:
    """By the reader of the mcap package, which needs the file's ending."""
    found: dict[str, list] = {}
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                found.setdefault(channel.topic, []).append(json.loads(message.data))
        for _, channel, _, decoded in reader.iter_decoded_messages(
            topics=["/target/pose", "/tf", "/camera/image", "/camera/calibration"]
        ):
            found.setdefault(channel.topic, []).append(decoded)
        assert reader.get_summary() is not None
    return found


def test_a_log_is_read_by_another_reader(recorded, camera, tour):
    path, writer, states = recorded
    writer.close()
    found = _messages(path)
    assert found["/rendezview/state"] == json.loads(json.dumps(states))
    assert len(found["/target/pose"]) == len(found["/tf"]) == len(states)
    pose, transform = found["/target/pose"][3], found["/tf"][3]
    w, x, y, z = states[3]["pose"]["quat_wxyz"]
    assert (pose.pose.orientation.w, pose.pose.orientation.x) == (w, x)
    assert (transform.rotation.y, transform.rotation.z) == (y, z)
    assert (transform.parent_frame_id, transform.child_frame_id) == ("camera", "target")
    assert pose.pose.position.z == states[3]["pose"]["translation_m"][2]
    assert pose.timestamp.seconds + 1e-9 * pose.timestamp.nanos == pytest.approx(tour[3][0])
    image = found["/camera/image"][3]
    assert image.encoding == "mono8"
    assert image.data == tour[3][2].tobytes()
    calibration = found["/camera/calibration"][0]
    assert (calibration.width, calibration.height) == (camera.width, camera.height)
    assert list(calibration.K) == camera.matrix.ravel().tolist()


def _chunk_places(path: Path) -> list[list[int]]:
    """Of each chunk its start, its end, and the end of its indexes."""
    places: list[list[int]] = []
    for record, offset, length in records(path):
        if isinstance(record, Chunk):
            places.append([offset, offset + length, 0])
        elif isinstance(record, MessageIndex):
            places[-1][2] = offset + length
    return places


def test_a_log_cut_anywhere_keeps_every_whole_frame(recorded, tmp_path):
    path, _, _ = recorded
    whole = path.read_bytes()  # not closed: as a kill leaves it
    places = _chunk_places(path)
    ends = [end for *_, end in places]
    first = places[0][0]
    rng = np.random.default_rng(2)
    cut_at = [*ends[:2], ends[0] - 1, ends[1] + 1, *rng.integers(first, len(whole), 12), len(whole)]
    for cut in map(int, cut_at):
        copy = tmp_path / "cut.mcap"
        copy.write_bytes(whole[:cut])
        kept = sum(end <= cut for end in ends)
        mended = mend(copy)
        assert (mended.path, mended.damaged_bytes) == (copy, 0)
        assert 0 <= mended.cut_bytes <= cut - ([first, *ends][kept])
        assert mend(copy) is None
        whole_chunks = sum(end <= cut for _, end, _ in places)  # its indexes are made again
        assert len(_messages(copy).get("/rendezview/state", [])) == whole_chunks >= kept


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r", b"no log at all", b"\x00" * 100])
def test_what_is_no_log_is_refused(tmp_path, content):
    path = tmp_path / "no.mcap"
    path.write_bytes(content)
    for look in (mend, read_log):
        with pytest.raises(RendezviewError, match="not an MCAP"):
            look(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize("closed", [True, False])
def test_a_run_is_repeated_bit_for_bit(recorded, closed):
    path, writer, states = recorded
    if closed:
        writer.close()
    log = read_log(path)
    model = model_of(log, None)  # the log's own
    *_, (_, so_far) = repeat(log, model)
    assert (so_far.frames, so_far.differing, so_far.gap) == (len(states), 0, None)
    assert so_far.poses == sum(state["pose"] is not None for state in states) > 20


def test_another_run_is_not_taken_for_the_same(recorded, refining_model):
    path, _, _ = recorded
    log = read_log(path)
    other = log.request.model_dump(mode="json")
    other["camera"]["fx"] *= 1.0000001
    log.notes["request"] = json.dumps(other)
    *_, (_, so_far) = repeat(log, refining_model)
    assert so_far.differing == so_far.frames
    assert 0.0 < so_far.largest < 1e-3


def _replay(*arguments: object) -> str:
    done = python("-m", "rendezview", "replay", *arguments)
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_after_a_kill_everything_acknowledged_is_there_and_the_client_connects_again(
    start_service, camera, tour, tmp_path, monkeypatch, capsys
):
    place, copy = tmp_path / "run.mcap", tmp_path / "aside" / "copy.mcap"
    served, restarted = start_service("--record", str(place)), []
    flags = ("--port", served.url.rstrip("/").rpartition(":")[2], "--record", str(place))
    with served.client() as client:
        session = client.open(camera, prior=tour[0][1])
        states, told = [], []
        for time_s, truth, image in tour[:8]:
            states.append(session.track(image, time_s))
            line = {"time_s": time_s, "pose": truth, "covariance": 1e-4 * np.eye(6)}
            told.append(session.measure("mirrors", line))
        stream = client.open(camera, name="again").stream()
        stream.send(tour[0][2], 0.0)
        assert stream.receive(MOST_S)["frame"] == 0
        with pytest.raises(ServiceTimeout):
            stream.receive(0.05)
        served.kill()
        copy.parent.mkdir()
        copy.write_bytes(place.read_bytes())
        starting = threading.Thread(
            target=lambda: restarted.append(start_service(*flags, given=False))
        )
        starting.start()
        # Refused at first, then the new service says that it has no such session.
        with pytest.raises(RendezviewError):
            _send_all(stream, tour[1:4])
        starting.join(MOST_S)
        assert client.sessions() == []
    assert all(answer["recorded"] for answer in states + told)
    (again,) = restarted
    again.await_line("log mended")  # once it listens
    again.stop()
    assert _messages(place)["/rendezview/state"] == states
    lines = _messages(place)["/rendezview/measurement"]
    assert [line["verdict"] for line in lines] == [one["verdicts"][0] for one in told]
    again = _replay(place)
    assert "8 frames, 8 poses, 8 lines of other sensors: all repeated bit for bit" in again
    monkeypatch.setattr(sys, "argv", ["rendezview", "replay", str(copy), "--mend"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in (0, None)
    assert "completed" in capsys.readouterr().err
    assert mend(copy) is None


def _send_all(stream, frames) -> None:
    for time_s, _, image in frames:
        stream.send(image, time_s)
        stream.receive(MOST_S)


def test_rerun_opens_a_log_as_it_is(recorded, camera):
    reader = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk").McapReader
    path, writer, states = recorded
    writer.close()
    found: dict[str, list[tuple[int, set[str]]]] = {}
    for part in reader(path).stream().to_chunks():
        names = {name for name in part.to_record_batch().schema.names if ":" in name}
        found.setdefault(str(part.entity_path), []).append((part.num_rows, names))

    def rows(entity: str, component: str) -> int:
        return sum(count for count, names in found[entity] if component in names)

    assert rows("/camera/image", "Image:buffer") == len(states)
    assert rows("/tf", "Transform3D:translation") == len(states)
    assert rows("/target/pose", "InstancePoses3D:quaternions") == len(states)
    assert rows("/camera/calibration", "Pinhole:image_from_camera") >= 1
    assert rows("/rendezview/state", "McapMessage:data") == len(states)  # as bytes only


def test_a_log_is_a_run_and_its_pictures_a_sequence(recorded, camera, tour, tmp_path):
    path, writer, states = recorded
    writer.close()
    run = list(moments(path))
    assert [moment.record for moment in run] == json.loads(json.dumps(states))
    assert all(moment.camera == camera for moment in run)
    np.testing.assert_array_equal(run[5].image, tour[5][2])
    sequence = open_sequence(path)
    assert len(sequence) == len(tour)
    for frame, (time_s, _, image) in zip(sequence, tour, strict=True):
        assert frame.time_s == pytest.approx(time_s)
        np.testing.assert_array_equal(frame.read(), image)
    assert sequence.frames[0].camera == camera
