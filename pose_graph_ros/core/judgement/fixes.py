# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Judge positions and poses in the map over time, and odometry where it has slipped.

`belief.bank` says what has happened. Here measurements get their weights from it, and odometry
that has slipped a lower one.
"""

from collections.abc import Callable, Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.belief.bank import as_claimed, Bank, Decided, is_believed, Odometry, Prior
from pose_graph_ros.core.belief.hypotheses import ALONE, BEGINS, GOES_ON, GOOD, SLIPPED
from pose_graph_ros.core.belief.rows import measured, Records
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.config import BackendConfig, Robust
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.fix_states import FixStates, LONE
from pose_graph_ros.core.judgement.judgements import MOST_OTHERS, NEW, SavedVerdicts
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.texts import sentence, unknown
from pose_graph_ros.core.judgement.verdicts import (
    AUTO,
    BELIEVED,
    Decision,
    DECISIONS,
    Verdict,
)
from pose_graph_ros.core.measurements import (
    Answer,
    AnswerStatus,
    HeadingOnly,
    LoopClosure,
    rejected,
)
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import AS_CLAIMED, OdometryErrors
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.bias import CorrelatedErrors
from pose_graph_ros.core.sources.factor_builder import FactorBuilder, NewConstraint

# Up to so many measurements it is asked whether those that are believed tell where the map is,
# which at least so many are needed for. If they do not, nothing is doubted yet.
FEW, LEAST = 100, 3
# Errors of sources that have slow ones, as long as nothing is known of them.
SLOW = CorrelatedErrors(40.0, 0.5, 0.25)


class _Decided(NamedTuple):
    """What is decided on all measurements in the map, at some time."""

    run: IntArray
    state: IntArray  # of each record, both of shape (M,)
    # weights of odometry edges by id; replaced, never changed, so that it is not copied
    loosened: dict[int, float]
    slips: dict[int, tuple[int, int, float]]  # the same of `FixJudge._slips`


class FixJudge:
    def __init__(
        self, smoother: IncrementalSmoother, reweighting: Reweighting, config: BackendConfig,
        nodes: HiddenNodes, factors: FactorBuilder,
    ) -> None:
        self._smoother, self._reweighting, self._config = smoother, reweighting, config
        self._nodes, self._factors = nodes, factors
        self.states = self._states = FixStates()
        self.chain = OdometryChain()
        self._bank = Bank()
        self._loosened: dict[int, float] = {}
        # where odometry has slipped, by the id of the measurement that shows it: between which
        # nodes, and the factor on the covariance of the odometry between that allows for it
        self._slips: dict[int, tuple[int, int, float]] = {}
        self._before: _Decided | None = None  # during an update, what was decided before it
        self._new_ids: IntArray = np.empty(0, dtype=np.int64)  # rows that came with the update
        self._final: _Decided | None = None  # what `final_weights` has found
        self._now_ns = -1   # newest stamp of odometry
        self._is_restored = False  # whether the bank does not know the records yet

    @property
    def loosened(self) -> Mapping[int, float]:
        """Weights of the odometry edges, by id, that are believed less than claimed."""
        return self._loosened

    def configure(self, config: BackendConfig) -> None:
        self._config = config

    def before(
        self, new: Sequence[NewConstraint], change: GraphUpdate, now_ns: int,
    ) -> GraphUpdate:
        """Return an update in which all rows have the weights that the new ones make right."""
        judged = [one for one in new if one.kind not in (LoopClosure, HeadingOnly)
                  and self._config.measurement_source(one.source, one.kind).robust
                  is Robust.JUDGED]
        if len(judged) == 0:
            return change
        self._now_ns, before, graph = now_ns, self._begin(), self._smoother.graph
        self.chain.extend(graph)
        if self._is_restored:
            self._add_records()
        ids = np.array([one.number for one in judged])
        rows = measured(change.factors.rows(ids - graph.next_ids.factor),
                        [one.stamp_ns for one in judged], ids.tolist())
        if len(rows) == 0:
            return change
        by_id = {one.number: one for one in judged}
        self._new_ids = rows['id'].copy()
        for number in self._new_ids.tolist():
            self._states.append(by_id[number], now_ns, BELIEVED, run=LONE)
        if len(self._bank) == 0 and not np.any(graph.fixed) and not graph.has_touched:
            self._begin_with_graph(int(rows['node'][np.argmin(rows['stamp_ns'])]))
        self._insert(rows)
        decided = self._bank.decide(self._noise())
        self._apply(self._bank, decided)
        self._note_distances(decided)
        return self._with_weights(change, before)

    def _insert(self, rows: Records) -> None:
        numbers = np.searchsorted(self._states.added, rows['id'])
        rows['source'] = np.minimum(self._states.source[numbers], BANK.sources - 1)
        chain = self.chain
        stamps_ns = self._nodes.stamps_ns[np.searchsorted(self._nodes.ids, chain.nodes)]
        self._bank.insert(rows, Odometry(
            chain.nodes, chain.poses, chain.sums, stamps_ns, self._nodes.errors))

    def _begin_with_graph(self, node: int) -> None:
        graph = self._smoother.graph
        self._bank.begin_with(Prior(
            node, graph.poses_of(node), np.ascontiguousarray(self._smoother.covariance(node))))

    def _add_records(self) -> None:
        """Let the bank know of records that were loaded."""
        states, self._is_restored = self._states, False
        rows = measured(self._smoother.graph.factors_at(states.added),
                        states.stamps_ns[:, 0].tolist(), states.added.tolist())
        if len(rows) > 0:
            self._insert(rows)

    def _noise(
        self, errors: OdometryErrors | None = None, unknown_errors: CorrelatedErrors | None = None,
    ) -> Records:
        """
        Return the noise of odometry and sources as it is known, or is assumed to be.

        If errors of odometry are given, sources whose errors are to be found have unknown ones.
        """
        noise = as_claimed()
        known = self._nodes.errors if errors is None else errors
        noise['way'], noise['turn'] = known.way, known.turn
        finding = self._factors.finding()
        for number, source in enumerate(self._states.sources[:BANK.sources]):
            found = self._factors.errors_in_use(source) if source in self._factors.sources else None
            if found is not None and (errors is None or source not in finding):
                is_given = self._factors.sources[source].errors is None
                noise['tau'][0, number] = found.tau
                noise['white'][0, number] = 1.0 if is_given else found.white
                noise['slow'][0, number] = 1.0 if is_given else found.correlated
            elif unknown_errors is not None and source in finding:
                noise['tau'][0, number], noise['slow'][0, number], noise['white'][0, number] = (
                    unknown_errors)
        return noise

    def _apply(self, bank: Bank, decided: Decided) -> None:
        """Believe and doubt measurements, and odometry where it has slipped."""
        if len(bank) <= FEW:
            decided = bank.told(0)
        states, rows = self._states, bank.rows[decided.first:]
        if len(rows) == 0:
            return
        at = np.searchsorted(states.added, rows['id'])
        known = (at < len(states)) & (states.added[np.minimum(at, len(states) - 1)] == rows['id'])
        numbers = at[known]
        choice = decided.choice
        if decided.first == 0 and not _determines(rows[is_believed(choice)]):
            choice = np.full(len(rows), GOOD)
        wrong = ~is_believed(choice)
        states.believe(numbers[~wrong[known]], believed=True)
        states.believe(numbers[wrong[known]], believed=False)
        states.run[numbers] = self._runs(rows, choice, decided.first)[known]
        before, slips = bank.rows[:decided.first], dict(self._slips)
        for row, row_id in enumerate(rows['id'].tolist()):
            slips.pop(row_id, None)
            if choice[row] == SLIPPED:
                last = rows[row - 1] if row > 0 else before[-1]
                variance = 0.5 * float(rows['turn'][row, [0, 3]].sum()
                                       + rows['way'][row, [0, 2]].sum())
                slip = (BANK.slip_size**2 + float(decided.far[row])**2) / 3.0
                slips[row_id] = (int(last['node']), int(rows['node'][row]),
                                 1.0 + slip / max(variance, 1e-6))
        if slips != self._slips:
            self._slips = slips
            self._loosened = {
                edge: 1.0 / scale for begin, end, scale in slips.values()
                for edge in _odometry_between(self._smoother.graph, begin, end).tolist()}

    def _runs(self, rows: Records, choice: IntArray, first: int) -> IntArray:
        """Return the ids of the measurements that the faults of others began with, or 0."""
        runs, begun = np.zeros(len(rows), dtype=np.int64), dict[int, int]()
        states = self._states
        for row, (one, source) in enumerate(rows[['id', 'source']].tolist()):
            if choice[row] == BEGINS or (choice[row] == GOES_ON and source not in begun):
                begun[source] = one
                if choice[row] == GOES_ON:  # it has begun before the first row
                    earlier = np.flatnonzero(self._bank.rows['source'][:first] == source)[-1:]
                    at = np.searchsorted(states.added, self._bank.rows['id'][earlier])
                    at = at[at < len(states)]
                    if len(at) > 0 and states.run[at[0]] > 0:
                        begun[source] = int(states.run[at[0]])
            elif choice[row] not in (ALONE, GOES_ON):
                begun.pop(source, None)
            runs[row] = LONE if choice[row] == ALONE else begun.get(source, 0)
        return runs

    def _note_distances(self, decided: Decided) -> None:
        """Note how far new measurements are from where they were expected."""
        rows = self._bank.rows['id'][decided.first:]
        new = np.isin(rows, self._new_ids)
        numbers = np.searchsorted(self._states.added, rows[new])
        self._states.distance[numbers] = np.sqrt(decided.d2[new])

    def _with_weights(self, change: GraphUpdate, before: _Decided) -> GraphUpdate:
        """Return an update with the weights of new records and of those that have changed."""
        weights, loosened = self._states.weights(before.state, self._reweighting), before.loosened
        for edge in () if loosened is self._loosened else {*loosened, *self._loosened}:
            if loosened.get(edge) != self._loosened.get(edge):
                weights[edge] = self._loosened.get(edge, 1.0)
        return change._replace(weigh={**change.weigh, **weights})

    def _begin(self) -> _Decided:
        self._before, self._final = self._decided(), None
        self._new_ids = self._new_ids[:0]
        return self._before

    def _decided(self) -> _Decided:
        return _Decided(self._states.run.copy(), self._states.state.copy(), self._loosened,
                        self._slips)

    def _decide(self, decided: _Decided) -> None:
        """Make it what is decided; what has come since is taken away."""
        self._states.truncate(len(decided.run))
        self._states.run[:], self._states.state[:] = decided.run, decided.state
        self._loosened, self._slips = decided.loosened, decided.slips

    def commit(self) -> None:
        if self._before is None:
            return
        before, states = self._before.state, self._states
        states.set_base_weights(before, self._reweighting)
        for number in states.changed(before).tolist():
            states.announce(number, int(before[number]), self._now_ns)
        for number in range(len(before), len(states)):
            states.announce(number, NEW, self._now_ns)
        self._before = None

    def rollback(self) -> None:
        if self._before is not None:
            self._decide(self._before)
            self._bank.remove(self._new_ids)
            self._before = None

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, as long as no measurement is added."""
        before, records_back = self._decided(), self._states.snapshot()

        def bring_back() -> None:
            self._decide(before)
            records_back()
        return bring_back

    def finish(self) -> None:
        """Judge all again, unless `final_weights` has just decided it."""
        final = self._final
        if not self._can_judge_all():
            return
        before = self._begin()
        if final is None:
            self._judge_all()
        else:
            self._decide(final)
        change = self._with_weights(GraphUpdate(), before)
        if len(change.weigh) > 0 and self._smoother.update(change).reason != '':
            self.rollback()
        else:
            self.commit()

    def final_weights(self) -> FloatArray:
        """Return the weights that `finish` would give, by row."""
        graph, states = self._smoother.graph, self._states
        weights = graph.weights
        if not self._can_judge_all():
            return weights
        self._begin()
        self._judge_all()
        weights[graph.factor_rows(states.held)] = states.believed
        final = self._decided()
        self.rollback()
        self._final = final
        return weights

    def _can_judge_all(self) -> bool:
        return 0 < len(self._states) <= BELIEF.most_again and not self._smoother.graph.has_touched

    def _judge_all(self) -> None:
        """Judge all again, with white or slow errors of the sources, whichever is likelier."""
        self.chain.extend(self._smoother.graph)
        if self._is_restored:
            self._add_records()
        best, most = None, -math.inf
        for errors in (None, SLOW):
            bank = self._bank.again()
            decided = bank.decide(self._noise(AS_CLAIMED, errors))
            evidence = bank.evidence - (0.0 if errors is None else BANK.occam)
            if evidence > most:
                best, most = (bank, decided), evidence
        assert best is not None
        self._slips = {}
        self._apply(*best)

    def decide_leaving(self, factors: IntArray) -> list[Verdict]:
        """Return the verdicts on what leaves unused."""
        states = self._states
        unused = np.flatnonzero(states.leaving(factors) & ~states.believed)
        return states.verdicts(self._smoother.graph, unused[-MOST_OTHERS:])

    def forget(self, nodes: IntArray, factors: IntArray) -> None:
        leaving = self._states.leaving(factors)
        if np.any(leaving):
            self._states.select(np.flatnonzero(~leaving))
            self._bank.forget(self._states.added)
        self.chain.forget(nodes)
        self._final = None
        gone = {*factors.tolist()}
        if not gone.isdisjoint(self._loosened):
            self._loosened = {edge: weight for edge, weight in self._loosened.items()
                              if edge not in gone}

    def decide(self, name: str, decision: Decision) -> Answer:
        """Return the answer to a person's decision on a measurement, which is applied at once."""
        number = self._states.find(name)
        if number < 0:
            return unknown(name, has_left=self._states.has_left(name))
        states = self._states
        believed = decision is Decision.IN or (
            decision is Decision.AUTO and int(states.run[number]) == 0)
        before, decided = self._begin(), int(states.decision[number])
        states.decision[number] = AUTO
        states.believe(np.array((number,)), believed=believed)
        if len(states.changed(before.state)) > 0:
            result = self._smoother.update(self._with_weights(GraphUpdate(), before))
            if result.reason != '':
                self.rollback()
                states.decision[number] = decided
                return rejected('failed', 'the solver failed with it')
        self.commit()
        states.decision[number] = DECISIONS.index(decision)
        verdict, = states.verdicts(self._smoother.graph, np.array((number,)))
        return Answer(AnswerStatus.ACCEPTED, detail=f'{name}: {sentence(verdict)}')

    def restore(self, saved: SavedVerdicts, loosened: Mapping[int, float], now_ns: int) -> None:
        self._now_ns, self._is_restored = now_ns, True
        self._states.restore(saved)
        self._loosened = dict(loosened)


def _determines(rows: Records) -> bool:
    """Tell whether measurements say where the robot is in the map, and which way it looks."""
    if np.any(rows['heading_variance'] > 0.0):
        return True
    return len(rows) >= LEAST and float(np.max(np.ptp(rows['mean'][:, :2], axis=0))) > float(
        np.sqrt(np.min(rows['noise'][:, 0])))


def _odometry_between(graph: Graph, begin: int, end: int) -> IntArray:
    """
    Return the ids of odometry edges between two nodes, or of those around them if they are one.
    """
    factors = graph.factor_records
    odometry = np.flatnonzero(factors['kind'] == FactorKind.ODOMETRY)
    i, j, _ = graph.node_ids[factors['ends'][odometry]].T
    inside = (i < end) & (j > begin) if end > begin else (i == end) | (j == end)
    return np.asarray(graph.factor_ids[odometry[inside]])
