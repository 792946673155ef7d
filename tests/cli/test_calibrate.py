"""`rendezview calibrate`: a camera from boards, a card to print; cameras as a source of frames."""

from __future__ import annotations

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.mjpeg_stream import mjpeg_stream

from rendezview.cli import reflectors
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.camera_files import load_camera, save_camera
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.frame import Frame
from rendezview.io.sequences.live import is_live, live_frames, with_rate
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.beacons.detect.difference import LitDark, ThresholdOptions
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.beacons.run import FramePair, wrong_mode
from rendezview.sensors.observation import Status
from rendezview_ground.simulate.bop_writer import BopSceneWriter

CAMERA = Camera(640, 480, 620.0, 625.0, 322.0, 236.0)
SQUARE = 40  # px of the printed board


def view(board, pitch, rng):
    """A picture of a board (an image whose squares are SQUARE px) held at random before CAMERA."""
    height, width = board.shape
    size = pitch * np.array([width, height]) / SQUARE
    turn = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3) * (1.0, 1.0, 0.5))[0]
    at = np.array([rng.uniform(-0.05, 0.05), rng.uniform(-0.04, 0.04), rng.uniform(0.45, 0.6)])
    corners = np.array([[0, 0, 0], [size[0], 0, 0], [size[0], size[1], 0], [0, size[1], 0]])
    places = (corners - [*(0.5 * size), 0.0]) @ turn.T + at
    pixels = (places[:, :2] / places[:, 2:]) * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    source = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
    warp = cv2.getPerspectiveTransform(source, pixels.astype(np.float32))
    return cv2.warpPerspective(
        board, warp, (CAMERA.width, CAMERA.height), flags=cv2.INTER_AREA, borderValue=255
    )


def dots(rng, peak, ground=20.0, off=0.0):
    """Three dots on an even ground, with noise."""
    rows, columns = np.mgrid[:480, :640]
    grey = ground + rng.normal(0.0, 1.5, (480, 640))
    for x, y in ((200, 240), (330, 250), (400, 300)):
        grey += peak * np.exp(-0.5 * ((columns - x - off) ** 2 + (rows - y) ** 2) / 9.0)
    return np.clip(grey, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("boards")
    chess = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((SQUARE, SQUARE))) * 255
    chess = np.pad(chess.astype(np.uint8), SQUARE, constant_values=255)
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    charuco = cv2.aruco.CharucoBoard((8, 6), 0.03, 0.022, markers)
    printed = charuco.generateImage((8 * SQUARE, 6 * SQUARE))
    for name, board, pitch in (("chess", chess, 0.025), ("charuco", printed, 0.03)):
        (folder / name).mkdir()
        for k in range(10):
            cv2.imwrite(str(folder / name / f"{k:02d}.png"), view(board, pitch, rng))
    return folder


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("chess", ("--board", "9x6", "--pitch-mm", "25")),
        ("charuco", ("--board", "8x6", "--pitch-mm", "30", "--marker-mm", "22")),
    ],
)
def test_a_camera_is_calibrated_from_a_board(run, boards, tmp_path, kind, options):
    out = tmp_path / "camera.yaml"
    ran = run("calibrate", "camera", boards / kind, *options, "-o", out)
    assert ran.code == 0, ran
    assert "pictures, r.m.s." in ran.err
    found = load_camera(out)
    assert (found.width, found.height) == (640, 480)
    assert (found.fx, found.fy) == pytest.approx((620.0, 625.0), rel=0.02)
    assert (found.cx, found.cy) == pytest.approx((322.0, 236.0), abs=8.0)


def test_what_is_no_board_is_told(run, boards, tmp_path):
    out = tmp_path / "c.yaml"
    one = boards / "chess" / "00.png"
    run("calibrate", "camera", one, "-o", out).says("5 are needed")
    run("calibrate", "camera", tmp_path, "-o", out).says("no pictures")
    run("calibrate", "camera", one, "--board", "9", "-o", out).says("--board must be")
    run("calibrate", "camera", boards / "charuco", "--board", "8x6", "--marker-mm", "22",
        "--dictionary", "DICT_X", "-o", out).says("no 'DICT_X'")  # fmt: skip


def test_a_card_is_written_and_read_without_a_mesh(run, tmp_path):
    ran = run("calibrate", "card", "-o", tmp_path / "card")
    assert ran.code == 0, ran
    assert (tmp_path / "card" / "card.pdf").stat().st_size > 500
    run("reflectors", tmp_path / "card" / "target.toml", "93").says("no such camera")
    run("train", tmp_path / "card", "-o", tmp_path / "m.rvm").says("has no mesh")


def test_cameras_are_told_from_paths(tmp_path, monkeypatch):
    assert all(is_live(name) for name in ("0", "/dev/video0", "rtsp://host/1"))
    assert not any(is_live(name) for name in ("pictures", "a.mp4"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "7").mkdir()
    assert not is_live("7")
    with pytest.raises(RendezviewError, match=r"93: no such camera|cannot be opened"):
        live_frames("93", CAMERA)
    with pytest.raises(RendezviewError, match="cannot be opened"):
        live_frames("http://127.0.0.1:9/nothing", CAMERA)


def test_a_rate_gives_pictures_their_times(boards):
    timed = with_rate(open_sequence(boards / "chess", CAMERA), 4.0)
    assert [frame.time_s for frame in timed][:3] == [0.0, 0.25, 0.5]
    with pytest.raises(RendezviewError, match="--rate"):
        with_rate(timed, 0.0)


def test_dots_without_a_dark_picture_are_told(run, boards, tmp_path):
    rng = np.random.default_rng(1)
    folder = tmp_path / "dots"
    folder.mkdir()
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), dots(rng, 180.0))
    run("calibrate", "card", "-o", tmp_path / "card")
    run("calibrate", "camera", boards / "chess", "-o", tmp_path / "c.yaml")
    ran = run("reflectors", tmp_path / "card", folder, "--camera", tmp_path / "c.yaml")
    assert ran.code == 0, ran
    assert "did you mean --mode single?" in ran.err


