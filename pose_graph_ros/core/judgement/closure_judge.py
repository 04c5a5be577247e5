# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which loop closures to believe, decided as they come and again when the evidence changes.

A closure passes the *gate* if its error at the estimate is plausible: `e^T (J P J^T + R)^-1 e` is
below the 99 % quantile, with P the joint covariance of both nodes in the graph of what is believed
and R the claimed covariance, floored. Then `belief_rule` says whether it is *believed*. One that
does not fit any more is thrown out: back to weight 0, from where it may come again.
"""

from collections.abc import Callable, Sequence

import numpy as np

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement import closures, final
from pose_graph_ros.core.judgement.beliefs import BeliefRule, Beliefs, Retests, ScaleLeft
from pose_graph_ros.core.judgement.closure_states import ClosureReports, ClosureStates
from pose_graph_ros.core.judgement.closure_trial import ClosureTrial, SetSearch
from pose_graph_ros.core.judgement.closures import chances, claims, ClosureTable, GATE
from pose_graph_ros.core.judgement.judgements import MOST_OTHERS, NEW, SavedVerdicts
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.residual_scale import ScaleLearner
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.texts import sentence, unknown
from pose_graph_ros.core.judgement.verdicts import (
    AUTO,
    Decision,
    DECISIONS,
    DOUBTED,
    SourceVerdicts,
    State,
    STATES,
    USED,
    Verdict,
    WAITING,
)
from pose_graph_ros.core.measurements import Answer, AnswerStatus, rejected
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import NewConstraint


class ClosureJudge:
    def __init__(self, smoother: IncrementalSmoother, reweighting: Reweighting) -> None:
        self._smoother, self._reweighting = smoother, reweighting
        self.chain = self._chain = OdometryChain()
        self._table = ClosureTable(self._chain)
        self.states = self._states = ClosureStates()
        self.reports = ClosureReports(self._states, self._table)
        self._retests = Retests(self._states)
        self._rule = BeliefRule(self._states, self._table)
        self._final = (0, 0, -1)  # next ids of the graph and round at the last final decision
        self._n_staged = 0
        self._search = SetSearch(self._states)
        self._beliefs = Beliefs(smoother, reweighting, self._states, self._table)
        self._scales = ScaleLearner(smoother, self._states, self._table, self._beliefs)

    def before(
        self, new: Sequence[NewConstraint], edges: Factors, now_ns: int,
    ) -> FloatArray:
        """Return the weights with which closures are to be added, shape (M,)."""
        begin, n = len(self._states), len(new)
        self._beliefs.now_ns, self._n_staged = now_ns, n
        self._chain.extend(self._smoother.graph)
        self._table.append(claims(edges))
        for one in new:
            self._states.append(one, now_ns, WAITING)
        self._scales.add_sources()
        numbers = np.arange(begin, begin + n)
        if not self._smoother.graph.has_touched and not self._is_large:
            chosen = self._rule.choose(*self._test(numbers[:BELIEF.tests_of_new]))
            for number, state in chosen.items():
                self._states.state[number] = STATES.index(state)
        return self._beliefs.weights(numbers)

    def withhold(self) -> FloatArray | None:
        """Return the weights of the last `before` without belief; None if they had none."""
        numbers = np.arange(len(self._states) - self._n_staged, len(self._states))
        if not np.any(self._states.in_graph[numbers]):
            return None
        self._states.state[numbers] = WAITING
        self._retests.again(numbers)
        self._search.want()
        return self._beliefs.weights(numbers)

    @property
    def trial(self) -> ClosureTrial:
        return self._beliefs.trial

    @property
    def _is_large(self) -> bool:
        return self._smoother.graph.n_nodes > BELIEF.large

    def rollback(self) -> None:
        self.reports.forget()
        self._table.drop(self._n_staged)
        self._states.truncate(len(self._states) - self._n_staged)
        self._n_staged = 0

    def commit(self) -> None:
        begin, self._n_staged = len(self._states) - self._n_staged, 0
        if begin < len(self._states):
            self._retests.begin_turns()
        for number in range(begin, len(self._states)):
            self._states.announce(number, NEW, self._beliefs.now_ns)
        for source in np.unique(self._states.source[begin:]).tolist():
            self._table.forget(self._states.forget(source).tolist())
        if np.any(self._states.in_graph[begin:]):
            self._beliefs.round += 1
            self._beliefs.set_base_weights(np.arange(begin, len(self._states)))

    def _test(self, numbers: IntArray) -> tuple[IntArray, FloatArray]:
        """Test closures that are not in the graph; return those that pass, and their chances."""
        some, n = self._table.rows(numbers), len(numbers)
        errors, spread = self._smoother.innovations(closures.as_edges(some))
        total, distance = spread + some.noise, np.empty(n)
        closures.distances(errors, total, distance)
        self._table.spread[numbers] = spread
        self._states.distance[numbers] = np.sqrt(distance)
        self._retests.tested(numbers, self._beliefs.round)
        passes = distance < GATE
        for number, state in zip(
                numbers.tolist(), np.where(passes, WAITING, DOUBTED).tolist(), strict=True):
            before = int(self._states.state[number])
            self._states.state[number] = state
            if state == DOUBTED and not self._states.corroborated[number]:
                self._states.corroborated[number] = self._rule.is_corroborated(
                    number, ~self._states.in_graph)
            if number < len(self._states) - self._n_staged:
                self._states.announce(number, before, self._beliefs.now_ns)
        return numbers[passes], chances(total[passes], self._smoother.graph.extent)

    def after(self) -> None:
        """Judge again, within bounds, after an update of a graph that is not large."""
        if not self._is_large:
            self._part(BELIEF.tests_in_update)

    def work(self) -> bool:
        return not self._smoother.graph.has_touched and (
            self._part(self._most) or self._try() or self._scales.learn()
            or self._look_for_another_set())

    def test(self) -> bool:
        """Do a bounded part of the tests that are left; tell whether there was any."""
        return (len(self._states) > 0 and not self._smoother.graph.has_touched
                and self._test_again(self._most))

    @property
    def _most(self) -> int:
        by_size = BELIEF.nodes_in_part // max(self._smoother.graph.n_nodes, 1)
        return max(min(BELIEF.tests_in_part, by_size), 1)

    def _try(self) -> bool:
        before = self._beliefs.round
        tried = self._beliefs.try_part()
        if self._beliefs.round > before:
            self._table.spread[:] = 0.0
        return tried

    def _part(self, most: int) -> bool:
        if len(self._states) == 0 or self._smoother.graph.has_touched:
            return False
        return self._throw_out() or self._test_again(most)

    def _throw_out(self) -> bool:
        """Take out of the graph what does not fit any more; tell whether there was any."""
        # where the graph cannot be solved without them, that is not tried for ever
        resting = self._retests.resting(self._smoother.graph.next_ids.node)
        inside = np.flatnonzero(self._states.in_graph & self._states.judged & ~resting)
        return self._throw_out_of(inside)

    def _throw_out_of(self, inside: IntArray) -> bool:
        """Take those of some closures out of the graph that do not fit; tell if there was any."""
        # the smoother knows the energies; raised covariances make the residuals only smaller
        inside = inside[closures.are_above(
            self._smoother.graph, self._states.held[inside], 0.5 * GATE)]
        fit = closures.residuals(self._smoother.graph, self._table.rows(inside))
        bad = inside[fit > GATE]
        if not self._change(dict.fromkeys(bad.tolist(), State.DOUBTED)):
            return False
        self._retests.thrown_out(bad)
        # without them the graph is less certain
        self._table.spread[:] = 0.0
        return True

    def _test_again(self, most: int) -> bool:
        """Test some closures that wait; tell whether some are left."""
        waiting = np.flatnonzero(
            ~self._states.in_graph & self._states.judged
            & self._retests.due(self._beliefs.round, self._smoother.graph.next_ids.node))
        if len(waiting) == 0:
            return False
        some = self._table.rows(waiting)
        errors = closures.errors_of(self._smoother.graph, some)
        # covariances only shrink while more is believed, so this is a lower bound
        spread, least = self._table.spread[waiting], np.empty(len(waiting))
        closures.distances(errors, spread + some.noise, least)
        known = spread[:, 0, 0] > 0.0
        hopeless = known & ~(least < GATE)
        self._retests.tested(waiting[hopeless], self._beliefs.round)
        rest = waiting[~hopeless]
        rest = rest[np.argsort(np.where(known, least, 0.0)[~hopeless], kind='stable')]
        passed, chance = self._test(rest[:most])
        return self._change(self._rule.choose(passed, chance)) or len(rest) > most

    def _change(self, states: dict[int, State]) -> bool:
        """Change states; tell whether there were any, and the update has not diverged."""
        if len(states) == 0:
            return False
        done = self._beliefs.apply(states)
        if not done:
            self._retests.failed(states, self._smoother.graph)
            self._search.want()
        return done

    def decide_leaving(self, edges: IntArray) -> list[Verdict]:
        """
        Decide on closures that are about to leave the graph; return the verdicts on those unused.
        """
        states, graph = self._states, self._smoother.graph
        self._chain.extend(graph)
        leaving = states.numbers(edges)
        if len(leaving) == 0:
            return []
        judged = leaving[states.judged[leaving]]
        if not graph.has_touched:
            self._throw_out_of(judged[states.in_graph[judged]])
            for _ in range(BELIEF.leaving_rounds):
                due = self._retests.due(self._beliefs.round, graph.next_ids.node)
                waiting = judged[~states.in_graph[judged] & due[judged]]
                if len(waiting) == 0 or graph.has_touched:
                    break
                self._change(self._rule.choose(*self._test(waiting[:BELIEF.tests_in_update])))
        return self.reports.of(graph, leaving[~states.in_graph[leaving]][-MOST_OTHERS:].tolist())

    def forget(self, nodes: IntArray, edges: IntArray) -> None:
        states, gone = self._states, self._states.numbers(edges)
        if len(gone) > 0:
            self._beliefs.closures_left(gone)
            # all others get other numbers
            kept = np.setdiff1d(np.arange(len(states)), gone)
            for table in (states, self._table):
                table.select(kept)
            self.reports.forget()
        self._chain.forget(nodes)

    def decide_finally(self) -> None:
        """Decide on all closures anew, by the graph alone, if anything has changed since."""
        smoother, states = self._smoother, self._states
        graph, judged = smoother.graph, np.flatnonzero(states.judged)
        present = *graph.next_ids, self._beliefs.round
        if len(judged) == 0 or present == self._final:
            return
        forced = states.held[states.in_graph & ~states.judged]
        inside = states.in_graph
        choice = to_the_end(final.decide(
            graph, states.held[judged], forced, inside[judged], self._reweighting))
        if choice is None:
            return
        inside[judged] = choice.believed
        self._scales.begin()
        if not self._beliefs.change_to(inside, choice.poses):
            return
        self._scales.learn_all()
        # nothing is to be tested again until something changes
        self._retests.tested(slice(None), self._beliefs.round)
        self._final = *present[:-1], self._beliefs.round

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, as long as no closure is added."""
        states_back, scales = self._states.snapshot(), self._scales.state()

        def bring_back() -> None:
            states_back()
            self._scales.set_state(*scales)
            self._search = SetSearch(self._states)
            self._beliefs.trial.end()
            self._retests.again(slice(None))
            self._table.spread[:] = 0.0
        return bring_back

    def _look_for_another_set(self) -> bool:
        """Do a part of the search of another set; tell whether there was anything to do."""
        more, found = self._search.work(self._smoother.graph)
        if found is not None:
            self._beliefs.try_set(found)
        return more

    def saved(self) -> SavedVerdicts:
        return self._states.saved(self._beliefs.scales)

    def restore(self, saved: SavedVerdicts, now_ns: int) -> None:
        self._beliefs.now_ns = now_ns
        self._chain.extend(self._smoother.graph)
        self._table.append(claims(self._smoother.graph.factors_at(saved.held)))
        self._states.restore(saved)
        self._scales.set_state(saved.scales.tolist(), [0] * len(saved.scales))
        self._beliefs.scales_left[:] = map(
            ScaleLeft, np.sum(saved.left[:, USED], axis=1).tolist(), saved.scales.tolist())
        self._scales.add_sources()

    def totals(self) -> dict[str, SourceVerdicts]:
        return self._states.totals(self._beliefs.scales)

    def decide(self, name: str, decision: Decision) -> Answer:
        """
        Apply a decision at once; a closure that had been forced in waits when that is taken back.
        """
        states = self._states
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
            self._table.bring_back([number])
        if forced and not self._beliefs.apply({number: state}, at_once=True):
            states.decision[number] = before
            return rejected('failed', 'the solver failed with it')
        self._beliefs.round += 1
        verdict, = self.reports.of(self._smoother.graph, [number])
        return Answer(AnswerStatus.ACCEPTED, detail=f'{name}: {sentence(verdict)}')
