"""YAML files of calibration tools (OpenCV, ROS), read with PyYAML.

Differences from plain PyYAML:

- Scalars follow YAML 1.2: ``1e-3`` is a number, ``yes`` and ``10:57:34`` are text.
- OpenCV's ``%YAML:1.0`` is accepted. Tags such as ``!!opencv-matrix`` are ignored.
- Only the first document is read: printed ROS messages end with ``---``.
- A repeated key, an alias or very deep nesting is an error.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import yaml

_MOST_DEPTH = 50  # nested collections; calibration files have about four. Source: a chosen limit
_DIRECTIVE = re.compile(r"^%YAML:.*$", re.MULTILINE)  # with its colon it is not YAML
_CONSTANTS = {
    "true": True, "false": False, "null": None, "~": None, "": None,
    ".nan": float("nan"), ".inf": float("inf"), "+.inf": float("inf"), "-.inf": float("-inf"),
}  # fmt: skip
_INTEGER = re.compile(r"[-+]?\d+")
_FLOAT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def parse_yaml(text: str) -> Any:
    """The first document of ``text`` as dicts, lists, numbers, strings, booleans and None.

    Raises:
        ValueError: not YAML, or one of the refused constructs above; the message gives the line.
    """
    # A tab may not indent in YAML, but calibration files written by hand have tabs.
    prepared = _DIRECTIVE.sub("", text, count=1).replace("\t", "    ")
    try:
        loader = _Loader(prepared)
        try:
            data = loader.get_data() if loader.check_data() else None  # type: ignore[no-untyped-call]
            loader.check_data()  # type: ignore[no-untyped-call]  # an error before a next document
            return data
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = "" if mark is None else f"line {mark.line + 1}: "
        raise ValueError(f"{where}{error.problem or error.context}") from error
    except yaml.reader.ReaderError as error:
        line = prepared.count("\n", 0, error.position) + 1
        raise ValueError(f"line {line}: a character that YAML does not allow") from error


class _Loader(yaml.SafeLoader):
    """Safe: it constructs plain values only, for any tags in the text."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 (PyYAML's own protocol)
    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """A node; aliases, which can expand without limit, and deep nesting are refused."""
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(None, None, "aliases (*name) are not read", mark)
        if self._depth >= _MOST_DEPTH:
            problem = f"more than {_MOST_DEPTH} nested lists or mappings"
            raise yaml.composer.ComposerError(None, None, problem, mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node; its tag plays no part."""
        if isinstance(node, yaml.MappingNode):
            return self.construct_mapping(node, deep)
        if isinstance(node, yaml.SequenceNode):
            return [self.construct_object(item) for item in node.value]
        quoted = isinstance(node, yaml.ScalarNode) and node.style is not None
        return node.value if quoted else _scalar(node.value)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """A dict; keys are text and must differ."""
        mapping: dict[Hashable, Any] = {}
        for key_node, value_node in node.value:
            mark = key_node.start_mark
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key must be text", mark)
            key = key_node.value
            if key in mapping:
                problem = f"the key {key!r} is there twice"
                raise yaml.constructor.ConstructorError(None, None, problem, mark)
            if node.flow_style and value_node.value == "" and value_node.style is None:
                problem = f"the key {key!r} in braces has no value"
                raise yaml.constructor.ConstructorError(None, None, problem, mark)
            mapping[key] = self.construct_object(value_node)
        return mapping


def _scalar(text: str) -> Any:
    """An unquoted scalar by the rules of YAML 1.2, decimal numbers only."""
    if text.lower() in _CONSTANTS:
        return _CONSTANTS[text.lower()]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    return text
