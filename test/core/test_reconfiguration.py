# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings that change under way: for what comes from then on, and for nothing before."""

from collections.abc import Sequence
from dataclasses import replace

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import (
    BackendConfig,
    Loss,
    MeasurementSource,
    NodePolicy,
    NoiseFrom,
    OdometryNoise,
    OdometrySource,
    SmootherConfig,
)
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.reweighting import costs_and_weights
from pose_graph_ros.core.measurements import (
    AnswerStatus,
    GlobalPose,
    Measurement,
    OdometrySample,
    Position,
)

SECOND = 1_000_000_000
Event = tuple[str, OdometrySample | Measurement]
PROMPT = OdometrySource(reorder_window=0.0)
CONFIG = BackendConfig(
    odometry={'odom': PROMPT, 'visual': PROMPT},
    measurements={'fix': MeasurementSource(), 'global_pose': MeasurementSource(),
                  'gnss': MeasurementSource(correlation_time=20.0)})


def drive(seed: int = 0, n: int = 300) -> list[Event]:
    """A slalom of 60 m at 2 m/s, 10 Hz, by noisy sensors; in the order of the stamps."""
    rng = np.random.default_rng(seed)
    T_map_odom = np.array([40.0, -25.0, 2.1])
    events: list[Event] = []
    pose = visual = true = np.zeros(3)
    for k in range(n):
        stamp_ns = 10 * SECOND + k * SECOND // 10
        step = np.array([0.2, 0.0, 0.06 * np.cos(0.1 * k)]) if k > 0 else np.zeros(3)
        true = se2.compose(true, step)
        pose = se2.compose(pose, step + rng.standard_normal(3) * [0.01, 0.005, 0.003])
        visual = se2.compose(visual, step + rng.standard_normal(3) * [0.01, 0.005, 0.003])
        twist = np.array([1e-3, 1e-3, 1e-4])
        events.append(('odom', OdometrySample(stamp_ns, pose, 2.0, twist)))
        events.append(('visual', OdometrySample(stamp_ns + 1, visual, 2.0, twist)))
        there = se2.compose(T_map_odom, true)
        if k % 10 == 5:
            events.append(('fix', Position(
                stamp_ns + 2, there[:2] + 0.5 * rng.standard_normal(2), 0.25 * np.eye(2),
                np.array([0.3, 0.0]))))
            events.append(('gnss', Position(
                stamp_ns + 2, there[:2] + 0.5 + 0.1 * rng.standard_normal(2),
                0.25 * np.eye(2), np.zeros(2))))
        if k % 50 == 25:
            events.append(('global_pose', GlobalPose(
                stamp_ns + 2, there + 0.1 * rng.standard_normal(3), 0.01 * np.eye(3))))
    return events


DRIVE = drive()
# Where updates come every 40 events, one comes here.
HALF = 320


def feed(
    backend: PoseGraphBackend, events: Sequence[Event], update_every: int = 0,
) -> PoseGraphBackend:
    for k, (source, event) in enumerate(events, 1):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event, source)
        else:
            backend.add_measurement(event, source)
        if update_every > 0 and k % update_every == 0:
            assert backend.update().status is not Status.FAILED
    return backend


def ended(backend: PoseGraphBackend) -> FloatArray:
    backend.optimize()
    return backend.estimate().path.poses


def only(events: Sequence[Event], *sources: str) -> list[Event]:
    return [event for event in events if event[0] in sources]


def with_odometry(config: BackendConfig = CONFIG, **changes: object) -> BackendConfig:
    return replace(config, odometry={
        name: replace(source, **changes) for name, source in config.odometry.items()})


def with_fix(**changes: object) -> BackendConfig:
    return replace(CONFIG, measurements={
        **CONFIG.measurements, 'fix': replace(CONFIG.measurements['fix'], **changes)})


def edges(backend: PoseGraphBackend) -> FloatArray:
    return backend.graph.factors.edges.information


