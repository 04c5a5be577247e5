# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of odometry in drives with loop closures alone: found where they are, and nowhere else."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, OdometrySource, WindowConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.judgement.verdicts import Decision, Judged, State, Verdict
from pose_graph_ros.core.measurements import LoopClosure, OdometrySample, Position

SECOND = 1_000_000_000
LAP, LAPS = 60, 4
SIGMA = np.array((0.1, 0.1, 0.02))
CONFIG = BackendConfig(odometry={'odom': OdometrySource(reorder_window=0.0)})
Events = Sequence[OdometrySample | LoopClosure | Position]


def drive(
    seed: int, jumps: dict[int, tuple[float, float, float]] | None = None, *,
    noise: float = 1.0, groups: int = 0,
) -> tuple[FloatArray, Events]:
    """
    Return true poses, and what is measured on laps around a hall.

    Parameters
    ----------
    seed : int
    jumps : dict, optional
        By the number of a step, what odometry measures besides.
    noise : float, factor on the noise of odometry
    groups : int, of four wrong closures that agree

    """
    rng = np.random.default_rng(seed)
    truth, odometry = [np.zeros(3)], [np.zeros(3)]
    for k in range(LAP * LAPS):
        moved = np.array((1.0, 0.0, 0.5 * np.pi / 3 if k % 15 >= 12 else 0.0))
        sigma = np.array((0.05, 0.03, np.hypot(0.01, 0.05 * np.sqrt(abs(moved[2])))))
        truth.append(se2.compose(truth[-1], moved))
        wrong = np.array((jumps or {}).get(k, (0.0, 0.0, 0.0)))
        odometry.append(se2.compose(odometry[-1], se2.compose(
            moved + noise * sigma * rng.normal(size=3), wrong)))
    events: list[OdometrySample | LoopClosure] = [OdometrySample((3 * k + 1) * SECOND, pose)
                      for k, pose in enumerate(odometry)]
    pairs = [(k - LAP, k, se2.between(truth[k - LAP], truth[k]))
             for k in range(LAP + 2, LAP * LAPS, 3)]
    for _ in range(groups):
        i, j = int(rng.integers(0, 80)), int(rng.integers(120, LAP * LAPS - 8))
        claim = np.array((*rng.uniform(-10.0, 10.0, 2), rng.uniform(-np.pi, np.pi)))
        pairs += [(i + n, j + n, se2.compose(
            se2.compose(se2.between(truth[i + n], truth[i]), claim),
            se2.between(truth[j], truth[j + n]))) for n in range(4)]
    for i, j, pose in pairs:
        events.append(LoopClosure(
            (3 * j + 1) * SECOND, se2.compose(pose, SIGMA * rng.normal(size=3)),
            np.diag(SIGMA**2), reference_ns=(3 * i + 1) * SECOND))
    return np.array(truth), sorted(events, key=lambda event: event.stamp_ns)


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


def jumps_in(backend: PoseGraphBackend) -> list[Verdict]:
    return [each for each in backend.verdicts() if each.kind is Judged.ODOMETRY]


