# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which loop closures are believed: small worlds with false ones, and the pieces by oracles."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, MeasurementSource, NodePolicy, Robust
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.io.graph_files import read_graph, write_graph
from pose_graph_ros.core.judgement.verdicts import Decision, DOUBTED, State
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample

SECOND = 10**9
LAP, LAPS = 80, 3
CONFIG = BackendConfig(nodes=NodePolicy(minimum_travel_distance=0.9))
SIGMAS = np.array([0.1, 0.1, 0.03])


def drive(seed: int) -> tuple[FloatArray, FloatArray]:
    """Return truth and odometry of three laps of 80 m, a node each metre."""
    rng = np.random.default_rng(seed)
    truth, odometry = np.zeros((LAP * LAPS, 3)), np.zeros((LAP * LAPS, 3))
    step = np.array([1.0, 0.0, 2.0 * np.pi / LAP])
    for k in range(1, len(truth)):
        truth[k] = se2.compose(truth[k - 1], step)
        odometry[k] = se2.compose(odometry[k - 1], step + rng.normal(0.0, (0.03, 0.02, 0.006)))
    return truth, odometry


TRUTH, ODOMETRY = drive(0)


def closure(i: int, j: int, z: FloatArray) -> LoopClosure:
    return LoopClosure((j + 1) * SECOND, z, np.diag(SIGMAS**2), reference_ns=(i + 1) * SECOND)


def true_one(i: int, j: int, rng: np.random.Generator) -> LoopClosure:
    return closure(i, j, se2.between(TRUTH[i], TRUTH[j]) + rng.normal(0.0, SIGMAS))


def run(closures: list[LoopClosure], *, config: BackendConfig = CONFIG,
        begin: PoseGraphBackend | None = None, first: int = 0,
        last: int = len(TRUTH)) -> PoseGraphBackend:
    """Drive, update every 5 s, and do all work in between."""
    backend = begin or PoseGraphBackend(config)
    for k in range(first, last):
        backend.add_odometry(OdometrySample((k + 1) * SECOND, ODOMETRY[k]))
        for each in closures:
            if each.stamp_ns == (k + 1) * SECOND:
                backend.add_measurement(each, 'scan')
        if k % 5 == 0:
            backend.update()
            work(backend)
    backend.finish()
    backend.update()
    work(backend)
    return backend


def work(backend: PoseGraphBackend) -> None:
    while not backend.refine().finished:
        pass


