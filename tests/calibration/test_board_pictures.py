"""Pictures of a board are read as those of a run: as they are stored."""

from pathlib import Path

import numpy as np
from PIL import Image

from rendezview.calibration.board import pictures_of_a_camera


def test_a_picture_that_asks_to_be_turned_is_not(tmp_path: Path):
    """The camera file would be of pictures of 40 × 60, and every run has 60 × 40."""
    exif = Image.Exif()
    exif[0x0112] = 6  # by 90°
    Image.fromarray(np.zeros((40, 60), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    (picture,) = pictures_of_a_camera([tmp_path / "a.jpg"])
    assert picture.shape == (40, 60)
