# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The decision at the end of a stream: the same set and the same path for any order of arrival."""

from collections.abc import Sequence

from hypothesis import given, settings, strategies as st
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
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.judgement import closure_search
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.measurements import LoopClosure, Measurement, OdometrySample, Position

SECOND = 1_000_000_000
LAP, N = 40, 130
CONFIG = BackendConfig(
    odometry={'odom': OdometrySource(reorder_window=0.0)},
    measurements={'scan': MeasurementSource(robust=Robust.JUDGED),
                  'fix': MeasurementSource(robust=Robust.LOSS, loss=Loss.HUBER)})


class Drive:
    """Laps of a circle at 1.2 m/s, with right and wrong closures, and fixes if asked for."""

    def __init__(self, seed: int, *, fixes: bool = False) -> None:
        rng = np.random.default_rng(seed)
        step = np.array([1.2, 0.0, 2.0 * np.pi / LAP])
        truth, measured = [np.zeros(3)], [np.zeros(3)]
        for k in range(N):
            moved = step + np.array([0.2 * np.sin(0.9 * k), 0.0, 0.08 * np.sin(0.37 * k)])
            truth.append(se2.compose(truth[-1], moved))
            measured.append(se2.compose(
                measured[-1], moved + rng.normal(0.0, [0.03, 0.02, 0.015])))
        self.truth = np.array(truth)
        self.odometry = [OdometrySample((k + 1) * SECOND, pose) for k, pose in enumerate(measured)]
        self.measurements: list[Measurement] = []
        self.wrong: set[int] = set()
        cov = np.diag([0.01, 0.01, 4e-4])
        for number, k in enumerate(range(LAP + 5, N, 3)):
            z = se2.between(self.truth[k - LAP], self.truth[k]) + rng.normal(0.0, [0.1, 0.1, 0.02])
            reference = k - LAP
            if number % 3 == 1:
                self.wrong.add((k + 1) * SECOND)
                reference = int(rng.integers(0, k - 20))
                z = rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi])
            self.measurements.append(LoopClosure(
                (k + 1) * SECOND, z, cov, reference_ns=(reference + 1) * SECOND))
        for k in range(0, N, 4) if fixes else ():
            where = self.truth[k, :2] + rng.normal(0.0, 0.5, 2)
            if k % 20 == 8:
                where = where + 15.0
            self.measurements.append(Position(
                (k + 1) * SECOND, where, 0.25 * np.eye(2), np.zeros(2)))


def source_of(what: Measurement) -> str:
    return 'scan' if isinstance(what, LoopClosure) else 'fix'


def run(events: Sequence[OdometrySample | Measurement], every: int = 5) -> PoseGraphBackend:
    backend = PoseGraphBackend(CONFIG)
    for k, event in enumerate(events):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
        else:
            backend.add_measurement(event, source_of(event))
        if k % every == 0:
            backend.update()
    assert backend.optimize().status is Status.CONVERGED
    return backend


def believed(backend: PoseGraphBackend) -> set[int]:
    return {verdict.stamp_ns for verdict in backend.verdicts() if verdict.state.in_graph
            and verdict.source == 'scan'}


def path(backend: PoseGraphBackend) -> FloatArray:
    return backend.graph.poses[:N]


DRIVES = {(seed, fixes): Drive(seed, fixes=fixes) for seed in range(2) for fixes in (False, True)}
RESULTS: dict[tuple[int, bool], PoseGraphBackend] = {}


def reference(seed: int, fixes: bool) -> PoseGraphBackend:
    if (seed, fixes) not in RESULTS:
        drive = DRIVES[seed, fixes]
        RESULTS[seed, fixes] = run(
            sorted([*drive.odometry, *drive.measurements], key=lambda event: event.stamp_ns))
    return RESULTS[seed, fixes]


@pytest.mark.parametrize('fixes', [False, True])
@pytest.mark.parametrize('seed', range(2))
def test_the_right_closures_are_believed_at_the_end(seed: int, *, fixes: bool) -> None:
    drive, backend = DRIVES[seed, fixes], reference(seed, fixes)
    scans = {one.stamp_ns for one in drive.measurements if isinstance(one, LoopClosure)}
    found = believed(backend)
    assert not found & drive.wrong
    assert len(found) > 0.9 * len(scans - drive.wrong)
    off = path(backend)[:, :2] - drive.truth[:N, :2]
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 1.0


@settings(max_examples=6)
@given(st.integers(0, 1), st.booleans(), st.integers(0, 2**32 - 1),
       st.sampled_from((2.0, 30.0, 1000.0)), st.sampled_from((1, 7, 1000)))
def test_any_order_of_arrival_ends_with_the_same_set_and_the_same_path(
    seed: int, fixes: bool, order: int, delay: float, every: int,
) -> None:
    drive, expected = DRIVES[seed, fixes], reference(seed, fixes)
    rng = np.random.default_rng(order)
    arrivals = [(float(sample.stamp_ns), sample) for sample in drive.odometry]
    arrivals += [(one.stamp_ns + rng.uniform(0.0, delay) * SECOND, one)
                 for one in drive.measurements]
    arrivals.sort(key=lambda each: each[0])
    backend = run([event for _, event in arrivals], every)
    assert believed(backend) == believed(expected)
    off = path(backend) - path(expected)
    off[:, 2] = se2.wrap(off[:, 2])
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


def test_in_a_very_large_graph_the_set_is_improved(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = DRIVES[1, False]
    monkeypatch.setattr(closure_search, 'BELIEF', BELIEF._replace(most_at_end=100))
    backend = run(sorted([*drive.odometry, *drive.measurements], key=lambda one: one.stamp_ns))
    scans = {one.stamp_ns for one in drive.measurements}
    found = believed(backend)
    assert not found & drive.wrong
    assert len(found) > 0.9 * len(scans - drive.wrong)
