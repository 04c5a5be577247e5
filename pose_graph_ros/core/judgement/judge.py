# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Decides which constraints the graph believes.

All judged constraints are rows of the graph, with weight 0 while they are not believed. Around an
update the judge is called three times: `before` weighs the new rows by what is believed so far,
`commit` or `rollback` says whether the update succeeded, and `after` judges again what may have
changed. It does a bounded part of that; `work` does the rest, part by part, between two updates.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import config, saved_columns
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.graph_view import DrawnRows
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement import fix_states, odometry_chain, settings, verdicts as vd
from pose_graph_ros.core.judgement.closure_judge import ClosureJudge
from pose_graph_ros.core.judgement.fixes import FixJudge
from pose_graph_ros.core.judgement.judgements import LEFT, MOST_OTHERS, SavedVerdicts
from pose_graph_ros.core.judgement.texts import sentence, unknown
from pose_graph_ros.core.measurements import Answer, AnswerStatus, LoopClosure, rejected
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import OdometryErrors
from pose_graph_ros.core.smoother.incremental import DIVERGED, IncrementalSmoother, UpdateResult
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.queued import Queued


class SavedJudgement(NamedTuple):
    closures: SavedVerdicts
    fixes: SavedVerdicts
    loosened: saved_columns.Integers  # ids of odometry edges that are believed less than claimed
    weights: saved_columns.Numbers  # their weights
    # number of odometry edges of some sources that have left the graph doubted
    odometry_left: Mapping[str, int]
    # pose and covariance of the hypotheses on fixes, see `Spread`
    spread: saved_columns.Rows3


