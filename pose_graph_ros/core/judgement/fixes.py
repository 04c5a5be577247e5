# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Judge positions and poses in the map over time, and odometry where it has slipped.

`belief.bank` says what has happened. Here measurements get their weights from it, and odometry
that has slipped a lower one.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.belief.bank import Bank, Decided, is_believed, Odometry, Prior, Spread
from pose_graph_ros.core.belief.hypotheses import ALONE, BEGINS, GOES_ON, GOOD, SLIPPED
from pose_graph_ros.core.belief.learning import axes_of, claimed, Known, TURN, WAY
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
from pose_graph_ros.core.judgement.texts import sentence, unknown
from pose_graph_ros.core.judgement.verdicts import AUTO, BELIEVED, Decision, DECISIONS, Verdict
from pose_graph_ros.core.measurements import (
    Answer,
    AnswerStatus,
    GlobalPose,
    PoseMeasurement,
    Position,
    rejected,
)
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import FactorBuilder, NewConstraint

# Up to so many measurements it is asked whether those that are believed tell where the map is,
# which at least so many are needed for. If they do not, nothing is doubted yet.
FEW, LEAST = 100, 3
# Rows of measurements that a bank with another noise is taken along in one step.
ROWS_IN_STEP = 50


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
        self._next: Bank | None = None  # with noise learnt anew, on its way to the newest row
        self._is_new = False  # whether all that the bank says is to be applied
        self._sources: list[str] = []  # whose measurements the bank has, by number
        self._loosened: dict[int, float] = {}
        # where odometry has slipped, by the id of the measurement that shows it: between which
        # nodes, and the factor on the covariance of the odometry between that allows for it
        self._slips: dict[int, tuple[int, int, float]] = {}
        self._before: _Decided | None = None  # during an update, what was decided before it
        self._new_ids: IntArray = np.empty(0, dtype=np.int64)  # rows that came with the update
        self._now_ns = -1   # newest stamp of odometry
        self._is_restored = False  # whether the bank does not know the records yet
        self._spread = self._bank.spread  # until it does, that of a file

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
        seen = [one for one in new if one.kind in (GlobalPose, Position)
                and self._sees(one.source, one.kind)]
        if len(seen) == 0:
            return change
        self._now_ns, before, graph = now_ns, self._begin(), self._smoother.graph
        self.chain.extend(graph)
        if self._is_restored:
            self._add_records()
        ids = np.array([one.number for one in seen])
        rows = measured(change.factors.rows(ids - graph.next_ids.factor),
                        [one.stamp_ns for one in seen], ids.tolist())
        if len(rows) == 0:
            return change
        by_id = {one.number: one for one in seen}
        self._new_ids = rows['id'].copy()
        for row in rows:
            one = by_id[int(row['id'])]
            row['source'] = self._number(one.source)
            row['judged'] = self._is_judged(one.source, one.kind)
            if row['judged']:
                self.states.append(one, now_ns, BELIEVED, run=LONE)
        if len(self._bank) == 0 and not np.any(graph.fixed) and not graph.has_touched:
            self._begin_with_graph(int(rows['node'][np.argmin(rows['stamp_ns'])]))
        self._insert(rows)
        decided = self._bank.decide()
        self._apply(self._bank.told(0) if self._is_new or len(self._bank) <= FEW else decided)
        self._note_distances(decided)
        return self._with_weights(change, before)

    def _is_judged(self, source: str, kind: type[PoseMeasurement]) -> bool:
        return self._config.measurement_source(source, kind).robust is Robust.JUDGED

    def _sees(self, source: str, kind: type[PoseMeasurement]) -> bool:
        """Tell whether the bank has the measurements of a source: to judge them, or to learn."""
        settings = self._config.measurement_source(source, kind)
        return settings.robust is Robust.JUDGED or settings.finds_correlation

    def _number(self, source: str) -> int:
        """Return the number of the errors of a source, which is told to the bank if it is new."""
        if source not in self._sources:
            self._sources.append(source)
            number = self._sources.index(source)
            if number < BANK.sources:
                given = self._errors_in_use(source)
                for bank in self._banks():
                    bank.noise['white'][0, number], bank.noise['slow'][0, number] = (
                        given[1:] if given is not None else (1.0, 0.0))
                    bank.noise['tau'][0, number] = 1.0 if given is None else given[0]
        return min(self._sources.index(source), BANK.sources - 1)

    def _errors_in_use(self, source: str) -> tuple[float, float, float] | None:
        """Return time constant, white and slow variance as the filters take them."""
        found = self._factors.errors_in_use(source)
        if found is None:
            return None
        if source in self._factors.sources and self._factors.sources[source].errors is not None:
            return found.tau, found.white, found.correlated
        return found.tau, 1.0, 1.0  # of a given time constant, both variances are in the rows

    def _banks(self) -> list[Bank]:
        return [self._bank] if self._next is None else [self._bank, self._next]

    def _insert(self, rows: Records) -> None:
        for bank in self._banks():
            bank.insert(rows, self._odometry())

    def _odometry(self) -> Odometry:
        chain = self.chain
        return Odometry(
            chain.nodes, chain.poses, chain.sums,
            self._nodes.stamps_ns[np.searchsorted(self._nodes.ids, chain.nodes)],
            self._nodes.errors)

    def _begin_with_graph(self, node: int) -> None:
        graph = self._smoother.graph
        self._bank.begin_with(Prior(
            node, graph.poses_of(node), np.ascontiguousarray(self._smoother.covariance(node))))

    def _add_records(self) -> None:
        """Let the bank know of measurements that were loaded."""
        self._is_restored = False
        for source in self._factors.sources:
            rows = self._records(source)
            if len(rows) > 0 and self._sees(source, GlobalPose):
                rows['source'] = self._number(source)
                rows['judged'] = self._is_judged(source, GlobalPose)
                self._insert(rows)

    def _records(self, source: str, least: float = BANK.least_position) -> Records:
        some = self._factors.sources[source].measured.values
        return measured(self._smoother.graph.factors_at(some['id']), some['stamp_ns'].tolist(),
                        some['id'].tolist(), least)

    def path(self, source: str, without: Collection[int]) -> Records:
        """Return rows for the measurements in the graph of one source, but for some stamps."""
        self.chain.extend(self._smoother.graph)
        rows, bank = self._records(source, 0.0), Bank()
        rows = rows[~np.isin(rows['stamp_ns'], np.array([*without], dtype=np.int64))]
        if len(rows) > 0:
            bank.insert(rows, self._odometry())
        return bank.rows

    @property
    def bank(self) -> Bank:
        """The bank with the noise in use, which only this object may change."""
        return self._bank

    def prepare(self) -> None:
        """Let the bank know of all measurements, also after a graph was loaded."""
        if self._is_restored:
            self.chain.extend(self._smoother.graph)
            self._add_records()

    def known(self) -> Known:
        """Return which noise is given, and which is to be found."""
        n, finding = min(len(self._sources), BANK.sources), self._factors.finding()
        point, scale = [*claimed(n)], self._config.odometry_scale
        if scale > 0.0:
            point[WAY] = point[TURN] = 2.0 * math.log2(scale)
        free = list[int]()
        for number, source in enumerate(self._sources[:n]):
            given = None if source in finding else self._errors_in_use(source)
            if given is not None:
                tau, white, correlated = given
                for axis, value in zip(axes_of(number), (white, correlated, tau), strict=True):
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

    @property
    def spread(self) -> Spread:
        """What others than the best hypothesis say of where the robot is."""
        return self._spread if self._is_restored else self._bank.spread

    def adopt(self, noise: Records, newest: int | None = None) -> None:
        """Judge the newest measurements, or all, anew with another noise, step by step."""
        self._next = self._bank.again(noise, newest)

    @property
    def decides_anew(self) -> bool:
        return self._next is not None

    def step(self) -> bool:
        """Do a part of that; return whether something is left."""
        if self._next is not None and not self._next.advance(ROWS_IN_STEP):
            self._next.decide()
            self._bank, self._next, self._is_new = self._next, None, True
        return self._next is not None

    def _apply(self, decided: Decided) -> None:
        """Believe and doubt measurements, and odometry where it has slipped."""
        bank = self._bank
        states, rows = self._states, bank.rows[decided.first:]
        if len(rows) == 0:
            return
        known = np.isin(rows['id'], states.added)
        numbers = np.searchsorted(states.added, rows['id'][known])
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
        new = np.isin(rows, self._new_ids) & np.isin(rows, self._states.added)
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
        self._before = self._decided()
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
        self._before, self._is_new = None, False

    def rollback(self) -> None:
        if self._before is not None:
            self._decide(self._before)
            for bank in self._banks():
                bank.remove(self._new_ids)
            self._before = None

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, as long as no measurement is added."""
        before, records_back = self._decided(), self._states.snapshot()

        def bring_back() -> None:
            self._decide(before)
            records_back()
        return bring_back

    def finish(self) -> None:
        """Give all measurements the weights that the bank says."""
        self.prepare()
        if len(self._bank) == 0 or self._smoother.graph.has_touched:
            return
        while self.step():
            pass
        before = self._begin()
        self._slips, self._loosened = {}, {}
        self._bank.decide()
        self._apply(self._bank.told(0))
        change = self._with_weights(GraphUpdate(), before)
        if len(change.weigh) > 0 and self._smoother.update(change).reason != '':
            self.rollback()
        else:
            self.commit()

    def decide_leaving(self, factors: IntArray) -> list[Verdict]:
        """Return the verdicts on what leaves unused."""
        states = self._states
        unused = np.flatnonzero(states.leaving(factors) & ~states.believed)
        return states.verdicts(self._smoother.graph, unused[-MOST_OTHERS:])

    def forget(self, nodes: IntArray, factors: IntArray) -> None:
        leaving = self._states.leaving(factors)
        if np.any(leaving):
            self._states.select(np.flatnonzero(~leaving))
        for bank in self._banks():
            bank.forget(self._smoother.graph.factor_ids, BANK.most_learnt)
        self.chain.forget(nodes)
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

    def restore(
        self, saved: SavedVerdicts, loosened: Mapping[int, float], spread: FloatArray, now_ns: int,
    ) -> None:
        self._now_ns, self._is_restored = now_ns, True
        if len(spread) > 0:
            self._spread = Spread(spread[0], spread[1:])
        self._states.restore(saved)
        self._loosened = dict(loosened)


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