def error(backend: PoseGraphBackend, truth: FloatArray) -> float:
    estimate = backend.estimate()
    assert estimate is not None
    at = (estimate.path.stamps_ns // SECOND - 1) // 3
    off = se2.between(truth[at[0]], truth[at])[:, :2] - estimate.path.poses[:, :2]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def kept(backend: PoseGraphBackend) -> int:
    return backend.verdict_totals()['scan'].counts.get(State.BELIEVED, 0)


N_RIGHT = len(range(LAP + 2, LAP * LAPS, 3))


@cache
def clean() -> float:
    truth, events = drive(0)
    return error(run(events), truth)


@pytest.mark.parametrize('jump', [(3.0, 0.0, 0.0), (0.0, 6.0, 0.0), (0.0, 0.0, 0.6)])
def test_a_jump_is_found_and_all_closures_are_kept(jump: tuple[float, float, float]) -> None:
    truth, events = drive(0, {140: jump})
    backend = run(events)
    verdict, = jumps_in(backend)
    assert verdict.reference_ns is not None
    assert verdict.reference_ns <= (3 * 140 + 1) * SECOND
    assert verdict.stamp_ns >= (3 * 141 + 1) * SECOND
    assert verdict.stamp_ns - verdict.reference_ns < 60 * SECOND
    assert verdict.state is State.DOUBTED
    assert len(verdict.contradicted_by) > 0
    assert kept(backend) == N_RIGHT
    assert error(backend, truth) < clean() + 0.5


def test_a_jump_is_found_while_driving() -> None:
    truth, events = drive(0, {140: (0.0, 0.0, 0.6)})
    backend = PoseGraphBackend(CONFIG)
    for k, event in enumerate(events):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
        else:
            backend.add_measurement(event, 'scan')
        if k % 10 == 0:
            backend.update()
            while not backend.refine().finished:
                pass
    backend.update()
    assert len(jumps_in(backend)) == 1
    assert error(backend, truth) < clean() + 0.5
    changes = [each for each in backend.verdict_changes() if each.kind is Judged.ODOMETRY]
    assert [each.after for each in changes] == [State.DOUBTED]


def test_two_jumps_are_found() -> None:
    truth, events = drive(1, {100: (0.0, 5.0, 0.0), 170: (0.0, 0.0, -0.7)})
    backend = run(events)
    assert len(jumps_in(backend)) == 2
    assert kept(backend) == N_RIGHT
    assert error(backend, truth) < clean() + 0.5


@pytest.mark.parametrize(('noise', 'groups', 'seed'), [(1.0, 0, 0), (3.0, 0, 1), (1.0, 6, 0)])
def test_no_jump_is_invented(seed: int, noise: float, groups: int) -> None:
    _, events = drive(seed, noise=noise, groups=groups)
    backend = run(events)
    assert jumps_in(backend) == []
    if noise == 1.0:
        assert kept(backend) == N_RIGHT


def test_the_order_of_arrival_changes_nothing() -> None:
    _, events = drive(0, {140: (3.0, 0.0, 0.4)})
    closures = [event for event in events if isinstance(event, LoopClosure)]
    odometry = [event for event in events if isinstance(event, OdometrySample)]
    late = run([*odometry, *np.random.default_rng(0).permutation(np.array(closures)).tolist()])
    one, other = jumps_in(run(events)), jumps_in(late)
    assert [(each.id, each.stamp_ns, each.reference_ns) for each in one] == [
        (each.id, each.stamp_ns, each.reference_ns) for each in other]
    assert len(one) == 1


def test_a_jump_is_told_once_saved_and_goes_when_the_evidence_turns() -> None:
    _, events = drive(0, {140: (0.0, 6.0, 0.0)})
    backend = run(events)
    changes = [each for each in backend.verdict_changes() if each.kind is Judged.ODOMETRY]
    assert [(each.before, each.after) for each in changes] == [(State.BELIEVED, State.DOUBTED)]
    backend.optimize()
    assert not any(each.kind is Judged.ODOMETRY for each in backend.verdict_changes())
    verdict, = jumps_in(backend)
    assert backend.graph.weights[0][verdict.number] < 0.01
    saved = backend.saved()
    saved.check()
    again, = jumps_in(PoseGraphBackend.restored(CONFIG, saved))
    assert (again.id, again.stamp_ns, again.reference_ns, again.since_ns) == (
        verdict.id, verdict.stamp_ns, verdict.reference_ns, verdict.since_ns)
    for each in backend.verdicts():
        if each.kind is Judged.LOOP_CLOSURE:
            backend.decide(each.id, Decision.OUT)
    backend.add_measurement(LoopClosure(
        401 * SECOND, np.zeros(3), np.diag(SIGMA**2), reference_ns=398 * SECOND), 'scan')
    backend.optimize()
    assert jumps_in(backend) == []
    assert backend.graph.weights[0][verdict.number] == 1.0
    change, = (each for each in backend.verdict_changes() if each.kind is Judged.ODOMETRY)
    assert (change.before, change.after) == (State.DOUBTED, State.BELIEVED)


def jump_between_fixes() -> tuple[FloatArray, Events]:
    truth, events = drive(0, {140: (10.0, 0.0, 0.0)})
    rng = np.random.default_rng(1)
    with_fixes: list[OdometrySample | Position] = []
    for event in events:
        if isinstance(event, OdometrySample):
            k = (event.stamp_ns // SECOND - 1) // 3
            with_fixes.append(event)
            if not 130 <= k < 150:
                with_fixes.append(Position(
                    event.stamp_ns, truth[k, :2] + rng.normal(0.0, 0.3, 2), 0.09 * np.eye(2),
                    np.zeros(2)))
    return truth, with_fixes


def test_odometry_that_fixes_have_won_over_is_told() -> None:
    backend = run(jump_between_fixes()[1])
    verdict, = jumps_in(backend)
    assert verdict.reference_ns is not None
    assert verdict.reference_ns <= (3 * 140 + 1) * SECOND < verdict.stamp_ns
    assert 8.0 < float(np.hypot(*verdict.residual[:2])) < 12.0
    assert all(name.startswith('fix/') for name in verdict.contradicted_by)
    assert len(verdict.contradicted_by) == 5
    # where a node is thinned out in the middle, two stretches are left
    odometry, graph = backend._judge._odometry, backend.graph
    (gap,) = odometry._gaps.values()
    gone = np.array(gap.edges[3:5])
    loosened = {edge: gap.weight for edge in gap.edges if edge not in gone}
    odometry.forget(graph, gone, np.empty((0, 2), dtype=np.int64), loosened)
    for each, edges in zip(jumps_in(backend), (gap.edges[:3], gap.edges[5:]), strict=True):
        ends = graph.edges_at(np.array((edges[0], edges[-1])))
        stamps_ns = backend._nodes.stamps_ns[np.searchsorted(
            backend._nodes.ids, (ends.i[0], ends.j[1]))]
        assert (each.reference_ns, each.stamp_ns) == tuple(stamps_ns.tolist())
        assert each.since_ns == verdict.since_ns


def test_odometry_that_left_doubted_is_counted_also_by_a_loaded_graph() -> None:
    config = replace(CONFIG, window=WindowConfig(nodes=40))
    backend = run(jump_between_fixes()[1], config)
    totals = backend.verdict_totals()['odom']
    assert 0 < totals.n_left_unused < totals.n_left
    saved = backend.saved()
    saved.check()
    assert PoseGraphBackend.restored(config, saved).verdict_totals()['odom'] == totals