def states(backend: PoseGraphBackend) -> dict[int, State]:
    return {each.stamp_ns // SECOND - 1: each.state for each in backend.verdicts()}


def error(backend: PoseGraphBackend) -> float:
    """Return the rms distance to the truth after the best rigid motion [m]."""
    path = backend.graph.poses[:, :2]
    ours, theirs = path - path.mean(0), TRUTH[:len(path), :2] - TRUTH[:len(path), :2].mean(0)
    u, _, v = np.linalg.svd(ours.T @ theirs)
    return float(np.sqrt(np.mean(np.sum((ours @ u @ v - theirs) ** 2, axis=1))))


def true_ones(rng: np.random.Generator) -> list[LoopClosure]:
    return [true_one(j - LAP, j, rng) for j in range(LAP + 5, LAP * LAPS, 3)]


def false_ones(rng: np.random.Generator) -> list[LoopClosure]:
    """Random places are taken for one another, with a small pose in between."""
    return [closure(int(rng.integers(0, 30)), j, rng.normal(0.0, (1.0, 1.0, 1.0)))
            for j in range(LAP - 30, LAP * LAPS - 1, 3) if j % LAP > 40]


# --- worlds --------------------------------------------------------------------------------------

@pytest.mark.parametrize('seed', range(2))
def test_false_closures_are_doubted_and_all_true_ones_believed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, false = true_ones(rng), false_ones(rng)
    clean, dirty = run(true), run(true + false)
    expected = {int(each.stamp_ns // SECOND) - 1: True for each in true}
    expected.update(dict.fromkeys((each.stamp_ns // SECOND - 1 for each in false), False))
    assert {k: state.in_graph for k, state in states(dirty).items()} == expected
    dirty.optimize(), clean.optimize()
    assert np.allclose(dirty.graph.poses, clean.graph.poses, atol=1e-6)
    assert error(dirty) < 0.5
    # closures with weight 0 are rows of the graph
    assert len(dirty.graph.factors.edges) == len(clean.graph.factors.edges) + len(false)


def group(at: int, to: int, n: int, rng: np.random.Generator) -> list[LoopClosure]:
    """Return n closures that agree that the robot is at the place of another time, turned."""
    z = np.array([0.5, -0.5, 1.0])
    return [closure(to + k, at + k, se2.compose(se2.compose(
        se2.between(TRUTH[to + k], TRUTH[to]), z), se2.between(TRUTH[at], TRUTH[at + k]))
        + rng.normal(0.0, 0.2 * SIGMAS)) for k in range(n)]


def test_a_false_group_that_came_first_is_thrown_out_by_true_ones() -> None:
    rng = np.random.default_rng(4)
    # 20 sigmas are claimed for each metre: anything passes the first gate
    config = BackendConfig(nodes=CONFIG.nodes)
    backend = run(false := group(60, 10, 4, rng), config=config, last=66)
    for each in backend.verdicts():
        backend.decide(each.id, Decision.IN)
    for each in backend.verdicts():
        backend.decide(each.id, Decision.AUTO)
    run(true_ones(rng), begin=backend, first=66)
    assert all(not states(backend)[each.stamp_ns // SECOND - 1].in_graph for each in false)
    assert error(backend) < 0.5


def test_one_group_of_right_closures_is_believed_beside_a_few_wrong_ones() -> None:
    rng = np.random.default_rng(17)
    right = [true_one(j - LAP, j, rng) for j in range(LAP + 20, LAP + 32, 2)]
    backend = run([*right, *false_ones(rng)[:3]])
    backend.optimize()
    found = {k for k, state in states(backend).items() if state.in_graph}
    assert found == {each.stamp_ns // SECOND - 1 for each in right}


def test_right_closures_that_agree_all_the_way_are_believed_beside_wrong_groups() -> None:
    rng = np.random.default_rng(18)
    right, wrong = true_ones(rng), []
    for begin, end in ((5, 70), (12, 55), (24, 120), (40, 145), (66, 200), (31, 225)):
        z = rng.normal(0.0, (1.0, 1.0, 1.0))
        wrong += [closure(begin + k, end + k, se2.compose(
            se2.inverse(se2.between(TRUTH[begin], TRUTH[begin + k])), se2.compose(
                z, se2.between(TRUTH[end], TRUTH[end + k])))) for k in range(0, 8, 2)]
    wrong = [each for each in wrong if each.stamp_ns not in {other.stamp_ns for other in right}]
    backend = run([*right, *wrong])
    backend.optimize()
    found = {k for k, state in states(backend).items() if state.in_graph}
    assert found == {each.stamp_ns // SECOND - 1 for each in right}


def test_robust_none_believes_everything() -> None:
    rng = np.random.default_rng(7)
    config = BackendConfig(
        nodes=CONFIG.nodes, measurements={'scan': MeasurementSource(robust=Robust.NONE)})
    backend = run([*true_ones(rng), *false_ones(rng)], config=config)
    assert backend.verdicts() == []
    assert error(backend) > 2.0


def test_a_saved_graph_goes_on_with_its_judgement(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    closures = [*true_ones(rng), *false_ones(rng)]
    backend = run(closures, last=150)
    write_graph(backend.saved(), tmp_path / 'map')
    other = PoseGraphBackend.restored(CONFIG, read_graph(tmp_path / 'map'))
    kept = [(each.id, each.state, each.since_ns, each.decision, each.number)
            for each in backend.verdicts()]
    assert kept == [(each.id, each.state, each.since_ns, each.decision, each.number)
                    for each in other.verdicts()]
    for each in (backend, other):
        run(closures, begin=each, first=150)
        each.optimize()
    assert states(backend) == states(other)
    assert np.allclose(backend.graph.poses, other.graph.poses, atol=1e-6)


# --- pieces --------------------------------------------------------------------------------------


@pytest.mark.parametrize('correlation_time', [0.0, 10.0])
def test_a_bias_does_not_make_a_distant_place_large(correlation_time: float) -> None:
    backend = PoseGraphBackend(replace(CONFIG, measurements={
        'fix': MeasurementSource(robust=Robust.NONE, correlation_time=correlation_time)}))
    for k in range(5):
        backend.add_measurement(GlobalPose(
            (k + 1) * SECOND, TRUTH[k] + np.array([10_000.0, 2_000.0, 0.0]),
            np.diag([0.1, 0.1, 0.01])), 'fix')
    # nothing but its gate, which is as large as a tenth of the place, speaks for this one
    run([closure(3, 2 * LAP + 3, np.array([1.0, 1.0, 0.1]))], begin=backend)
    assert np.any(backend.graph.is_bias) == (correlation_time > 0.0)
    only, = (each for each in backend.verdicts() if each.source == 'scan')
    assert only.state is State.WAITING


@pytest.mark.parametrize('n_parts', [1, 40, 200])
def test_closures_may_leave_while_a_better_set_is_looked_for(n_parts: int) -> None:
    rng, backend = np.random.default_rng(3), PoseGraphBackend()
    by_stamp = {each.stamp_ns: each for each in (*true_ones(rng), *false_ones(rng))}
    for k, pose in enumerate(ODOMETRY):
        backend.add_odometry(OdometrySample((k + 1) * SECOND, pose))
        if (k + 1) * SECOND in by_stamp:
            backend.add_measurement(by_stamp[(k + 1) * SECOND], 'scan')
        if k % 20 == 0:
            backend.update()
    backend.update()
    judge = backend._judge._closures
    states = judge.states
    # all are left out, as if none had been tested, so that there is something to look for
    judge._change(dict.fromkeys(np.flatnonzero(states.in_graph).tolist(), DOUBTED))
    job = judge._searched()
    for _ in range(n_parts):
        next(job, None)
    n, left = len(states), states.held[::3].copy()
    judge.forget(left)
    for _ in job:
        pass
    assert len(states) == n - len(left)
    assert np.count_nonzero(states.in_graph) > 5
    np.testing.assert_array_equal(
        backend.graph.weights[backend.graph.factor_rows(states.held)], states.in_graph)
