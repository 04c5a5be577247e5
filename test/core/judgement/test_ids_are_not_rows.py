# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judgement and sources keep ids: where these are not the rows, all is as where they are."""


import numpy as np
import pytest
from test_closures import CONFIG, false_ones, ODOMETRY, SECOND, true_ones, TRUTH, work

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.graph.graph import Graph, NextIds
from pose_graph_ros.core.judgement.verdicts import Decision, Verdict
from pose_graph_ros.core.measurements import (
    AnswerStatus,
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

SHIFT = NextIds(1000, 3000)
"""Ids of the first rows of a graph, as if others had left it."""


def fixes(rng: np.random.Generator) -> list[Measurement]:
    """Return fixes at every other node with errors that go on, and some in a row 17 m aside."""
    error, found = np.zeros(2), list[Measurement]()
    for k in range(0, len(TRUTH), 2):
        error = 0.95 * error + rng.normal(0.0, 0.5 * np.sqrt(1.0 - 0.95**2), 2)
        at = TRUTH[k, :2] + error + 17.0 * (90 <= k < 110)
        found.append(Position((k + 1) * SECOND, at, 0.25 * np.eye(2), np.zeros(2)))
    return found


def closures(rng: np.random.Generator) -> list[Measurement]:
    return [*true_ones(rng), *false_ones(rng)]


def run(
    measurements: list[Measurement], config: BackendConfig, first: NextIds,
) -> list[PoseGraphBackend | list[Verdict] | np.ndarray]:
    """Drive and return a back end, with verdicts and poses while driving and at the end."""
    smoother = IncrementalSmoother(config.smoother)
    smoother.graph.fill(Graph().rows()._replace(next_ids=first))
    backend, seen = PoseGraphBackend(config, smoother=smoother), []
    by_stamp = {each.stamp_ns: each for each in measurements}
    for k, pose in enumerate(ODOMETRY):
        stamp_ns = (k + 1) * SECOND
        backend.add_odometry(OdometrySample(stamp_ns, pose))
        if stamp_ns in by_stamp:
            one = by_stamp[stamp_ns]
            backend.add_measurement(one, 'scan' if isinstance(one, LoopClosure) else 'fix')
        if k % 5 == 0:
            backend.update()
            work(backend)
        if k % 60 == 59:
            seen += [backend.verdicts(), backend.graph.poses.copy()]
    doubted = next(each for each in backend.verdicts() if not each.state.in_graph)
    for decision in (Decision.IN, Decision.AUTO):
        assert backend.decide(doubted.id, decision).status is AnswerStatus.ACCEPTED
    backend.optimize()
    return [backend, *seen, backend.verdicts(), backend.graph.poses.copy()]


@pytest.mark.parametrize('what', [closures, fixes])
def test_nothing_depends_on_which_ids_nodes_and_constraints_have(what: object) -> None:
    assert callable(what)
    measurements = what(np.random.default_rng(3))
    (plain, *expected), (backend, *found) = (
        run(measurements, CONFIG, first) for first in (NextIds(0, 0), SHIFT))
    assert isinstance(plain, PoseGraphBackend)
    assert isinstance(backend, PoseGraphBackend)
    for one, other in zip(expected, found, strict=True):
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other)
            continue
        for a, b in zip(one, other, strict=True):
            assert (a.number + SHIFT.factor, str(a._replace(number=0))) == (
                b.number, str(b._replace(number=0)))
    np.testing.assert_array_equal(plain.graph.weights, backend.graph.weights)
    assert plain.verdict_totals() == backend.verdict_totals()
    assert str(plain.reports()) == str(backend.reports())
    assert plain._factors.errors_in_use('fix') == backend._factors.errors_in_use('fix')
    if what is fixes:
        assert plain._factors.errors_in_use('fix') is not None
