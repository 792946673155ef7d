"""Sequences: BOP scenes, their writer, and folders of images."""

import json
import pickle
import shutil

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.camera_files import save_camera
from rendezview.io.sequences import open_sequence
from rendezview_ground.simulate.bop_writer import BopSceneWriter

CAMERA = Camera(64, 48, 80.0, 81.0, 31.0, 24.0, (-0.1, 0.01, 0.001, 0.0, 0.0))


def picture(level, shape=(48, 64)):
    return np.full(shape, level, dtype=np.uint8)


def poses(count):
    rng = np.random.default_rng(0)
    return [Pose.from_quat_wxyz(rng.normal(size=4), rng.normal(size=3)) for _ in range(count)]


def write_scene(folder, numbers=(0, 1, 10), **options):
    truth = poses(len(numbers))
    with BopSceneWriter(folder, CAMERA, **options) as writer:
        for index, im_id in enumerate(numbers):
            mask = np.zeros((48, 64), dtype=bool)
            mask[:5] = True
            writer.add(im_id, picture(im_id + 1), truth[index], 0.1 * im_id, mask=mask)
    return truth


def files_of(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


# ---- BOP ---------------------------------------------------------------------------------


def test_a_written_scene_is_read_back_whole(tmp_path):
    truth = write_scene(tmp_path / "scene", scene_id=7)
    sequence = open_sequence(tmp_path / "scene")
    assert sequence.scene_id == 7
    assert sequence.source == tmp_path / "scene"
    assert [frame.im_id for frame in sequence] == [0, 1, 10]
    assert len(sequence) == 3
    for frame, pose in zip(sequence.frames, truth, strict=True):
        assert frame.camera == CAMERA  # with its distortion
        assert frame.time_s == 0.1 * frame.im_id
        assert frame.obj_id == 1
        assert (frame.camera_from_target.rotation == pose.rotation).all()
        np.testing.assert_allclose(
            frame.camera_from_target.translation_m, pose.translation_m, rtol=1e-15
        )
        image = frame.read()
        assert image.dtype == np.uint8
        assert (image == picture(frame.im_id + 1)).all()


def test_the_scene_is_laid_out_as_bop_describes(tmp_path):
    folder = tmp_path / "000012"
    truth = write_scene(folder, numbers=(3,))
    assert files_of(folder) == [
        "camera.json", "gray/000003.png", "mask_visib/000003_000000.png", "scene_camera.json",
        "scene_gt.json",
    ]  # fmt: skip
    camera = json.loads((folder / "scene_camera.json").read_text())["3"]
    assert camera["cam_K"] == [80.0, 0.0, 31.0, 0.0, 81.0, 24.0, 0.0, 0.0, 1.0]
    (entry,) = json.loads((folder / "scene_gt.json").read_text())["3"]
    assert entry["cam_R_m2c"] == truth[0].rotation.ravel().tolist()
    assert entry["cam_t_m2c"] == (1000.0 * truth[0].translation_m).tolist()
    mask = cv2.imread(str(folder / "mask_visib/000003_000000.png"), cv2.IMREAD_UNCHANGED)
    assert (mask[:5] == 255).all()
    assert (mask[5:] == 0).all()
    assert open_sequence(folder).scene_id == 12


def test_a_frame_without_truth_and_time_is_read_as_such(tmp_path):
    with BopSceneWriter(tmp_path / "s", CAMERA) as writer:
        writer.add(0, picture(1), None, None)
    (frame,) = open_sequence(tmp_path / "s")
    assert frame.camera_from_target is None
    assert frame.time_s is None


def foreign_scene(folder, truth=None, suffix=".png", size=(48, 64)):
    """A scene of another program: rgb, no camera.json, rounded numbers, unknown keys."""
    (folder / "rgb").mkdir(parents=True)
    colour = np.zeros((*size, 3), dtype=np.uint8)
    colour[..., 1] = 200  # green
    cv2.imwrite(str(folder / "rgb" / f"000002{suffix}"), colour)
    cameras = {"2": {"cam_K": [80, 0, 31, 0, 81.5, 24, 0, 0, 1], "depth_scale": 0.1, "elev": 1}}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    if truth is not None:
        (folder / "scene_gt.json").write_text(json.dumps({"2": truth}))
    return folder


def entry(pose, obj_id=5):
    return {
        "cam_R_m2c": pose.rotation.ravel().round(5).tolist(),
        "cam_t_m2c": (pose.translation_m * 1e3).round(3).tolist(),
        "obj_id": obj_id,
    }


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_a_scene_of_another_program_is_read(tmp_path, suffix):
    (pose,) = poses(1)
    folder = foreign_scene(tmp_path / "lab", [entry(pose)], suffix)
    sequence = open_sequence(folder / "scene_camera.json")
    assert sequence.scene_id == 1
    (frame,) = sequence
    assert frame.camera == Camera(64, 48, 80.0, 81.5, 31.0, 24.0)
    assert frame.obj_id == 5
    np.testing.assert_allclose(frame.camera_from_target.rotation, pose.rotation, atol=2e-5)
    np.testing.assert_allclose(
        frame.camera_from_target.translation_m, pose.translation_m, atol=1e-6
    )
    assert frame.read().mean() == pytest.approx(0.587 * 200, abs=2)


def test_a_given_camera_wins_over_the_scene(tmp_path):
    write_scene(tmp_path / "s")
    other = Camera(64, 48, 10.0, 10.0, 1.0, 1.0)
    assert all(frame.camera == other for frame in open_sequence(tmp_path / "s", other))


def test_the_target_among_several_objects_has_to_be_chosen(tmp_path):
    first, second = poses(2)
    folder = foreign_scene(tmp_path / "s", [entry(first, 5), entry(second, 8)])
    with pytest.raises(RendezviewError, match=r"scene_gt\.json: 2: several objects \(5, 8\)"):
        open_sequence(folder)
    (frame,) = open_sequence(folder, obj_id=8)
    assert frame.obj_id == 8
    np.testing.assert_allclose(frame.camera_from_target.rotation, second.rotation, atol=2e-5)
    (absent,) = open_sequence(folder, obj_id=9)
    assert absent.camera_from_target is None


@pytest.mark.parametrize("obj_id", [None, 5])
def test_frames_with_several_instances_of_the_target_have_no_truth(tmp_path, obj_id):
    first, second, other = poses(3)
    entries = [entry(first, 5), entry(second, 5)] + ([] if obj_id is None else [entry(other, 8)])
    sequence = open_sequence(foreign_scene(tmp_path / "s", entries), obj_id=obj_id)
    assert (sequence[0].camera_from_target, sequence[0].obj_id) == (None, 5)
    assert sequence.notes == ("1 of 1 frames show the target several times: they have no truth",)


def test_a_sequence_is_indexed_as_a_list(tmp_path):
    write_scene(tmp_path / "s")
    sequence = open_sequence(tmp_path / "s")
    assert sequence[0] is sequence.frames[0]
    assert sequence[-1] is sequence.frames[-1]
    part = sequence[1:]
    assert (len(part), part.scene_id) == (len(sequence) - 1, sequence.scene_id)
    assert list(part) == list(sequence.frames[1:])
    with pytest.raises(IndexError):
        sequence[1000]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("scene_camera.json", "{", r"scene_camera\.json: not valid JSON"),
        ("scene_camera.json", "{}", "lists no frames"),
        ("scene_camera.json", '{"a": {"cam_K": [1,0,0,0,1,0,0,0,1]}}', "'a' is not a frame number"),
        ("scene_camera.json", '{"2": {}}', r"scene_camera\.json: 2\.cam_K: missing"),
        ("scene_camera.json", '{"2": {"cam_K": [1, 2]}}', r"2\.cam_K: .*at least 9"),
        ("scene_camera.json", '{"2": {"cam_K": [1,2,0,0,1,0,0,0,1]}}', r"2\.cam_K: .*no skew"),
        ("scene_camera.json", '{"2": {"cam_K": [-1,0,0,0,1,0,0,0,1]}}', r"2\.cam_K: fx must be"),
        ("scene_gt.json", '{"2": [{"obj_id": 1}]}', r"scene_gt\.json: 2\.0\.cam_R_m2c: missing"),
        (
            "scene_gt.json",
            '{"2": [{"obj_id": 1, "cam_R_m2c": [2,0,0,0,2,0,0,0,2], "cam_t_m2c": [0,0,1]}]}',
            r"scene_gt\.json: 2: cam_R_m2c: not a rotation",
        ),
    ],
)
def test_a_wrong_scene_file_is_named(tmp_path, name, content, message):
    folder = foreign_scene(tmp_path / "s", [])
    (folder / name).write_text(content)
    with pytest.raises(RendezviewError, match=message):
        open_sequence(folder)