def observed(backend: PoseGraphBackend) -> FloatArray:
    return backend.graph.factors.observed.information


# --- What does not change ------------------------------------------------------------------------

ROBUST = replace(with_odometry(reorder_window=0.35), measurements={
    name: replace(source, loss=Loss.CAUCHY) for name, source in CONFIG.measurements.items()})
TWIST = with_odometry(noise_from=NoiseFrom.TWIST, reorder_window=0.35)


@pytest.mark.parametrize('config', [CONFIG, ROBUST, TWIST], ids=['plain', 'robust', 'twist'])
def test_the_same_settings_again_change_no_bit(config: BackendConfig) -> None:
    expected = feed(PoseGraphBackend(config), DRIVE, 37)
    backend = PoseGraphBackend(config)
    other = replace(with_odometry(config, maximum_speed=0.1, covariance_scale=9.0),
                    nodes=NodePolicy(minimum_travel_distance=0.1), measurements={
        'gnss': MeasurementSource(correlation_time=20.0, loss=Loss.HUBER)})
    for k in range(0, len(DRIVE), 37):
        feed(backend, DRIVE[k:k + 37], 37)
        backend.configure(other)    # and nothing comes
        backend.configure(BackendConfig(**{
            name: getattr(config, name) for name in BackendConfig.__slots__}))
    np.testing.assert_array_equal(ended(backend), ended(expected))
    np.testing.assert_array_equal(edges(backend), edges(expected))
    assert backend.counts == expected.counts


@pytest.mark.parametrize(('wanted', 'said'), [
    (with_odometry(noise_from=NoiseFrom.TWIST), r'odom: .*noise_from: .*MODEL.*TWIST'),
    (with_fix(correlation_time=5.0), r'fix: .*correlation_time: .* expected 0\.0, got 5\.0'),
    (replace(CONFIG, measurements={}), r'gnss: .*correlation_time: .* expected 20\.0, got 0\.0'),
    (replace(CONFIG, smoother=SmootherConfig(alpha=0.5)), r'BackendConfig\.smoother: ')])
def test_what_must_stay_is_refused_and_then_nothing_changes(
    wanted: BackendConfig, said: str,
) -> None:
    expected = feed(PoseGraphBackend(CONFIG), DRIVE, 40)
    backend = feed(PoseGraphBackend(CONFIG), DRIVE[:HALF], 40)
    wanted = replace(wanted, nodes=NodePolicy(minimum_travel_distance=7.0))
    with pytest.raises(ConfigError, match=said):
        backend.configure(wanted)
    feed(backend, DRIVE[HALF:], 40)
    np.testing.assert_array_equal(ended(backend), ended(expected))


# --- Odometry ------------------------------------------------------------------------------------

@pytest.mark.parametrize('wanted', [
    with_odometry(noise=OdometryNoise(sigma_distance=0.4, sigma_heading_turn=0.3)),
    with_odometry(covariance_scale=9.0),
    with_odometry(noise=OdometryNoise(sigma_floor_position=0.1, sigma_floor_heading=0.1))],
    ids=['model', 'scale', 'floor'])
def test_edges_have_the_noise_that_is_set_when_they_are_made(wanted: BackendConfig) -> None:
    samples = only(DRIVE, 'odom')
    old = edges(feed(PoseGraphBackend(CONFIG), samples))
    new = edges(feed(PoseGraphBackend(wanted), samples))
    backend = feed(PoseGraphBackend(CONFIG), samples[:150])
    made = len(backend.graph.factors.edges)
    assert 10 < made < len(old) - 10
    anchor = backend.estimate().covariance
    backend.configure(wanted)
    # so has what is not an edge yet: the way from the newest node to the robot
    assert backend.estimate().covariance[0, 0] >= anchor[0, 0]
    assert backend.estimate().odometry.noise == wanted.odometry['odom'].noise
    feed(backend, samples[150:])
    np.testing.assert_array_equal(edges(backend), np.concatenate((old[:made], new[made:])))
    assert not np.any(old[made:] == new[made:], axis=(1, 2)).all()


