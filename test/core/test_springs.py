# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What there is to see of a graph, held to a slow look at every row, and names for people."""

import re
import time

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_graphs import matrix, random_graph

from pose_graph_ros.core import factors, se2, springs
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, NodePolicy
from pose_graph_ros.core.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph import Graph, GraphUpdate
from pose_graph_ros.core.measurements import (
    GlobalPose,
    HeadingOnly,
    LoopClosure,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.sources import Correlation, Loss, MeasurementSource, OdometrySource
from pose_graph_ros.core.springs import GraphView, Lines

SECOND = 1_000_000_000
seeds = st.integers(0, 2**32 - 1)
biases = st.integers(0, 4)
# Energies by the kernel and by NumPy differ by rounding.
SAME = {'rtol': 1e-9, 'atol': 1e-9}


def weighted(seed: int, n_biases: int) -> Graph:
    """Return a random graph; some of its edges are odometry, some rows have weights or are out."""
    graph = random_graph(seed, n_edges=10, n_observed=6, n_biases=n_biases)
    graph.apply(GraphUpdate(
        edges=Edges([0, 2], [1, 3], [[1.0, 0.0, 0.1]] * 2, [np.eye(3)] * 2,
                    [EdgeKind.ODOMETRY] * 2),
        weigh_edges={0: 0.25, 1: 0.0}, remove_observed=(2,), weigh_observed={1: 0.5}))
    return graph


@given(seeds, biases)
def test_energies_are_those_of_the_errors(seed: int, n_biases: int) -> None:
    graph = weighted(seed, n_biases)
    edges, observed = np.empty(graph.n_edges), np.empty(graph.n_observed)
    factors.energies(graph.memory.head, edges, observed)
    expected, (weights, observed_weights) = graph.energies(), graph.weights
    np.testing.assert_allclose(edges * weights, expected.edges, **SAME)
    np.testing.assert_allclose(observed * observed_weights, expected.observed, **SAME)
    full = weighted(seed, n_biases)
    full.apply(GraphUpdate(
        weigh_edges=dict.fromkeys(range(graph.n_edges), 1.0),
        weigh_observed=dict.fromkeys(range(graph.n_observed), 1.0)))
    np.testing.assert_allclose(edges, full.energies().edges, **SAME)
    np.testing.assert_allclose(observed, full.energies().observed, **SAME)


def slow_view(graph: Graph) -> dict[str, list[list[float]]]:
    """Look at each row: its ends and sigmas, as a list of five numbers for each spring."""
    found: dict[str, list[list[float]]] = {
        'nodes': [], 'odometry': [], 'loop_closures': [], 'observed': []}
    poses, is_bias, edges, observed = graph.poses, graph.is_bias, graph.edges, graph.observed
    energies = graph.energies()
    for k in range(graph.n_nodes):
        if not is_bias[k]:
            found['nodes'].append(poses[k, :2].tolist())
    for k in range(graph.n_edges):
        if edges.weight[k] == 0.0:
            continue
        start, information = poses[edges.i[k]], edges.information[k]
        sigmas = np.sqrt(energies.edges[k] / edges.weight[k] / (np.diag(information) > 0.0).sum())
        if edges.kind[k] != EdgeKind.BIAS:
            name = 'odometry' if edges.kind[k] == EdgeKind.ODOMETRY else 'loop_closures'
            found[name].append([*start[:2], *poses[edges.j[k], :2], sigmas])
        elif not is_bias[edges.i[k]] and information[0, 0] > 0.0:
            predicted = matrix(start) @ [*edges.bias[k, :2], 1.0]
            found['observed'].append([*predicted[:2], *edges.mean[k, :2], sigmas])
    for k in range(graph.n_observed):
        information = observed.information[k]
        if (observed.weight[k] == 0.0 or is_bias[observed.node[k]]
                or information[0, 0] == 0.0):
            continue
        predicted = matrix(poses[observed.node[k]]) @ [*observed.offset[k, :2], 1.0]
        sigmas = np.sqrt(
            energies.observed[k] / observed.weight[k] / (np.diag(information) > 0.0).sum())
        found['observed'].append([*predicted[:2], *observed.mean[k, :2], sigmas])
    return found


def rows(lines: Lines) -> FloatArray:
    return np.column_stack((lines.ends.reshape(-1, 4), lines.sigmas))


def in_any_order(table: FloatArray) -> FloatArray:
    return table[np.lexsort(np.round(table, 6).T)]


@given(seeds, biases)
def test_the_view_shows_each_row_once_and_no_bias(seed: int, n_biases: int) -> None:
    graph = weighted(seed, n_biases)
    view = springs.view(graph)
    assert view is not None
    expected = slow_view(graph)
    np.testing.assert_array_equal(view.nodes, expected.pop('nodes'))
    for name, wanted in expected.items():
        np.testing.assert_allclose(
            in_any_order(rows(getattr(view, name))),
            in_any_order(np.array(wanted).reshape(-1, 5)), **SAME)


def test_a_heading_has_no_place() -> None:
    backend = PoseGraphBackend()
    assert backend.view() is None
    for k in range(1, 20):
        backend.add_odometry(OdometrySample(k * SECOND, np.array((float(k), 0.0, 0.0))))
    backend.add_measurement(GlobalPose(3 * SECOND, np.array((3.0, 0.0, 0.1)), np.eye(3)), 'pose')
    backend.add_measurement(HeadingOnly(4 * SECOND, 0.0, 0.01), 'imu')
    backend.optimize()
    view = backend.view()
    assert view is not None
    assert len(view.observed.ends) == 1
    np.testing.assert_array_equal(view.observed.ends[0, 1], [3.0, 0.0])


def test_a_view_does_not_follow_the_graph_and_cannot_be_written() -> None:
    graph = weighted(0, 2)
    view = springs.view(graph)
    assert view is not None
    before = [array.tobytes() for array in arrays(view)]
    graph.set_poses(graph.poses + 1.0)
    assert [array.tobytes() for array in arrays(view)] == before
    for array in arrays(view):
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 0.0


def arrays(view: GraphView) -> list[FloatArray]:
    lines = (view.odometry, view.loop_closures, view.observed)
    return [view.nodes, *(array for line in lines for array in (line.ends, line.sigmas))]


# --- Names -----------------------------------------------------------------------------------

def driven() -> PoseGraphBackend:
    """Drive a circle twice, with all kinds of sources."""
    backend = PoseGraphBackend(BackendConfig(
        nodes=NodePolicy(minimum_travel_distance=1.0),
        odometry={name: OdometrySource(reorder_window=0.0) for name in ('wheels', 'visual')},
        measurements={
            'wander': MeasurementSource(correlation_time=20.0),
            'inflated': MeasurementSource(
                correlation_time=5.0, correlation=Correlation.INFLATE),
            'robust': MeasurementSource(loss=Loss.HUBER, rejection_threshold=1.0)}))
    rng = np.random.default_rng(3)
    pose, step = np.zeros(3), np.array((0.5, 0.0, np.pi / 30.0))
    for k in range(121):
        stamp = k * SECOND
        if k > 0:
            pose = se2.compose(pose, step)
        for name in ('wheels', 'visual'):
            noise = rng.normal(0.0, 0.01, 3)
            backend.add_odometry(OdometrySample(stamp, pose + noise), name)
        where = pose[:2] + rng.normal(0.0, 0.3, 2)
        after = stamp - SECOND // 4
        if k == 2:
            backend.add_measurement(GlobalPose(after, pose, 0.01 * np.eye(3)), 'pose')
        elif k % 4 == 2:
            name = ('wander', 'inflated', 'robust')[k // 4 % 3]
            backend.add_measurement(Position(after, where, 0.01 * np.eye(2), np.zeros(2)), name)
        if k % 40 == 39:
            backend.add_measurement(HeadingOnly(after, float(pose[2]), 0.01), 'imu')
        if k in {70, 100}:
            backend.add_measurement(LoopClosure(
                stamp, np.array((0.5, 0.0, 0.0)), 0.01 * np.eye(3),
                reference_ns=stamp - 60 * SECOND), 'scans')
        if k % 7 == 0:
            backend.update()
    backend.optimize()
    return backend


def test_every_constraint_has_the_name_of_its_source_and_of_its_ends() -> None:
    backend = driven()
    found = backend.largest_energies(10_000)
    energies = backend.graph.energies()
    all_energies = np.concatenate((energies.edges, energies.observed))
    assert len(found) == np.count_nonzero(all_energies > 0.0)
    assert sum(spring.energy for spring in found) == pytest.approx(energies.chi2)
    assert [spring.energy for spring in found] == sorted(
        (spring.energy for spring in found), reverse=True)
    names = [spring.name for spring in found]
    assert len(set(names)) == len(names)
    n = len(backend.node_stamps_ns)
    for source in ('wheels', 'visual'):
        ours = [spring for spring in found if spring.source == source]
        assert {spring.kind for spring in ours} == {'odometry'}
        assert {spring.name for spring in ours} == {
            f'{source} x{k} - x{k + 1}' for k in range(n - 1)}
    stamps = backend.node_stamps_ns

    def node(seconds: float) -> int:
        return int(np.searchsorted(stamps, round(seconds * SECOND), side='right')) - 1

    assert {spring.name for spring in found if spring.source == 'scans'} == {
        f'scans x{node(k - 60)} - x{node(k)}' for k in (70, 100)}
    expected = {'pose': {2}, 'imu': {39, 79, 119}} | {
        name: {k for k in range(6, 121, 4) if k // 4 % 3 == number}
        for number, name in enumerate(('wander', 'inflated', 'robust'))}
    for source, instants in expected.items():
        ours = {spring.name for spring in found
                if spring.source == source and spring.kind != 'bias'}
        assert ours == {f'{source} at {k - 0.25:.3f} s near x{node(k - 0.25)}' for k in instants}
    kinds = {spring.source: spring.kind for spring in found if spring.kind != 'bias'}
    assert kinds == {
        'wheels': 'odometry', 'visual': 'odometry', 'scans': 'loop_closure',
        'pose': 'global_pose', 'imu': 'heading', 'wander': 'position', 'inflated': 'position',
        'robust': 'position'}
    beforehand = [spring for spring in found if spring.kind == 'bias']
    assert 1 <= len(beforehand) <= len(expected['wander'])
    width = 20.0 / 64
    for spring in beforehand:
        began = re.fullmatch(r'error of wander at (\d+\.\d{3}) s', spring.name)
        assert began is not None
        assert any(0.0 <= k - 0.25 - float(began[1]) < width + 1e-3 for k in expected['wander'])


def test_energies_are_told_with_the_weight_and_without() -> None:
    backend = driven()
    found = backend.largest_energies(10_000)
    robust = [spring for spring in found if spring.source == 'robust']
    for spring in robust:
        assert spring.freedom == 2
        # Huber with a threshold of 1: the weight is 1 / sigmas beyond it
        assert spring.energy == pytest.approx(min(spring.unweighted, spring.unweighted**0.5))
    assert any(spring.unweighted > 2.0 * spring.energy for spring in robust)
    freedom = {spring.kind: spring.freedom for spring in found}
    assert freedom == {'odometry': 3, 'loop_closure': 3, 'global_pose': 3, 'position': 2,
                       'heading': 1, 'bias': 3}


def test_the_largest_are_the_first_of_all() -> None:
    backend = driven()
    every = backend.largest_energies(10_000)
    assert backend.largest_energies(5) == every[:5]
    assert backend.largest_energies(0) == []
    assert PoseGraphBackend().largest_energies(5) == []


def test_when_another_odometry_leads_its_edges_are_its_own() -> None:
    backend = PoseGraphBackend(BackendConfig(odometry={
        name: OdometrySource(reorder_window=0.0) for name in ('wheels', 'visual')}))
    rng = np.random.default_rng(1)
    for k in range(1, 61):
        for name in ('wheels', 'visual') if k <= 30 else ('visual',):
            backend.add_odometry(OdometrySample(
                k * SECOND, np.array((float(k), 0.0, 0.0)) + rng.normal(0.0, 0.01, 3)), name)
    backend.add_measurement(
        LoopClosure(50 * SECOND, np.array((35.0, 0.0, 0.0)), 0.01 * np.eye(3), 15 * SECOND),
        'scan')
    backend.optimize()
    names = {spring.name for spring in backend.largest_energies(10_000)}
    last = len(backend.node_stamps_ns) - 1
    assert f'visual x{last - 1} - x{last}' in names
    assert f'wheels x{last - 1} - x{last}' not in names
    assert {'wheels x3 - x4', 'visual x3 - x4'} <= names


def test_where_the_source_is_not_known_the_kind_is_the_name() -> None:
    backend = driven()
    before = backend.largest_energies(10_000)
    # of what a loaded graph had by other settings nothing is known
    for known in ('_own', '_ties', '_correlated'):
        getattr(backend._joins, known).clear()
    for old, new in zip(before, backend.largest_energies(10_000), strict=True):
        assert (new.energy, new.kind, new.freedom) == (old.energy, old.kind, old.freedom)
        if old.kind == 'bias':
            assert new.name == 'bias'
        elif old.kind == 'odometry':
            assert new.name.partition(' ')[2] == old.name.partition(' ')[2]
        else:
            ends = old.name[old.name.index('near' if 'near' in old.name else 'x'):]
            assert (new.source, new.name) == ('', f'{old.kind} {ends}')


def test_a_large_graph_is_looked_at_quickly() -> None:
    n = 50_000
    graph, ahead = Graph(), np.arange(n - 1)
    graph.apply(GraphUpdate(
        hidden=np.zeros((n, 3)), edges=Edges(
            ahead, ahead + 1, np.ones((n - 1, 3)), np.tile(np.eye(3), (n - 1, 1, 1)),
            np.zeros(n - 1, dtype=int))))
    springs.view(graph)
    start = time.process_time()
    springs.view(graph)
    # a hundred times what it takes
    assert time.process_time() - start < 1.0
