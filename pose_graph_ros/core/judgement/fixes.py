# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Judge positions and poses in the map over time, and odometry where they contradict it.

`run_set` makes runs of measurements that agree with one another and decides which to believe.
Here their members get their weights, and odometry that does not explain a jump a lower one.
"""

from collections.abc import Callable, Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import BackendConfig, Robust
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges, ObservedNodes
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement import fix_states as fs
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.run_set import decision_cost, RunSet, Turn
from pose_graph_ros.core.judgement.runs import odometry_between
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.texts import sentence, unknown
from pose_graph_ros.core.judgement.tracks import (
    biased_observations,
    Observation,
    observations,
    Track,
)
from pose_graph_ros.core.judgement.verdicts import Decision, MOST_OTHERS, State, Verdict
from pose_graph_ros.core.measurements import (
    Answer,
    AnswerStatus,
    HeadingOnly,
    LoopClosure,
    rejected,
)
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.source_constraints import NewConstraint


class _Before(NamedTuple):
    """The state before an update, but for the records, of which there were `size`."""

    size: int
    runs: RunSet
    loosened: dict[int, float]


class _Decided(NamedTuple):
    run: IntArray
    believed: IntArray  # of each record, both of shape (M,)
    runs: RunSet
    loosened: dict[int, float]


class FixJudge:
    def __init__(
        self, smoother: IncrementalSmoother, reweighting: Reweighting, config: BackendConfig,
    ) -> None:
        self._smoother, self._reweighting, self._config = smoother, reweighting, config
        self.states = self._states = fs.FixStates()
        self._runs = RunSet()
        # weights of odometry edges by id; replaced, never changed, so that it is not copied
        self._loosened: dict[int, float] = {}
        self._restore: _Before | None = None
        self._decided: _Decided | None = None
        # stamp [ns] of the newest believed measurement that has left, and where the robot was
        self._cut: tuple[int, Track] | None = None
        # newest stamp of odometry, and the record that is judged again, -1 for a new one
        self._now_ns, self._again = -1, -1

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
        self._begin()
        self._now_ns = now_ns
        graph = self._smoother.graph
        solved = not graph.has_touched
        self._runs.chain.extend(graph)
        first, loosened = len(self._states), self._loosened
        is_edge = np.array([one.is_edge for one in judged])
        numbers, begin = np.array([one.number for one in judged]), graph.next_ids
        seen = _both(change.edges.rows(numbers[is_edge] - begin.edge),
                     change.observed.rows(numbers[~is_edge] - begin.observed), is_edge)
        for one, each in zip(judged, seen, strict=True):
            self._judge(one.stamp_ns, each, one, solved=solved)
        for number in range(first, len(self._states)):
            if not self._states.believed[number]:
                self._states.announce(number, None)
        return self._with_weights(change, first, loosened)

    def _with_weights(
        self, change: GraphUpdate, first: int, loosened: Mapping[int, float],
    ) -> GraphUpdate:
        """Return an update with the weights of new records and of those that have changed."""
        edges, observed = self._states.weights(first, self._reweighting)
        for edge in () if loosened is self._loosened else {*loosened, *self._loosened}:
            if loosened.get(edge) != self._loosened.get(edge):
                edges[edge] = self._loosened.get(edge, 1.0)
        return change._replace(weigh_edges={**change.weigh_edges, **edges},
                               weigh_observed={**change.weigh_observed, **observed})

    @property
    def chain(self) -> OdometryChain:
        return self._runs.chain

    def _begin(self) -> None:
        self._restore, self._decided = self._copy(), None

    def _copy(self) -> _Before:
        return _Before(len(self._states), self._runs.copy(), self._loosened)

    def commit(self) -> None:
        if self._restore is None:
            return
        self._states.set_base_weights(self._restore.size, self._reweighting)
        for number, before in self._states.changed.items():
            if before != bool(self._states.records['believed'][number]):
                self._states.announce(number, State.BELIEVED if before else State.DOUBTED)
        self._states.forget()
        self._restore = None

    def rollback(self) -> None:
        if self._restore is not None:
            self._states.undo(self._restore.size)
            self._set(self._restore)

    def _set(self, before: _Before) -> None:
        self._runs, self._loosened, self._restore = before.runs, before.loosened, None

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, as long as no measurement is added."""
        before, records_back = self._copy(), self._states.snapshot()

        def bring_back() -> None:
            records_back()
            self._set(before)
        return bring_back

    def _judge(self, stamp_ns: int, seen: Observation | None, one: NewConstraint | None, *,
               solved: bool = False) -> None:
        """Give a measurement, a new one or else the record `_again`, to a run."""
        if seen is None:
            return      # a heading alone
        states = self._states
        source = (states.sources[states.records['source'][self._again]]
                  if one is None else one.source)
        begun = not np.any(self._smoother.graph.fixed)
        given = self._runs.judge(
            stamp_ns, seen, source, self._of_graph(seen.node, solved=solved),
            solved=solved, begun=begun)
        if one is not None:
            states.append(one, run=given.run, believed=given.believed,
                          distance=math.sqrt(given.d2), now_ns=self._now_ns)
        else:
            states.records['run'][self._again] = given.run
            if bool(states.records['believed'][self._again]) != given.believed:
                states.believe(
                    np.array((self._again,)), believed=given.believed, now_ns=self._now_ns)
        if given.turn is not None:
            self._apply(given.turn)

    def _of_graph(self, node: int, *, solved: bool) -> Track:
        pose = self._smoother.graph.poses_of(node)
        if not solved:
            return Track(node, pose, np.zeros((3, 3)))
        return Track(node, pose, np.ascontiguousarray(
            self._runs.chain.noise_factor * self._smoother.covariance(node)))

    def _apply(self, turn: Turn) -> None:
        """Believe and doubt the members of runs, and the odometry between them."""
        records = self._states.records
        for number, rest, stamp_ns in turn.cuts:
            after = np.flatnonzero((records['run'] == number)
                                   & (records['stamp_ns'] >= stamp_ns))
            self._states.keep(after)
            self._states.believe(after, believed=False, now_ns=self._now_ns)
            records['run'][after] = rest
        for number, believed in turn.runs:
            self._states.believe(np.flatnonzero(records['run'] == number),
                                 believed=believed, now_ns=self._now_ns)
        self._loosened = {
            edge: 1.0 / scale for begin, end, scale in turn.jumps
            for edge in odometry_between(self._smoother.graph, begin, end).tolist()}

    def finish(self) -> None:
        """Judge all again by odometry alone, unless `final_weights` has just decided it."""
        loosened, states, decided = self._loosened, self._states, self._decided
        if not self._can_judge_all():
            return
        self._begin()
        states.keep(np.arange(len(states)))
        if decided is None:
            self._judge_all()
        else:
            self._use(decided)
        states.changed = {number: before for number, before in sorted(states.changed.items())
                          if before != bool(states.records['believed'][number])}
        change = self._with_weights(GraphUpdate(), len(states), loosened)
        if (len(change.weigh_edges) + len(change.weigh_observed) > 0
                and self._smoother.update(change).reason != ''):
            self.rollback()
        else:
            self.commit()

    def final_weights(self) -> tuple[FloatArray, FloatArray]:
        """Return the weights that `finish` would give, by row."""
        graph, records = self._smoother.graph, self._states.records
        weights = graph.weights
        if not self._can_judge_all():
            return weights
        self._begin()
        self._states.keep(np.arange(len(self._states)))
        self._judge_all()
        for kind, table, row_of in ((1, weights[0], graph.edge_rows),
                                    (0, weights[1], graph.observed_rows)):
            some = records[records['edge'] == kind]
            table[row_of(some['held'])] = some['believed']
        decided = self._decision()
        self.rollback()
        self._decided = decided
        return weights

    def _decision(self) -> _Decided:
        records = self._states.records
        return _Decided(records['run'].copy(), records['believed'].copy(),
                        self._runs, self._loosened)

    def _use(self, decided: _Decided) -> None:
        self._runs, self._loosened = decided.runs, decided.loosened
        self._states.records['run'] = decided.run
        for believed in (False, True):
            self._states.believe(np.flatnonzero(decided.believed == believed), believed=believed,
                                 now_ns=self._now_ns)

    def _can_judge_all(self) -> bool:
        return 0 < len(self._states) <= BELIEF.most_again and not self._smoother.graph.has_touched

    def _judge_all(self) -> None:
        """Judge all again, with the errors that they state; the cheaper decision is kept."""
        graph, states, present = self._smoother.graph, self._states, self._decision()
        self._runs, self._loosened = self._runs.empty(), {}
        self._runs.chain.extend(graph)
        if self._cut is not None:
            self._runs.begin_with(*self._cut)
        states.records['run'] = fs.LONE
        order = states.by_stamp()
        held, observed, stamps_ns = (
            states.records[name][order] for name in ('held', 'observed', 'stamp_ns'))
        is_edge = observed < 0
        seen = _both(graph.edges_at(held[is_edge]), graph.observed_at(observed[~is_edge]), is_edge)
        for self._again, stamp_ns, one in zip(
                order.tolist(), stamps_ns.tolist(), seen, strict=True):
            self._judge(stamp_ns, one, None)
        self._again = -1
        if np.array_equal(present.believed, states.records['believed']):
            return
        begin = None if self._cut is None else self._cut[1]
        now, before = (decision_cost(
            ((stamp_ns, one, run, believed) for stamp_ns, one, run, believed in zip(
                stamps_ns.tolist(), seen, decided.run[order].tolist(),
                (decided.believed[order] != 0).tolist(), strict=True) if one is not None),
            begin, self._runs.chain) for decided in (self._decision(), present))
        if before < now:
            self._use(present)

    def decide_leaving(
        self, edges: IntArray, observed: IntArray,
    ) -> tuple[list[Verdict], tuple[int, Track] | None]:
        """Return the verdicts on what leaves unused, and where the robot was, for `forget`."""
        graph, states = self._smoother.graph, self._states
        self._runs.chain.extend(graph)
        leaving = states.leaving(edges, observed)
        unused = np.flatnonzero(leaving & ~states.believed)
        return (fs.verdicts_on(states, graph, unused[-MOST_OTHERS:]),
                self._after(np.flatnonzero(leaving & states.believed)))

    def _after(self, numbers: IntArray) -> tuple[int, Track] | None:
        """Return where the robot was after some believed measurements, by what was before."""
        graph, chain, cut = self._smoother.graph, self._runs.chain, self._cut
        records = self._states.records[numbers]
        records = records[np.argsort(records['stamp_ns'], kind='stable')]
        is_edge = records['observed'] < 0
        seen = _both(graph.edges_at(records['held'][is_edge]),
                     graph.observed_at(records['observed'][~is_edge]), is_edge)
        for stamp_ns, one in zip(records['stamp_ns'].tolist(), seen, strict=True):
            if one is None or (cut is not None and one.node < cut[1].node):
                continue
            track = Track(one.node, graph.poses_of(one.node),
                          np.diag((BELIEF.nowhere, BELIEF.nowhere, 0.3**2)))
            if cut is not None:
                track = cut[1].moved(chain, one.node)
            cut = stamp_ns, track.updated(track.innovation(one))
        return cut

    def forget(
        self, nodes: IntArray, edges: IntArray, observed: IntArray,
        last: tuple[int, Track] | None,
    ) -> None:
        self._states.leave(self._states.leaving(edges, observed))
        self._cut, self._decided = last or self._cut, None
        if self._cut is not None:
            self._cut = self._cut[0], self._cut[1].carried(self._runs.chain, nodes)
        self._runs.forget(nodes)
        gone = {*edges.tolist()}
        if not gone.isdisjoint(self._loosened):
            self._loosened = {edge: weight for edge, weight in self._loosened.items()
                              if edge not in gone}

    def decide(self, name: str, decision: Decision) -> Answer:
        """Return the answer to a person's decision on a measurement, which is applied at once."""
        number = self._states.find(name)
        if number < 0:
            return unknown(name, has_left=self._states.has_left(name))
        record = self._states.records[number]
        believed = decision is Decision.IN or (
            decision is Decision.AUTO and self._runs.believes(int(record['run'])))
        self._begin()
        self._states.keep(np.array((number,)))
        record['decision'] = fs.AUTO
        self._states.believe(np.array((number,)), believed=believed, now_ns=self._now_ns)
        change = self._with_weights(GraphUpdate(), len(self._states), self._loosened)
        if len(self._states.changed) > 0:
            result = self._smoother.update(change)
            if result.reason != '':
                self.rollback()
                return rejected('failed', 'the solver failed with it')
        self.commit()
        self._states.records['decision'][number] = fs.DECISIONS.index(decision)
        verdict, = fs.verdicts_on(
            self._states, self._smoother.graph, np.array((number,)))
        return Answer(AnswerStatus.ACCEPTED, detail=f'{name}: {sentence(verdict)}')

    def saved(self) -> fs.SavedFixes:
        return self._states.saved(self._loosened)

    def restore(self, saved: fs.SavedFixes, now_ns: int) -> None:
        self._now_ns = now_ns
        self._states.restore(saved)
        self._loosened = dict(zip(saved.loosened.tolist(), saved.weights.tolist(), strict=True))


def _both(edges: Edges, observed: ObservedNodes, is_edge: BoolArray) -> list[Observation | None]:
    """Return the observations of two tables, in the order that `is_edge` tells."""
    tables = iter(observations(observed)), iter(biased_observations(edges))
    return [next(tables[edge]) for edge in is_edge.tolist()]
