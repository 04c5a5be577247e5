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
from pose_graph_ros.core.judgement import fix_states as fs, fix_verdicts
from pose_graph_ros.core.judgement.decision_cost import decision_cost
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.run_set import NOWHERE, RunSet, Turn
from pose_graph_ros.core.judgement.runs import odometry_between
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
from pose_graph_ros.core.sources.constraint_queue import NewConstraint

# Largest number of measurements that are all judged again at the end of a stream.
MOST_AGAIN = 100_000


class _Before(NamedTuple):
    """The state before an update, but for the records, of which there were `size`."""

    size: int
    runs: RunSet
    loosened: dict[int, float]


class _Decided(NamedTuple):
    """A decision on all measurements."""

    run: IntArray
    believed: IntArray
    """Of each record, both of shape (M,)."""
    runs: RunSet
    loosened: dict[int, float]


class FixJudge:
    """
    Judges positions and poses in the map; see the module.

    Parameters
    ----------
    smoother, reweighting, config : as in `Judge`

    """

    def __init__(
        self, smoother: IncrementalSmoother, reweighting: Reweighting, config: BackendConfig,
    ) -> None:
        self._smoother, self._reweighting, self._config = smoother, reweighting, config
        self.states = self._states = fs.FixStates()
        self._runs = RunSet()
        self._loosened: dict[int, float] = {}
        """Weights of odometry edges by id; replaced, never changed, so that it is not copied."""
        self._restore: _Before | None = None
        self._decided: _Decided | None = None
        self._cut: tuple[int, Track] | None = None
        """Stamp [ns] of the newest believed measurement that has left, and where the robot was."""
        self._now_ns, self._again = -1, -1
        """Newest stamp of odometry, and the record that is judged again, -1 for a new one."""

    @property
    def loosened(self) -> Mapping[int, float]:
        """Weights of the odometry edges, by id, that are believed less than claimed."""
        return self._loosened

    def configure(self, config: BackendConfig) -> None:
        """Set the settings for later measurements."""
        self._config = config

    def before(
        self, new: Sequence[NewConstraint], change: GraphUpdate, now_ns: int,
    ) -> GraphUpdate:
        """
        Return an update in which all rows have the weights that the new ones make right.

        Parameters
        ----------
        new : sequence of NewConstraint, what the new rows were made from, in the order of stamps
        change : GraphUpdate, that adds them
        now_ns : int, stamp of the newest odometry

        """
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
                edges[edge] = self.weight_of_odometry(edge)
        return change._replace(weigh_edges={**change.weigh_edges, **edges},
                               weigh_observed={**change.weigh_observed, **observed})

    @property
    def chain(self) -> OdometryChain:
        """The odometry between hidden nodes, as the judge knows it."""
        return self._runs.chain

    def weight_of_odometry(self, edge: int) -> float:
        """Return the weight that an odometry edge has, by its id, as far as fixes know."""
        return self._loosened.get(edge, 1.0)

    def _begin(self) -> None:
        self._restore, self._decided = self._copy(), None

    def _copy(self) -> _Before:
        return _Before(len(self._states), self._runs.copy(), self._loosened)

    def commit(self) -> None:
        """Keep what the last `before` has decided, after its update has succeeded."""
        if self._restore is None:
            return
        self._states.set_base_weights(self._restore.size, self._reweighting)
        for number, before in self._states.changed.items():
            if before != bool(self._states.records[number, fs.BELIEVED]):
                self._states.announce(number, State.BELIEVED if before else State.DOUBTED)
        self._states.forget()
        self._restore = None

    def rollback(self) -> None:
        """Forget the last `before`, as its update has failed."""
        if self._restore is not None:
            self._states.undo(self._restore.size)
            self._set(self._restore)

    def _set(self, before: _Before) -> None:
        self._runs, self._loosened, self._restore = before.runs, before.loosened, None

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, as long as no measurement is added."""
        before, records = self._copy(), self._states.state()

        def bring_back() -> None:
            self._states.set_state(*records)
            self._set(before)
        return bring_back

    def _judge(self, stamp_ns: int, seen: Observation | None, one: NewConstraint | None, *,
               solved: bool = False) -> None:
        """Give a measurement, a new one or else the record `_again`, to a run."""
        if seen is None:
            return      # a heading alone
        states = self._states
        source = (states.sources[states.records[self._again, fs.SOURCE]]
                  if one is None else one.source)
        begun = not np.any(self._smoother.graph.fixed)
        given = self._runs.judge(
            stamp_ns, seen, source, self._of_graph(seen.node, solved=solved),
            solved=solved, begun=begun)
        if one is not None:
            states.append(one, run=given.run, believed=given.believed,
                          distance=math.sqrt(given.d2), now_ns=self._now_ns)
        else:
            states.records[self._again, fs.RUN] = given.run
            if bool(states.records[self._again, fs.BELIEVED]) != given.believed:
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
            after = np.flatnonzero((records[:, fs.RUN] == number)
                                   & (records[:, fs.STAMP] >= stamp_ns))
            self._states.keep(after)
            self._states.believe(after, believed=False, now_ns=self._now_ns)
            records[after, fs.RUN] = rest
        for number, believed in turn.runs:
            self._states.believe(np.flatnonzero(records[:, fs.RUN] == number),
                                 believed=believed, now_ns=self._now_ns)
        self._loosened = {
            edge: 1.0 / scale for begin, end, scale in turn.jumps
            for edge in odometry_between(self._smoother.graph, begin, end).tolist()}

    def finish(self) -> None:
        """
        Judge all measurements again in the order of their stamps, by odometry alone.

        What `final_weights` has decided since the last measurement came is not decided twice.
        """
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
                          if before != bool(states.records[number, fs.BELIEVED])}
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
            some = records[records[:, fs.EDGE] == kind]
            table[row_of(some[:, fs.HELD])] = some[:, fs.BELIEVED]
        decided = self._decision()
        self.rollback()
        self._decided = decided
        return weights

    def _decision(self) -> _Decided:
        records = self._states.records
        return _Decided(records[:, fs.RUN].copy(), records[:, fs.BELIEVED].copy(),
                        self._runs, self._loosened)

    def _use(self, decided: _Decided) -> None:
        self._runs, self._loosened = decided.runs, decided.loosened
        self._states.records[:, fs.RUN] = decided.run
        for believed in (False, True):
            self._states.believe(np.flatnonzero(decided.believed == believed), believed=believed,
                                 now_ns=self._now_ns)

    def _can_judge_all(self) -> bool:
        return 0 < len(self._states) <= MOST_AGAIN and not self._smoother.graph.has_touched

    def _judge_all(self) -> None:
        """
        Judge all measurements again, and keep the present decision if it is the cheaper one.

        Their errors are taken to be as stated, whatever was found since they came.
        """
        graph, states, present = self._smoother.graph, self._states, self._decision()
        self._runs, self._loosened = self._runs.empty(), {}
        self._runs.chain.extend(graph)
        if self._cut is not None:
            self._runs.begin_with(*self._cut)
        states.records[:, fs.RUN] = fs.LONE
        order = states.by_stamp()
        held, observed, stamps_ns = states.records[order][:, (fs.HELD, fs.OBSERVED, fs.STAMP)].T
        is_edge = observed < 0
        seen = _both(graph.edges_at(held[is_edge]), graph.observed_at(observed[~is_edge]), is_edge)
        for self._again, stamp_ns, one in zip(
                order.tolist(), stamps_ns.tolist(), seen, strict=True):
            self._judge(stamp_ns, one, None)
        self._again = -1
        if np.array_equal(present.believed, states.records[:, fs.BELIEVED]):
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
        """
        Return the verdicts on measurements that are about to leave the graph unused.

        With them comes where the robot was at the newest one that is believed, for `forget`.

        Parameters
        ----------
        edges, observed : ndarray of int, ids of what leaves

        """
        graph, states = self._smoother.graph, self._states
        self._runs.chain.extend(graph)
        leaving = states.leaving(edges, observed)
        unused = np.flatnonzero(leaving & ~states.believed)
        return (fix_verdicts.verdicts_on(states, graph, unused[-MOST_OTHERS:]),
                self._after(np.flatnonzero(leaving & states.believed)))

    def _after(self, numbers: IntArray) -> tuple[int, Track] | None:
        """Return where the robot was after some believed measurements, by what was before."""
        graph, chain, cut = self._smoother.graph, self._runs.chain, self._cut
        records = self._states.records[numbers]
        records = records[np.argsort(records[:, fs.STAMP], kind='stable')]
        is_edge = records[:, fs.OBSERVED] < 0
        seen = _both(graph.edges_at(records[is_edge, fs.HELD]),
                     graph.observed_at(records[~is_edge, fs.OBSERVED]), is_edge)
        for stamp_ns, one in zip(records[:, fs.STAMP].tolist(), seen, strict=True):
            if one is None or (cut is not None and one.node < cut[1].node):
                continue
            track = Track(one.node, graph.poses_of(one.node), np.diag((NOWHERE, NOWHERE, 0.3**2)))
            if cut is not None:
                track = cut[1].moved(chain, one.node)
            cut = stamp_ns, track.updated(track.innovation(one))
        return cut

    def forget(
        self, nodes: IntArray, edges: IntArray, observed: IntArray,
        last: tuple[int, Track] | None,
    ) -> None:
        """
        Forget measurements that have left the graph, and the path there.

        Parameters
        ----------
        nodes, edges, observed : ndarray of int, ids
        last : tuple, optional, the second result of `decide_leaving`, if a measurement has left

        """
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
        """
        Return the answer to a person's decision on a measurement, which is applied at once.

        Parameters
        ----------
        name : str, `Verdict.id`

        """
        number = self._states.find(name)
        if number < 0:
            return unknown(name, has_left=self._states.has_left(name))
        record = self._states.records[number]
        believed = decision is Decision.IN or (
            decision is Decision.AUTO and self._runs.believes(int(record[fs.RUN])))
        self._begin()
        self._states.keep(np.array((number,)))
        record[fs.DECISION] = fs.AUTO
        self._states.believe(np.array((number,)), believed=believed, now_ns=self._now_ns)
        change = self._with_weights(GraphUpdate(), len(self._states), self._loosened)
        if len(self._states.changed) > 0:
            result = self._smoother.update(change)
            if result.reason != '':
                self.rollback()
                return rejected('failed', 'the solver failed with it')
        self.commit()
        self._states.records[number, fs.DECISION] = fs.DECISIONS.index(decision)
        verdict, = fix_verdicts.verdicts_on(
            self._states, self._smoother.graph, np.array((number,)))
        return Answer(AnswerStatus.ACCEPTED, detail=f'{name}: {sentence(verdict)}')

    def saved(self) -> fs.SavedFixes:
        """Return the state; the runs are not part of it."""
        return self._states.saved(self._loosened)

    def restore(self, saved: fs.SavedFixes, now_ns: int) -> None:
        """
        Restore what `saved` has returned, for the same graph.

        Parameters
        ----------
        now_ns : int, stamp of the newest hidden node

        """
        self._now_ns = now_ns
        self._states.restore(saved)
        self._loosened = dict(zip(saved.loosened.tolist(), saved.weights.tolist(), strict=True))


def _both(edges: Edges, observed: ObservedNodes, is_edge: BoolArray) -> list[Observation | None]:
    """Return the observations of two tables, in the order that `is_edge` tells."""
    tables = iter(observations(observed)), iter(biased_observations(edges))
    return [next(tables[edge]) for edge in is_edge.tolist()]