def test_a_scene_without_images_is_refused(tmp_path):
    folder = foreign_scene(tmp_path / "s")
    shutil.rmtree(folder / "rgb")
    with pytest.raises(RendezviewError, match=r"no images .* in gray/ or rgb/"):
        open_sequence(folder)


def test_a_folder_of_scenes_says_to_choose_one(tmp_path):
    write_scene(tmp_path / "test" / "000001")
    write_scene(tmp_path / "test" / "000002")
    with pytest.raises(RendezviewError, match=r"holds 2 BOP scenes: .*000001"):
        open_sequence(tmp_path / "test")


# ---- reading frames ----------------------------------------------------------------------


def test_a_missing_damaged_or_wrong_picture_is_named_when_read(tmp_path, capfd):
    write_scene(tmp_path / "s", numbers=(0, 1, 2, 3, 4, 5))
    gray = tmp_path / "s" / "gray"
    (gray / "000000.png").unlink()
    (gray / "000001.png").write_bytes(b"no picture")
    (gray / "000002.png").write_bytes(b"")
    noise = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
    content = cv2.imencode(".png", noise)[1].tobytes()
    (gray / "000003.png").write_bytes(content[: len(content) // 2])
    cv2.imwrite(str(gray / "000004.png"), picture(1, (40, 60)))
    frames = open_sequence(tmp_path / "s").frames
    with pytest.raises(RendezviewError, match=r"000000\.png: no such file"):
        frames[0].read()
    for index in (1, 2, 3):
        with pytest.raises(RendezviewError, match=rf"00000{index}\.png: not an image"):
            frames[index].read()
    with pytest.raises(RendezviewError, match=r"000004\.png: .*60 × 40 .* 64 × 48"):
        frames[4].read()
    assert capfd.readouterr().err == ""  # OpenCV's own complaints are not shown


def test_frames_can_be_sent_to_another_process(tmp_path):
    write_scene(tmp_path / "s")
    frame = pickle.loads(pickle.dumps(open_sequence(tmp_path / "s").frames[1]))
    assert (frame.read() == picture(2)).all()


def test_deep_pictures_become_eight_bits(tmp_path):
    save_camera(CAMERA, tmp_path / "camera.yaml")
    cv2.imwrite(str(tmp_path / "a.png"), np.full((48, 64), 0x8000, dtype=np.uint16))
    assert (open_sequence(tmp_path).frames[0].read() == 128).all()


# ---- bare folder -------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["camera.json", "camera.yaml", "camera.yml"])
def test_images_of_a_folder_come_in_natural_order_with_its_camera(tmp_path, name):
    for image in ("f10.png", "f2.png", "f1.JPG", "._f1.png"):
        (tmp_path / image).write_bytes(cv2.imencode(".png", picture(9))[1].tobytes())
    (tmp_path / "notes.txt").write_text("")
    save_camera(CAMERA, tmp_path / name)
    sequence = open_sequence(tmp_path)
    assert [frame.name for frame in sequence] == ["f1.JPG", "f2.png", "f10.png"]
    assert [frame.im_id for frame in sequence] == [0, 1, 2]
    frame = sequence.frames[0]
    assert frame.camera == CAMERA
    assert (frame.time_s, frame.camera_from_target, frame.obj_id) == (None, None, 1)
    assert (frame.read() == 9).all()


def test_a_folder_of_images_needs_a_camera(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), picture(1))
    with pytest.raises(RendezviewError, match="no camera: give a camera file, or put one"):
        open_sequence(tmp_path)
    assert open_sequence(tmp_path, CAMERA).frames[0].camera == CAMERA


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none", "no such file or folder"),
        ("empty", "no images in it"),
        ("notes.txt", "no sequence of images"),
        ("a.png", "not an image that can be read"),
        ("a.json", "no sequence of images"),
        ("a.mp4", "not a video that can be read"),
    ],
)
def test_what_is_no_sequence_is_refused(tmp_path, name, message, capfd):
    (tmp_path / "empty").mkdir()
    for file in ("notes.txt", "a.png", "a.json", "a.mp4"):
        (tmp_path / file).write_text("nothing")
    with pytest.raises(RendezviewError, match=message):
        open_sequence(tmp_path / name, CAMERA)
    assert "OpenCV" not in capfd.readouterr().err  # FFmpeg's own line cannot be kept back


