# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Judge positions and poses in the map over time, and odometry where they contradict it.

Each is compared with where the robot is by what is believed. What agrees becomes a member of the
newest run that is believed; what does not, of another run that it agrees with, or begins one.
`runs` decides which to believe; odometry that does not explain the way between is believed less.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import BackendConfig, Robust
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray
from pose_graph_ros.core.graph.constraints import Edges, ObservedNodes
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement import fix_states as fs, fix_verdicts
from pose_graph_ros.core.judgement.consistency import OdometryChain
from pose_graph_ros.core.judgement.runs import (
    best_runs,
    EVENT,
    odometry_between,
    remembered,
    Run,
)
from pose_graph_ros.core.judgement.stated_noise import StatedNoise
from pose_graph_ros.core.judgement.texts import sentence
from pose_graph_ros.core.judgement.tracks import (
    biased_observations,
    Innovation,
    Observation,
    observations,
    Track,
)
from pose_graph_ros.core.judgement.verdicts import Decision, State
from pose_graph_ros.core.measurements import (
    Answer,
    AnswerStatus,
    HeadingOnly,
    LoopClosure,
    rejected,
)
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import NewConstraint

# More of the squared distance for a pose than for a position, so that as few are in doubt.
MORE_OF_POSE = 2.5
# A prediction with this many times the variance of the measurement begins a new run.
WIDE = 9.0
# Sigma of the heading at the beginning of a run, if it is not known better [rad], and variance of
# the position before the first measurement [m^2].
BEGIN_HEADING = 0.2
NOWHERE = 1e6
# Largest number of measurements that are all judged again at the end of a stream.
MOST_AGAIN = 100_000
# Factor on the sigmas of odometry while fixes are judged, as those that are stated are often too
# small. What sources show of them is not used: it depends on the fixes that are believed.
ODOMETRY_SCALE = 2.0
# How long what is in the graph before the first measurement counts as a run [s].
KNOWN_BEFORE = 100.0


