"""What a reading should be at a state: residuals, Jacobians by perturbation, edges, surfaces."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.fusion.scenes import PLANE, QUIET, RING, WHITE, still_at

from rendezview.fusion import (
    BeamMesh,
    BeamSurface,
    FusionOptions,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    SensorOptions,
)
from rendezview.fusion.models import forecasts
from rendezview.fusion.prediction import estimate_of
from rendezview.fusion.state import RING_GEOMETRY, begin, with_slot
from rendezview.geometry.pose import Pose

# One large face, aslant, where the beam of the scenes meets the target.
WALL = BeamMesh(30.0 * np.array([[0, -1, -1], [0, 1, -1], [0.5, 0, 2]]), np.array([[0, 1, 2]]))
HALF = SensorOptions(bias_share=0.5)
OPTIONS = replace(QUIET, pose=HALF, ring=HALF, range=HALF)
GEOMETRY = replace(OPTIONS, ring_radius_sigma=0.1, ring_depth_sigma_m=0.5)


def begun(world, measurement, options):
    """A state at a first pose, a little beside the truth, with room for the measurement."""
    state = begin(world.pose(0.0), options)._replace(confirmed=True)
    return with_slot(state, measurement, options.ring)


def moved(state, step):
    """Attitude on the left, place added."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return state._replace(rotation=turn @ state.rotation, place_m=state.place_m + step[3:])


def with_deviation(state, entry, value):
    deviations = state.deviations.copy()
    deviations[:, entry] += value
    return state._replace(deviations=deviations)


def meanings(state, measurement, options):
    found = forecasts(state, measurement, options)
    assert isinstance(found, list), found
    return found


def innovation(state, measurement, options, which=0):
    """Measured less expected, with what the deviations say."""
    found = meanings(state, measurement, options)[which]
    return found.residual - found.design @ (state.weights @ state.deviations)


def slopes(state, measurement, options, entries, which=0):
    """The design's columns by perturbation: an innovation falls where what is expected rises."""
    columns = []
    for entry in entries:
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            if entry < 6:
                step[entry] = sign * 1e-6
                there = moved(state, step)
            else:
                there = with_deviation(state, entry, sign * 1e-6)
            ends.append(innovation(there, measurement, options, which))
        columns.append((ends[1] - ends[0]) / 2e-6)
    return np.column_stack(columns)


def test_the_slope_of_a_pose_is_its_derivative(world):
    one = world.pose(0.0)
    state = begun(world, one, OPTIONS)
    # At the measured attitude a difference of rotation vectors is that of the rotations.
    state = state._replace(rotation=np.array(one.pose.rotation))
    (found,) = meanings(state, one, OPTIONS)
    start = state.slots[one.sensor].start
    entries = [*range(6), *range(start, start + 6)]
    slope = slopes(state, one, OPTIONS, entries)
    assert found.design[:, entries] == pytest.approx(slope, abs=1e-6)
    others = np.delete(found.design, entries, axis=1)
    assert not others.any()  # no rate, jitter or acceleration is seen at once


def test_the_slope_of_a_pose_far_from_the_state_errs_by_half_the_angle(world):
    one = world.pose(0.0, np.array([0.05, -0.04, 0.02, 0.0, 0.0, 0.0]))
    state = begun(world, one, OPTIONS)
    (found,) = meanings(state, one, OPTIONS)
    slope = slopes(state, one, OPTIONS, range(6))
    angle = np.linalg.norm(found.residual[:3])
    assert np.abs(found.design[:, :6] - slope)[:3].max() < 0.6 * angle
    assert found.design[3:, :6] == pytest.approx(slope[3:], abs=1e-6)


@pytest.mark.parametrize("options", [OPTIONS, GEOMETRY], ids=["known", "radius and depth"])
def test_the_slope_of_a_ring_is_its_derivative(world, options):
    ring = world.ring(0.0)
    state = begun(world, ring, options)
    slot = state.slots.get(RING_GEOMETRY)
    entries = list(range(6))
    if slot is not None:
        state = with_deviation(with_deviation(state, slot.start, 0.4), slot.start + 1, -0.3)
        entries += [slot.start, slot.start + 1]
    bias = state.slots["ring"].start
    entries += range(bias, bias + 5)
    (found,) = meanings(state, ring, options)
    slope = slopes(state, ring, options, entries)
    # Its axis is a unit vector beside another: the tangents turn with the state, of second order.
    assert found.design[:3, entries] == pytest.approx(slope[:3], abs=1e-6)
    assert found.design[3:, entries] == pytest.approx(slope[3:], abs=0.03)
    assert np.abs(slope[3:, :3]).max() > 0.9
    assert not np.delete(found.design, entries, axis=1).any()