# ---- writer ------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_aborted_scene_leaves_nothing(tmp_path, error):
    def abort() -> None:
        with BopSceneWriter(tmp_path / "s", CAMERA) as writer:
            writer.add(0, picture(1), None, None, mask=picture(1))
            raise error

    with pytest.raises(error):
        abort()
    assert not (tmp_path / "s").exists()


def test_an_aborted_scene_leaves_the_users_other_files(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    writer = BopSceneWriter(tmp_path, CAMERA)
    writer.add(0, picture(1), None, None)
    writer.abort()
    assert files_of(tmp_path) == ["notes.txt"]


def test_a_scene_is_not_complete_before_it_is_closed(tmp_path):
    writer = BopSceneWriter(tmp_path / "s", CAMERA)
    writer.add(0, picture(1), None, None)
    assert files_of(tmp_path / "s") == ["gray/000000.png"]
    writer.close()
    writer.close()
    assert (tmp_path / "s" / "scene_gt.json").is_file()
    with pytest.raises(ValueError, match="closed"):
        writer.add(1, picture(1), None, None)


def test_a_folder_with_a_scene_is_refused_unless_overwriting(tmp_path):
    write_scene(tmp_path / "s", numbers=(0, 1, 2))
    (tmp_path / "s" / "notes.txt").write_text("mine")
    before = files_of(tmp_path / "s")
    with pytest.raises(RendezviewError, match="already has a scene"):
        BopSceneWriter(tmp_path / "s", CAMERA)
    assert files_of(tmp_path / "s") == before
    write_scene(tmp_path / "s", numbers=(5,), overwrite=True)
    assert [frame.im_id for frame in open_sequence(tmp_path / "s")] == [5]
    assert files_of(tmp_path / "s") == [
        "camera.json", "gray/000005.png", "mask_visib/000005_000000.png", "notes.txt",
        "scene_camera.json", "scene_gt.json",
    ]  # fmt: skip


def test_pictures_left_by_a_kill_count_as_a_scene(tmp_path):
    (tmp_path / "s" / "gray").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "s" / "gray" / "000000.png"), picture(1))
    with pytest.raises(RendezviewError, match="already has a scene"):
        BopSceneWriter(tmp_path / "s", CAMERA)


