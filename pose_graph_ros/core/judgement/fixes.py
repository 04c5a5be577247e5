# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Judge positions and poses in the map over time, and odometry where it has slipped.

`belief.bank` says what has happened. Here measurements get their weights from it, and odometry
that has slipped a lower one.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.belief.bank import Bank, Decided, is_believed, Odometry, Spread
from pose_graph_ros.core.belief.hypotheses import ALONE, BEGINS, GOES_ON, GOOD, SLIPPED
from pose_graph_ros.core.belief.learning import axes_of, claimed, Known, TURN, WAY
from pose_graph_ros.core.belief.rows import measured, Records
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.config import Robust
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.fix_states import FixStates, LONE
from pose_graph_ros.core.judgement.judgements import NEW, SavedVerdicts
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.verdicts import AUTO, BELIEVED, Decision, DECISIONS
from pose_graph_ros.core.measurements import GlobalPose, PoseMeasurement, Position
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.bias import CorrelatedErrors
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.queued import Queued

# Up to so many measurements it is asked whether those that are believed tell where the map is,
# which at least so many are needed for. If they do not, nothing is doubted yet.
FEW, LEAST = 100, 3
# Rows of measurements that a bank with another noise is taken along in one step.
ROWS_IN_STEP = 50


class _Decided(NamedTuple):
    """What was decided before an update."""

    size: int  # number of records
    numbers: IntArray  # of those of them that are decided on anew, ascending, shape (M,)
    state: IntArray
    run: IntArray  # of each of these, both of shape (M,)
    loosened: Mapping[int, float]  # as in `FixJudge`
    slips: dict[int, tuple[int, int, float]]


