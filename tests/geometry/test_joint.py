"""Joints: angles, ranges and configurations."""

import numpy as np
import pytest

from rendezview.geometry.joint import Hinge, Joint

HINGE = Hinge(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
DOOR = Joint("door", (HINGE,), -0.5, 1.0)
WING = Joint("wing", (Hinge(np.array([0.0, 1.0, 0.0]), np.zeros(3)),), 0.0, np.pi, np.pi)
DOORS = Joint("doors", (HINGE, Hinge(-HINGE.axis, -HINGE.origin_m)), 0.0, 2.0)


def test_a_turn_is_about_the_axis_through_the_origin() -> None:
    moved = HINGE.moved([[2.0, 0.0, 5.0], [1.0, 0.0, 3.0]], np.pi / 2)
    assert moved == pytest.approx(np.array([[1.0, 1.0, 5.0], [1.0, 0.0, 3.0]]))


def test_angles_are_held_at_the_limits_or_wrapped() -> None:
    assert DOOR.within(1.4) == 1.0
    assert DOOR.within(-2.0) == -0.5
    assert WING.within(np.pi + 0.2) == pytest.approx(0.2)
    assert WING.within(-0.2) == pytest.approx(np.pi - 0.2)


def test_angles_of_repeating_turns_are_apart_the_shorter_way() -> None:
    assert WING.apart(0.1, np.pi - 0.1) == pytest.approx(0.2)
    assert DOOR.apart(0.9, -0.4) == pytest.approx(1.3)


@pytest.mark.parametrize("joint", [DOOR, WING])
def test_every_angle_of_the_range_is_within_half_a_step_of_a_sheet(joint: Joint) -> None:
    configurations = joint.configurations(0.26)
    for angle in np.linspace(joint.lowest_rad, joint.highest_rad, 200):
        assert (
            min(abs(joint.apart(angle, configuration)) for configuration in configurations) <= 0.131
        )


def test_a_joint_survives_its_record() -> None:
    again = Joint.of_record(WING.record())
    assert (again.name, again.lowest_rad, again.period_rad) == ("wing", 0.0, np.pi)
    assert again.hinges[0].axis == pytest.approx(WING.hinges[0].axis)
    pair = Joint.of_record(DOORS.record())
    assert [h.axis.tolist() for h in pair.hinges] == [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    assert [h.origin_m.tolist() for h in pair.hinges] == [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    single = {key: value for key, value in WING.record().items() if key != "others"}
    assert len(Joint.of_record(single).hinges) == 1, "models of earlier versions"
    with pytest.raises(ValueError, match="three numbers"):
        Joint.of_record(WING.record() | {"axis": [0.0, 1.0]})
