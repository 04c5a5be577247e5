# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The promise: the same measurements give the same path, in whatever order and when they come."""

from collections import Counter
from dataclasses import dataclass
import functools

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from saved_graphs import Event, feed

from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, Loss, MeasurementSource, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import (
    GlobalPose,
    HeadingOnly,
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
)

SECOND = 1_000_000_000
EPOCH = 1_767_225_600 * SECOND
# The path after the closing full optimisation [m, rad] ...
SAME_PATH = 1e-9
# ... and what the smoother's tolerance, and noise that was learnt earlier, leave before it [m].
SAME_ONLINE = 1e-2
LONGEST_DELAY = 60.0
WINDOW = 0.25
DURATION = 40.0
T_MAP_ODOM = np.array([40.0, -25.0, 2.1])


def stamp_of(time: float) -> int:
    return EPOCH + round(time * 1e9)


FINE = np.arange(0.0, DURATION + 1.0, 0.001)
LOCAL = np.zeros((len(FINE), 3))
LOCAL[:, 2] = 2.0 * np.pi * FINE / 30.0 + 0.3 * np.sin(FINE)
LOCAL[1:, 0] = np.cumsum(2.0 * np.cos(LOCAL[:-1, 2]) * 0.001)
LOCAL[1:, 1] = np.cumsum(2.0 * np.sin(LOCAL[:-1, 2]) * 0.001)
LOCAL = se2.wrapped(LOCAL)
TRUTH = se2.compose(T_MAP_ODOM, LOCAL)


def truth(time: float) -> FloatArray:
    return TRUTH[round(time * 1000.0)]


def odometry(source: str, times: FloatArray, rng: np.random.Generator) -> list[Event]:
    """Drift a little, and a lot more (a reset) at 25 s."""
    pose, frames = np.array([1.0, -2.0, 0.3]), []
    for k, t in enumerate(times.tolist()):
        if k > 0:
            step = se2.between(truth(times[k - 1]), truth(t))
            pose = se2.compose(pose, step + rng.normal(0.0, [0.004, 0.002, 0.001]))
        if source == 'wheel' and 25.0 <= t < 25.1:
            pose = np.zeros(3)
        frames.append(Event(source, OdometrySample(stamp_of(t), pose)))
    return frames


def simulated(seed: int, *, outliers: bool) -> tuple[list[Event], list[Event]]:
    """Return odometry and measurements of a drive, each in the order of the stamps."""
    rng = np.random.default_rng(seed)
    wheel, visual = np.arange(0.0, DURATION, 0.1), np.arange(0.035, DURATION, 0.14)
    wheel = wheel[(wheel < 12.0) | (wheel > 17.0)]     # silent for 5 s: the other one leads
    events = []

    def times(begin: float, period: float) -> FloatArray:
        return np.arange(begin, DURATION - 1.0, period) + rng.uniform(0.0, 0.5 * period)

    def add(source: str, what: Measurement) -> None:
        events.append(Event(source, what))

    lever_arm = np.array([0.4, 0.1])
    for t in times(0.2, 1.0):
        where = se2.transform(truth(t), lever_arm) + rng.normal(0.0, 0.3, 2)
        add('gps', Position(stamp_of(t), where, 0.09 * np.eye(2), lever_arm))
    for t in times(0.3, 1.5):
        off = 15.0 if rng.random() < 0.15 and outliers else 0.0
        where = truth(t)[:2] + rng.normal(0.0, 0.5, 2) + off
        add('beacon', Position(stamp_of(t), where, 0.25 * np.eye(2), np.zeros(2)))
    for t in times(1.0, 7.0):
        add('pose', GlobalPose(
            stamp_of(t), truth(t) + rng.normal(0.0, [0.2, 0.3, 0.05]),
            np.diag([0.04, 0.09, 0.0025])))
    for t in times(0.5, 2.0):
        add('compass', HeadingOnly(stamp_of(t), float(truth(t)[2] + rng.normal(0.0, 0.1)), 0.01))
    for t in times(31.0, 1.0):
        z = se2.between(truth(t - 30.0), truth(t)) + rng.normal(0.0, [0.05, 0.05, 0.01])
        if rng.random() < 0.2 and outliers:
            z = np.add(z, [6.0, -4.0, 1.0])
        cov = np.diag([0.0025, 0.0025, 1e-4])
        ends = stamp_of(t), stamp_of(t - 30.0)
        if rng.random() < 0.5:
            ends, z = ends[::-1], se2.inverse(z)
        add('scan', LoopClosure(ends[0], z, cov, reference_ns=ends[1]))
    for t in times(15.0, 4.0):
        turn = float(truth(t)[2] - truth(t - 13.0)[2] + rng.normal(0.0, 0.02))
        add('walls', LoopClosure(
            stamp_of(t), np.array([0.0, 0.0, turn]), np.diag([np.inf, np.inf, 4e-4]),
            reference_ns=stamp_of(t - 13.0)))
    return (sorted(odometry('wheel', wheel, rng) + odometry('visual', visual, rng)),
            sorted(events))


PLAIN = BackendConfig(
    odometry={'wheel': OdometrySource(), 'visual': OdometrySource()},
    measurements={'scan': MeasurementSource(), 'walls': MeasurementSource()})
