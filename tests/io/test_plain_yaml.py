"""The subset of YAML that calibration tools write."""

import math

import pytest

from rendezview.io.plain_yaml import parse_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("# nothing\n\n", None),
        ("a: 1", {"a": 1}),
        ("%YAML:1.0\n---\na: 1\n---\nb: 2", {"a": 1}),
        ("a: -.5\nb: 1.\nc: 1e-3\nd: +2", {"a": -0.5, "b": 1.0, "c": 1e-3, "d": 2}),
        ("a: 1_000\nb: nan\nc: 0x10", {"a": "1_000", "b": "nan", "c": "0x10"}),
        ("a: true\nb: ~\nc:\nd: null", {"a": True, "b": None, "c": None, "d": None}),
        ("a: x # y\nb: x#y\nc: '#'\n'd e': \"1\"", {"a": "x", "b": "x#y", "c": "#", "d e": "1"}),
        ("a: b: c\nt: 10:57:34", {"a": "b: c", "t": "10:57:34"}),
        ("- 1\n- [2, 3]\n-\n- - 4\n  - 5", [1, [2, 3], None, [4, 5]]),
        ("a:\n- 1\n- 2\nb: 3", {"a": [1, 2], "b": 3}),
        ("a:\n  - x: 1\n    y: 2\n  - x: 3", {"a": [{"x": 1, "y": 2}, {"x": 3}]}),
        ("a: [1, # one\n    2,\n 3]\nb: 4", {"a": [1, 2, 3], "b": 4}),
        ("a: {x: 1, y: [], z: {}}", {"a": {"x": 1, "y": [], "z": {}}}),
        ("a: !!opencv-matrix\n   rows: 1\n   data: [ 1. ]", {"a": {"rows": 1, "data": [1.0]}}),
        ("a:\n  b:\n    c: 1\n  d: 2\ne: 3", {"a": {"b": {"c": 1}, "d": 2}, "e": 3}),
        ("a: ['x, y', \"[\"]", {"a": ["x, y", "["]}),
    ],
)
def test_plain_yaml_is_read(text, value):
    assert parse_yaml(text) == value


def test_special_numbers_are_read():
    read = parse_yaml("a: [.nan, .inf, -.Inf]")["a"]
    assert math.isnan(read[0])
    assert read[1:] == [math.inf, -math.inf]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a: 1\nb", 2),
        ("a: [1, 2", 1),
        ("a: [1] 2", 1),
        ("a: [1, 2}", 1),
        ("a: {1, 2}", 1),
        ("a: 1\na: 2", 2),
        ("a: 1\n   b: 2", 2),
        ("  a: 1\nb: 2", 2),
    ],
)
def test_what_is_outside_the_subset_is_refused_with_its_line(text, line):
    with pytest.raises(ValueError, match=f"line {line}:"):
        parse_yaml(text)
