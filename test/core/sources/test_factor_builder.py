# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From queues to updates: the order of arrival is forgotten, and each row knows its source."""

import numpy as np
from saved_graphs import assert_same_value

from pose_graph_ros.core.config import BackendConfig, Loss, MeasurementSource
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.measurements import Position
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.gauss_markov import (
    Additions,
    CorrelatedErrors,
    GaussMarkovBias,
)
from pose_graph_ros.core.sources.measurement_constraints import absolute_constraint
from pose_graph_ros.core.sources.source_constraints import AttachedMeasurement, Queue, QueuedEdge

SECOND = 1_000_000_000
N = 40
CONFIG = BackendConfig(measurements={
    'white': MeasurementSource(loss=Loss.HUBER),
    'biased': MeasurementSource(correlation_time=64.0),
    'other': MeasurementSource(loss=Loss.CAUCHY)})


def line() -> Graph:
    """Return nodes at every metre and second of a line."""
    graph, ahead = Graph(), np.arange(N - 1)
    graph.apply(GraphUpdate(
        hidden=np.column_stack((np.arange(N), np.zeros((N, 2)))), fix=(0,), edges=Edges(
            ahead, ahead + 1, np.tile((1.0, 0.0, 0.0), (N - 1, 1)),
            np.tile(100.0 * np.eye(3), (N - 1, 1, 1)), [EdgeKind.ODOMETRY] * (N - 1))))
    return graph


def fix(source: str, second: int) -> AttachedMeasurement:
    where = np.array([second + 0.1, 0.05 * (second % 3)])
    measurement = Position(second * SECOND, where, 0.25 * np.eye(2), np.zeros(2))
    attachment = Attachment(second, np.zeros(3), np.zeros((3, 3)))
    return AttachedMeasurement(
        source, absolute_constraint(measurement, attachment), measurement, attachment)


def closure(i: int, j: int) -> Edges:
    return Edges([i], [j], [[j - i, 0.0, 0.0]], [np.eye(3)], [EdgeKind.LOOP_CLOSURE])


def some(seconds: list[int]) -> Queue:
    return Queue([QueuedEdge('scan', closure(seconds[0], seconds[0] + 5))], [
        fix(source, k) for k in seconds for source in ('white', 'biased', 'other')])


def builder() -> tuple[FactorBuilder, Reweighting]:
    reweighting = Reweighting()
    return FactorBuilder(CONFIG, reweighting), reweighting


def committed(factors: FactorBuilder, graph: Graph, *queues: Queue) -> None:
    for queue in queues:
        graph.apply(factors.build(queue, graph))
        factors.commit()


def test_an_update_adds_each_constraint_once() -> None:
    graph, (factors, reweighting) = line(), builder()
    update = factors.build(some([3, 4, 20]), graph)
    kinds = update.edges.kind.tolist()
    assert kinds.count(EdgeKind.LOOP_CLOSURE) == 1
    # one to a state for each fix, one from each state but the first to the state before
    assert len(update.biases) == 3
    assert kinds.count(EdgeKind.BIAS) == 3 + 2
    # white, other, and the prior of the first state
    assert len(update.observed) == 3 + 3 + 1
    assert factors.n_measurements == 0
    assert len(reweighting) == 0
    graph.apply(update)
    factors.commit()
    assert factors.n_measurements == 9
    assert factors.n_bias_edges == np.sum(graph.edges.kind == EdgeKind.BIAS) == 5
    assert len(reweighting) == 6    # white and other


def test_every_row_knows_the_source_and_the_stamp_that_it_came_from() -> None:
    graph, (factors, _) = line(), builder()
    committed(factors, graph, some([3, 4, 20]), some([1, 10, 30]))
    found: dict[str, list[int]] = {}
    edges, observed = graph.edges, graph.observed
    for row in range(graph.n_edges):
        origin = factors.origin(row, edge=True)
        kind = edges.kind[row]
        assert (origin is None) == (kind == EdgeKind.ODOMETRY or bool(
            kind == EdgeKind.BIAS and graph.is_bias[edges.i[row]]))
        if origin is not None:
            found.setdefault(origin.source, []).append(origin.stamp_ns)
            if kind == EdgeKind.BIAS:   # nodes are numbered by their seconds
                assert edges.i[row] * SECOND == origin.stamp_ns
    for row in range(graph.n_observed):
        origin = factors.origin(row, edge=False)
        assert (origin is None) == bool(graph.is_bias[observed.node[row]])
        if origin is not None:
            found.setdefault(origin.source, []).append(origin.stamp_ns)
            assert observed.node[row] * SECOND == origin.stamp_ns
    seconds = [k * SECOND for k in (1, 3, 4, 10, 20, 30)]
    assert found.pop('scan') == [-1, -1]
    assert {name: sorted(stamps) for name, stamps in found.items()} == dict.fromkeys(
        ('white', 'biased', 'other'), seconds)
    assert factors.origin(graph.n_edges, edge=True) is None
    assert factors.origin(graph.n_observed, edge=False) is None


def test_an_update_that_is_rolled_back_is_built_again_as_it_was() -> None:
    graph, (factors, reweighting) = line(), builder()
    committed(factors, graph, some([3, 4, 20]))
    before = factors.saved(), reweighting.saved()
    first = factors.build(some([1, 10, 30]), graph)
    factors.rollback()
    assert_same_value((factors.saved(), reweighting.saved()), before)
    second = factors.build(some([1, 10, 30]), graph)
    assert_same_value(second.edges, first.edges)
    assert_same_value(second.observed, first.observed)
    assert (second.remove_edges, second.remove_observed, second.weigh_observed) == (
        first.remove_edges, first.remove_observed, first.weigh_observed)


def test_a_bias_that_came_into_use_stays_when_the_next_update_fails_before_it_is_built() -> None:
    graph, (factors, _) = line(), builder()
    committed(factors, graph, some([3, 4, 20]))
    bias, additions = GaussMarkovBias(CorrelatedErrors(64.0, 1.0, 0.05)), Additions(graph.next_ids)
    bias.begin()
    bias.add(3 * SECOND, fix('white', 3).observed, np.zeros(2), additions)
    graph.apply(additions.update())
    factors.set_error_model('white', bias)
    factors.rollback()
    assert len(bias.nodes) == 1


def restored(factors: FactorBuilder, config: BackendConfig) -> FactorBuilder:
    other = FactorBuilder(config, Reweighting())
    for name, saved in factors.saved().items():
        other.restore(name, saved)
    return other


def test_with_another_error_model_saved_constraints_stay_and_are_counted() -> None:
    graph, (factors, _) = line(), builder()
    committed(factors, graph, some([3, 4, 20]))
    all_white = BackendConfig(measurements={name: MeasurementSource() for name in (
        'white', 'biased', 'other')})
    other = restored(factors, all_white)
    assert other.n_measurements == factors.n_measurements
    assert other.saved()['biased'].n_otherwise == 3
    update = other.build(Queue([], [fix('biased', 7)]), graph)
    assert (len(update.biases), len(update.edges), len(update.observed)) == (0, 0, 1)