ROBUST = BackendConfig(
    odometry=PLAIN.odometry,
    measurements={'beacon': MeasurementSource(loss=Loss.CAUCHY),
                  'gps': MeasurementSource(loss=Loss.HUBER, rejection_threshold=1.5),
                  'scan': MeasurementSource(loss=Loss.CAUCHY), 'walls': MeasurementSource()})
CORRELATED = BackendConfig(odometry=PLAIN.odometry, measurements={
    'gps': MeasurementSource(correlation_time=20.0, loss=Loss.HUBER, rejection_threshold=0.7),
    'beacon': MeasurementSource(loss=Loss.HUBER),
    'pose': MeasurementSource(correlation_time=5.0),
    'compass': MeasurementSource(correlation_time=5.0)})
CONFIGS = {'plain': PLAIN, 'robust': ROBUST, 'correlated': CORRELATED}

# For robust losses with outliers.
DRIVES = {(number, robust): simulated(number, outliers=robust)
          for number in range(3) for robust in (False, True)}


def drive(number: int, kind: str) -> tuple[list[Event], list[Event]]:
    return DRIVES[number, kind == 'robust']


@dataclass(frozen=True)
class Result:
    """What a run led to."""

    online: FloatArray
    stamps: FloatArray
    path: FloatArray
    counts: Counter[tuple[str, str]]
    chi2: float


def run(events: list[Event], config: BackendConfig, updates: frozenset[int]) -> Result:
    backend = PoseGraphBackend(config)
    for k, event in enumerate(events):
        feed(backend, event)
        if k in updates:
            assert backend.update().status is not Status.FAILED
    backend.update()
    while not backend.refine().finished:
        pass
    online = backend.estimate()
    assert online is not None
    report = backend.optimize()
    assert report.status is Status.CONVERGED
    assert (backend.n_waiting, backend.n_quarantined) == (0, 0)
    estimate = backend.estimate()
    assert estimate.alignment is AlignmentState.ALIGNED
    return Result(online.path.poses, estimate.path.stamps_ns, estimate.path.poses,
                  backend.counts, estimate.chi2)


@functools.cache
def reference(number: int, kind: str) -> Result:
    odometry_, measurements = drive(number, kind)
    return run(sorted(odometry_ + measurements), CONFIGS[kind], frozenset(range(0, 2000, 10)))


def assert_same(result: Result, expected: Result) -> None:
    np.testing.assert_array_equal(result.stamps, expected.stamps)
    np.testing.assert_allclose(result.path[:, :2], expected.path[:, :2], atol=SAME_PATH)
    np.testing.assert_allclose(
        se2.wrap(result.path[:, 2] - expected.path[:, 2]), 0.0, atol=SAME_PATH)
    off = np.hypot(*(result.online - expected.online)[:, :2].T)
    assert np.max(off) < SAME_ONLINE


def test_the_drive_is_one_that_asks_for_something() -> None:
    for number, kind in ((0, 'plain'), (1, 'robust'), (2, 'correlated')):
        result = reference(number, kind)
        assert result.counts['wheel', 'jump'] == 1
        expected = np.array([truth((stamp - EPOCH) * 1e-9) for stamp in result.stamps.tolist()])
        off = np.hypot(*(result.path - expected)[:, :2].T)
        assert np.sqrt(np.mean(off**2)) < 0.25


@pytest.mark.parametrize('kind', CONFIGS)
@settings(max_examples=3)
@given(st.integers(0, 2), st.integers(0, 2**32 - 1),
       st.sampled_from((0.1, 2.0, LONGEST_DELAY)), st.sampled_from((1, 7, 50, 400)))
def test_delayed_shuffled_and_doubled_messages_give_the_same_path(
    kind: str, number: int, seed: int, delay: float, update_every: int,
) -> None:
    rng = np.random.default_rng(seed)
    odometry_, measurements = drive(number, kind)
    arrivals = [(event.what.stamp_ns + rng.uniform(0.0, WINDOW * 1e9 - 1.0), event)
                for event in odometry_]
    doubles: Counter[str] = Counter()
    for event in measurements:
        late = event.what.stamp_ns + rng.uniform(-0.3, delay) * 1e9
        arrivals.append((late, event))
        for _ in range(rng.integers(0, 3) if rng.random() < 0.3 else 0):
            arrivals.append((late + rng.uniform(0.0, 20.0) * 1e9, event))
            doubles[event.source] += 1
    for when, event in list(arrivals[:len(odometry_)]):
        if rng.random() < 0.05:
            arrivals.append((when + rng.uniform(0.0, 3.0) * 1e9, event))
            doubles[event.source] += 1
    arrivals.sort()
    n = len(arrivals)
    updates = frozenset(rng.choice(n, n // update_every, replace=False).tolist())
    result = run([event for _, event in arrivals], CONFIGS[kind], updates)
    expected = reference(number, kind)
    assert_same(result, expected)
    for source in ('wheel', 'visual', 'gps', 'beacon', 'pose', 'compass', 'scan', 'walls'):
        assert result.counts[source, 'duplicate_stamp'] == doubles[source]
        assert result.counts[source, 'accepted'] == expected.counts[source, 'accepted']
        assert result.counts[source, 'out_of_order'] == 0


def test_all_measurements_before_and_all_after_the_odometry_give_the_same_path() -> None:
    for kind, config in CONFIGS.items():
        odometry_, measurements = drive(0, kind)
        for events in (measurements[::-1] + odometry_, odometry_ + measurements[::-1]):
            assert_same(run(events, config, frozenset()), reference(0, kind))