def test_the_shape_of_a_target_is_calibrated_from_a_scene(
    run, refining_model, bumpy_mesh, camera, draw, tmp_path
):
    stretched = replace(bumpy_mesh, vertices_m=bumpy_mesh.vertices_m * [1.03, 1.0, 1.0])
    folder, center = tmp_path / "scene", np.array(refining_model.centre_m)
    with BopSceneWriter(folder, camera) as scene:
        for k in range(8):
            rng = np.random.default_rng([9, k])
            rotation = Rotation.random(random_state=rng)
            pose = Pose(rotation.as_matrix(), np.array([0.0, 0.0, 9.0]) - rotation.apply(center))
            scene.add(k, draw(stretched, pose, camera, rng), pose, float(k))
    refining_model.save(tmp_path / "cad.rvm")
    shape = ("calibrate", "shape", tmp_path / "cad.rvm", folder, "-o", tmp_path / "built.rvm")
    ran = run(*shape, "--poses", "scene", "--length", "x=1.03/1.0")
    assert ran.code == 0, ran
    assert "of 8 frames" in ran.err
    strain = np.array(ViewModel.load(tmp_path / "built.rvm").provenance["strain"])
    assert strain[0, 0] == pytest.approx(0.03, abs=0.003)
    assert strain[1, 1] == pytest.approx(0.0, abs=0.006)
    target = tmp_path / "target.toml"
    head = (
        'name = "bumpy"\n[docking_ring]\ncentre_m = [0, 0, 0]\naxis = [0, 0, 1]\nradius_m = 0.1\n'
    )
    target.write_text(head)
    run(*shape, "--parts", target).says("no [[parts]]")
    low, high = bumpy_mesh.vertices_m.min(0), bumpy_mesh.vertices_m.max(0)
    box = [[float(0.5 * (low + high)[0]), *(low[1:] - 1.0).tolist()], (high + 1.0).tolist()]
    target.write_text(f'{head}[[parts]]\nname = "front"\ntrust = 1.0\nboxes_m = [{box}]\n')
    lens = tmp_path / "lens.yaml"
    ran = run(*shape, "--poses", "scene", "--parts", target, "--lens", lens)
    assert ran.code == 0, ran
    assert "front" in ran.err
    assert "trust" in ran.err
    assert "focal length" in ran.err
    assert load_camera(lens).fx == pytest.approx(camera.fx, rel=0.02)
    motion = ViewModel.load(tmp_path / "built.rvm").provenance["mounted"]["front"]
    assert len(motion) == 6
    assert 0.0 < abs(motion[3]) < 0.1
    run(*shape, "--length", "w=1/1").says("--length must be")
    run(*shape, "--length", "x=1/0").says("--length must be")
    run(*shape, "--poses", tmp_path / "none.csv").says("none.csv")


def test_separate_poses_are_told_of_the_likely_option(monkeypatch):
    """Dots are found at once and nothing follows them: the mode of the pictures is right."""
    said = []
    monkeypatch.setattr(reflectors, "say", said.append)
    grey = np.full((CAMERA.height, CAMERA.width), 9, np.uint8)
    frame = Frame(0, "0.png", 0.0, CAMERA, None, 1, lambda: grey)
    pair = FramePair(frame, None, None, False)
    found = ReflectorObservation(Status.UNCONFIRMED, "found for the first time")
    gone = ReflectorObservation(Status.NO_SPOTS, "no spots")
    for readings in ([found, gone, found], [found, gone, gone, gone]):
        hint = reflectors._Hint(ThresholdOptions())
        for reading in readings:
            hint.look(pair, LitDark(grey), reading)
        hint.tell()
    assert len(said) == 1
    assert "--independent" in said[0]


def test_a_camera_that_goes_on_is_told_of_the_likely_option(run, tmp_path):
    grey = dots(np.random.default_rng(3), -160.0, 200.0)
    run("calibrate", "card", "-o", tmp_path / "card")
    save_camera(CAMERA, tmp_path / "c.yaml")
    with mjpeg_stream([grey], 40) as address:
        watched = ("reflectors", tmp_path / "card", address, "--camera", tmp_path / "c.yaml")
        ran = run(*watched, "--readings", 12)
        few = run(*watched, "--readings", 2)
        right = run(*watched, "--readings", 12, "--invert")
    assert ran.err.count("did you mean --invert?") == 1, ran
    assert few.err.count("did you mean --invert?") == 1, few
    assert "did you mean" not in right.err


@pytest.mark.parametrize("moved_px", [0.0, 12.0])
def test_a_run_without_a_pose_names_the_likely_option(moved_px):
    picture = functools.partial(dots, np.random.default_rng(2))

    def hint(lit, dark=None, invert=False):
        frames = [
            Frame(k, f"{k}.png", 0.0, CAMERA, None, 1, lambda p=p: p)
            for k, p in enumerate((lit, dark))
        ]
        return wrong_mode([FramePair(frames[0], None if dark is None else frames[1], None, invert)])

    assert "--mode single" in hint(picture(180.0), picture(180.0, off=moved_px))
    assert hint(picture(180.0), picture(4.0)) is None
    assert "--invert" in hint(picture(-160.0, ground=200.0))
    assert "--invert" in hint(picture(-160.0, 200.0), picture(-160.0, 200.0, moved_px))
    assert hint(picture(-160.0, ground=200.0), invert=True) is None
    assert hint(picture(180.0)) is None