def test_a_scene_without_frames_is_refused(tmp_path):
    writer = BopSceneWriter(tmp_path / "s", CAMERA)
    with pytest.raises(RendezviewError, match="at least one frame"):
        writer.close()
    assert not (tmp_path / "s").exists()


def test_a_scene_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "s").write_text("a file")
    with pytest.raises(RendezviewError, match="cannot be created"):
        BopSceneWriter(tmp_path / "s", CAMERA)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"im_id": -1}, "im_id"),
        ({"im_id": 0}, "im_id"),
        ({"image": picture(1, (40, 64))}, "image must be uint8"),
        ({"image": np.zeros((48, 64))}, "image must be uint8"),
        ({"mask": picture(1, (40, 64))}, "mask must be"),
        ({"time_s": float("nan")}, "time_s"),
    ],
)
def test_a_wrong_frame_is_a_programmers_error(tmp_path, change, message):
    frame = {"im_id": 1, "image": picture(1), "camera_from_target": None, "time_s": None}
    with BopSceneWriter(tmp_path / "s", CAMERA) as writer:
        writer.add(0, picture(1), None, None)
        with pytest.raises(ValueError, match=message):
            writer.add(**{**frame, **change})


def test_the_scene_number_must_fit_the_folder(tmp_path):
    with pytest.raises(ValueError, match="scene_id 3"):
        BopSceneWriter(tmp_path / "000002", CAMERA, scene_id=3)
    assert BopSceneWriter(tmp_path / "000002", CAMERA).scene_id == 2
    assert BopSceneWriter(tmp_path / "s", CAMERA).scene_id == 1
