"""YAML as calibration tools write it: what is read, and what is refused with its line."""

import math

import pytest

from rendezview.io.calibration_yaml import parse_yaml


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
        ("a: 'b: c'\nt: 10:57:34", {"a": "b: c", "t": "10:57:34"}),
        ("a: 1.5e3\nb: 010\nc: 2011-02-03", {"a": 1500.0, "b": 10, "c": "2011-02-03"}),
        ("a: yes\nb: off\nd: ''", {"a": "yes", "b": "off", "d": ""}),
        ("a:\t1", {"a": 1}),
        ("%YAML 1.2\n---\na: &x 1", {"a": 1}),
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
def test_calibration_yaml_is_read(text, value):
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
        ("a: b: c", 1),
        ("a: {b: 1, b: 2}", 1),
        ("a: 1\nb: \x01", 2),
        ("[a, b]: 1", 1),
    ],
)
def test_wrong_yaml_is_refused_with_its_line(text, line):
    with pytest.raises(ValueError, match=f"line {line}:"):
        parse_yaml(text)


def test_a_text_that_grows_by_aliases_is_refused():
    levels = "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdef", "bcdefg", strict=True))
    with pytest.raises(ValueError, match=r"line 2: aliases \(\*name\) are not read"):
        parse_yaml("a: &a [x, x]\n" + levels)


@pytest.mark.parametrize("text", ["[" * 10_000, "- " * 10_000, "{a: " * 10_000])
def test_very_deep_nesting_is_refused(text):
    with pytest.raises(ValueError, match=r"line 1: more than 50 nested"):
        parse_yaml(text)


@pytest.mark.parametrize("tag", ["!!python/object/apply:os.system", "!!opencv-matrix", "!x"])
def test_a_tag_runs_nothing_and_the_value_is_plain(tag):
    assert parse_yaml(f"a: {tag} [1, x]") == {"a": [1, "x"]}
