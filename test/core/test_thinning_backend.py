# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The back end in a place that is driven often, with `thinning.cell`."""

from dataclasses import replace

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    MeasurementSource,
    Robust,
    ThinningConfig,
    WindowConfig,
)
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.measurements import AnswerStatus, LoopClosure, OdometrySample, Position

PER_LAP, LAPS = 40, 6
SIGMA = np.array((0.02, 0.02, 0.005))


def stamp(k: int) -> int:
    return (k + 1) * 1_000_000_000


def driven(
    config: BackendConfig, saved_at: int = -1, *, fixes: bool = False,
) -> tuple[PoseGraphBackend, FloatArray]:
    """
    Return a back end after laps on a circle, a closure each fifth node, and the true poses.

    At a node it is replaced by what its saved state gives. With fixes there is one at each node,
    whose error has a time constant of 10 s.
    """
    bias = np.random.default_rng(4)
    error = bias.standard_normal(2)
    rng, backend = np.random.default_rng(3), PoseGraphBackend(config)
    angle = 2.0 * np.pi / PER_LAP * np.arange(PER_LAP * LAPS)
    truth = se2.wrapped(np.column_stack((6.0 * np.cos(angle), 6.0 * np.sin(angle), angle)))
    pose = truth[0]
    for k, true in enumerate(truth):
        if k > 0:
            pose = se2.compose(pose, se2.compose(
                se2.between(truth[k - 1], true), SIGMA * rng.standard_normal(3)))
        backend.add_odometry(OdometrySample(stamp(k), pose))
        if fixes:
            error = np.exp(-0.1) * error + np.sqrt(1.0 - np.exp(-0.2)) * bias.standard_normal(2)
            backend.add_measurement(Position(
                stamp(k), true[:2] + error + 0.05 * bias.standard_normal(2),
                np.eye(2), np.zeros(2)), 'fix')
        if k > PER_LAP and k % 5 == 0:
            # half of the closures name a node, half a time
            other = k - PER_LAP * int(rng.integers(1, k // PER_LAP + 1))
            named = {'reference_node': other} if k % 2 == 0 else {'reference_ns': stamp(other)}
            answer = backend.add_measurement(LoopClosure(
                stamp(k), pose=se2.compose(
                    se2.between(truth[other], true), SIGMA * rng.standard_normal(3)),
                covariance=np.diag(SIGMA**2), **named), 'loop')
            assert answer.status is not AnswerStatus.REJECTED or answer.reason == 'before_window'
        if k % 3 == 0:
            backend.update()
        if k == saved_at:
            backend = PoseGraphBackend.restored(config, backend.saved())
    backend.update()
    return backend, truth


def settings(cell: float) -> BackendConfig:
    return BackendConfig(
        measurements={'loop': MeasurementSource(robust=Robust.NONE),
                      'fix': MeasurementSource(correlation_time=10.0)},
        thinning=ThinningConfig(cell=cell, newest=15))


def test_the_graph_does_not_grow_and_the_path_is_whole() -> None:
    whole, truth = driven(settings(0.0))
    thinned, _ = driven(settings(2.0))
    n = len(truth) - 1      # the last sample waits for those that might come before it
    assert whole.graph.n_nodes == n
    assert thinned.graph.n_nodes < 2 * PER_LAP
    paths = []
    for backend in (whole, thinned):
        estimate = backend.estimate()
        assert estimate is not None
        assert estimate.trajectory is not None
        assert estimate.n_hidden == n
        paths.append(estimate.trajectory.poses[:n])
        assert np.max(np.hypot(*(paths[-1] - truth[:n])[:, :2].T)) < 0.5
    assert np.sqrt(np.mean((paths[1] - paths[0])[:, :2]**2)) < 0.1


def test_with_a_window_nodes_that_were_thinned_out_leave_with_it_and_lose_their_anchors() -> None:
    config = replace(settings(2.0), window=WindowConfig(nodes=2 * PER_LAP))
    backend, truth = driven(config)
    estimate, saved = backend.estimate(), backend.saved()
    thinned, n_frozen = saved.nodes.thinned, len(saved.nodes.frozen)
    assert n_frozen > 2 * PER_LAP
    assert len(thinned['numbers']) > 20
    assert np.min(thinned['numbers']) >= n_frozen
    assert np.all(backend.graph.node_rows(saved.nodes.ids[thinned['anchors']]) >= 0)
    assert backend.graph.n_nodes < PER_LAP + 30
    n = len(truth) - 1
    assert estimate is not None
    assert estimate.n_hidden == n
    error = estimate.path.poses[:n] - truth[:n]
    assert np.max(np.hypot(*error[:, :2].T)) < 0.5
    # the places of those whose anchors have changed are as certain as the graph
    for number in thinned['numbers'].tolist():
        place = backend._nodes.attachment(number, np.zeros(3), np.zeros((3, 3)))
        assert backend._nodes.has_left(number)
        assert np.max(np.abs(place.motion[:2])) < 4.0
        assert 0.0 < np.trace(place.noise[:2, :2]) < 1.0


def test_fixes_with_correlated_errors_leave_with_their_biases() -> None:
    config = settings(2.0)
    config = replace(config, thinning=replace(config.thinning, newest=8))
    whole, truth = driven(settings(0.0), fixes=True)
    thinned, _ = driven(config, 4 * PER_LAP, fixes=True)
    errors = []
    for backend in (whole, thinned):
        graph, estimate = backend.graph, backend.estimate()
        assert estimate is not None
        n = len(truth) - 1
        assert estimate.n_hidden == n
        off = estimate.path.poses[:n] - truth[:n]
        errors.append(float(np.sqrt(np.mean(off[:, :2]**2))))
    assert whole.graph.n_nodes >= 2 * n
    # so many fixes stay where the area is small, and their nodes with them
    most = 8 * config.thinning.newest
    assert np.count_nonzero(~graph.is_pose) < most
    assert graph.n_nodes < 2 * PER_LAP + 2 * most
    assert len(graph.factors.observed) < PER_LAP + most
    assert len(graph.factors.edges) < 8 * PER_LAP
    assert errors[1] < 1.5 * errors[0]
    # samples behind what has left are gone; late fixes and closures there are taken all the same
    assert len(thinned.saved().nodes.streams['odom'].stamps_ns) < 60
    for late in (Position(stamp(50) + 300_000_000, truth[50, :2], np.eye(2), np.zeros(2)),
                 LoopClosure(stamp(n - 1), se2.between(truth[55], truth[n - 1]),
                             np.diag(SIGMA**2), reference_ns=stamp(55) + 1000)):
        source = 'fix' if isinstance(late, Position) else 'loop'
        assert thinned.add_measurement(late, source).status is not AnswerStatus.REJECTED
    assert thinned.update().new_constraints == 2


def test_neither_nodes_nor_edges_grow_with_the_laps() -> None:
    rng, backend = np.random.default_rng(6), PoseGraphBackend(settings(2.0))
    angle = 2.0 * np.pi / PER_LAP * np.arange(20 * PER_LAP)
    truth = se2.wrapped(np.column_stack((6.0 * np.cos(angle), 6.0 * np.sin(angle), angle)))
    pose, late, sizes = truth[0], PER_LAP + 7, []
    for k, true in enumerate(truth):
        if k > 0:
            pose = se2.compose(pose, se2.compose(
                se2.between(truth[k - 1], true), SIGMA * rng.standard_normal(3)))
        backend.add_odometry(OdometrySample(stamp(k), pose))
        # half of the closures come when both of their nodes are old
        now = k - late * int(k % 2 == 0)
        if now > PER_LAP and k % 5 < 2:
            other = now - PER_LAP * int(rng.integers(1, now // PER_LAP + 1)) + int(
                rng.integers(0, 4))
            backend.add_measurement(LoopClosure(
                stamp(now), pose=se2.compose(
                    se2.between(truth[other], truth[now]), SIGMA * rng.standard_normal(3)),
                covariance=np.diag(SIGMA**2), reference_ns=stamp(other)), 'loop')
        if k % 3 == 0:
            backend.update()
        if k % PER_LAP == PER_LAP - 1:
            kinds = backend.graph.factors.edges.kind
            sizes.append((backend.graph.n_nodes, len(kinds),
                          np.count_nonzero(kinds == FactorKind.LOOP_CLOSURE)))
    earlier, later = np.max(sizes[5:10], axis=0), np.max(sizes[15:], axis=0)
    assert np.all(later <= 1.1 * earlier)
    off = se2.between(backend.graph.poses[-1], truth[len(truth) - 2])
    assert np.hypot(*off[:2]) < 0.3


@pytest.mark.parametrize('cell', [0.0, 2.0])
def test_covariances_along_the_path_are_those_of_its_nodes(cell: float) -> None:
    backend, truth = driven(settings(cell))
    estimate = backend.estimate()
    assert estimate is not None
    found = backend.path_covariances(estimate)
    assert found.shape == (len(estimate.path), 3, 3)
    np.testing.assert_array_equal(found[-1], estimate.covariance)
    table, graph = backend._nodes, backend.graph
    for number in range(len(truth) - 1):
        place = table.attachment(number, np.zeros(3), np.zeros((3, 3)))
        of_node = backend._smoother.covariance(place.node)
        expected = covariance.propagated(
            graph.poses_of(place.node), of_node, place.motion, place.noise)
        np.testing.assert_allclose(found[number], expected, rtol=1e-5, atol=1e-9)
    assert (table.n_thinned > 20) == (cell > 0.0)
