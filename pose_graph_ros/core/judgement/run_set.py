# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The runs of measurements that agree with one another, and which of them are believed at present.

Each measurement is compared with where the robot is by what is believed. What agrees becomes a
member of the newest run that is believed; what does not, of another run that it agrees with, or
begins one. `runs` has the prices by which it is decided which of them to believe.
"""

from collections.abc import Iterable, Iterator
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.judgement.fix_states import LONE
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.runs import Run, slip_price, Transition
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.tracks import Innovation, Observation, Track

# Median of chi2 with 2 and 3 degrees of freedom.
MEDIAN = {2: 1.386, 3: 2.366}


class Turn(NamedTuple):
    """What a decision changes."""

    # runs whose members from a stamp on are doubted: number, that of a new run with these, and the
    # stamp [ns]
    cuts: list[tuple[int, int, int]]
    runs: list[tuple[int, bool]]  # numbers of other runs that are believed now, or not any more
    # all jumps of odometry that are believed: the nodes between which one is, and the factor on
    # the covariance of the odometry between them that makes it one of 1 sigma
    jumps: list[tuple[int, int, float]]


class Given(NamedTuple):
    """The run that a measurement was given to."""

    run: int
    believed: bool  # whether that is believed, before `turn`
    d2: float  # squared Mahalanobis distance from what is believed
    turn: Turn | None = None  # what is decided anew by the measurement


class RunSet:
    def __init__(self) -> None:
        self.chain = OdometryChain()
        self.chain.noise_factor = BELIEF.odometry_scale**2
        self._runs: list[Run] = []
        self._main: Run | None = None  # the newest run that is believed
        self._n_runs = 0
        # Factors on the covariances that sources state, at least 1, while measurements are judged:
        # each follows the median of the squared distances of those that are believed.
        self._noise: dict[str, float] = {}

    def __iter__(self) -> Iterator[Run]:
        return iter(self._runs)

    def copy(self) -> 'RunSet':
        """Return a copy that does not change with this one, but for the chain of odometry."""
        other = RunSet()
        runs = {run.number: run.copy() for run in self._runs}
        other.chain, other._n_runs = self.chain, self._n_runs
        other._runs = list(runs.values())
        other._main = None if self._main is None else runs.get(self._main.number)
        other._noise = dict(self._noise)
        return other

    def empty(self) -> 'RunSet':
        """Return one without runs, along the same odometry."""
        other = RunSet()
        other.chain, other._n_runs = self.chain, self._n_runs
        return other

    def believes(self, number: int) -> bool:
        return any(run.believed for run in self._runs if run.number == number)

    def judge(
        self, stamp_ns: int, seen: Observation, source: str, of_graph: Track, *, solved: bool,
        begun: bool,
    ) -> Given:
        """Return the run that a measurement is given to, and what is decided anew on all runs."""
        seen = seen._replace(noise=self._noise.get(source, 1.0) * seen.noise)
        if self._main is None and solved and begun:
            self._main = Run(self._next_number(), stamp_ns, of_graph, believed=True)
            self._main.seconds = BELIEF.known_before
            self._runs.append(self._main)
        predicted = self._predicted(seen.node, of_graph if solved else None)
        main = self._main
        if main is None or predicted is None:
            prior = of_graph._replace(cov=np.diag((BELIEF.nowhere, BELIEF.nowhere, 0.3**2)))
            return Given(self._begin_run(stamp_ns, seen, prior, believed=True).number, True, 0.0)
        mine = predicted.innovation(seen)
        fits = mine.d2 <= gate(seen.size)
        late = stamp_ns < main.end_ns
        cov, noise = predicted.cov, seen.noise
        wide = cov[0, 0] + cov[1, 1] >= BELIEF.wide_prediction * (noise[0, 0] + noise[1, 1])
        run = None if late else self._join_other(stamp_ns, seen, mine if fits else None, wide=wide)
        if run is None and fits and (not wide or late):
            self._note_noise(source, mine.d2, seen.size)
            main.n += 1
            if not late:
                self._go_on(main, stamp_ns, predicted, mine)
            return Given(main.number, True, mine.d2)
        if run is None and late:
            return self._decided(Given(LONE, False, mine.d2), stamp_ns)
        if run is None:
            run = self._begin_run(stamp_ns, seen, predicted, believed=fits)
        return self._decided(Given(run.number, run.believed, mine.d2), stamp_ns)

    def _note_noise(self, source: str, d2: float, size: int) -> None:
        step = BELIEF.noise_step if d2 > MEDIAN[size] else -BELIEF.noise_step
        factor = self._noise.get(source, 1.0) * math.exp(step)
        self._noise[source] = min(max(factor, 1.0), BELIEF.most_noise)

    def _go_on(self, main: Run, stamp_ns: int, predicted: Track, mine: Innovation) -> None:
        main.note_state(stamp_ns, predicted)
        main.count_time(stamp_ns)
        main.track = predicted.updated(mine)
        for other in self._runs:
            other.contradicted = other.contradicted or not other.believed

    def _predicted(self, node: int, of_graph: Track | None) -> Track | None:
        """Return where the robot is by what is believed: by the main run or the graph."""
        main = self._main
        if main is None:
            return None
        if main.track.node > node:
            return of_graph
        track = main.track.moved(self.chain, node).bent(main.track.pose)
        if of_graph is not None and np.trace(of_graph.cov[:2, :2]) < np.trace(track.cov[:2, :2]):
            return of_graph
        return track

    def _join_other(
        self, stamp_ns: int, seen: Observation, mine: Innovation | None, *, wide: bool,
    ) -> Run | None:
        """
        Add an observation to the doubted run that predicts it best.

        Where the run that is believed predicts it as well, with `mine`, another one must go on at
        present and predict it better, and be more than a single measurement: but where that
        prediction is `wide`, each of a row of wrong ones would begin a run, and count for itself.
        """
        best = np.inf if mine is None else mine.d2 + mine.spread
        chosen: tuple[Run, Track, Track] | None = None
        for run in self._runs:
            if (run.believed or stamp_ns < run.end_ns or run.track.node > seen.node or (
                    mine is not None and ((run.n == 1 and not wide) or run.contradicted))):
                continue
            begin, track, turned = run.predicted(seen, self.chain)
            innovation = track.innovation(seen)
            cost = innovation.d2 + innovation.spread + turned
            if innovation.d2 <= gate(seen.size) and cost < best:
                best, chosen = cost, (run, begin, track.updated(innovation))
        if chosen is None:
            return None
        run, begin, track = chosen
        run.first = begin
        run.add(stamp_ns, seen, track, self.chain)
        if run.contradicted:
            run.number = self._next_number()
            run.restart(stamp_ns)
        return run

    def _begin_run(
        self, stamp_ns: int, seen: Observation, predicted: Track, *, believed: bool,
    ) -> Run:
        heading = max(float(predicted.cov[2, 2]), BELIEF.begin_heading**2)
        alone = predicted._replace(cov=np.diag((BELIEF.nowhere, BELIEF.nowhere, heading)))
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

    def _decided(self, given: Given, stamp_ns: int) -> Given:
        turn = self._decide()
        self._runs = remembered(self._runs, stamp_ns)
        return given._replace(turn=turn)

    def _decide(self) -> Turn | None:
        """Believe the best runs; odometry between them less than claimed, where it must be."""
        chosen = best_runs(self._runs, self.chain)
        numbers = {run.number for run, _ in chosen}
        if (all(run.believed == (run.number in numbers) for run in self._runs)
                and all(way.cut < 0 for _, way in chosen)):
            return None
        cuts = [self._cut(before, way.cut) for (before, _), (_, way) in pairwise(chosen)
                if way.cut >= 0]
        turned = [run for run in self._runs if run.believed != (run.number in numbers)]
        for run in turned:
            run.believed, run.contradicted = not run.believed, False
        self._main = chosen[-1][0]
        return Turn(cuts, [(run.number, run.believed) for run in turned], [
            *chosen[0][0].jumps_before, *(
                (before.track.node, run.first.node, way.scale)
                for (before, _), (run, way) in pairwise(chosen) if way.scale > 1.0)])

    def forget(self, nodes: IntArray) -> None:
        """Forget nodes that have left the graph, with the runs that ended there."""
        stay = self.chain.nodes[~np.isin(self.chain.nodes, nodes)]
        if len(stay) > 0 and len(stay) < len(self.chain):
            first = int(stay[0])
            self._runs = without_old(self._runs, first, self._main, self.chain)
            kept = {run.number: run.carry(self.chain, nodes) for run in self._runs}
            for run in self._runs:
                run.states_left(kept)
                run.jumps_before = tuple(jump for jump in run.jumps_before if jump[1] >= first)
        self.chain.forget(nodes)

    def begin_with(self, stamp_ns: int, track: Track) -> None:
        """Begin with where the robot is by measurements that have left the graph."""
        self._main = Run(self._next_number(), stamp_ns, track, believed=True)
        self._main.seconds = BELIEF.known_before
        self._runs.append(self._main)

    def _cut(self, run: Run, state: int) -> tuple[int, int, int]:
        stamp_ns = run.states[state][0]
        rest = run.cut_after(state, self._next_number())
        self._runs.append(rest)
        for each in self._runs:
            each.prices.pop(run.number, None)
        return run.number, rest.number, stamp_ns


def gate(size: int) -> float:
    """Return the squared distance beyond which a measurement of 2 or 3 numbers is in doubt."""
    return BELIEF.event + BELIEF.more_of_pose * (size - 2)




def best_runs(runs: list[Run], chain: OdometryChain) -> list[tuple[Run, Transition]]:
    """Return the runs to believe, in the order of time, each with the way from the one before."""
    ordered = sorted(runs, key=lambda run: (run.begin_ns, run.number))
    total: list[float] = []
    before: list[tuple[int, Transition]] = []
    for k, run in enumerate(ordered):
        cost, best = run.before, (-1, Transition(0.0))
        for m, other in enumerate(ordered[:k]):
            for way in run.ways_after(other, chain):
                price = total[m] + way.price
                if way.cut >= 0:
                    lasted = (other.end_ns - other.states[way.cut][0]) * 1e-9
                    if not any(wrong.n > 1 and wrong.seconds >= lasted
                               for wrong in ordered[m + 1:k]):
                        # no wrong run follows that they could be the beginning of
                        price += BELIEF.event
                if price < cost:
                    cost, best = price, (m, way)
        total.append(cost - run.price)
        before.append(best)
    k, chosen = int(np.argmin(total)), []
    while k >= 0:
        chosen.append((ordered[k], before[k][1]))
        k = before[k][0]
    return chosen[::-1]


def remembered(runs: list[Run], stamp_ns: int) -> list[Run]:
    """Return the runs without those that cannot win any more, and at most `most_runs` of them."""
    price = max((run.price for run in runs if run.believed), default=0.0)
    runs = [run for run in runs if run.believed or not (
        (run.n < BELIEF.least_members and stamp_ns - run.end_ns > BELIEF.short_lived_ns)
        or (run.contradicted and price > run.price + BELIEF.hopeless_run))]
    while len(runs) > BELIEF.most_runs:
        doubted = [run for run in runs if not run.believed]
        runs.remove(min(doubted, key=lambda run: run.seconds) if len(doubted) > 0
                    else min(runs, key=lambda run: run.begin_ns))
    return runs


def without_old(runs: list[Run], node: int, kept: Run | None, chain: OdometryChain) -> list[Run]:
    """
    Return the runs without those that ended before a node, whose prices pass on to those after.
    """
    left = sorted(runs, key=lambda run: (run.begin_ns, run.number))
    for old in [run for run in left if run.track.node < node and run is not kept]:
        left.remove(old)
        for run in left:
            for way in run.ways_after(old, chain):
                price = old.before - old.price + way.price
                if way.cut < 0 and price < run.before:
                    jump = (old.track.node, run.first.node, way.scale)
                    run.before = price
                    run.jumps_before = old.jumps_before + ((jump,) if way.scale > 1.0 else ())
            run.prices.pop(old.number, None)
    return [run for run in runs if run in left]


def decision_cost(
    decided: Iterable[tuple[int, Observation, int, bool]], begin: Track | None,
    chain: OdometryChain,
) -> float:
    """
    Return the sum of the squared distances of all measurements and the prices of what is wrong.

    The decision has stamp [ns], observation, number of its run, and whether it is believed, by
    stamp; `begin` is where the robot is by what is not among them.
    """
    total, main = 0.0, begin
    wrong: dict[int, tuple[int, Track]] = {}
    for stamp_ns, seen, run, believed in decided:
        before_ns, before = (stamp_ns, main) if believed else wrong.get(run, (stamp_ns, None))
        if not believed:
            total += BELIEF.event if before is None else BELIEF.wrong_rate * min(
                (stamp_ns - before_ns) * 1e-9, BELIEF.longest_wrong)
        if before is None:
            known = seen.mean if main is None else main.moved(chain, seen.node).pose
            after = Track(seen.node, known, np.diag(
                (BELIEF.nowhere, BELIEF.nowhere, BELIEF.begin_heading**2)))
        else:
            after = before.moved(chain, seen.node).bent(before.pose)
            d2, most = after.innovation(seen).d2, gate(seen.size)
            total += min(d2, most)
            if believed and d2 > most:
                price, after = _slipped(before, after, seen, chain)
                total += min(price, d2 - most)
        after = after.updated(after.innovation(seen))
        if believed:
            main = after
        elif run != LONE:
            wrong[run] = stamp_ns, after
    return total


def _slipped(
    before: Track, after: Track, seen: Observation, chain: OdometryChain,
) -> tuple[float, Track]:
    error, _, cov, _, _ = after.innovation(seen)
    size = math.hypot(error[0], error[1])
    way = float(np.diff(chain.travel(np.array((before.node, seen.node))))[0])
    slip = np.diag((*2 * ((BELIEF.slip**2 + size**2) / 3.0,), BELIEF.slip_heading**2))
    price = slip_price(size, 0.5 * float(cov[0, 0] + cov[1, 1]), way)
    return price, after._replace(cov=after.cov + slip)