class _Before(NamedTuple):
    """The state before an update, but for the records, of which there were `size`."""

    size: int
    runs: dict[int, Run]
    main: int
    loosened: dict[int, float]
    noise: StatedNoise


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
        self._chain = OdometryChain()
        self._chain.noise_factor = ODOMETRY_SCALE**2
        self.states = self._states = fs.FixStates()
        self._runs: list[Run] = []
        self._main: Run | None = None
        """The newest run that is believed."""
        self._n_runs = 0
        self._loosened: dict[int, float] = {}
        """Weights of odometry edges by row; replaced, never changed, so that it is not copied."""
        self._noise = StatedNoise()
        self.odometry_weight = 1.0  # in the graph, where it is not loosened
        self._restore: _Before | None = None
        self._now_ns, self._again = -1, -1
        """Newest stamp of odometry, and the record that is judged again, -1 for a new one."""

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
        self._restore, self._now_ns = self._copy(), now_ns
        graph = self._smoother.graph
        solved = not graph.has_touched
        self._chain.extend(graph)
        first, loosened = len(self._states), self._loosened
        is_edge = np.array([one.is_edge for one in judged])
        rows = np.array([one.row for one in judged])
        seen = _both(change.edges.rows(rows[is_edge] - graph.n_edges),
                     change.observed.rows(rows[~is_edge] - graph.n_observed), is_edge)
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
        for row in () if loosened is self._loosened else {*loosened, *self._loosened}:
            if loosened.get(row) != self._loosened.get(row):
                edges[row] = self.odometry_weight * self._loosened.get(row, 1.0)
        return change._replace(weigh_edges={**change.weigh_edges, **edges},
                               weigh_observed={**change.weigh_observed, **observed})

    def _copy(self) -> _Before:
        runs = {run.number: run.copy() for run in self._runs}
        return _Before(len(self._states), runs, -1 if self._main is None else self._main.number,
                       self._loosened, self._noise.copy())

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
        self._runs, self._main = list(before.runs.values()), before.runs.get(before.main)
        self._loosened, self._noise = before.loosened, before.noise
        self._restore = None

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, as long as no measurement is added."""
        before, records = self._copy(), self._states.state()

        def bring_back() -> None:
            self._states.set_state(*records)
            self._set(before)
        return bring_back

    def _judge(self, stamp_ns: int, seen: Observation | None, one: NewConstraint | None, *,
               solved: bool = False) -> None:
        """Give a measurement to a run, and decide again on the runs if one may have won."""
        if seen is None:
            return      # a heading alone
        source = (self._states.sources[self._states.records[self._again, fs.SOURCE]]
                  if one is None else one.source)
        seen = seen._replace(noise=self._noise.factor(source) * seen.noise)
        if self._main is None and solved and not np.any(self._smoother.graph.fixed):
            # with what is in the graph already
            track = self._of_graph(seen.node)
            self._main = Run(self._next_number(), stamp_ns, track, believed=True)
            self._main.seconds = KNOWN_BEFORE
            self._runs.append(self._main)
        predicted = self._predicted(seen.node, solved=solved)
        main = self._main
        if main is None or predicted is None:
            pose = self._smoother.graph.poses[seen.node].copy()
            prior = Track(seen.node, pose, np.diag((NOWHERE, NOWHERE, 0.3**2)))
            self._record(one, self._begin_run(stamp_ns, seen, prior, believed=True), 0.0)
            return
        mine = predicted.innovation(seen)
        fits = mine.d2 <= EVENT + MORE_OF_POSE * (seen.size - 2)
        late = stamp_ns < main.end_ns
        spread = float(np.trace(predicted.cov[:2, :2]) / np.trace(seen.noise[:2, :2]))
        run = None if late else self._join_other(stamp_ns, seen, mine if fits else None)
        if run is None and fits and (spread < WIDE or late):
            self._noise.note(source, mine.d2, seen.size)
            self._record(one, main, mine.d2)
            main.n += 1
            if not late:
                main.note_state(stamp_ns, predicted)
                main.count_time(stamp_ns)
                main.track = predicted.updated(mine)
                for other in self._runs:
                    other.contradicted = other.contradicted or not other.believed
            return
        if run is None and not late:
            run = self._begin_run(stamp_ns, seen, predicted, believed=fits)
        self._record(one, run, mine.d2)
        self._decide()
        self._runs = remembered(self._runs, stamp_ns)

    def _predicted(self, node: int, *, solved: bool) -> Track | None:
        """
        Return where the robot is at a node by what is believed.

        The track of the main run knows nothing of loop closures, and the graph takes the errors
        of all measurements in it for independent; the one that knows more is returned.
        """
        main = self._main
        if main is None:
            return None
        track = None
        if main.track.node <= node:
            track = main.track.moved(self._chain, node).bent(main.track.pose)
        if not solved:
            return track
        by_graph = self._of_graph(node)
        if track is None or np.trace(by_graph.cov[:2, :2]) < np.trace(track.cov[:2, :2]):
            return by_graph
        return track

    def _of_graph(self, node: int) -> Track:
        return Track(node, self._smoother.graph.poses[node].copy(),
                     np.ascontiguousarray(
            self._chain.noise_factor * self._smoother.covariance(node)))

    def _join_other(
        self, stamp_ns: int, seen: Observation, mine: Innovation | None,
    ) -> Run | None:
        """
        Add an observation to the doubted run that predicts it best.

        Where the run that is believed predicts it as well, with `mine`, another one must be more
        than a single measurement, go on at present, and predict it better.
        """
        best = np.inf if mine is None else mine.d2 + mine.spread
        chosen: tuple[Run, Track, Track] | None = None
        for run in self._runs:
            if (run.believed or stamp_ns < run.end_ns or run.track.node > seen.node or (
                    mine is not None and (run.n == 1 or run.contradicted))):
                continue
            begin, track, turned = run.predicted(seen, self._chain)
            innovation = track.innovation(seen)
            cost = innovation.d2 + innovation.spread + turned
            if innovation.d2 <= EVENT + MORE_OF_POSE * (seen.size - 2) and cost < best:
                best, chosen = cost, (run, begin, track.updated(innovation))
        if chosen is None:
            return None
        run, begin, track = chosen
        run.first = begin
        run.add(stamp_ns, seen, track, self._chain)
        if run.contradicted:
            run.number = self._next_number()
            run.restart(stamp_ns)
        return run

    def _begin_run(
        self, stamp_ns: int, seen: Observation, predicted: Track, *, believed: bool,
    ) -> Run:
        heading = max(float(predicted.cov[2, 2]), BEGIN_HEADING**2)
        alone = predicted._replace(cov=np.diag((NOWHERE, NOWHERE, heading)))
        first = alone.updated(alone.innovation(seen))
        track = predicted.updated(predicted.innovation(seen)) if believed else first
        run = Run(self._next_number(), stamp_ns, track, believed=believed)
        run.first = first
        if believed:
            self._main = run
        elif seen.size == 2:
            run.expected = float(predicted.pose[2]), float(predicted.cov[2, 2])
            run.members = (seen,)
        self._runs.append(run)
        return run

    def _next_number(self) -> int:
        self._n_runs += 1
        return self._n_runs

    def _record(self, one: NewConstraint | None, run: Run | None, d2: float) -> None:
        number, believed = (fs.LONE, False) if run is None else (run.number, run.believed)
        if one is None:
            self._states.records[self._again, fs.RUN] = number
            if bool(self._states.records[self._again, fs.BELIEVED]) != believed:
                self._states.believe(
                    np.array((self._again,)), believed=believed, now_ns=self._now_ns)
            return
        self._states.append(
            one, run=number, believed=believed, distance=math.sqrt(d2), now_ns=self._now_ns)

    def _decide(self) -> None:
        """Believe the best runs; odometry between them less than claimed, where it must be."""
        chosen = best_runs(self._runs, self._chain)
        numbers = {run.number for run, _ in chosen}
        if (all(run.believed == (run.number in numbers) for run in self._runs)
                and all(way.cut < 0 for _, way in chosen)):
            return
        for (before, _), (_, way) in pairwise(chosen):
            if way.cut >= 0:
                self._cut(before, way.cut)
        records = self._states.records
        for run in self._runs:
            if run.believed != (run.number in numbers):
                run.believed, run.contradicted = not run.believed, False
                self._states.believe(np.flatnonzero(records[:, fs.RUN] == run.number),
                                     believed=run.believed, now_ns=self._now_ns)
        newest = chosen[-1][0]
        self._main = newest
        self._loosened = {
            row: 1.0 / way.scale for (before, _), (run, way) in pairwise(chosen) if way.scale > 1.0
            for row in odometry_between(
                self._smoother.graph, before.track.node, run.first.node).tolist()}

    def _cut(self, run: Run, state: int) -> None:
        """Doubt the members of a run after a state."""
        stamp_ns = run.states[state][0]
        rest = run.cut_after(state, self._next_number())
        records = self._states.records
        after = np.flatnonzero(
            (records[:, fs.RUN] == run.number) & (records[:, fs.STAMP] >= stamp_ns))
        self._states.keep(after)
        self._states.believe(after, believed=False, now_ns=self._now_ns)
        records[after, fs.RUN] = rest.number
        self._runs.append(rest)
        for each in self._runs:
            each.prices.pop(run.number, None)

    def finish(self) -> None:
        """Judge all measurements again in the order of their stamps, by odometry alone."""
        loosened, states = self._loosened, self._states
        if not self._judge_all():
            return
        states.changed = {number: before for number, before in states.changed.items()
                          if before != bool(states.records[number, fs.BELIEVED])}
        change = self._with_weights(GraphUpdate(), len(states), loosened)
        if (len(change.weigh_edges) + len(change.weigh_observed) > 0
                and self._smoother.update(change).reason != ''):
            self.rollback()
        else:
            self.commit()

    def final_weights(self) -> tuple[FloatArray, FloatArray]:
        """Return the weights that `finish` would give."""
        weights = self._smoother.graph.weights
        if self._judge_all():
            for kind, table in ((1, weights[0]), (0, weights[1])):
                some = self._states.records[self._states.records[:, fs.EDGE] == kind]
                table[some[:, fs.ROW]] = some[:, fs.BELIEVED]
            self.rollback()
        return weights

    def _judge_all(self) -> bool:
        """
        Judge all measurements again, if that can be done; `commit` or `rollback` follows.

        Their errors are taken to be as stated, whatever was found since they came.
        """
        graph, states = self._smoother.graph, self._states
        if not 0 < len(states) <= MOST_AGAIN or graph.has_touched:
            return False
        self._restore = self._copy()
        states.keep(np.arange(len(states)))
        self._runs, self._main, self._loosened = [], None, {}
        self._noise = StatedNoise()
        self._chain.extend(graph)
        states.records[:, fs.RUN] = fs.LONE
        order = states.by_stamp()
        rows, observed, stamps_ns = states.records[order][:, (fs.ROW, fs.OBSERVED, fs.STAMP)].T
        is_edge = observed < 0
        seen = _both(graph.edges_at(rows[is_edge]), graph.observed_at(observed[~is_edge]), is_edge)
        for self._again, stamp_ns, one in zip(
                order.tolist(), stamps_ns.tolist(), seen, strict=True):
            self._judge(stamp_ns, one, None)
        self._again = -1
        return True

    def decide(self, name: str, decision: Decision) -> Answer:
        """
        Return the answer to a person's decision on a measurement, which is applied at once.

        Parameters
        ----------
        name : str, `Verdict.id`
        decision : Decision

        """
        number = self._states.find(name)
        if number < 0:
            return rejected('unknown_id', f'expected the id of a verdict, got {name!r}')
        record = self._states.records[number]
        run = next((each for each in self._runs if each.number == record[fs.RUN]), None)
        believed = decision is Decision.IN or (
            decision is Decision.AUTO and run is not None and run.believed)
        self._restore = self._copy()
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

    def restore(self, saved: fs.SavedFixes) -> None:
        """Restore what `saved` has returned, for a graph with the same rows."""
        self._states.restore(saved)
        self._loosened = dict(zip(saved.loosened.tolist(), saved.weights.tolist(), strict=True))


def _both(edges: Edges, observed: ObservedNodes, is_edge: BoolArray) -> list[Observation | None]:
    """Return the observations of two tables, in the order that `is_edge` tells."""
    tables = iter(observations(observed)), iter(biased_observations(edges))
    return [next(tables[edge]) for edge in is_edge.tolist()]
