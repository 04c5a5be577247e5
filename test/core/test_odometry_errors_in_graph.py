# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What fixes show of odometry carries the path where there are none."""

from dataclasses import replace

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, POSITIONS, WindowConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.measurements import (
    AnswerStatus,
    GlobalPose,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.odometry.motion import AS_CLAIMED, OdometryErrors

SECOND = 1_000_000_000
RATE, LONGER = 0.006, 0.01
"""What odometry turns too little [rad/s], and by which part its way is too long."""
OUTAGE, ASIDE, BACK, END = 150, 200, 220, 270
"""When fixes end, come again but 40 m aside, and are right again [s]."""


def drive(seed: int) -> tuple[list[OdometrySample | Position], np.ndarray]:
    """Return odometry at 5 Hz that hardly drifts but for constant errors, and fixes at 1 Hz."""
    rng = np.random.default_rng(seed)
    truth, said, events = [np.zeros(3)], np.array((3.0, 1.0, 2.0)), []
    for tick in range(1, 5 * END + 1):
        stamp = tick * SECOND // 5
        turn = 0.2 * (0.3 * np.sin(0.05 * tick / 5) + (0.3 if tick % 150 < 25 else 0.0))
        step = np.array((0.2, 0.0, turn))
        truth.append(se2.compose(truth[-1], step))
        noise = rng.standard_normal(3) * (0.01, 0.01, 0.0005)
        said = se2.compose(said, step * (1.0 + LONGER, 1.0, 1.0) - (0.0, 0.0, 0.2 * RATE) + noise)
        events.append(OdometrySample(stamp, said))
        second = tick / 5
        if tick % 5 == 0 and not OUTAGE <= second < ASIDE:
            aside = np.array((-24.0, 32.0)) if ASIDE <= second < BACK else np.zeros(2)
            where = truth[-1][:2] + aside + rng.standard_normal(2)
            events.append(Position(stamp, where, np.eye(2), np.zeros(2)))
    return events, np.array(truth)


def fed(
    events: list[OdometrySample | Position], config: BackendConfig | None = None,
    backend: PoseGraphBackend | None = None,
) -> tuple[PoseGraphBackend, np.ndarray]:
    """Return the back end, and the newest position at each fix."""
    backend, newest = backend or PoseGraphBackend(config), []
    for event in events:
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
            continue
        backend.add_measurement(event, 'fix')
        backend.update()
        for _ in range(20):
            backend.refine()
        estimate = backend.estimate(with_path=False)
        assert estimate is not None
        newest.append((event.stamp_ns, *estimate.T_map_base[:2]))
    return backend, np.array(newest)


def rms(backend: PoseGraphBackend, truth: np.ndarray) -> float:
    estimate = backend.estimate()
    assert estimate is not None
    at = np.round(estimate.path.stamps_ns * 5 / SECOND).astype(int)
    return float(np.sqrt(np.mean(np.sum(
        (estimate.path.poses - truth[at])[:, :2]**2, axis=1))))


def test_constant_errors_are_taken_out_and_fixes_aside_after_an_outage_are_refused() -> None:
    events, truth = drive(1)
    backend, newest = fed(events)
    aside = (newest[:, 0] >= ASIDE * SECOND) & (newest[:, 0] < BACK * SECOND)
    at = np.round(newest[aside, 0] * 5 / SECOND).astype(int)
    error = np.hypot(*(newest[aside, 1:] - truth[at, :2]).T)
    assert np.max(error) < 4.0      # m, after 50 to 70 s without a right fix
    backend.optimize()
    estimate = backend.estimate()
    assert estimate is not None
    errors = estimate.odometry_errors
    assert errors.rate == pytest.approx(RATE, abs=3e-4)
    assert errors.scale == pytest.approx(-LONGER, abs=1e-2)
    assert errors.turn < 0.5
    assert abs(errors.rate - RATE) < 3.0 * errors.rate_sigma < 1.5e-3
    assert 0.0 < errors.scale_sigma < 0.01
    doubted = {verdict.stamp_ns for verdict in backend.verdicts()
               if verdict.state is State.DOUBTED}
    assert doubted == {second * SECOND for second in range(ASIDE, BACK)}
    assert rms(backend, truth) < 0.6
    # with errors of odometry given by hand, which has none of these, the same drive is far off
    claimed = BackendConfig(odometry={'odom': replace(
        BackendConfig().odometry_source('odom'), sigma_scale=1.0)})
    without, _ = fed(events, claimed)
    without.optimize()
    assert rms(without, truth) > 1.1 * rms(backend, truth)


def test_neither_the_order_of_arrival_nor_a_file_in_between_changes_the_path() -> None:
    events, _ = drive(1)
    events = [event for event in events if event.stamp_ns < OUTAGE * SECOND]
    random = np.random.default_rng(0)
    late = [event.stamp_ns + (30 * SECOND * random.random() if isinstance(event, Position) else 0)
            for event in events]
    shuffled = [events[k] for k in np.argsort(late, kind='stable')]
    half = next(k for k, event in enumerate(events) if event.stamp_ns > 145 * SECOND)
    backends = [fed(events)[0], fed(shuffled)[0]]
    begun = fed(events[:half])[0]
    backends.append(fed(events[half - 10:], backend=PoseGraphBackend.restored(
        None, begun.saved()))[0])
    assert begun.estimate().odometry_errors.rate != 0.0
    paths = []
    for backend in backends:
        backend.optimize()
        assert backend.estimate().odometry_errors.rate == pytest.approx(RATE, abs=1e-3)
        paths.append(backend.estimate().path.poses)
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-5)
    np.testing.assert_allclose(paths[2], paths[0], atol=1e-5)


def test_errors_of_odometry_are_found_in_a_window() -> None:
    events, truth = drive(4)
    events = [event for event in events if event.stamp_ns < OUTAGE * SECOND]
    backend, newest = fed(events, BackendConfig(
        measurements={'fix': POSITIONS}, window=WindowConfig(seconds=30.0)))
    assert backend.estimate().n_frozen > 100
    assert backend.estimate().odometry_errors.rate == pytest.approx(RATE, abs=1e-3)
    error = newest[-60:, 1:] - truth[np.round(newest[-60:, 0] * 5 / SECOND).astype(int), :2]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 1.0


def test_where_a_person_has_put_the_robot_is_not_changed_by_errors_of_odometry() -> None:
    events, truth = drive(1)
    half = next(k for k, event in enumerate(events) if event.stamp_ns > 145 * SECOND)
    backend = fed(events[:half])[0]
    assert backend.estimate().odometry_errors != AS_CLAIMED
    placed = GlobalPose(120 * SECOND, truth[600] + (5.0, 0.0, 0.0), np.diag((0.25, 0.25, 0.01)))
    assert backend.set_pose(placed, 'initialpose').status is AnswerStatus.ACCEPTED
    edge = backend.graph.factors.edges.rows(slice(-1, None))
    before = backend.estimate().odometry_errors
    again = PoseGraphBackend.restored(None, backend.saved())
    for each in (backend, again):
        each._tuner._correct_odometry(OdometryErrors(2.0, 3.0, 0.001, 0.01))
        assert each.estimate().odometry_errors != before
        last = each.graph.factors.edges.rows(slice(-1, None))
        np.testing.assert_array_equal(last.information, edge.information)
        np.testing.assert_array_equal(last.mean, edge.mean)
