# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry that fixes have won over: told, counted and saved."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, OdometrySource, WindowConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.judgement.verdicts import Judged, Verdict
from pose_graph_ros.core.measurements import LoopClosure, OdometrySample, Position

SECOND = 1_000_000_000
LAP, LAPS, JUMP = 60, 4, 140
SIGMA = np.array((0.1, 0.1, 0.02))
CONFIG = BackendConfig(odometry={'odom': OdometrySource(reorder_window=0.0)})
Events = Sequence[OdometrySample | LoopClosure | Position]


def drive() -> Events:
    """Return odometry of laps around a hall that jumps between fixes, and closures."""
    rng = np.random.default_rng(0)
    truth, odometry = [np.zeros(3)], [np.zeros(3)]
    for k in range(LAP * LAPS):
        moved = np.array((1.0, 0.0, 0.5 * np.pi / 3 if k % 15 >= 12 else 0.0))
        sigma = np.array((0.05, 0.03, np.hypot(0.01, 0.05 * np.sqrt(abs(moved[2])))))
        truth.append(se2.compose(truth[-1], moved))
        jump = np.array((10.0 if k == JUMP else 0.0, 0.0, 0.0))
        odometry.append(se2.compose(
            odometry[-1], se2.compose(moved + sigma * rng.normal(size=3), jump)))
    events: list[OdometrySample | LoopClosure | Position] = []
    for k, pose in enumerate(odometry):
        stamp_ns = (3 * k + 1) * SECOND
        events.append(OdometrySample(stamp_ns, pose))
        if not 130 <= k < 150:
            events.append(Position(
                stamp_ns, truth[k][:2] + rng.normal(0.0, 0.3, 2), 0.09 * np.eye(2), np.zeros(2)))
        if k in range(LAP + 2, LAP * LAPS, 3):
            events.append(LoopClosure(
                stamp_ns, se2.compose(se2.between(truth[k - LAP], truth[k]),
                                      SIGMA * rng.normal(size=3)),
                np.diag(SIGMA**2), reference_ns=(3 * (k - LAP) + 1) * SECOND))
    return events


def run(events: Events, config: BackendConfig = CONFIG) -> PoseGraphBackend:
    backend = PoseGraphBackend(config)
    for k, event in enumerate(events):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
        else:
            backend.add_measurement(event, 'scan' if isinstance(event, LoopClosure) else 'fix')
        if k % 10 == 0:
            backend.update()
    assert backend.optimize().status is not Status.FAILED
    return backend


def doubted(backend: PoseGraphBackend) -> list[Verdict]:
    return [each for each in backend.verdicts() if each.kind is Judged.ODOMETRY]


def test_odometry_that_fixes_have_won_over_is_told() -> None:
    backend = run(drive())
    verdict, = doubted(backend)
    assert verdict.reference_ns is not None
    assert verdict.reference_ns <= (3 * JUMP + 1) * SECOND < verdict.stamp_ns
    assert 8.0 < float(np.hypot(*verdict.residual[:2])) < 12.0
    assert all(name.startswith('fix/') for name in verdict.contradicted_by)
    assert len(verdict.contradicted_by) == 5


def test_odometry_that_left_doubted_is_counted_also_by_a_loaded_graph() -> None:
    config = replace(CONFIG, window=WindowConfig(nodes=40))
    backend = run(drive(), config)
    totals = backend.verdict_totals()['odom']
    assert 0 < totals.n_left_unused < totals.n_left
    saved = backend.saved()
    assert PoseGraphBackend.restored(config, saved).verdict_totals()['odom'] == totals