def test_a_ring_is_where_its_radius_and_depth_put_it(world):
    ring = world.ring(0.0)
    state = begun(world, ring, GEOMETRY)
    slot = state.slots[RING_GEOMETRY]
    state = with_deviation(with_deviation(state, slot.start, 0.4), slot.start + 1, -0.3)
    pose, _, _ = estimate_of(state)
    # True radius 4 % larger: a sensor that takes the given one puts it 4 % too near.
    centre = pose.apply(RING.centre_m - 0.15 * RING.axis) / 1.04
    off = ring.candidates[0].centre_m - centre
    assert innovation(state, ring, GEOMETRY)[:3] == pytest.approx(off, abs=1e-12)


@pytest.mark.parametrize(
    "beam",
    [
        RangeMeasurement(0.0, "laser", 29.0, 0.02, (PLANE,)),
        RangeMeasurement(
            0.0, "laser", 30.0, 0.02,
            (BeamSurface(np.array([0.2, 0.5, -0.3]), np.array([-0.8, 0.6, 0.0]), 0.03),),
            np.array([0.4, -0.3, 0.1]), np.array([0.05, 0.02, 1.0]),
        ),
        RangeMeasurement(
            0.0, "laser", 30.0, 0.02,
            WALL, np.array([0.1, -0.2, 0.1]), np.array([0.01, 0.02, 1.0]),
        ),
    ],
    ids=["straight", "slanting", "mesh"],
)  # fmt: skip
def test_the_slope_of_a_range_is_its_derivative(world, beam):
    state = begun(world, beam, OPTIONS)
    bias = state.slots["laser"].start
    (found,) = meanings(state, beam, OPTIONS)
    slope = slopes(state, beam, OPTIONS, [*range(6), bias])
    assert found.design[:, [*range(6), bias]] == pytest.approx(slope, abs=1e-5)
    assert not np.delete(found.design, [*range(6), bias], axis=1).any()


def test_a_range_is_the_way_to_the_plane(world):
    beam = replace(world.range(0.0, 1e-9), origin_m=np.array([0.3, 0.1, 0.2]))
    state = begun(world, beam, OPTIONS)
    (found,) = meanings(state, beam, OPTIONS)
    pose, _, _ = estimate_of(state)
    spot = beam.origin_m + (beam.range_m - found.residual[0]) * beam.direction
    assert PLANE.normal @ (pose.inverse().apply(spot) - PLANE.point_m) == pytest.approx(
        0.0, abs=1e-9
    )


def test_noise_and_bias_are_together_what_the_sensor_reports(world):
    told = replace(OPTIONS, pose=SensorOptions(inflation=1.5))
    for one in world.kinds(0.0):
        state = begun(world, one, told)
        found = meanings(state, one, told)[0]
        bias = state.slots[one.sensor].start
        part = found.design[:, bias : bias + len(found.residual)]
        whole = found.noise + part @ part.T
        assert whole == pytest.approx(found.root @ found.root.T, rel=1e-9, abs=1e-15)
        if isinstance(one, PoseMeasurement):
            assert whole == pytest.approx(1.5 * one.covariance, rel=1e-6, abs=1e-11)
            assert found.shares == pytest.approx(np.full(6, 0.4))
        if isinstance(one, RangeMeasurement):
            assert found.noise[0, 0] == pytest.approx(one.sigma_m**2)


def test_a_white_share_above_one_is_noise_beyond_the_report(world):
    one = world.pose(0.0)
    state = begun(world, one, OPTIONS)
    state = state._replace(white={"camera": np.full(6, 2.0)})
    (found,) = meanings(state, one, OPTIONS)
    assert not found.design[:, 18:].any()
    assert found.noise == pytest.approx(2.0 * one.covariance)