class FixJudge:
    def __init__(self, smoother: IncrementalSmoother, reweighting: Reweighting, nodes: HiddenNodes,
                 factors: FactorBuilder, chain: OdometryChain) -> None:
        self._smoother, self._reweighting = smoother, reweighting
        self._nodes, self._factors, self._chain = nodes, factors, chain
        self.states = FixStates()
        self.bank = Bank()  # with the noise in use, which only this object may change
        self.next_bank: Bank | None = None  # with noise learnt anew, on its way to the newest row
        self._is_new = False  # whether all that the bank says is to be applied
        self._sources: list[str] = []  # whose measurements the bank has, by number
        # weights of odometry edges, by id, that are believed less than claimed; only ever replaced
        self.loosened: Mapping[int, float] = {}
        # where odometry has slipped, by the id of the measurement that shows it: between which
        # nodes, and the factor on the covariance of the odometry between that allows for it; also
        # replaced
        self._slips: dict[int, tuple[int, int, float]] = {}
        self._before: _Decided | None = None  # during an update, what was decided before it
        self._new_ids: IntArray = np.empty(0, dtype=np.int64)  # rows that came with the update
        self._now_ns = -1   # newest stamp of odometry
        self._is_restored = False  # whether the bank does not know the records yet

    def before(self, new: Sequence[Queued], change: GraphUpdate, now_ns: int) -> GraphUpdate:
        """Return an update in which all rows have the weights that the new ones make right."""
        by_id = {one.number: one for one in new if one.measured in (GlobalPose, Position)
                 and self._is_judged(one.source, one.measured) is not None}
        if len(by_id) == 0:
            return change
        self._now_ns, graph = now_ns, self._smoother.graph
        self._begin()
        self.prepare()
        ids = np.array([*by_id])
        rows = measured(change.factors.rows(ids - graph.next_ids.factor),
                        [one.stamp_ns for one in by_id.values()], ids.tolist())
        if len(rows) == 0:
            return change
        self._new_ids, judged = rows['id'].copy(), dict[int, int]()  # by ids, their numbers
        for row in rows:
            one = by_id[int(row['id'])]
            row['source'] = self._number(one.source)
            row['judged'] = self._is_judged(one.source, one.measured)
            if row['judged']:
                judged[one.number] = len(self.states)
                self.states.append(one, now_ns, BELIEVED)
        if len(self.bank) == 0 and not np.any(graph.fixed) and not graph.has_touched:
            node = int(rows['node'][np.argmin(rows['stamp_ns'])])
            self.bank.begin_with(node, graph.poses_of(node), self._smoother.covariance(node))
        self._insert(rows)
        decided = self._decide()
        self._apply(self.bank.told(0) if self._is_new or len(self.bank) <= FEW else decided)
        # how far the new ones are from where they were expected
        for row_id, d2 in zip(self.bank.rows['id'][decided.first:].tolist(), decided.d2.tolist(),
                              strict=True):
            if row_id in judged:
                self.states.distance[judged[row_id]] = math.sqrt(d2)
        return self._with_weights(change)

    def _is_judged(self, source: str, kind: type[PoseMeasurement] = GlobalPose) -> bool | None:
        """Tell whether a source is judged; None if the bank does not even learn from it."""
        settings = self._factors.config.measurement_source(source, kind)
        if settings.robust is Robust.JUDGED:
            return True
        return False if settings.finds_correlation else None

    def trusts(self, source: str, kind: type[PoseMeasurement] = GlobalPose) -> bool:
        """Tell whether a source is believed whatever speaks against it."""
        return self._factors.config.measurement_source(source, kind).robust is Robust.NONE

    def _number(self, source: str) -> int:
        """Return the number of the errors of a source, which is told to the bank if it is new."""
        if source not in self._sources:
            self._sources.append(source)
            number = len(self._sources) - 1
            if number < BANK.sources:
                given = self._errors_in_use(source) or CorrelatedErrors(1.0, 0.0, 1.0)
                for bank in self._banks():
                    for name, value in zip(('tau', 'slow', 'white'), given, strict=True):
                        bank.noise[name][0, number] = value
        return min(self._sources.index(source), BANK.sources - 1)

    def _errors_in_use(self, source: str) -> CorrelatedErrors | None:
        """Return the errors of a source as the filters take them; None for white ones."""
        found, sources = self._factors.errors_in_use(source), self._factors.sources
        if found is None or (source in sources and sources[source].errors is not None):
            return found
        # of a given time constant, both variances are in the rows
        return CorrelatedErrors(found.tau, 1.0, 1.0)

    def _banks(self) -> list[Bank]:
        return [self.bank] if self.next_bank is None else [self.bank, self.next_bank]

    def _insert(self, rows: Records) -> None:
        for bank in self._banks():
            bank.insert(rows, self.odometry())

    def odometry(self) -> Odometry:
        """Return the chain of odometry, with the errors that it knows of."""
        chain, known = self._chain, self._nodes
        return Odometry(
            chain.nodes, chain.poses, chain.sums, known.ids, known.stamps_ns, known.errors)

    def _records(self, source: str, least: float = BANK.least_sigmas[0]) -> Records:
        some = self._factors.sources[source].measured.values
        return measured(self._smoother.graph.factors_at(some['id']), some['stamp_ns'].tolist(),
                        some['id'].tolist(), least)

    def path(self, source: str, without: Collection[int]) -> Records:
        """Return rows for the measurements in the graph of one source, but for some stamps."""
        self._chain.extend(self._smoother.graph)
        rows, bank = self._records(source, 0.0), Bank()
        rows = rows[~np.isin(rows['stamp_ns'], np.array([*without], dtype=np.int64))]
        if len(rows) > 0:
            bank.insert(rows, self.odometry())
        return bank.rows

    def prepare(self) -> None:
        """Let the bank know of all measurements, also after a graph was loaded."""
        self._chain.extend(self._smoother.graph)
        if not self._is_restored:
            return
        self._is_restored = False
        for source in self._factors.sources:
            rows = self._records(source)
            if len(rows) > 0 and (judged := self._is_judged(source)) is not None:
                rows['source'], rows['judged'] = self._number(source), judged
                self._insert(rows)

    def known(self, sources: Sequence[str] | None = None) -> Known:
        """Return which noise is given, and which is to be found, also of some other sources."""
        sources = self._sources if sources is None else sources
        n, finding = min(len(sources), BANK.sources), self._factors.finding()
        point, scale = [*claimed(n)], self._factors.config.odometry_scale
        if scale > 0.0:
            point[WAY] = point[TURN] = 2.0 * math.log2(scale)
        free = list[int]()
        for number, source in enumerate(sources[:n]):
            given = None if source in finding else self._errors_in_use(source)
            if given is not None:
                for axis, value in zip(axes_of(number), given[::-1], strict=True):
                    point[axis] = math.log2(value)
            else:
                # slow errors also where the graph does not know of them: what is not white looks
                # like a fault to filters by which all is
                free.append(number)
        return Known(tuple(point), scale == 0.0 and len(finding) > 0, tuple(free))

    @property
    def n_seen(self) -> int:
        """Number of measurements that the bank has got, also of those that have left the graph."""
        sources = self._factors.sources
        return sum(sources[source].n_ever for source in self._sources if source in sources)

    def source(self, name: str) -> int | None:
        """Return the number of the errors of a source; None if the bank has nothing of it."""
        return min(self._sources.index(name), BANK.sources - 1) if name in self._sources else None

    def adopt(self, noise: Records, newest: int | None = None) -> None:
        """Judge the newest measurements, or all, anew with another noise, step by step."""
        self.next_bank = self.bank.again(noise, newest)

    def step(self) -> bool:
        """Do a part of that; return whether something is left."""
        if self.next_bank is not None and not self.next_bank.advance(ROWS_IN_STEP):
            self.next_bank.decide()
            self.bank, self.next_bank, self._is_new = self.next_bank, None, True
        return self.next_bank is not None

    def _decide(self) -> Decided:
        """Take the bank to the newest row; what it has passed stays if that is interrupted."""
        while self.bank.advance(ROWS_IN_STEP):
            self._smoother.graph.memory.check()
        return self.bank.decide()

    def _apply(self, decided: Decided) -> None:
        """Believe and doubt measurements, and odometry where it has slipped."""
        states, rows = self.states, self.bank.rows[decided.first:]
        if len(rows) == 0:
            return
        numbers = states.numbers_of(rows['id'])
        known = numbers >= 0
        numbers = numbers[known]
        self._decide_on(numbers)
        choice = decided.choice
        if decided.first == 0 and not _determines(rows[is_believed(choice)]):
            choice = np.full(len(rows), GOOD)
        states.believe(numbers, is_believed(choice)[known])
        states.run[numbers] = self._runs(rows, choice, decided.first)[known]
        before, slips = self.bank.rows[:decided.first], dict(self._slips)
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
            self.loosened = {
                edge: 1.0 / scale for begin, end, scale in slips.values()
                for edge in _odometry_between(self._smoother.graph, begin, end).tolist()}

    def _runs(self, rows: Records, choice: IntArray, first: int) -> IntArray:
        """Return the ids of the measurements that the faults of others began with, or 0."""
        runs, begun = np.zeros(len(rows), dtype=np.int64), dict[int, int]()
        states = self.states
        for row, (one, source) in enumerate(rows[['id', 'source']].tolist()):
            if choice[row] == BEGINS or (choice[row] == GOES_ON and source not in begun):
                begun[source] = one
                if choice[row] == GOES_ON:  # it has begun before the first row
                    earlier = first - 1
                    while earlier >= 0 and self.bank.rows['source'][earlier] != source:
                        earlier -= 1
                    at = states.numbers_of(self.bank.rows['id'][earlier:first][:1])
                    if len(at) > 0 and at[0] >= 0 and states.run[at[0]] > 0:
                        begun[source] = int(states.run[at[0]])
            elif choice[row] not in (ALONE, GOES_ON):
                begun.pop(source, None)
            runs[row] = LONE if choice[row] == ALONE else begun.get(source, 0)
        return runs

    def _with_weights(self, change: GraphUpdate) -> GraphUpdate:
        """Return an update with the weights of new records and of those that have changed."""
        assert self._before is not None
        size, numbers, state, _, loosened, _ = self._before
        weights = self.states.weights(size, numbers, state)
        for edge in () if loosened is self.loosened else {*loosened, *self.loosened}:
            if loosened.get(edge) != self.loosened.get(edge):
                weights[edge] = self.loosened.get(edge, 1.0)
        return change._replace(weigh={**change.weigh, **weights})

    def _begin(self) -> None:
        none = np.empty(0, dtype=np.int64)
        self._before = _Decided(
            len(self.states), none, none, none, self.loosened, self._slips)
        self._new_ids = none

    def _decide_on(self, numbers: IntArray) -> None:
        """Note what is decided on records, which may change now."""
        assert self._before is not None
        old = np.sort(numbers[numbers < self._before.size])
        self._before = self._before._replace(
            numbers=old, state=self.states.state[old], run=self.states.run[old])

    def commit(self) -> None:
        if self._before is None:
            return
        states, (size, numbers, state, *_) = self.states, self._before
        for held, weight in states.weights(size, numbers, state, base=True).items():
            self._reweighting.set_base_weight(held, weight)
        for number, before in zip(numbers.tolist(), state.tolist(), strict=True):
            states.announce(number, before, self._now_ns)
        for number in range(size, len(states)):
            states.announce(number, NEW, self._now_ns)
        self._before, self._is_new = None, False

    def rollback(self) -> None:
        if self._before is None:
            return
        size, numbers, state, run, self.loosened, self._slips = self._before
        self.states.truncate(size)
        self.states.run[numbers], self.states.state[numbers] = run, state
        for bank in self._banks():
            bank.remove(self._new_ids)
        self._before = None

    def keep(self, undo: ExitStack[bool]) -> None:
        """Have what is decided brought back, as long as no measurement is added."""
        self.states.keep(undo)
        undo.callback(setattr, self, 'loosened', self.loosened)
        undo.callback(setattr, self, '_slips', self._slips)

    def finish(self) -> None:
        """Give all measurements the weights that the bank says."""
        self.prepare()
        if len(self.bank) == 0 or self._smoother.graph.has_touched:
            return
        while self.step():
            self._smoother.graph.memory.check()
        self._decide()
        self._begin()
        self._slips, self.loosened = {}, {}
        self._apply(self.bank.told(0))
        change = self._with_weights(GraphUpdate())
        if len(change.weigh) > 0 and self._smoother.update(change).reason != '':
            self.rollback()
        else:
            self.commit()

    def forget(self, factors: IntArray) -> None:
        leaving = self.states.leaving(factors)
        if np.any(leaving):
            self.states.select(np.flatnonzero(~leaving))
        for bank in self._banks():
            bank.forget(self._smoother.graph.factor_ids, BANK.most_learnt)
        gone = {*factors.tolist()}
        if not gone.isdisjoint(self.loosened):
            self.loosened = {edge: weight for edge, weight in self.loosened.items()
                             if edge not in gone}

    def decide(self, number: int, decision: Decision) -> bool:
        """Apply a person's decision on a measurement; return whether the solver succeeded."""
        states = self.states
        believed = decision is Decision.IN or (
            decision is Decision.AUTO and int(states.run[number]) == 0)
        numbers, decided = np.array((number,)), int(states.decision[number])
        states.decision[number] = AUTO
        self._begin()
        self._decide_on(numbers)
        before = int(states.state[number])
        states.believe(numbers, np.array((believed,)))
        if states.state[number] != before and self._smoother.update(
                self._with_weights(GraphUpdate())).reason != '':
            self.rollback()
            states.decision[number] = decided
            return False
        self.commit()
        states.decision[number] = DECISIONS.index(decision)
        return True

    def restore(self, saved: SavedVerdicts, loosened: Mapping[int, float], spread: FloatArray,
                now_ns: int) -> None:
        self._now_ns, self._is_restored = now_ns, True
        self.bank.spread = Spread(spread[0], spread[1:])   # until it knows the records
        self.states.restore(saved)
        self.loosened = dict(loosened)


def _determines(rows: Records) -> bool:
    """Tell whether measurements say where the robot is in the map, and which way it looks."""
    if np.any(rows['heading_variance'] > 0.0):
        return True
    return len(rows) >= LEAST and float(np.max(np.ptp(rows['mean'][:, :2], axis=0))) > float(
        np.sqrt(np.min(np.maximum(rows['noise'][:, 0], rows['least']))))


def _odometry_between(graph: Graph, begin: int, end: int) -> IntArray:
    """
    Return the ids of odometry edges between two nodes, or of those around them if they are one.
    """
    factors = graph.factor_records
    odometry = np.flatnonzero(factors['kind'] == FactorKind.ODOMETRY)
    i, j, _ = graph.node_ids[factors['ends'][odometry]].T
    inside = (i < end) & (j > begin) if end > begin else (i == end) | (j == end)
    return np.asarray(graph.factor_ids[odometry[inside]])
