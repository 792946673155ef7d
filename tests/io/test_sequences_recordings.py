"""ROS bags and MCAP files as sequences: every kind gives the pictures that went in."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer as ProtobufWriter
from rosbags.rosbag2 import StoragePlugin
from tests.io.bags import START_S, Shot, write_foxglove, write_foxglove_json, write_ros1, write_ros2
from tests.io.small_videos import stream

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.message_images import PackedPicture, RawPicture, grey

CAMERA = Camera(64, 48, 80.0, 81.0, 31.0, 24.5, (0.1, -0.02, 1e-3, 2e-3, 0.0))
OTHER = Camera(64, 48, 60.0, 61.0, 31.0, 24.5)
INFO = {"/camera/camera_info": CAMERA}
Write = Callable[..., Path]


def as_folder(path: Path, *arguments: object) -> Path:
    return write_ros2(path, *arguments, StoragePlugin.MCAP)


def as_bare_mcap(path: Path, *arguments: object) -> Path:
    (found,) = write_ros2(path, *arguments, StoragePlugin.MCAP).glob("*.mcap")
    return found


def as_bare_sqlite(path: Path, *arguments: object) -> Path:
    (found,) = write_ros2(path, *arguments).glob("*.db3")
    return found


KINDS = [
    pytest.param(write_ros1, "a.bag", id="ros1"),
    pytest.param(write_ros2, "a", id="ros2-sqlite"),
    pytest.param(as_bare_sqlite, "a", id="ros2-sqlite-file"),
    pytest.param(as_folder, "a", id="ros2-mcap"),
    pytest.param(as_bare_mcap, "a", id="ros2-mcap-file"),
    pytest.param(write_foxglove, "a.mcap", id="foxglove-protobuf"),
    pytest.param(write_foxglove_json, "a.mcap", id="foxglove-json"),
]


def shots(encoding: str = "mono8", topic: str = "/camera/image_raw", count: int = 4) -> list[Shot]:
    rng = np.random.default_rng(51)
    images = rng.integers(0, 255, (count, 48, 64), dtype=np.uint8)
    return [Shot(image, 0.25 * k, topic, encoding) for k, image in enumerate(images)]


@pytest.mark.parametrize("encoding", ["mono8", "png", "bgr8"])
@pytest.mark.parametrize(("write", "name"), KINDS)
def test_each_kind_gives_pictures_times_and_camera(
    tmp_path: Path, write: Write, name: str, encoding: str
) -> None:
    made = shots(encoding)
    sequence = open_sequence(write(tmp_path / name, made, INFO))
    assert len(sequence) == 4
    for index, (frame, shot) in enumerate(zip(sequence, made, strict=True)):
        assert frame.im_id == index
        assert frame.time_s == pytest.approx(
            START_S + shot.time_s, abs=1e-6
        )  # stamps, not arrivals
        assert frame.camera == CAMERA
        assert frame.camera_from_target is None
        np.testing.assert_array_equal(frame.read(), shot.image)
    assert "/camera/image_raw, frame 3" in sequence.frames[3].name


@pytest.mark.parametrize(("write", "name"), KINDS)
def test_pictures_are_read_in_any_order_and_in_another_process(
    tmp_path: Path, write: Write, name: str
) -> None:
    made = shots()
    frames = open_sequence(write(tmp_path / name, made, INFO)).frames
    for index in (2, 0, 3, 3, 1):
        np.testing.assert_array_equal(frames[index].read(), made[index].image)
    sent = pickle.loads(pickle.dumps(frames[2]))
    np.testing.assert_array_equal(sent.read(), made[2].image)


@pytest.mark.parametrize(("write", "name"), KINDS)
def test_of_several_topics_one_is_named_behind_the_path(
    tmp_path: Path, write: Write, name: str
) -> None:
    made = [*shots(topic="/left/image_raw"), *shots("png", "/right/image_raw", 2)]
    cameras = {"/left/camera_info": CAMERA, "/right/camera_info": OTHER}
    path = write(tmp_path / name, made, cameras)
    with pytest.raises(RendezviewError, match=r"several topics \(/left/image_raw \(4\), /right"):
        open_sequence(path)
    right = open_sequence(f"{path}#/right/image_raw")
    assert (len(right), right.frames[0].camera) == (2, OTHER)
    np.testing.assert_array_equal(right.frames[1].read(), made[5].image)
    assert open_sequence(Path(f"{path}#/left/image_raw")).frames[0].camera == CAMERA
    with pytest.raises(RendezviewError, match=r"no pictures of /up; it has /left/image_raw \(4\)"):
        open_sequence(f"{path}#/up")


def test_a_rectified_picture_has_the_camera_of_the_projection(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag", shots(topic="/camera/image_rect"), INFO)
    camera = open_sequence(path).frames[0].camera
    assert camera == Camera(64, 48, 72.0, 72.0, 31.0, 24.5)


def test_without_a_calibration_a_camera_file_is_needed(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag", shots(), {})
    with pytest.raises(RendezviewError, match="no camera: it holds no calibration"):
        open_sequence(path)
    assert open_sequence(path, CAMERA).frames[0].camera == CAMERA
    save_camera(CAMERA, tmp_path / "camera.yaml")
    assert open_sequence(path).frames[0].camera == CAMERA


def test_two_calibrations_as_near_as_each_other_have_to_be_chosen_from(tmp_path: Path) -> None:
    cameras = {"/camera/info_a": CAMERA, "/camera/info_b": OTHER}
    path = write_foxglove(tmp_path / "a.mcap", shots(), cameras)
    with pytest.raises(RendezviewError, match="/camera/info_a, /camera/info_b is that of"):
        open_sequence(path)
    assert open_sequence(path, OTHER).frames[0].camera == OTHER


@pytest.mark.parametrize(("write", "name"), KINDS)
def test_a_recording_without_pictures_is_refused(tmp_path: Path, write: Write, name: str) -> None:
    with pytest.raises(RendezviewError, match="holds no pictures"):
        open_sequence(write(tmp_path / name, [], INFO))


@pytest.mark.parametrize(("write", "name"), KINDS)
def test_a_damaged_recording_gives_its_beginning_or_one_clear_error(
    tmp_path: Path, write: Write, name: str
) -> None:
    made = shots()
    path = write(tmp_path / name, made, INFO)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    whole = file.read_bytes()
    rng = np.random.default_rng(52)
    for trial in range(12):
        if trial < 6:
            damaged = whole[: int(rng.integers(len(whole)))]
        else:
            content = bytearray(whole)
            for place in rng.integers(len(whole), size=20):
                content[place] ^= int(rng.integers(1, 256))
            damaged = bytes(content)
        file.write_bytes(damaged)
        with contextlib.suppress(RendezviewError):
            for frame in open_sequence(path):
                assert frame.read().shape == (48, 64)


def test_only_recordings_have_topics(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(RendezviewError, match="only recordings have topics"):
        open_sequence(f"{tmp_path}#/camera")
    with pytest.raises(RendezviewError, match="no such file or folder"):
        open_sequence(tmp_path / "no.bag")


COLOURS = np.random.default_rng(53).integers(0, 256, (6, 8, 3), dtype=np.uint8)
FROM_RGB, FROM_BGR = (
    cv2.cvtColor(COLOURS, code) for code in (cv2.COLOR_RGB2GRAY, cv2.COLOR_BGR2GRAY)
)


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", COLOURS, FROM_RGB),
        ("bgr8", COLOURS, FROM_BGR),
        ("rgba8", np.dstack([COLOURS, COLOURS[:, :, 0]]), FROM_RGB),
        ("bgra8", np.dstack([COLOURS, COLOURS[:, :, 0]]), FROM_BGR),
        ("yuv422", np.dstack([COLOURS[:, :, 1], COLOURS[:, :, 0]]), COLOURS[:, :, 0]),
        ("yuv422_yuy2", np.dstack([COLOURS[:, :, 0], COLOURS[:, :, 1]]), COLOURS[:, :, 0]),
    ],
)  # fmt: skip
def test_colour_becomes_grey_by_its_own_order(
    encoding: str, pixels: np.ndarray, expected: np.ndarray
) -> None:
    height, width = pixels.shape[:2]
    picture = RawPicture(
        width, height, pixels.shape[1] * pixels.shape[2], encoding, pixels.tobytes()
    )
    np.testing.assert_array_equal(grey(picture, "here"), expected)


@pytest.mark.parametrize(
    ("encoding", "red"),
    [
        ("bayer_rggb8", (0, 0)),
        ("bayer_bggr8", (1, 1)),
        ("bayer_gbrg8", (1, 0)),
        ("bayer_grbg8", (0, 1)),
    ],
)
def test_red_light_through_a_bayer_pattern_is_as_grey_as_red_is(
    encoding: str, red: tuple[int, int]
) -> None:
    pixels = np.zeros((16, 16), np.uint8)
    pixels[red[0] :: 2, red[1] :: 2] = 200
    found = grey(RawPicture(16, 16, 16, encoding, pixels.tobytes()), "here")
    assert found[4:12, 4:12].mean() == pytest.approx(0.299 * 200, abs=2.0)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (RawPicture(8, 6, 8, "mono8", bytes(40)), "40 bytes for 8 × 6 pixels"),
        (RawPicture(8, 6, 4, "mono8", bytes(48)), "4 from row to row"),
        (RawPicture(0, 0, 0, "mono8", b""), "0 × 0 pixels"),
        (RawPicture(8, 6, 16, "mono16", bytes(96)), "give a camera file with bit_depth"),
        (RawPicture(8, 6, 8, "mono12p", bytes(96)), "encoding 'mono12p' is not supported"),
        (PackedPicture(b"\x89PNG rubbish"), "not a PNG, JPEG or WebP"),
        (PackedPicture(b""), "not a PNG, JPEG or WebP"),
    ],
)
def test_a_picture_that_cannot_be_is_refused(
    picture: RawPicture | PackedPicture, message: str
) -> None:
    with pytest.raises(RendezviewError, match=message):
        grey(picture, "here")


def test_pictures_are_sorted_by_their_stamps_and_those_without_one_left_out(tmp_path: Path) -> None:
    made = shots(count=8)
    times_s = [0.0, 0.2, 0.1, 0.3, 0.3, 0.4, 0.35, 0.5]
    made = [replace(shot, time_s=t) for shot, t in zip(made, times_s, strict=True)]
    made.insert(3, replace(made[0], time_s=-float(START_S)))  # a stamp of 0
    for write, name in ((write_foxglove, "a.mcap"), (write_ros1, "a.bag"), (write_ros2, "a")):
        sequence = open_sequence(write(tmp_path / name, made, INFO))
        assert [round(frame.time_s - START_S, 6) for frame in sequence] == [
            0.0, 0.1, 0.2, 0.3, 0.35, 0.4, 0.5,
        ]  # fmt: skip
        assert [frame.im_id for frame in sequence] == list(range(7))
        for frame, k in zip(sequence, (0, 2, 1, 4, 7, 6, 8), strict=True):
            np.testing.assert_array_equal(frame.read(), made[k].image)
        *late, doubled, unset = sequence.notes
        if write is write_foxglove:  # the readers of bags sort by the times of recording
            assert "2 of 9 pictures come after pictures of a later stamp" in late[0]
        assert "1 of 9 pictures have the stamp of another one" in doubled
        assert "1 of 9 pictures have no stamp" in unset


def write_video(path: Path, name: str, parts: list[bytes], kind: str = "protobuf") -> Path:
    """A recording of a compressed video, one picture a message."""
    with open(path, "wb") as file, ProtobufWriter(file) as bag:
        for index, part in enumerate(parts):
            stamp = Timestamp(seconds=START_S, nanos=round(1e8 * index))
            video = CompressedVideo(timestamp=stamp, data=part, format=name)
            bag.write_message("/eye/video", video, START_S * 10**9, START_S * 10**9)
    return path


@pytest.mark.parametrize("name", ["h264", "h265"])
@pytest.mark.parametrize("lead", [0, 2])
def test_compressed_video_is_read_from_its_first_key_picture(
    tmp_path: Path, name: str, lead: int
) -> None:
    parts = stream(name)[3 - lead :] if lead else stream(name)
    first = lead or 0
    sequence = open_sequence(write_video(tmp_path / "v.mcap", name, parts), CAMERA)
    greys = [30.0 * (k + 1) for k in range(6)][-len(parts) + first :]
    assert [f.read().mean() for f in sequence] == pytest.approx(greys, abs=3.0)
    assert [f.time_s - START_S for f in sequence] == pytest.approx(
        [0.1 * k for k in range(first, len(parts))], abs=1e-6
    )
    expected = "2 of 5 pictures come before the first key picture of the video: left out"
    assert sequence.notes == ((expected,) if lead else ())
    last = pickle.loads(pickle.dumps(sequence.frames[-1]))
    assert last.read().mean() == pytest.approx(180.0, abs=3.0)


def test_a_compressed_video_of_another_format_is_refused_by_its_name(tmp_path: Path) -> None:
    for name in ("vp9", "av1", ""):
        with pytest.raises(RendezviewError, match=f"format '{name}' is not read: record h264"):
            open_sequence(write_video(tmp_path / "v.mcap", name, [b"abc"]), CAMERA)
    with pytest.raises(RendezviewError, match="1 of 1 pictures come before the first key"):
        open_sequence(write_video(tmp_path / "v.mcap", "h264", stream("h264")[1:2]), CAMERA)


def test_a_recording_that_was_cut_off_gives_what_is_whole_and_says_where(tmp_path: Path) -> None:
    path = write_foxglove(tmp_path / "a.mcap", shots(count=1000), INFO)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.7 * len(whole))])
    sequence = open_sequence(path)
    assert 0 < len(sequence) < 1000
    assert sequence.frames[-1].read().shape == (48, 64)
    (note,) = sequence.notes
    assert note.startswith(f"cut off at byte {int(0.7 * len(whole))}: ")
    path.write_bytes(whole[:2000])
    with pytest.raises(RendezviewError, match="it is cut off at byte 2000, before the first one"):
        open_sequence(path)