@settings(max_examples=8, deadline=None)
@given(st.sampled_from((0.0, 0.2, 0.7)), st.sampled_from((0.0, 0.2, 0.7)),
       st.sampled_from((0.5, 60.0)), st.integers(20, 120))
def test_how_far_somebody_has_looked_ahead_makes_no_difference(
    before: float, after: float, speed: float, when: int,
) -> None:
    first = with_odometry(TWIST, reorder_window=before, maximum_speed=speed)
    then = with_odometry(TWIST, reorder_window=after, maximum_speed=60.5 - speed)
    blind, looking = PoseGraphBackend(first), PoseGraphBackend(first)
    # 0.6 m from sample to sample: a jump, if nothing is faster than 0.5 m/s
    samples = zip(only(DRIVE, 'odom')[::3], only(DRIVE, 'visual')[::3], strict=True)
    for k, event in enumerate(event for pair in samples for event in pair):
        for backend in (blind, looking):
            if k == when:
                backend.configure(then)
            feed(backend, [event])
        looking.estimate()
    np.testing.assert_array_equal(ended(blind), ended(looking))
    assert blind.counts == looking.counts
    assert blind.counts['odom', 'jump'] > 5


def test_another_reorder_window_takes_what_comes_late_from_then_on() -> None:
    def sample(k: int) -> OdometrySample:
        return OdometrySample(SECOND + k * SECOND // 10, np.array([0.1 * k, 0.0, 0.0]))

    backend = PoseGraphBackend(CONFIG)
    for k in (0, 1, 2, 3, 5):
        assert backend.add_odometry(sample(k)).status is AnswerStatus.ACCEPTED
    assert backend.add_odometry(sample(4)).reason == 'out_of_order'
    backend.configure(with_odometry(reorder_window=0.5))
    for k in (8, 7, 6):
        assert backend.add_odometry(sample(k)).status is AnswerStatus.ACCEPTED
    assert backend.add_odometry(sample(4)).reason == 'out_of_order'
    backend.configure(CONFIG)
    assert backend.add_odometry(sample(10)).status is AnswerStatus.ACCEPTED
    assert backend.add_odometry(sample(9)).reason == 'out_of_order'


# --- Measurements --------------------------------------------------------------------------------

def test_a_loss_counts_for_what_joins_from_then_on() -> None:
    events = [(source, replace(event, position=event.position + np.array((9.0, 0.0)))
               if source == 'fix' and k % 3 == 0 else event)
              for k, (source, event) in enumerate(only(DRIVE, 'odom', 'fix', 'global_pose'))]
    backend = feed(PoseGraphBackend(CONFIG), events[:len(events) // 2], 20)
    backend.update()
    made = len(backend.graph.factors.observed)
    backend.configure(with_fix(loss=Loss.CAUCHY, rejection_threshold=2.0))
    feed(backend, events[len(events) // 2:], 20)
    backend.optimize()
    table, energies = backend.graph.factors, backend.graph.energies().factors
    weights, energies = table.observed.weight, energies[table.j < 0]
    assert np.all(weights[:made] == 1.0)
    assert np.min(weights[made:]) < 0.1
    energies = energies[made:] / weights[made:]
    positions = table.observed.information[made:, 2, 2] == 0.0
    np.testing.assert_allclose(
        weights[made:][positions],
        costs_and_weights(Loss.CAUCHY, energies[positions], 2.0)[1], rtol=1e-6)
    assert np.all(weights[made:][~positions] == 1.0)
    # and back: what has one keeps it
    backend.configure(CONFIG)
    before = ended(backend)
    np.testing.assert_array_equal(backend.graph.factors.observed.weight[:made], 1.0)
    assert np.min(backend.graph.factors.observed.weight[made:]) < 0.1
    np.testing.assert_allclose(ended(backend), before, atol=1e-9)
