# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is believed of the loop closures, as states, as weights of the graph and as announcements.

Some beliefs cannot be changed in the time of an update, as its iterations diverge with them. They
are tried on a copy, part by part (`closure_trial`), and kept if they fit there.
"""

from collections.abc import Collection, Mapping

import numpy as np

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.closure_states import ClosureStates, DOUBTED, STATES, USED
from pose_graph_ros.core.judgement.closure_trial import ClosureTrial
from pose_graph_ros.core.judgement.closures import ClosureTable
from pose_graph_ros.core.judgement.odometry_states import Doubt, OdometryStates
from pose_graph_ros.core.judgement.residual_scale import ScaleLeft
from pose_graph_ros.core.judgement.swaps import Found
from pose_graph_ros.core.judgement.verdicts import State
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
        table: ClosureTable, odometry: OdometryStates,
    ) -> None:
        self._smoother, self._reweighting, self._odometry = smoother, reweighting, odometry
        self._states, self._table = states, table
        self.scales: list[float] = []
        """Of each source, the factor on its sigmas in the graph."""
        self.round = 0
        """Increases when more or less is believed, so that those that wait are tested again."""
        self.now_ns = 0
        self.trial = ClosureTrial(smoother)
        self.scales_left: list[ScaleLeft] = []
        """Of each source, what its closures have shown that have left the graph."""
        self._doubts: dict[int, Doubt] | None = None
        """Odometry that is doubted with the set that is tried, if that changes."""
        self._odometry_round = -1

    def weights(self, numbers: IntArray) -> FloatArray:
        """Return the weights of closures by their states."""
        scales = np.array(self.scales)[self._states.source[numbers]]
        return np.where(self._states.in_graph[numbers], 1.0 / np.square(scales), 0.0)

    def set_base_weights(self, numbers: IntArray) -> None:
        """Tell robust losses the weights of closures, which the graph has already."""
        for number, weight in zip(numbers.tolist(), self.weights(numbers).tolist(), strict=True):
            self._reweighting.set_base_weight(int(self._states.edge[number]), weight, edge=True)

    def apply(
        self, changes: Mapping[int, State], *, at_once: bool = False,
        doubts: Mapping[int, Doubt] | None = None,
    ) -> bool:
        """
        Return whether states and weights could be changed; else nothing has.

        If its iterations diverge, they are tried on a copy later, or solved for at once.

        Parameters
        ----------
        changes : mapping, new states by the numbers of closures
        doubts : mapping, optional, the doubted odometry edges by id, if they change as well

        """
        weights = self.weights_with(changes, doubts)
        result = self._smoother.update(GraphUpdate(weigh_edges=weights), fall_back=at_once)
        if result.status is Status.FAILED:
            if result.reason == DIVERGED:
                self.trial.begin(changes, weights)
            return False
        self.trial.was_not_needed()
        self._keep(changes, doubts)
        return True

    def change_to(
        self, inside: BoolArray, poses: FloatArray, doubts: Mapping[int, Doubt],
    ) -> bool:
        """
        Return whether another set could be believed, at the poses of its solution.

        Parameters
        ----------
        inside : ndarray of bool, shape (M,), which closures are believed
        poses : ndarray, shape (N, 3)
        doubts : mapping, doubted odometry edges by id

        """
        graph = self._smoother.graph
        before = graph.poses.copy()
        graph.set_poses(continued(graph, poses))
        done = self.apply(self._states.changes_to(inside), at_once=True, doubts=doubts)
        if not done:
            graph.set_poses(before)
            self._smoother.update(GraphUpdate())
        self._table.forget_spread()
        return done

    def try_set(self, found: Found) -> None:
        """Try another set of closures, and odometry that is doubted with it, on a copy."""
        changes, graph = self._states.changes_to(found.inside), self._smoother.graph
        self._doubts = None if found.jump is None else {
            **self._odometry.doubts, **self._odometry.doubted(
                graph, (found.jump,), self.now_ns, self._states.name)}
        self.trial.begin(changes, self.weights_with(changes, self._doubts),
                         continued(graph, found.poses, found.nodes))

    def believe_odometry_again(self) -> bool:
        """Believe odometry that no believed closure leads over; tell whether there was any."""
        if self.round == self._odometry_round or len(self._odometry.doubts) == 0:
            return False
        self._odometry_round = self.round
        edges = self._smoother.graph.edges_at(self._states.edge[self._states.in_graph])
        left = self._odometry.still_doubted(edges)
        return len(left) < len(self._odometry.doubts) and self.apply({}, doubts=left)

    def weights_with(
        self, changes: Mapping[int, State], doubts: Mapping[int, Doubt] | None = None,
    ) -> dict[int, float]:
        """
        Return the weights of edges, by id, after a change of states.

        Parameters
        ----------
        changes, doubts : as in `apply`

        """
        numbers = np.array(sorted(changes), dtype=np.int64)
        before = self._states.state[numbers].copy()
        self._states.state[numbers] = [STATES.index(changes[k]) for k in numbers.tolist()]
        weights = self.weights(numbers).tolist()
        self._states.state[numbers] = before
        odometry = {} if doubts is None else self._odometry.weights_with(doubts)
        return {**dict(zip(self._states.edge[numbers].tolist(), weights, strict=True)), **odometry}

    def _keep(
        self, changes: Mapping[int, State], doubts: Mapping[int, Doubt] | None,
    ) -> None:
        """Change states, of which the graph has the weights already."""
        for number, state in sorted(changes.items()):
            before = int(self._states.state[number])
            self._states.state[number] = STATES.index(state)
            self._states.announce(number, before, self.now_ns)
        self.set_base_weights(np.array(sorted(changes), dtype=np.int64))
        if doubts is not None:
            for edge, weight in self._odometry.weights_with(doubts).items():
                self._reweighting.set_base_weight(edge, weight, edge=True)
            self._odometry.keep(doubts, self._smoother.graph)
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
        is_of_closures = len(changes) > 0 or self._doubts is not None
        if trial.is_outdated or (is_of_closures and (
                trial.weights != self.weights_with(changes, self._doubts)
                or not np.all(states.judged[[*changes]]))):
            later |= set(changes)
        else:
            bad = trial.misfits(self._table)
            if len(bad) == 0 and trial.adopt():
                self._keep(changes, self._doubts)
                later |= set(changes)
            for number in bad:
                before, states.state[number] = int(states.state[number]), DOUBTED
                states.announce(number, before, self.now_ns)
            later |= set(changes) - set(bad) if len(bad) > 0 else set()
        self.end_trial()
        return sorted(later)

    def closures_left(self, numbers: IntArray) -> None:
        """Keep what believed closures have shown of the errors of their sources."""
        states = self._states
        for source in np.unique(states.source[numbers]).tolist():
            used = USED[states.state[numbers]] & (states.source[numbers] == source)
            self.scales_left[source].add(int(np.count_nonzero(used)), self.scales[source])

    def forget(self, edges: Collection[int], numbers: Collection[int]) -> None:
        """
        Forget what has left the graph.

        Parameters
        ----------
        edges : collection of int, ids
        numbers : collection of int, closures

        """
        self.trial.forget(edges, numbers)
        if self._doubts is not None:
            self._doubts = {edge: doubt for edge, doubt in self._doubts.items()
                            if edge not in edges}

    def end_trial(self) -> None:
        """Forget what is tried."""
        self.trial.end()
        self._doubts = None
