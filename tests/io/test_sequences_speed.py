"""SPEED and SPEED+ folders, against the data sets' own projection."""

import json

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import open_sequence

CAMERA = Camera(64, 48, 80.0, 81.0, 31.0, 24.0)
SPEED_CAMERA = {"Nu": 64, "Nv": 48, "ppx": 1e-5, "ppy": 1e-5, "fx": 8e-4, "fy": 8e-4}


def passive_matrix(quat):
    """SPEED's ``quat2dcm``, element by element: it maps camera to target coordinates."""
    w, x, y, z = np.asarray(quat) / np.linalg.norm(quat)
    return np.array(
        [
            [2 * w * w - 1 + 2 * x * x, 2 * x * y + 2 * w * z, 2 * x * z - 2 * w * y],
            [2 * x * y - 2 * w * z, 2 * w * w - 1 + 2 * y * y, 2 * y * z + 2 * w * x],
            [2 * x * z + 2 * w * y, 2 * y * z - 2 * w * x, 2 * w * w - 1 + 2 * z * z],
        ]
    )


def speed_labels(count, suffix=""):
    rng = np.random.default_rng(2)
    return [
        {
            "filename": f"img{index:06d}.jpg",
            f"q_vbs2tango{suffix}": rng.normal(size=4).tolist(),
            f"r_Vo2To_vbs{suffix}": [0.1, -0.2, 8.0 + index],
        }
        for index in range(count)
    ]


def write_images(folder, labels):
    folder.mkdir(parents=True, exist_ok=True)
    for index, label in enumerate(labels):
        cv2.imwrite(str(folder / label["filename"]), np.full((48, 64), 10 * index, np.uint8))


def test_speed_poses_project_as_the_data_set_projects(tmp_path):
    labels = speed_labels(3)
    (tmp_path / "camera.json").write_text(json.dumps(SPEED_CAMERA))
    (tmp_path / "train.json").write_text(json.dumps(labels))
    write_images(tmp_path / "images" / "train", labels)
    sequence = open_sequence(tmp_path)
    points = np.random.default_rng(3).normal(size=(10, 3))
    k = np.array([[80.0, 0.0, 32.0], [0.0, 80.0, 24.0], [0.0, 0.0, 1.0]])
    for index, (frame, label) in enumerate(zip(sequence, labels, strict=True)):
        assert (frame.im_id, frame.name) == (index, label["filename"])
        in_camera = points @ passive_matrix(label["q_vbs2tango"]) + label["r_Vo2To_vbs"]
        expected = in_camera / in_camera[:, 2:] @ k.T
        pixels = frame.camera.project(frame.camera_from_target.apply(points))
        np.testing.assert_allclose(pixels, expected[:, :2], atol=1e-9)
        assert frame.read().mean() == pytest.approx(10 * index, abs=1)


def test_speed_plus_has_its_camera_in_the_parent_and_true_labels(tmp_path):
    labels = speed_labels(2, "_true")
    (tmp_path / "camera.json").write_text(json.dumps(SPEED_CAMERA))
    folder = tmp_path / "lightbox"
    write_images(folder / "images", labels)
    (folder / "test.json").write_text(json.dumps(labels, indent=2))
    frames = open_sequence(folder).frames
    assert frames[1].camera_from_target.translation_m.tolist() == [0.1, -0.2, 9.0]
    np.testing.assert_allclose(
        frames[1].camera_from_target.rotation,
        passive_matrix(labels[1]["q_vbs2tango_true"]).T,
        atol=1e-14,
    )
    assert open_sequence(folder, CAMERA).frames[0].camera == CAMERA


def test_several_speed_label_files_have_to_be_chosen_from(tmp_path):
    labels = speed_labels(2)
    (tmp_path / "camera.json").write_text(json.dumps(SPEED_CAMERA))
    write_images(tmp_path / "images", labels)
    (tmp_path / "train.json").write_text(json.dumps(labels))
    (tmp_path / "test.json").write_text(json.dumps([{"filename": "img000000.jpg"}]))
    with pytest.raises(RendezviewError, match=r"exactly one .*test\.json, .*train\.json"):
        open_sequence(tmp_path)
    (frame,) = open_sequence(tmp_path / "test.json")
    assert frame.camera_from_target is None
    assert len(open_sequence(tmp_path / "train.json")) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"r_Vo2To_vbs": None}, r"train\.json: 0 \(img000000\.jpg\): r_Vo2To_vbs: missing"),
        ({"q_vbs2tango": [1.0, 0.0, 0.0]}, r"train\.json: 0\.q_vbs2tango"),
        ({"q_vbs2tango": [0.0, 0.0, 0.0, 0.0]}, "not all zero"),
        ({"filename": "other.jpg"}, r"first image other\.jpg is in none of"),
    ],
)
def test_wrong_speed_labels_are_named(tmp_path, change, message):
    labels = speed_labels(1)
    (tmp_path / "camera.json").write_text(json.dumps(SPEED_CAMERA))
    write_images(tmp_path / "images", labels)
    (tmp_path / "train.json").write_text(json.dumps([{**labels[0], **change}]))
    with pytest.raises(RendezviewError, match=message):
        open_sequence(tmp_path)


def test_a_speed_labels_file_without_a_camera_is_refused(tmp_path):
    labels = speed_labels(1)
    folder = tmp_path / "a" / "b"
    write_images(folder / "images", labels)
    (folder / "train.json").write_text(json.dumps(labels))
    with pytest.raises(RendezviewError, match=r"no camera\.json"):
        open_sequence(folder / "train.json")
