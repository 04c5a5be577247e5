# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which loop closures to believe, decided as they come and again when the evidence changes.

A closure passes the *gate* if its error at the estimate is plausible: `e^T (J P J^T + R)^-1 e` is
below the 99 % quantile, with P the joint covariance of both nodes in the graph of what is believed
and R the claimed covariance, floored. It is *believed* if a clique of closures that agree along
the path supports it, or if a random one of its source would hardly pass: q p is small against
1 - q, with p the chance to pass and q the share of its source that is doubted. If p is large, only
the record q of the source speaks for it: it is believed weakly. One that does not fit any more is
*thrown out*: back to weight 0, from where it may come again. Between the updates `closure_search`
looks for a set of closures that costs less.
"""

from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack

import numpy as np

from pose_graph_ros.core.batch.optimizer import Status, to_the_end
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement import closures as cl, odometry_chain, verdicts as vd
from pose_graph_ros.core.judgement.closure_search import decide, Redecision
from pose_graph_ros.core.judgement.judgements import MOST_OTHERS, NEW, SavedVerdicts
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.smoother import incremental, trial
from pose_graph_ros.core.sources.queued import Queued


class ClosureJudge:
    def __init__(self, smoother: incremental.IncrementalSmoother, reweighting: Reweighting,
                 chain: odometry_chain.OdometryChain) -> None:
        self._smoother, self._reweighting, self._chain = smoother, reweighting, chain
        self.states = cl.ClosureTable(chain)
        self.redecision = Redecision(smoother)
        # increases when more or less is believed, so that those that wait are tested again
        self._round = 0
        self._now_ns = 0
        self._final = (0, 0, -1)  # next ids of the graph and round at the last final decision
        self._n_staged = 0

    # --- new closures ----------------------------------------------------------------------------

    def before(self, new: Sequence[Queued], edges: Factors, now_ns: int) -> FloatArray:
        """Return the weights with which closures are to be added, shape (M,)."""
        begin, n = len(self.states), len(new)
        self._now_ns, self._n_staged = now_ns, n
        self._chain.extend(self._smoother.graph)
        for one in new:
            self.states.append(one, now_ns, vd.WAITING)
        self.states.measure(begin, cl.claims(edges))
        numbers = np.arange(begin, begin + n)
        if not self._smoother.graph.has_touched and not self._is_large:
            for number, state in self._tested(numbers[:self._most]).items():
                self.states.state[number] = state
        return self.states.in_graph[numbers].astype(np.float64)

    def withhold(self) -> FloatArray | None:
        """Return the weights of the last `before` without belief; None if they had none."""
        numbers = np.arange(len(self.states) - self._n_staged, len(self.states))
        if not np.any(self.states.in_graph[numbers]):
            return None
        self.states.state[numbers], self.states.round[numbers] = vd.WAITING, cl.NEVER
        return self.states.in_graph[numbers].astype(np.float64)

    def rollback(self) -> None:
        self.states.truncate(len(self.states) - self._n_staged)
        self._n_staged = 0

    def commit(self) -> None:
        begin, self._n_staged = len(self.states) - self._n_staged, 0
        for number in range(begin, len(self.states)):
            self.states.announce(number, NEW, self._now_ns)
        for source in np.unique(self.states.source[begin:]).tolist():
            self.states.forget(source)
        if np.any(self.states.in_graph[begin:]):
            self._round += 1
            self._set_base_weights(np.arange(begin, len(self.states)))

    # --- tests -----------------------------------------------------------------------------------

    @property
    def _is_large(self) -> bool:
        return self._smoother.graph.n_nodes > BELIEF.large

    @property
    def _most(self) -> int:
        """Return how many closures are tested at once: they are as deep as the path is long."""
        by_size = BELIEF.nodes_in_part // max(self._smoother.graph.n_nodes, 1)
        return max(min(BELIEF.tests_in_part, by_size), 1)

    def _tested(self, numbers: IntArray) -> dict[int, int]:
        """Test closures that are not in the graph; return the states of those to believe."""
        some, states = self.states.rows(numbers), self.states
        errors, spread = self._smoother.innovations(cl.as_edges(some))
        distance = cl.squares(errors, spread + some.noise)
        states.spread[numbers] = spread
        before = states.state[numbers].copy()
        states.distance[numbers] = np.sqrt(distance)
        states.round[numbers] = self._round
        states.state[numbers] = np.where(distance < cl.GATE, vd.WAITING, vd.DOUBTED)
        chance = cl.chances(spread + some.noise, self._smoother.graph.extent)
        chosen = dict[int, int]()
        for k, number in enumerate(numbers.tolist()):
            if number < len(states) - self._n_staged:
                states.announce(number, int(before[k]), self._now_ns)
            if distance[k] < cl.GATE:
                # how many of the source are or were used, and doubted
                counts = states.counts(int(states.source[number]))
                alone = (counts[vd.DOUBTED] + 1.0) * chance[k] < BELIEF.wrong_odds * (
                    np.sum(counts[vd.USED]) + 1.0)
                if (alone and chance[k] <= BELIEF.wrong_odds) or states.is_supported(
                        number, (states.decision != vd.OUT) & ~states.forgotten):
                    chosen[number] = vd.BELIEVED
                elif alone:
                    chosen[number] = vd.WEAK
        return chosen

    def after(self) -> None:
        """Judge again, within bounds, after an update of a graph that is not large."""
        if not self._is_large:
            self._part()

    def _part(self) -> bool:
        """Throw out what does not fit, or test some that wait; tell whether there was any."""
        if self._smoother.graph.has_touched or len(self.states) == 0:
            return False
        return self._throw_out(np.flatnonzero(self.states.in_graph)) or self.test()

    def test(self) -> bool:
        """Do a bounded part of the tests that are left; tell whether some are left."""
        states = self.states
        if self._smoother.graph.has_touched:
            return False
        waiting = np.flatnonzero(~states.in_graph & states.judged & (states.round < self._round))
        waiting = waiting[~self._rest(waiting)]
        if len(waiting) == 0:
            return False
        some = states.rows(waiting)
        # covariances shrink while more is believed, so this is about the least that it can be
        least = cl.squares(self._smoother.graph.errors(cl.as_edges(some)),
                        states.spread[waiting] + some.noise)
        hopeless = ~(least < cl.GATE)
        states.round[waiting[hopeless]] = self._round
        rest = waiting[~hopeless][np.argsort(least[~hopeless], kind='stable')]
        return self._change(self._tested(rest[:self._most])) or len(rest) > self._most

    def work(self) -> bool:
        """Do a part on a copy, or of the tests that are left; tell whether there was any."""
        if self._smoother.graph.has_touched:
            return False
        if self.redecision.work() or self._part():
            return True
        if np.any(self.states.judged & ~self.states.in_graph):
            self.redecision.search(self._searched())
        return self.redecision.work()

    def _throw_out(self, inside: IntArray) -> bool:
        """Take those of some closures out of the graph that do not fit; tell if there was any."""
        graph, states = self._smoother.graph, self.states
        inside = inside[states.judged[inside] & ~self._rest(inside)]
        # the smoother knows the energies; raised covariances make the residuals only smaller
        rows, factors = graph.factor_rows(states.held[inside]), graph.factor_records
        inside = inside[factors['energy'][rows] > 0.5 * cl.GATE * factors['weight'][rows]]
        some = states.rows(inside)
        bad = inside[cl.squares(graph.errors(cl.as_edges(some)), some.noise) > cl.GATE]
        thrown_out = self._change(dict.fromkeys(bad.tolist(), vd.DOUBTED))
        # those that contradict one another would take turns in the graph for ever
        self._let_rest(bad)
        return thrown_out

    def _rest(self, numbers: IntArray) -> BoolArray:
        return np.asarray(self.states.resting[numbers] > self._smoother.graph.next_ids.node)

    def _let_rest(self, numbers: IntArray) -> None:
        """Let closures wait until the graph has grown by a share, so that a drive ends."""
        graph = self._smoother.graph
        self.states.resting[numbers] = graph.next_ids.node + max(
            int(BELIEF.pause * graph.n_nodes), BELIEF.least_rest)

    # --- changes ---------------------------------------------------------------------------------

    def _set_base_weights(self, numbers: IntArray) -> None:
        """Tell robust losses the weights of closures, which the graph has already."""
        for held, used in zip(self.states.held[numbers].tolist(),
                              self.states.in_graph[numbers].tolist(), strict=True):
            self._reweighting.set_base_weight(held, float(used))

    def _change(self, changes: Mapping[int, int], *, at_once: bool = False) -> bool:
        """Change states and weights; tell whether there were any, and it has not diverged."""
        if len(changes) == 0:
            return False
        weights = {int(self.states.held[k]): float(vd.USED[to]) for k, to in changes.items()}
        result = self._smoother.update(GraphUpdate(weigh=weights), fall_back=at_once)
        if result.status is Status.FAILED:
            numbers = np.array([*changes])
            self.states.round[numbers] = cl.NEVER
            self._let_rest(numbers)
            return False
        self._note(changes)
        return True

    def _note(self, changes: Mapping[int, int]) -> None:
        """Change states, of which the graph has the weights already."""
        for number, state in sorted(changes.items()):
            before = int(self.states.state[number])
            self.states.state[number] = state
            self.states.announce(number, before, self._now_ns)
        self._set_base_weights(np.array(sorted(changes), dtype=np.int64))
        self._round += 1
        if not np.all(vd.USED[[*changes.values()]]):
            self.states.spread[:] = cl.ANYTHING * np.eye(3)     # without them it is less certain

    def _changes_to(self, decided: IntArray, believed: IntArray) -> dict[int, int]:
        """Return the states of closures with a set of believed ones, both by the ids of edges."""
        states = self.states
        numbers = states.numbers(decided)
        now, later = states.in_graph[numbers], np.isin(states.held[numbers], believed)
        to = np.where(later, np.where(now, states.state[numbers], vd.BELIEVED), vd.DOUBTED)
        chosen = states.judged[numbers] & (now | later)
        return dict(zip(numbers[chosen].tolist(), to[chosen].tolist(), strict=True))

    # --- all closures together -------------------------------------------------------------------

    def _searched(self) -> Generator[None, None, None]:
        """Look for a set that costs less, and adopt it, if any that agree are left out."""
        graph, states = self._smoother.graph, self.states
        for number in np.flatnonzero(states.judged & ~states.in_graph).tolist():
            yield
            # closures may have left or been believed meanwhile
            outside = states.judged & ~states.in_graph
            if number < len(states) and states.is_supported(number, outside):
                break
        else:
            return
        judged, nodes = np.flatnonzero(states.judged), graph.node_ids.copy()
        decided = states.held[judged]
        choice = yield from decide(
            graph, decided, states.held[states.in_graph & ~states.judged], states.in_graph[judged])
        # some may have left the graph meanwhile
        if choice is None or np.array_equal(
                np.isin(decided, states.held[states.in_graph]), choice.believed):
            return
        believed = decided[choice.believed]
        changes = self._changes_to(decided, believed)
        weights = {int(states.held[k]): float(vd.USED[to]) for k, to in changes.items()}
        changed = np.array([*weights], dtype=np.int64)

        if (yield from self.redecision.tried(
                weights, trial.continued(graph, choice.poses, nodes),
                lambda: bool(np.all(states.judged[states.numbers(changed)])))):
            self._note(self._changes_to(changed, believed))

    def decide_finally(self) -> None:
        """Decide on all closures anew, by the graph, if anything has changed since."""
        graph, states = self._smoother.graph, self.states
        judged, present = np.flatnonzero(states.judged), (*graph.next_ids, self._round)
        if len(judged) == 0 or present == self._final:
            return
        decided, before = states.held[judged], graph.poses.copy()
        choice = to_the_end(decide(
            graph, decided, states.held[states.in_graph & ~states.judged],
            states.in_graph[judged], self._reweighting))
        if choice is None:
            return
        graph.set_poses(trial.continued(graph, choice.poses))
        changes = self._changes_to(decided, decided[choice.believed])
        if len(changes) > 0 and not self._change(changes, at_once=True):
            graph.set_poses(before)
            self._smoother.update(GraphUpdate())
            return
        # nothing is to be tested again until something changes
        states.round[:] = self._round
        self._final = *present[:-1], self._round

    def keep(self, undo: ExitStack[bool]) -> None:
        """Have the present state brought back, as long as no closure is added."""
        undo.callback(self.states.test_all_again)
        undo.callback(setattr, self.redecision, 'job', None)
        self.states.keep(undo)

    # --- what leaves the window ------------------------------------------------------------------

    def decide_leaving(self, edges: IntArray) -> list[vd.Verdict]:
        """
        Decide on closures that are about to leave the graph; return the verdicts on those unused.
        """
        states, graph = self.states, self._smoother.graph
        self._chain.extend(graph)
        leaving = states.numbers(edges)
        if len(leaving) == 0:
            return []
        if not graph.has_touched:
            self._throw_out(leaving[states.in_graph[leaving]])
            waiting = leaving[~states.in_graph[leaving] & states.judged[leaving]
                              & ~self._rest(leaving) & (states.round[leaving] < self._round)]
            self._change(self._tested(waiting[:self._most]))
        return states.verdicts(graph, leaving[~states.in_graph[leaving]][-MOST_OTHERS:])

    def forget(self, edges: IntArray) -> None:
        gone = self.states.numbers(edges)
        if len(gone) > 0:
            # all others get other numbers
            self.states.select(np.setdiff1d(np.arange(len(self.states)), gone))

    # --- from outside ----------------------------------------------------------------------------

    def restore(self, saved: SavedVerdicts, now_ns: int) -> None:
        self._now_ns = now_ns
        self._chain.extend(self._smoother.graph)
        self.states.restore(saved)
        self.states.measure(0, cl.claims(self._smoother.graph.factors_at(saved.table['held'])))

    def decide(self, number: int, decision: vd.Decision) -> bool:
        """
        Apply a person's decision at once; return whether the solver succeeded.

        A closure that had been forced in waits when that is taken back.
        """
        states = self.states
        before = int(states.decision[number])
        state = {vd.Decision.IN: vd.BELIEVED, vd.Decision.OUT: vd.DOUBTED,
                 vd.Decision.AUTO: vd.WAITING}[decision]
        forced = decision is not vd.Decision.AUTO or before != vd.AUTO
        states.decision[number] = vd.DECISIONS.index(decision)
        states.forgotten[number] = False
        if forced and not self._change({number: state}, at_once=True):
            states.decision[number] = before
            return False
        states.test_all_again()
        return True
