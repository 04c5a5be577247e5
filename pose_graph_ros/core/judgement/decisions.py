# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decisions of a person on loop closures."""

import numpy as np

from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.beliefs import Beliefs
from pose_graph_ros.core.judgement.closure_reports import ClosureReports
from pose_graph_ros.core.judgement.closure_states import AUTO, ClosureStates, DECISIONS
from pose_graph_ros.core.judgement.closures import claims, ClosureTable
from pose_graph_ros.core.judgement.texts import sentence, unknown
from pose_graph_ros.core.judgement.verdicts import Decision, State
from pose_graph_ros.core.measurements import Answer, AnswerStatus, rejected


def decide(
    name: str, decision: Decision, closures: tuple[ClosureStates, ClosureTable, Beliefs],
    reports: ClosureReports, graph: Graph,
) -> Answer:
    """
    Return the answer to a decision, which is applied at once; see `ClosureJudge.decide`.

    Parameters
    ----------
    name : str, `Verdict.id`
    closures : tuple, what is known and believed of all closures

    """
    states, table, beliefs = closures
    number = states.find(name)
    if number < 0:
        return unknown(name, has_left=states.has_left(name))
    before = int(states.decision[number])
    state = {Decision.IN: State.BELIEVED, Decision.OUT: State.DOUBTED,
             Decision.AUTO: State.WAITING}[decision]
    forced = decision is not Decision.AUTO or before != AUTO
    states.decision[number] = DECISIONS.index(decision)
    if states.forgotten[number]:
        states.forgotten[number] = False
        table.bring_back(
            np.array([number]), claims(graph.edges_at(states.edge[number:number + 1])))
    if forced and not beliefs.apply({number: state}, at_once=True):
        states.decision[number] = before
        return rejected('failed', 'the solver failed with it')
    beliefs.round += 1
    verdict, = reports.of(graph, [number])
    return Answer(AnswerStatus.ACCEPTED, detail=f'{name}: {sentence(verdict)}')
