# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A graph whose updates diverge: all of it is solved for now and then, not at each of them."""

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import (
    BackendConfig,
    Loss,
    MeasurementSource,
    OdometrySource,
    Robust,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.measurements import OdometrySample, Position
from pose_graph_ros.core.smoother import trial as trials

SECOND = 10**9
SIGMA = 0.3
N, SETTLED_IN = 200, 100


def contradicting(seed: int, n: int) -> list[tuple[OdometrySample, Position]]:
    """Return a drive in which every other 20 fixes are 40 m aside, with precise covariances."""
    rng = np.random.default_rng(seed)
    truth, odometry, drive = np.zeros(3), np.zeros(3), []
    for k in range(n):
        turn = 0.1 * np.sin(0.05 * k)
        truth = se2.compose(truth, np.array([1.0, 0.0, turn]))
        odometry = se2.compose(odometry, np.array([1.0, 0.0, turn + 0.01 * rng.normal()]))
        aside = 40.0 * (k // 20 % 2) * np.array([np.cos(k // 7), np.sin(k // 7)])
        fix = truth[:2] + aside + SIGMA * rng.normal(size=2)
        drive.append((OdometrySample(k * SECOND + 1, odometry),
                      Position(k * SECOND + 1, fix, SIGMA**2 * np.eye(2), np.zeros(2))))
    return drive


def test_all_is_solved_for_now_and_then_where_every_update_diverges(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solved = []
    whole = trials.solved
    monkeypatch.setattr(trials, 'solved', lambda copy, rows, *rest: (
        solved.append(len(rows.poses)), whole(copy, rows, *rest))[1])
    # with odometry that is believed so little every direction is possible
    backend = PoseGraphBackend(BackendConfig(
        odometry={'odom': OdometrySource(sigma_scale=8.0)},
        measurements={'fix': MeasurementSource(robust=Robust.LOSS, loss=Loss.HUBER)}))
    for k, (sample, fix) in enumerate(contradicting(1, N)):
        backend.add_odometry(sample)
        backend.add_measurement(fix, 'fix')
        if k % 2 == 1:
            backend.update()
            for _ in range(60):     # as many parts as there is time for
                if backend.refine().finished:
                    break
    late = [n for n in solved if n > SETTLED_IN]
    assert len(solved) > len(late) > 0      # else it is another case
    # 100 nodes came, each of them with a fix; at every update it would be 1000 times
    assert len(late) < 60
    # and nothing is lost: all fixes are in the graph at the end
    assert backend.optimize().status is Status.CONVERGED
    assert backend.counts['fix', 'accepted'] == N
    assert np.count_nonzero(backend.graph.factors.observed.weight > 0.0) == N


def test_what_waits_is_solved_for_also_where_nobody_refines() -> None:
    backend = PoseGraphBackend(BackendConfig(
        odometry={'odom': OdometrySource(sigma_scale=8.0)},
        measurements={'fix': MeasurementSource(robust=Robust.LOSS, loss=Loss.HUBER)}))
    for sample, fix in contradicting(0, 750):
        backend.add_odometry(sample)
        backend.add_measurement(fix, 'fix')
        backend.update()
    # some of the newest may wait; it was 450 for ever where they waited from one pause to the next
    assert np.count_nonzero(backend.graph.factors.observed.weight > 0.0) > 460