def test_the_relief_of_a_surface_is_a_bias(world):
    beam = replace(world.range(0.0), surfaces=(replace(PLANE, relief_m=0.3),))
    state = begun(world, beam, OPTIONS)
    (found,) = meanings(state, beam, OPTIONS)
    assert found.noise[0, 0] == pytest.approx(0.02**2)
    assert found.design[0, state.slots["laser"].start] == pytest.approx(0.3)
    assert not found.teaches


def test_an_axis_of_either_sign_is_the_same_ring(world):
    ring = world.ring(0.0)
    one = ring.candidates[0]
    root = world.rng.standard_normal((6, 6))
    mixed = 0.1 * one.covariance + 1e-6 * root @ root.T  # with covariance of centre and axis
    flipped = mixed.copy()
    flipped[:3, 3:] *= -1.0
    flipped[3:, :3] *= -1.0
    plus = replace(ring, candidates=(RingCandidate(one.centre_m, one.axis, mixed),))
    minus = replace(ring, candidates=(RingCandidate(one.centre_m, -one.axis, flipped),))
    state = begun(world, ring, OPTIONS)
    (a,), (b,) = (meanings(state, m, OPTIONS) for m in (plus, minus))
    assert np.abs(a.residual[3:]).max() < 0.1
    assert a.residual == pytest.approx(b.residual, abs=1e-12)
    assert a.noise == pytest.approx(b.noise, abs=1e-15)
    assert a.design == pytest.approx(b.design, abs=1e-12)


def test_each_circle_of_an_ellipse_is_a_meaning(world):
    ring = world.ring(0.0)
    one = ring.candidates[0]
    tilted = Rotation.from_rotvec([0.0, 0.4, 0.0]).as_matrix() @ one.axis
    pair = replace(ring, candidates=(RingCandidate(one.centre_m, tilted, one.covariance), one))
    state = begun(world, ring, OPTIONS)
    wrong, right = meanings(state, pair, OPTIONS)
    assert np.linalg.norm(wrong.residual[3:]) > 0.3
    assert np.linalg.norm(right.residual[3:]) < 0.05


