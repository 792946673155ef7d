"""Pictures of a board and of a rig are read as those of a run: as they are stored."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rendezview.calibration.board import pictures_of_a_camera
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons.detect.brown_lens import Lens
from rendezview.sensors.beacons.readings import open_readings
from rendezview.sensors.beacons.rig import Rig, RigCamera
from rendezview.sensors.beacons.rig_files import load_rig, save_opencv


def rig() -> Rig:
    names = ("left", "right")
    return Rig(
        tuple(
            RigCamera(name, 50.0, 50.0, 29.5, 19.5, Pose.identity(), Lens(), (60, 40))
            for name in names
        )
    )


def turned(path: Path) -> Path:
    """A picture of 60 × 40 that asks to be shown turned."""
    exif = Image.Exif()
    exif[0x0112] = 6  # by 90°
    Image.fromarray(np.zeros((40, 60), np.uint8)).save(path, exif=exif)
    return path


def test_a_picture_that_asks_to_be_turned_is_not(tmp_path: Path):
    """The camera file would be of pictures of 40 × 60, and every run has 60 × 40."""
    (picture,) = pictures_of_a_camera([turned(tmp_path / "a.jpg")])
    assert picture.shape == (40, 60)


def test_pictures_of_a_rig_that_ask_to_be_turned_fit_it(tmp_path: Path):
    for name in ("left01.jpg", "right01.jpg"):
        turned(tmp_path / name)
    (reading,) = open_readings(tmp_path, rig(), ())
    assert [len(spots) for spots in reading.fetch()] == [0, 0]


@pytest.mark.parametrize(("key", "wrong"), [("M2", "M1"), ("D2", "D1"), ("T", "T"), ("R", "R")])
def test_a_wrong_number_in_opencvs_rig_is_named(tmp_path: Path, key: str, wrong: str):
    path = tmp_path / "stereo.yaml"
    save_opencv(rig(), path)
    before, mark, after = path.read_text().partition(f"{key}: ")
    path.write_text(before + mark + after.replace("data: [ ", "data: [ .nan, ", 1))
    with pytest.raises(RendezviewError, match=rf"stereo\.yaml.*{wrong}: "):
        load_rig(path)
