# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which of the loop closures that have passed the gate are believed, and when one is tested again.

`BeliefRule` chooses; `Beliefs` changes states and weights together.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.closure_states import ClosureStates, NEVER
from pose_graph_ros.core.judgement.closure_trial import ClosureTrial, Found
from pose_graph_ros.core.judgement.closures import ClosureTable
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import OUT, State, STATES, USED
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.trial import continued


class Retests:
    """
    Of each closure, by number, what its next test waits for.

    Closures are tested again whenever more or less is believed. But those that contradict one
    another could take turns in the graph for ever, so one that was thrown out a few times waits
    for the next closure to come. And the iterations of an update diverge with some: these wait
    until the graph has grown by a share, so that all failures together take a time in proportion
    to the drive.
    """

    def __init__(self, states: ClosureStates) -> None:
        self._states = states

    def due(self, now: int, next_node: int) -> BoolArray:
        """Return which closures may be tested, shape (M,)."""
        return np.asarray((self._states.round < now) & (self._states.turns < BELIEF.most_turns)
                          & ~self.resting(next_node))

    def resting(self, next_node: int) -> BoolArray:
        """Return which closures wait for a node with an id from this on, shape (M,)."""
        return np.asarray(self._states.resting > next_node)

    def tested(self, numbers: IntArray | slice, now: int) -> None:
        self._states.round[numbers] = now

    def again(self, numbers: IntArray | slice) -> None:
        """Have closures tested, whatever was found before."""
        self._states.round[numbers], self._states.resting[numbers] = NEVER, 0

    def thrown_out(self, numbers: IntArray) -> None:
        self._states.turns[numbers] += 1

    def failed(self, numbers: Iterable[int], graph: Graph) -> None:
        """Let closures rest, as the iterations diverge where their belief is changed."""
        chosen = [*numbers]
        self._states.round[chosen] = NEVER
        self._states.resting[chosen] = graph.next_ids.node + max(
            int(BELIEF.rest_share * graph.n_nodes), BELIEF.least_rest)

    def begin_turns(self) -> None:
        """Let all closures in again that have taken turns, as another one has come."""
        self._states.turns[:] = 0


class BeliefRule:
    """
    Chooses what is believed; it changes nothing.

    A closure is believed if a clique of closures that agree along the path supports it, or if a
    random one of its source would hardly pass: q p is small against 1 - q, with p the chance to
    pass and q the share of its source that is doubted. If p is large, only the record q of the
    source speaks for it: it is believed weakly.
    """

    def __init__(self, states: ClosureStates, table: ClosureTable) -> None:
        self._states, self._table = states, table

    def choose(self, passed: IntArray, chance: FloatArray) -> dict[int, State]:
        """Return what to believe of closures that have passed; of wide gates only one."""
        chosen: dict[int, State] = {}
        for k in np.argsort(chance, kind='stable').tolist():
            if chance[k] > BELIEF.narrow_chance and len(chosen) > 0:
                break
            state = self._belief(int(passed[k]), float(chance[k]))
            if state.in_graph:
                chosen[int(passed[k])] = state
        return chosen

    def _belief(self, number: int, chance: float) -> State:
        good, bad = self._states.record(int(self._states.source[number]))
        alone = (bad + 1.0) * chance < BELIEF.wrong_odds * (good + 1.0)
        if (alone and chance <= BELIEF.weak_chance) or self.is_corroborated(
                number, self._states.decision != OUT):
            return State.BELIEVED
        return State.WEAKLY_BELIEVED if alone else State.WAITING

    def is_corroborated(self, number: int, usable: BoolArray) -> bool:
        """Tell whether a clique of closures that agree along the path supports one."""
        support = self._table.support(number, usable)
        return len(support.clique) >= BELIEF.clique and support.travel >= BELIEF.clique_travel


@dataclass(slots=True)
class ScaleLeft:
    """A factor on sigmas, and how many closures that have left have shown it."""

    n: int = 0
    scale: float = 1.0

    def add(self, n: int, scale: float) -> None:
        """Add closures."""
        self.n += n
        if n > 0:
            part = n / min(self.n, BELIEF.most_counted)
            self.scale *= (scale / self.scale)**min(part, 1.0)