def test_another_edge_counts_for_its_bearing_and_teaches_nothing(world):
    options = replace(OPTIONS, ring_other_edge=0.1)
    ring = world.ring(0.0)
    state = begun(world, ring, options)
    edge, other = meanings(state, ring, options)
    assert (edge.other_edge, other.other_edge) == (False, True)
    assert edge.teaches
    assert not other.teaches
    assert np.exp([edge.log_prior, other.log_prior]) == pytest.approx([0.9, 0.1])
    # Its bias is another than that of the ring's own edge.
    start = state.slots["ring"].start
    assert edge.design[:, start : start + 5].any()
    assert not edge.design[:, start + 5 : start + 10].any()
    assert not other.design[:, start : start + 5].any()
    whole = other.root @ other.root.T
    sight = ring.candidates[0].centre_m
    away_m = np.linalg.norm(sight)
    sight = sight / away_m
    across = np.cross(sight, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    centre = whole[:3, :3]
    assert np.sqrt(sight @ centre @ sight) / away_m == pytest.approx(0.3, rel=0.01)
    assert np.sqrt(across @ centre @ across) / away_m == pytest.approx(0.01, rel=0.01)


def test_what_cannot_be_compared_says_why(world):
    ring, beam = world.ring(0.0), world.range(0.0)
    state = begun(world, ring, OPTIONS)
    behind = state._replace(place_m=-state.place_m)
    assert "behind the camera" in forecasts(behind, ring, OPTIONS)
    state = begun(world, beam, OPTIONS)
    along = replace(beam, direction=np.array([1.0, 0.0, -0.01]))
    assert "grazes" in forecasts(state, along, OPTIONS)
    away = replace(beam, direction=np.array([0.0, 0.0, -1.0]))
    assert "behind the ranger" in forecasts(state, away, OPTIONS)
    mesh = replace(beam, surfaces=WALL)
    assert "waits" in forecasts(state._replace(confirmed=False), mesh, OPTIONS)
    flat = replace(ring.candidates[0], covariance=np.zeros((6, 6)))
    state = begun(world, ring, OPTIONS)
    assert "covariance" in forecasts(state, replace(ring, candidates=(flat,)), OPTIONS)
    lost = begun(world, ring, GEOMETRY)
    lost = with_deviation(lost, lost.slots[RING_GEOMETRY].start, -9.5)
    assert "radius is lost" in forecasts(lost, ring, GEOMETRY)


@pytest.mark.parametrize(
    ("inner_m", "outer_m", "says"), [(0.0, 0.1, False), (0.0, 5.0, True), (3.0, 5.0, False)]
)
def test_a_spot_beside_the_surface_says_nothing(world, inner_m, outer_m, says):
    state = begun(world, world.range(0.0), OPTIONS)
    surface = replace(PLANE, inner_m=inner_m, outer_m=outer_m)
    found = forecasts(state, replace(world.range(0.0), surfaces=(surface,)), OPTIONS)
    assert isinstance(found, list) is says
    if not says:
        assert "may miss" in found


def test_the_next_surface_stands_in_where_the_spot_may_miss_the_first(world):
    beam = world.range(0.0)
    state = begun(world, beam, OPTIONS)
    narrow, rough = replace(PLANE, outer_m=0.1), replace(PLANE, relief_m=0.3)
    (found,) = meanings(state, replace(beam, surfaces=(narrow, rough)), OPTIONS)
    assert found.root[0, 0] == pytest.approx(np.hypot(0.3, 0.02))


def test_a_spot_is_not_trusted_at_the_edge_of_a_surface(world):
    """The margin is two σ of the spot's place, by attitude and place together."""
    beam = world.range(0.0)
    state = begun(world, beam, OPTIONS)
    (found,) = meanings(state, beam, OPTIONS)
    pose, _, _ = estimate_of(state)
    spot = pose.inverse().apply((beam.range_m - found.residual[0]) * beam.direction)
    from_m = float(np.linalg.norm(spot - PLANE.point_m))

    def spot_of(one):
        return one.place_m + one.rotation.T @ (beam.range_m * beam.direction)

    slope = [(spot_of(moved(state, 1e-6 * e)) - spot_of(state)) / 1e-6 for e in np.eye(6)]
    spread = np.transpose(slope) @ state.covariances[0][:6, :6] @ slope
    sigma_m = np.sqrt(np.diag(spread).max())
    for margin, says in ((1.9, False), (2.1, True)):
        surface = replace(PLANE, outer_m=from_m + margin * sigma_m)
        found = forecasts(state, replace(beam, surfaces=(surface,)), OPTIONS)
        assert isinstance(found, list) is says


def test_a_sensor_mounted_elsewhere_says_the_same(world):
    sensor_from_camera = Pose(
        Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([0.4, -0.1, 0.2])
    )
    camera_from_sensor = sensor_from_camera.inverse()
    turn = np.kron(np.eye(2), sensor_from_camera.rotation)
    pose, ring = world.pose(0.0), world.ring(0.0)
    elsewhere = PoseMeasurement(
        0.0, "camera", sensor_from_camera @ pose.pose, turn @ pose.covariance @ turn.T
    )
    one = ring.candidates[0]
    seen = RingCandidate(
        sensor_from_camera.apply(one.centre_m), sensor_from_camera.rotation @ one.axis,
        turn @ one.covariance @ turn.T,
    )  # fmt: skip
    beam = RangeMeasurement(0.0, "laser", 29.0, 0.02, (PLANE,))
    direct = replace(
        beam, origin_m=camera_from_sensor.translation_m,
        direction=camera_from_sensor.rotation @ np.array([0.0, 0.0, 1.0]),
    )  # fmt: skip
    pairs = ((pose, elsewhere), (ring, replace(ring, candidates=(seen,))), (direct, beam))
    for here, there in pairs:
        state = begun(world, here, OPTIONS)
        (a,), (b,) = (
            meanings(state, m, OPTIONS) for m in (here, there.in_camera(sensor_from_camera))
        )
        assert a.residual == pytest.approx(b.residual, abs=1e-12)
        assert a.noise == pytest.approx(b.noise, abs=1e-12)
        assert a.design == pytest.approx(b.design, abs=1e-12)


def test_options_of_a_name_win_over_those_of_a_kind(world):
    options = FusionOptions(pose=WHITE, sensors={"stereo": SensorOptions(inflation=4.0)})
    for sensor, factor in (("camera", 1.0), ("stereo", 4.0)):
        one = world.pose(0.0, sensor=sensor)
        state = begin(one, options)
        (found,) = meanings(state, still_at(state, one), options)
        assert found.root @ found.root.T == pytest.approx(factor * one.covariance)
