"""Options of the filter, from files and by hand."""

import math

import pytest

from rendezview.errors import RendezviewError
from rendezview.fusion import FusionOptions, MotionOptions, SensorOptions
from rendezview.fusion.logs import read_options


def test_options_take_the_keys_of_files_and_the_names_of_fields(tmp_path):
    file = tmp_path / "options.json"
    file.write_text('{"pose": {"lasting": 0.5, "bias_s": 7.0}, "ring": {"lasting_range": 0.1}}')
    options = read_options(file)
    assert (options.pose.bias_share, options.pose.bias_s) == (0.5, 7.0)
    assert options.ring.bias_range == 0.1
    file.write_text('{"motion": {"accelerations": [0.001], "lasting_accelerations": [0.01], '
                    '"stays_s": [60]}}')  # fmt: skip
    assert read_options(file).motion.accelerations == (0.001,)
    file.write_text('{"pose": {"share": 0.5}}')
    with pytest.raises(RendezviewError, match="share"):
        read_options(file)


@pytest.mark.parametrize(
    ("part", "key"),
    [("motion", key) for key in ("linear", "along", "pointing", "slews")]
    + [
        (part, key)
        for part in ("pose", "ring", "range")
        for key in ("gate", "lock_after", "loose_after", "unlock_after", "window", "nis_limit")
    ]
    + [("pose", "floor_rad"), ("ring", "floor_range"), (None, "recent_s")],
)
def test_keys_of_earlier_versions_are_ignored_and_named(part, key, tmp_path):
    file = tmp_path / "options.json"
    kept = '"history_s": 7.0'
    inner = f'"{key}": 0.001'
    file.write_text(
        f"{{{kept}, {inner}}}" if part is None else f'{{{kept}, "{part}": {{{inner}}}}}'
    )
    with pytest.warns(DeprecationWarning, match=key):
        options = read_options(file)
    assert options == FusionOptions(history_s=7.0)


def test_an_old_key_of_a_named_sensor_is_ignored_and_the_rest_is_taken(tmp_path):
    file = tmp_path / "options.json"
    file.write_text('{"sensors": {"ring": {"gate": 0.001, "inflation": 2.0}}}')
    with pytest.warns(DeprecationWarning, match="gate"):
        options = read_options(file)
    assert options.sensors == {"ring": SensorOptions(inflation=2.0)}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"angular": -1.0}, "angular must not be negative"),
        ({"accelerations": (1e-3,)}, "one entry for each"),
        ({"stays_s": (60.0, 40.0, 0.0)}, "must be positive"),
        ({"jitters": (), "jitters_s": ()}, "1 to 4"),
        ({"angular": 1e308}, "angular must be 0 or 1e-12 … 1e[+]09, not 1e[+]308"),
        ({"jitters": (1e-3, 1e300)}, "jitters must be 0 or"),
    ],
)
def test_wrong_motion_options_are_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        MotionOptions(**wrong)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"inflation": 0.0}, "inflation"),
        ({"bias_share": 1.0}, "lasting"),
        ({"bias_s": 0.0}, "lasting_s"),
        ({"outliers": 0.6}, "outliers"),
        ({"inflation": 1e308}, "inflation must be 0 or"),
        ({"bias_s": 1e-308}, "lasting_s must be 0 or"),
    ],
)
def test_wrong_sensor_options_are_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        SensorOptions(**wrong)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"risk": math.nan}, "risk must be from"),
        ({"risk": 5.0}, "risk must be from"),
        ({"risk": 0.0}, "risk must be from"),
        ({"ring_other_edge": 1.0}, "must be a probability"),
        ({"ring_depth_sigma_m": -0.1}, "ring_depth_sigma_m must be finite"),
        ({"history_s": math.inf}, "history_s must be finite"),
        ({"coasting_after_s": math.nan}, "coasting_after_s must be finite"),
        ({"lost_rad": math.nan}, "lost_rad must be positive"),
        ({"start_with": 0}, "start_with must be positive"),
    ],
)
def test_wrong_options_of_the_filter_are_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        FusionOptions(**wrong)
