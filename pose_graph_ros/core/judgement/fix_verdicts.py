# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The verdicts on positions and poses in the map, with the reasons."""

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.fix_states import (
    AUTO,
    BELIEVED,
    DECISION,
    DECISIONS,
    EDGE,
    FixStates,
    HELD,
    LONE,
    RUN,
    SINCE,
    SOURCE,
    STAMP,
)
from pose_graph_ros.core.judgement.runs import EVENT
from pose_graph_ros.core.judgement.verdicts import Judged, listed, MOST_NAMED, State, Verdict


def verdicts(states: FixStates, graph: Graph, most_believed: int | None) -> list[Verdict]:
    """
    Return the verdicts that are listed; see `verdicts.listed`.

    Parameters
    ----------
    most_believed : int or None

    """
    numbers = listed(states.records[:, SOURCE], states.believed,
                     states.records[:, DECISION] != AUTO, most_believed)
    return verdicts_on(states, graph, numbers)


def believed_after(states: FixStates, stamp_ns: int) -> tuple[str, ...]:
    """Return the ids of the first believed measurements from a stamp on."""
    after = np.flatnonzero(states.believed & (states.records[:, STAMP] >= stamp_ns))
    first = after[np.argsort(states.records[after, STAMP], kind='stable')][:MOST_NAMED]
    return tuple(map(states.name, first.tolist()))


def verdicts_on(states: FixStates, graph: Graph, numbers: IntArray) -> list[Verdict]:
    """
    Return the verdicts on some measurements.

    Parameters
    ----------
    numbers : ndarray of int, shape (K,)

    """
    residuals = _residuals(graph, *states.records[numbers][:, (HELD, EDGE)].T)
    return [_verdict(states, number, residual)
            for number, residual in zip(numbers.tolist(), residuals, strict=True)]


def _verdict(states: FixStates, number: int, residual: FloatArray) -> Verdict:
    record = states.records[number]
    believed, edge = bool(record[BELIEVED]), bool(record[EDGE])
    # members of a run follow one another
    first, records = max(number - 50, 0), states.records
    alike = first + np.flatnonzero(records[first:number + 50, RUN] == record[RUN])
    alike = alike[alike != number] if record[RUN] != LONE else alike[:0]
    # a person may force out what fits, and force in what does not
    contradicted = (not believed if record[DECISION] == AUTO
                    else bool(states.distances[number]**2 > EVENT))
    near = alike[np.argsort(np.abs(alike - number), kind='stable')][:MOST_NAMED]
    return Verdict(
        id=states.name(number), kind=Judged.FIX, source=states.sources[record[SOURCE]],
        stamp_ns=int(record[STAMP]), reference_ns=None,
        state=State.BELIEVED if believed else State.DOUBTED, since_ns=int(record[SINCE]),
        decision=DECISIONS[record[DECISION]],
        residual=residual,
        distance=float(states.distances[number]),
        supported_by=tuple(states.name(other) for other in near.tolist()),
        contradicted_by=('odometry',) if contradicted else (), edge=edge, number=int(record[HELD]))


def _residuals(graph: Graph, held: IntArray, is_edge: IntArray) -> FloatArray:
    """Return the errors at the estimate, shape (K, 3), nan where nothing is measured."""
    residuals = np.empty((len(held), 3))
    some = is_edge != 0
    biased, observed = graph.edges_at(held[some]), graph.observed_at(held[~some])
    for which, error, information in (
            (some, graph.edge_errors(biased), biased.information),
            (~some, graph.observed_errors(observed), observed.information)):
        measured = np.diagonal(information, axis1=1, axis2=2) > 0.0
        residuals[which] = np.where(measured, error, np.nan)
    return residuals