class Judge:
    """Judges the constraints of a graph; it knows no clock, and nothing of how they arrived."""

    def __init__(self, smoother: IncrementalSmoother, reweighting: Reweighting, nodes: HiddenNodes,
                 factors: FactorBuilder) -> None:
        self._smoother, self._reweighting = smoother, reweighting
        self._nodes, self._factors, self._chain = nodes, factors, odometry_chain.OdometryChain()
        self.fixes = FixJudge(smoother, reweighting, nodes, factors, self._chain)
        self._odometry = fix_states.OdometryStates(nodes)
        self._closures = closures = ClosureJudge(smoother, reweighting, self._chain)
        self.after, self.test, self.work = closures.after, closures.test, closures.work
        # solves the graph with some weights between the updates, as these diverge
        self.solve_later = closures.redecision.solve_later
        # follows measurements that other factors hold now, with the same weights; by ids
        self.moved = self.fixes.states.moved
        # the judged closures of the last `before`, by their numbers among its factors
        self._staged = np.empty(0, dtype=np.int64)
        self._new: Sequence[Queued] = ()  # all constraints of the last `before`
        # on the newest constraints that have left the graph unused
        self._left: deque[vd.Verdict] = deque(maxlen=MOST_OTHERS)

    def before(self, new: Sequence[Queued], change: GraphUpdate, now_ns: int) -> GraphUpdate:
        """Return an update in which the new rows have the weights that they begin with."""
        self._new = new
        change = self.fixes.before(new, change, now_ns)
        first, factors = self._smoother.graph.next_ids.factor, change.factors
        # one without a position, such as of the walls of a building, recognises no place
        may_be = (factors.kind == FactorKind.LOOP_CLOSURE) & (factors.information[:, 0, 0] > 0.0)
        closures = [one for one in new if may_be[one.number - first]
                    and self._factors.config.measurement_source(
                        one.source, LoopClosure).robust is config.Robust.JUDGED]
        if len(closures) == 0:
            return change
        self._staged = np.array([one.number - first for one in closures])
        return _weighed(change, self._staged, self._closures.before(
            closures, change.factors.rows(self._staged), now_ns))

    def solve(self, change: GraphUpdate, *, at_once: bool = False) -> UpdateResult:
        """
        Return the result of the update of the last `before`.

        If its iterations diverge, the new closures are doubted for the moment, and tried between
        two updates. If they diverge without them and nothing else that is new has a weight, it is
        because of what earlier updates have left over: that is solved for between two updates.
        So is what is new in a large graph, or where that goes on: solving all of it takes longer
        than an update may, but `at_once`. If they diverge even so, the result is FAILED with the
        reason `DIVERGED`, and the constraints may come again.
        """
        result = self._smoother.update(change, fall_back=False)
        weights = self._closures.withhold() if result.reason == DIVERGED else None
        if weights is not None:
            change = _weighed(change, self._staged, weights)
            result = self._smoother.update(change, fall_back=False)
        if result.reason != DIVERGED:
            return result
        if self._smoother.append(change):
            self.solve_later({})
            return UpdateResult(Status.MAX_ITERATIONS, '', 0, 0, 0, 0)
        if not at_once and not self.may_solve():
            without, later = self._without_weights(change)
            result = self._smoother.update(without, fall_back=False)
            self.solve_later({} if result.reason == DIVERGED else later)
            return result
        return self._smoother.update(change)

    def _without_weights(self, change: GraphUpdate) -> tuple[GraphUpdate, dict[int, float]]:
        """
        Return an update with weight 0 for its new measurements in the map that have a loss.

        With it come the weights, by id, that it leaves out. As long as the graph cannot be solved
        with them, reweighting tries to set them.
        """
        begin, weights = self._smoother.graph.next_ids.factor, change.factors.weight.copy()
        later, wanted = dict[int, float](), dict(change.weigh)
        for one in self._new:
            if one.measured is LoopClosure or self._factors.config.measurement_source(
                    one.source, one.measured).applied_loss is config.Loss.NONE:
                continue
            row = one.held - begin
            later[one.held] = wanted.pop(one.held, float(weights[row]))
            weights[row] = 0.0
        for number in list(wanted):
            if self._reweighting.base_weight(number) is not None:
                later[number] = wanted.pop(number)
        return change._replace(
            factors=change.factors.replaced(weight=weights), weigh=wanted), later

    def may_solve(self) -> bool:
        """Tell whether an update that has diverged may solve for all at once."""
        redecision = self._closures.redecision
        is_large = self._smoother.graph.n_nodes > settings.BELIEF.large
        return not is_large and redecision.may_solve()

    @property
    def solves_later(self) -> bool:
        return self._closures.redecision.is_due_or_pausing

    def commit(self) -> None:
        self._closures.commit()
        self.fixes.commit()
        self._follow_odometry(self._nodes.newest_ns)

    def _follow_odometry(self, now_ns: int, *, announce: bool = True) -> None:
        self._odometry.follow(self.fixes.loosened, self._smoother.graph, now_ns, announce=announce)

    def rollback(self) -> None:
        self._closures.rollback()
        self.fixes.rollback()

    def verdicts(self, most_believed: int | None = None) -> list[vd.Verdict]:
        """Return the verdicts that are listed, see `Judgements`, and on what left unused."""
        graph, closures, fixes = self._smoother.graph, self._closures.states, self.fixes.states
        return [*closures.verdicts(graph, closures.listed(most_believed)),
                *self._odometry.verdicts(graph, fixes),
                *fixes.verdicts(graph, fixes.listed(most_believed)), *self._left]

    def closures(self) -> tuple[IntArray, IntArray]:
        """Return the edges of judged loop closures, and stamps of their ends [ns], (L, 2)."""
        return self._closures.states.held, self._closures.states.stamps_ns

    def drawn_rows(self) -> DrawnRows:
        """Return the ids of factors that are drawn in another way than believed ones."""
        closures, fixes = self._closures.states, self.fixes.states
        weak, waiting, doubted = (closures.held[closures.state == state].tolist()
                                  for state in (vd.WEAK, vd.WAITING, vd.DOUBTED))
        return DrawnRows(weak, waiting, doubted + self._odometry.edges,
                         fixes.held[~fixes.believed].tolist())

    def changes(self) -> list[vd.Change]:
        return [*self._closures.states.take_changes(), *self._odometry.take_changes(),
                *self.fixes.states.take_changes()]

    def totals(self) -> Mapping[str, vd.SourceVerdicts]:
        return {**self._odometry.totals(), **self._closures.states.totals(),
                **self.fixes.states.totals()}

    def decide(self, name: str, decision: vd.Decision) -> Answer:
        """Return the answer to a person's decision on a constraint, which is applied at once."""
        judges: tuple[ClosureJudge | FixJudge, ...] = self._closures, self.fixes
        number, at = max((judge.states.find(name), k) for k, judge in enumerate(judges))
        if number < 0:
            return unknown(name, has_left=number == LEFT)
        states = judges[at].states
        if not judges[at].decide(number, decision):
            return rejected('failed', 'the solver failed with it')
        verdict, = states.verdicts(self._smoother.graph, np.array([number]))
        return Answer(AnswerStatus.ACCEPTED, detail=f'{name}: {sentence(verdict)}')

    def decide_leaving(self, factors: IntArray) -> list[vd.Verdict]:
        """
        Return the verdicts on constraints that are about to leave the graph unused, for `forget`.
        """
        graph, fixes = self._smoother.graph, self.fixes.states
        unused = self._closures.decide_leaving(factors)
        leaving = np.flatnonzero(fixes.leaving(factors) & ~fixes.believed)
        unused += fixes.verdicts(graph, leaving[-MOST_OTHERS:])
        unused += [each for each in self._odometry.verdicts(graph, fixes)
                   if each.number in factors]
        return [each._replace(left=True, since_ns=self._nodes.newest_ns) for each in unused]

    def forget(self, nodes: IntArray, factors: IntArray, leaving: Sequence[vd.Verdict]) -> None:
        self._chain.forget(nodes)
        self._closures.forget(factors)
        self.fixes.forget(factors)
        self._odometry.forget(factors)
        self._follow_odometry(self._nodes.newest_ns, announce=False)
        self._left.extend(leaving)

    def saved(self) -> SavedJudgement:
        loosened = self.fixes.loosened
        return SavedJudgement(
            self._closures.states.saved(), self.fixes.states.saved(),
            np.array([*loosened], dtype=np.int64), np.array([*loosened.values()]),
            dict(self._odometry.left), np.vstack(self.fixes.bank.spread))

    def restore(self, saved: SavedJudgement, now_ns: int) -> None:
        self._closures.restore(saved.closures, now_ns)
        self.fixes.restore(saved.fixes, dict(zip(
            saved.loosened.tolist(), saved.weights.tolist(), strict=True)), saved.spread, now_ns)
        self._odometry.left.update(saved.odometry_left)
        self._follow_odometry(now_ns, announce=False)

    def correct_odometry(self, before: OdometryErrors, after: OdometryErrors) -> None:
        """Follow the edges of odometry, which know of other errors of it now."""
        nodes, known = self._chain.nodes, self._nodes
        stamps_ns = known.stamps_ns[np.searchsorted(known.ids, nodes)]
        self._chain.correct(before, after, stamps_ns, ~np.isin(nodes[1:], known.relocated_ids))

    def finish(self, undo: ExitStack[bool]) -> None:
        """
        Test the closures that wait, then decide on all by the graph alone.

        If what follows fails, all that is undone: verdicts, weights and poses. The next update of
        the smoother then eliminates the graph again.
        """
        graph = self._smoother.graph
        undo.callback(graph.set_poses, graph.poses.copy())
        undo.callback(graph.set_weights, graph.weights)
        base_weights = self._reweighting['base']
        undo.callback(np.copyto, base_weights, base_weights.copy())
        for judge in (self._closures, self.fixes, self._odometry):
            judge.keep(undo)
        # each part believes one more, or leaves fewer to be tested
        while self._closures.test():
            graph.memory.check()
        self.fixes.finish()
        self._follow_odometry(self._nodes.newest_ns)
        self._closures.decide_finally()


def _weighed(change: GraphUpdate, numbers: IntArray, weights: FloatArray) -> GraphUpdate:
    every = change.factors.weight.copy()
    every[numbers] = weights
    return change._replace(factors=change.factors.replaced(weight=every))
