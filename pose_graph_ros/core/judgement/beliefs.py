# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is believed of the loop closures, as states, as weights of the graph and as announcements.

Some beliefs cannot be changed in the time of an update, as its iterations diverge with them. They
are tried on a copy, part by part (`closure_trial`), and kept if they fit there.
"""

from collections.abc import Mapping

import numpy as np

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.closure_reports import ClosureReports
from pose_graph_ros.core.judgement.closure_states import (
    AUTO,
    ClosureStates,
    DECISIONS,
    DOUBTED,
    STATES,
    USED,
)
from pose_graph_ros.core.judgement.closure_trial import ClosureTrial
from pose_graph_ros.core.judgement.closures import claims, ClosureTable
from pose_graph_ros.core.judgement.residual_scale import ScaleLeft
from pose_graph_ros.core.judgement.swaps import Found
from pose_graph_ros.core.judgement.texts import sentence, unknown
from pose_graph_ros.core.judgement.verdicts import Decision, State
from pose_graph_ros.core.measurements import Answer, AnswerStatus, rejected
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.results import DIVERGED
from pose_graph_ros.core.smoother.trial import continued


class Beliefs:
    """
    Changes states and weights of closures together.

    Parameters
    ----------
    reweighting : Reweighting, of its constraints with a robust loss

    """

    def __init__(
        self, smoother: IncrementalSmoother, reweighting: Reweighting, states: ClosureStates,
        table: ClosureTable,
    ) -> None:
        self._smoother, self._reweighting = smoother, reweighting
        self._states, self._table = states, table
        self.scales: list[float] = []
        """Of each source, the factor on its sigmas in the graph."""
        self.round = 0
        """Increases when more or less is believed, so that those that wait are tested again."""
        self.now_ns = 0
        self.trial = ClosureTrial(smoother)
        self.scales_left: list[ScaleLeft] = []
        """Of each source, what its closures have shown that have left the graph."""

    def weights(self, numbers: IntArray) -> FloatArray:
        """Return the weights of closures by their states."""
        scales = np.array(self.scales)[self._states.source[numbers]]
        return np.where(self._states.in_graph[numbers], 1.0 / np.square(scales), 0.0)

    def set_base_weights(self, numbers: IntArray) -> None:
        """Tell robust losses the weights of closures, which the graph has already."""
        for number, weight in zip(numbers.tolist(), self.weights(numbers).tolist(), strict=True):
            self._reweighting.set_base_weight(int(self._states.edge[number]), weight, edge=True)

    def apply(self, changes: Mapping[int, State], *, at_once: bool = False) -> bool:
        """
        Return whether states and weights could be changed; else nothing has.

        If its iterations diverge, they are tried on a copy later, or solved for at once.

        Parameters
        ----------
        changes : mapping, new states by the numbers of closures

        """
        weights = self.weights_with(changes)
        result = self._smoother.update(GraphUpdate(weigh_edges=weights), fall_back=at_once)
        if result.status is Status.FAILED:
            if result.reason == DIVERGED:
                self.trial.begin(changes, weights)
            return False
        self.trial.was_not_needed()
        self._keep(changes)
        return True

    def change_to(self, inside: BoolArray, poses: FloatArray) -> bool:
        """
        Return whether another set could be believed, at the poses of its solution.

        Parameters
        ----------
        inside : ndarray of bool, shape (M,), which closures are believed
        poses : ndarray, shape (N, 3)

        """
        graph = self._smoother.graph
        before = graph.poses.copy()
        graph.set_poses(continued(graph, poses))
        done = self.apply(self._states.changes_to(inside), at_once=True)
        if not done:
            graph.set_poses(before)
            self._smoother.update(GraphUpdate())
        self._table.forget_spread()
        return done

    def try_set(self, found: Found) -> None:
        """Try another set of closures on a copy."""
        changes, graph = self._states.changes_to(found.inside), self._smoother.graph
        self.trial.begin(changes, self.weights_with(changes),
                         continued(graph, found.poses, found.nodes))

    def weights_with(self, changes: Mapping[int, State]) -> dict[int, float]:
        """
        Return the weights of edges, by id, after a change of states.

        Parameters
        ----------
        changes : as in `apply`

        """
        numbers = np.array(sorted(changes), dtype=np.int64)
        before = self._states.state[numbers].copy()
        self._states.state[numbers] = [STATES.index(changes[k]) for k in numbers.tolist()]
        weights = self.weights(numbers).tolist()
        self._states.state[numbers] = before
        return dict(zip(self._states.edge[numbers].tolist(), weights, strict=True))

    def _keep(self, changes: Mapping[int, State]) -> None:
        """Change states, of which the graph has the weights already."""
        for number, state in sorted(changes.items()):
            before = int(self._states.state[number])
            self._states.state[number] = STATES.index(state)
            self._states.announce(number, before, self.now_ns)
        self.set_base_weights(np.array(sorted(changes), dtype=np.int64))
        self.round += 1

    def try_part(self) -> list[int] | None:
        """
        Do a part of a trial, and keep what fits; None if there is none.

        Returns closures that are to be tested again.
        """
        trial, states = self.trial, self._states
        if not trial.work():
            return None
        if not trial.is_finished:
            return []
        changes, later = trial.changes, trial.later
        if trial.is_outdated or (len(changes) > 0 and (
                trial.weights != self.weights_with(changes)
                or not np.all(states.judged[[*changes]]))):
            later |= set(changes)
        else:
            bad = trial.misfits(self._table)
            if len(bad) == 0 and trial.adopt():
                self._keep(changes)
                later |= set(changes)
            for number in bad:
                before, states.state[number] = int(states.state[number]), DOUBTED
                states.announce(number, before, self.now_ns)
            later |= set(changes) - set(bad) if len(bad) > 0 else set()
        trial.end()
        return sorted(later)

    def closures_left(self, numbers: IntArray) -> None:
        """Keep what believed closures have shown of the errors of their sources."""
        states = self._states
        for source in np.unique(states.source[numbers]).tolist():
            used = USED[states.state[numbers]] & (states.source[numbers] == source)
            self.scales_left[source].add(int(np.count_nonzero(used)), self.scales[source])


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
