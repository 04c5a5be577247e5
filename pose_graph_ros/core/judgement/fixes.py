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
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.fix_states import FixStates, LONE
from pose_graph_ros.core.judgement.judgements import MOST_OTHERS, NEW, SavedVerdicts
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.run_set import decision_cost, RunSet, Turn
from pose_graph_ros.core.judgement.runs import odometry_between
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.texts import sentence, unknown
from pose_graph_ros.core.judgement.tracks import (
    Observation,
    observations,
    Track,
)
from pose_graph_ros.core.judgement.verdicts import (
    AUTO,
    BELIEVED,
    Decision,
    DECISIONS,
    DOUBTED,
    Verdict,
)
from pose_graph_ros.core.measurements import (
    Answer,
    AnswerStatus,
    HeadingOnly,
    LoopClosure,
    rejected,
)
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import NewConstraint


class _Decided(NamedTuple):
    """What is decided on all measurements in the map, at some time."""

    run: IntArray
    state: IntArray  # of each record, both of shape (M,)
    runs: RunSet
    # weights of odometry edges by id; replaced, never changed, so that it is not copied
    loosened: dict[int, float]


class FixJudge:
    def __init__(
        self, smoother: IncrementalSmoother, reweighting: Reweighting, config: BackendConfig,
    ) -> None:
        self._smoother, self._reweighting, self._config = smoother, reweighting, config
        self.states = self._states = FixStates()
        self._runs = RunSet()
        self._loosened: dict[int, float] = {}
        self._before: _Decided | None = None  # during an update, what was decided before it
        self._final: _Decided | None = None  # what `final_weights` has found
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
        self._now_ns, before = now_ns, self._begin()
        graph = self._smoother.graph
        solved = not graph.has_touched
        self._runs.chain.extend(graph)
        seen = observations(change.factors.rows(
            np.array([one.number for one in judged]) - graph.next_ids.factor))
        for one, each in zip(judged, seen, strict=True):
            self._judge(one.stamp_ns, each, one, solved=solved)
        return self._with_weights(change, before)

    def _with_weights(self, change: GraphUpdate, before: _Decided) -> GraphUpdate:
        """Return an update with the weights of new records and of those that have changed."""
        weights, loosened = self._states.weights(before.state, self._reweighting), before.loosened
        for edge in () if loosened is self._loosened else {*loosened, *self._loosened}:
            if loosened.get(edge) != self._loosened.get(edge):
                weights[edge] = self._loosened.get(edge, 1.0)
        return change._replace(weigh={**change.weigh, **weights})

    @property
    def chain(self) -> OdometryChain:
        return self._runs.chain

    def _begin(self) -> _Decided:
        self._before, self._final = self._decided(), None
        return self._before

    def _decided(self) -> _Decided:
        return _Decided(self._states.run.copy(), self._states.state.copy(), self._runs.copy(),
                        self._loosened)

    def _decide(self, decided: _Decided) -> None:
        """Make it what is decided; what has come since is taken away."""
        self._states.truncate(len(decided.run))
        self._states.run[:], self._states.state[:] = decided.run, decided.state
        self._runs, self._loosened = decided.runs, decided.loosened

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
            self._before = None

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, as long as no measurement is added."""
        before, records_back = self._decided(), self._states.snapshot()

        def bring_back() -> None:
            self._decide(before)
            records_back()
        return bring_back

    def _judge(self, stamp_ns: int, seen: Observation | None, one: NewConstraint | None, *,
               solved: bool = False) -> None:
        """Give a measurement, a new one or else the record `_again`, to a run."""
        if seen is None:
            return      # a heading alone
        states = self._states
        source = (states.sources[states.source[self._again]]
                  if one is None else one.source)
        begun = not np.any(self._smoother.graph.fixed)
        given = self._runs.judge(
            stamp_ns, seen, source, self._of_graph(seen.node, solved=solved),
            solved=solved, begun=begun)
        if one is not None:
            states.append(one, self._now_ns, BELIEVED if given.believed else DOUBTED,
                          math.sqrt(given.d2), run=given.run)
        else:
            states.run[self._again] = given.run
            states.believe(np.array((self._again,)), believed=given.believed)
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
        states = self._states
        for number, rest, stamp_ns in turn.cuts:
            after = np.flatnonzero(
                (states.run == number) & (states.stamps_ns[:, 0] >= stamp_ns))
            states.believe(after, believed=False)
            states.run[after] = rest
        for number, believed in turn.runs:
            states.believe(np.flatnonzero(states.run == number), believed=believed)
        self._loosened = {
            edge: 1.0 / scale for begin, end, scale in turn.jumps
            for edge in odometry_between(self._smoother.graph, begin, end).tolist()}

    def finish(self) -> None:
        """Judge all again by odometry alone, unless `final_weights` has just decided it."""
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
        """Judge all again, with the errors that they state; the cheaper decision is kept."""
        graph, states, present = self._smoother.graph, self._states, self._decided()
        self._runs, self._loosened = self._runs.empty(), {}
        self._runs.chain.extend(graph)
        if self._cut is not None:
            self._runs.begin_with(*self._cut)
        states.run[:] = LONE
        order = states.by_stamp()
        stamps_ns, seen = states.stamps_ns[order, 0], self._seen(order)
        for self._again, stamp_ns, one in zip(
                order.tolist(), stamps_ns.tolist(), seen, strict=True):
            self._judge(stamp_ns, one, None)
        self._again = -1
        if np.array_equal(present.state, states.state):
            return
        begin = None if self._cut is None else self._cut[1]
        now, before = (decision_cost(
            ((stamp_ns, one, run, believed) for stamp_ns, one, run, believed in zip(
                stamps_ns.tolist(), seen, decided.run[order].tolist(),
                (decided.state[order] == BELIEVED).tolist(), strict=True) if one is not None),
            begin, self._runs.chain) for decided in (self._decided(), present))
        if before < now:
            self._decide(present)

    def _seen(self, numbers: IntArray) -> list[Observation | None]:
        """Return the observations of some records, as they were added."""
        return observations(self._smoother.graph.factors_at(self._states.added[numbers]))

    def decide_leaving(
        self, factors: IntArray,
    ) -> tuple[list[Verdict], tuple[int, Track] | None]:
        """Return the verdicts on what leaves unused, and where the robot was, for `forget`."""
        graph, states = self._smoother.graph, self._states
        self._runs.chain.extend(graph)
        leaving = states.leaving(factors)
        unused = np.flatnonzero(leaving & ~states.believed)
        return (states.verdicts(graph, unused[-MOST_OTHERS:]),
                self._after(np.flatnonzero(leaving & states.believed)))

    def _after(self, numbers: IntArray) -> tuple[int, Track] | None:
        """Return where the robot was after some believed measurements, by what was before."""
        graph, chain, cut = self._smoother.graph, self._runs.chain, self._cut
        stamps_ns = self._states.stamps_ns[numbers, 0]
        order = np.argsort(stamps_ns, kind='stable')
        for stamp_ns, one in zip(
                stamps_ns[order].tolist(), self._seen(numbers[order]), strict=True):
            if one is None or (cut is not None and one.node < cut[1].node):
                continue
            track = Track(one.node, graph.poses_of(one.node),
                          np.diag((BELIEF.nowhere, BELIEF.nowhere, 0.3**2)))
            if cut is not None:
                track = cut[1].moved(chain, one.node)
            cut = stamp_ns, track.updated(track.innovation(one))
        return cut

    def forget(
        self, nodes: IntArray, factors: IntArray, last: tuple[int, Track] | None,
    ) -> None:
        leaving = self._states.leaving(factors)
        if np.any(leaving):
            self._states.select(np.flatnonzero(~leaving))
        self._cut, self._final = last or self._cut, None
        if self._cut is not None:
            self._cut = self._cut[0], self._cut[1].carried(self._runs.chain, nodes)
        self._runs.forget(nodes)
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
            decision is Decision.AUTO and self._runs.believes(int(states.run[number])))
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
        self._now_ns = now_ns
        self._states.restore(saved)
        self._loosened = dict(loosened)
