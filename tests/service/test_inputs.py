"""Numbers and names are checked where they enter; nothing that is wrong comes further."""

from __future__ import annotations

import json

import numpy as np
import pytest
from tests.waiting import MOST_S

from rendezview_service.client import Client, ServiceError
from rendezview_service.logs.replay import model_of, read_log, repeat
from rendezview_service.messages.frames import read_frame
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.tracker.tracking import SessionTracker, camera_message


def test_where_to_look_holds_until_there_is_a_pose(client, camera, tour):
    for roi, fault in (([1.0], "roi"), ([5000.0, 3.0], "outside"), ([1.0, 2.0, -3.0], "positive")):
        with pytest.raises(ServiceError, match=fault) as refused:
            client.open(camera, roi=roi)
        assert refused.value.status == 422
    _, pose, frame = tour[0]
    x, y = camera.project(pose.translation_m)
    away = [0.0, 0.0, max(x / 6.0, 8.0), max(y / 6.0, 8.0)]
    with client.open(camera, roi=away) as session:
        assert session.track(frame)["pose"] is None
    with client.open(camera, roi=[x, y]) as session:
        assert session.track(frame)["pose"] is not None


def test_where_to_look_first_is_not_where_it_was_lost(refining_model, camera, tour):
    """After a pose the region is over, however long the target is out of sight."""
    _, pose, frame = tour[0]
    x, _ = camera.project(pose.translation_m)
    box = [x + 60.0 - 80.0, 0.0, 160.0, camera.height]
    asked = {"camera": camera_message(camera).model_dump(), "roi": box}
    tracker = SessionTracker("s", refining_model, SessionRequest.model_validate(asked))
    assert tracker.track(np.roll(frame, 60, axis=1), 0.0, 0.0)[0]["pose"] is not None
    empty = np.full_like(frame, int(np.median(frame)))
    assert tracker.track(empty, 100.0, 100.0)[0]["pose"] is None
    assert tracker.track(np.roll(frame, -60, axis=1), 200.0, 200.0)[0]["pose"] is not None


def test_a_frame_says_where_its_target_is(client, camera, tour, tmp_path):
    _, pose, frame = tour[0]
    x, y = camera.project(pose.translation_m)
    away = [0.0, 0.0, max(x / 6.0, 8.0), max(y / 6.0, 8.0)]
    with client.open(camera) as session, session.stream() as stream:
        for roi, fault in (([1.0], "roi"), ([5e3, 3.0], "outside"), ([1.0, 2.0, -3.0], "positive")):
            with pytest.raises(ServiceError, match=fault) as refused:
                session.track(frame, 0.0, roi)
            assert refused.value.status == 422
        assert session.track(frame, 0.0, away)["pose"] is None
        assert session.track(frame, 1.0, [x, y])["pose"] is not None
        for time_s, roi, found in ((2.0, away, False), (3.0, None, True), (4.0, [x, y], True)):
            stream.send(frame, time_s, roi)
            state = stream.receive(MOST_S)
            assert (state["time_s"], state["pose"] is not None) == (time_s, found)
        stream.send(frame, 5.0, [1.0])
        with pytest.raises(ServiceError, match="roi"):
            stream.receive(MOST_S)
        assert session.info()["frames"] == 5  # none of those that were refused
        (tmp_path / "run.mcap").write_bytes(session.log())
    log = read_log(tmp_path / "run.mcap")
    *_, (_, so_far) = repeat(log, model_of(log, None))
    assert (so_far.frames, so_far.first_difference) == (5, None)


@pytest.mark.parametrize(
    ("head", "said"),
    [(b'{"time_s": 1e11}\n', "time_s"), (b'{"time_s": 1', "JSON"),
     (b'{"time_s": 1, "x": 2}\n', "x"), (b'{"time_s": NaN}\n', "NaN"),
     (b'{"time_s": null, "roi": [1e99, 2]}\n', "outside")],
)  # fmt: skip
def test_a_frame_whose_line_is_wrong_is_refused(client, camera, tour, head, said):
    with client.open(camera) as session, session.stream() as stream:
        stream._send(head + tour[0][2].tobytes())
        with pytest.raises(ServiceError, match=said) as refused:
            stream.receive(MOST_S)
        assert refused.value.status == 422
        assert session.info()["frames"] == 0


def test_a_raw_frame_stays_when_the_next_one_comes_into_the_same_memory(camera):
    """The pictures of the last frames of two sessions, which share a worker."""
    memory = bytearray(camera.width * camera.height)
    image = read_frame(memoryview(memory), camera)
    memory[:] = b"\xff" * len(memory)
    assert not image.any()
    assert image.flags.writeable


def test_a_jump_of_a_frame_does_not_keep_later_ones_out(client, camera, tour):
    with client.open(camera, prior=tour[0][1]) as session, session.stream() as stream:
        for time_s in (1e10, 6e9):
            with pytest.raises(ServiceError, match="too far ahead of the clock") as refused:
                session.track(tour[0][2], time_s)
            assert refused.value.status == 422
        assert session.track(tour[0][2], 5.0)["frame"] == 0
        with pytest.raises(ServiceError, match="too far ahead"):
            session.track(tour[1][2], 1e10)
        stream.send(tour[1][2], 10_000.0)
        with pytest.raises(ServiceError, match="too far ahead"):
            stream.receive(MOST_S)
        assert session.track(tour[1][2], 3000.0)["frame"] == 1


def test_senders_with_long_names_do_not_mix(service, camera, tour):
    names = ["a" * 64 + end for end in ("b", "c")]
    first, second = (Client(service.url, sender=name, timeout_s=MOST_S) for name in names)
    with first, second, first.open(camera, prior=tour[0][1]) as session:
        session.track(tour[0][2])
        with pytest.raises(ServiceError, match="another sender") as refused:
            second.session(session.name).track(tour[1][2])
        assert refused.value.status == 409


def test_options_of_an_older_filter_are_ignored_with_a_warning(service, client, camera):
    names = ("width", "height", "fx", "fy", "cx", "cy")
    options = {"motion": {"linear": 1e-3}, "pose": {"gate": 9.0, "inflation": 1.5}}
    request = {"camera": {name: getattr(camera, name) for name in names}}
    request["fusion"] = {"options": options}
    info = client.request("POST", "/v1/sessions", json.dumps(request).encode())
    said = " ".join(info["warnings"])
    assert "linear" in said
    assert "gate" in said
    assert client.session(info["id"]).info()["warnings"] == info["warnings"]
    client.session(info["id"]).close()
    with client.open(camera) as session:
        assert session.info()["warnings"] == []
