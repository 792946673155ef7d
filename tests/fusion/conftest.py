"""Worlds of drawn measurements."""

from __future__ import annotations

import pytest
from tests.fusion.scenes import World


@pytest.fixture
def make_world() -> type[World]:
    return World


@pytest.fixture
def world() -> World:
    return World(3)