class Beliefs:
    """Changes states and weights of closures together."""

    def __init__(
        self, smoother: IncrementalSmoother, reweighting: Reweighting, states: ClosureStates,
        table: ClosureTable,
    ) -> None:
        self._smoother, self._reweighting = smoother, reweighting
        self._states, self._table = states, table
        self.scales: list[float] = []  # of each source, the factor on its sigmas in the graph
        # increases when more or less is believed, so that those that wait are tested again
        self.round = 0
        self.now_ns = 0
        self.trial = ClosureTrial(smoother)
        # of each source, what its closures have shown that have left the graph
        self.scales_left: list[ScaleLeft] = []

    def weights(self, numbers: IntArray) -> FloatArray:
        scales = np.array(self.scales)[self._states.source[numbers]]
        return np.where(self._states.in_graph[numbers], 1.0 / np.square(scales), 0.0)

    def set_base_weights(self, numbers: IntArray) -> None:
        """Tell robust losses the weights of closures, which the graph has already."""
        for number, weight in zip(numbers.tolist(), self.weights(numbers).tolist(), strict=True):
            self._reweighting.set_base_weight(int(self._states.held[number]), weight)

    def apply(self, changes: Mapping[int, State], *, at_once: bool = False) -> bool:
        """Tell whether states and weights were changed; if not, they may be tried later."""
        weights = self.weights_with(changes)
        result = self._smoother.update(GraphUpdate(weigh=weights), fall_back=at_once)
        if result.status is Status.FAILED:
            return False
        self._keep(changes)
        return True

    def change_to(self, inside: BoolArray, poses: FloatArray) -> bool:
        """Return whether another set could be believed, at the poses of its solution."""
        graph = self._smoother.graph
        before = graph.poses.copy()
        graph.set_poses(continued(graph, poses))
        done = self.apply(self._states.changes_to(inside), at_once=True)
        if not done:
            graph.set_poses(before)
            self._smoother.update(GraphUpdate())
        self._table.spread[:] = 0.0
        return done

    def try_set(self, found: Found) -> None:
        graph = self._smoother.graph
        self.trial.begin(found, self.weights_with(self._changes_to(found)),
                         continued(graph, found.poses, found.nodes))

    def _changes_to(self, found: Found) -> dict[int, State]:
        states = self._states
        inside = states.in_graph
        numbers = states.numbers(found.edges)
        numbers = numbers[states.judged[numbers]]
        inside[numbers] = np.isin(states.held[numbers], found.believed)
        return states.changes_to(inside)

    def weights_with(self, changes: Mapping[int, State]) -> dict[int, float]:
        """Return the weights of edges, by id, after a change of states."""
        numbers = np.array(sorted(changes), dtype=np.int64)
        before = self._states.state[numbers].copy()
        self._states.state[numbers] = [STATES.index(changes[k]) for k in numbers.tolist()]
        weights = self.weights(numbers).tolist()
        self._states.state[numbers] = before
        return dict(zip(self._states.held[numbers].tolist(), weights, strict=True))

    def _keep(self, changes: Mapping[int, State]) -> None:
        """Change states, of which the graph has the weights already."""
        for number, state in sorted(changes.items()):
            before = int(self._states.state[number])
            self._states.state[number] = STATES.index(state)
            self._states.announce(number, before, self.now_ns)
        self.set_base_weights(np.array(sorted(changes), dtype=np.int64))
        self.round += 1

    def try_part(self) -> bool:
        """Do a part of a trial; tell whether there was any."""
        trial, states = self.trial, self._states
        if not trial.work():
            return False
        if trial.is_finished:
            changes = {} if trial.found is None else {
                number: state for number, state in self._changes_to(trial.found).items()
                if int(states.held[number]) in trial.weights}
            # the set is as when the trial began, but for what has left the graph
            wanted = self.weights_with(changes)
            there = states.held[np.isin(states.held, [*trial.weights])].tolist()
            if wanted == {edge: trial.weights[edge] for edge in there} and trial.adopt():
                self._keep(changes)
            trial.end()
        return True

    def closures_left(self, numbers: IntArray) -> None:
        """Keep what believed closures have shown of the errors of their sources."""
        states = self._states
        for source in np.unique(states.source[numbers]).tolist():
            used = USED[states.state[numbers]] & (states.source[numbers] == source)
            self.scales_left[source].add(int(np.count_nonzero(used)), self.scales[source])
