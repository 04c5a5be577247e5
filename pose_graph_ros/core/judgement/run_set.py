# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The runs of measurements that agree with one another, and which of them are believed at present.

Each measurement is compared with where the robot is by what is believed. What agrees becomes a
member of the newest run that is believed; what does not, of another run that it agrees with, or
begins one. `runs` has the prices by which it is decided which of them to believe.
"""

from collections.abc import Iterator
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.judgement.fix_states import LONE
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.runs import EVENT, LEAST_MEMBERS, Run, Transition
from pose_graph_ros.core.judgement.tracks import Innovation, Observation, Track

# More of the squared distance for a pose than for a position, so that as few are in doubt.
MORE_OF_POSE = 2.5
# A prediction with this many times the variance of the measurement begins a new run.
WIDE = 9.0
# Sigma of the heading at the beginning of a run, if it is not known better [rad], and variance of
# the position before the first measurement [m^2].
BEGIN_HEADING = 0.2
NOWHERE = 1e6
# Factor on the sigmas of odometry while fixes are judged, as those that are stated are often too
# small. What sources show of them is not used: it depends on the fixes that are believed.
ODOMETRY_SCALE = 2.0
# Change of the logarithm of the factor of a source by one measurement, and the largest factor. Its
# memory is about a hundred measurements, so that a fault of a minute hardly changes it.
STEP, MOST = 0.03, 4.0
# Median of chi2 with 2 and 3 degrees of freedom.
MEDIAN = {2: 1.386, 3: 2.366}
# How long what is in the graph before the first measurement counts as a run [s].
KNOWN_BEFORE = 100.0


class Turn(NamedTuple):
    """What a decision changes."""

    cuts: list[tuple[int, int, int]]
    """Runs whose members from a stamp on are doubted: number, that of a new run with these, and
    the stamp [ns]."""
    runs: list[tuple[int, bool]]
    """Numbers of other runs that are believed now, or not any more."""
    jumps: list[tuple[int, int, float]]
    """
    All jumps of odometry that are believed: the nodes between which one is, and the factor on the
    covariance of the odometry between them that makes it one of 1 sigma.
    """


class Given(NamedTuple):
    """The run that a measurement was given to."""

    run: int
    believed: bool
    """Whether that is believed, before `turn`."""
    d2: float
    """Squared Mahalanobis distance from what is believed."""
    turn: Turn | None = None
    """What is decided anew by the measurement."""


class StatedNoise:
    """
    Factors on the covariances that sources state, at least 1, while measurements are judged.

    Each follows the median of the squared distances of those that are believed.
    """

    def __init__(self) -> None:
        self._factors: dict[str, float] = {}

    def factor(self, source: str) -> float:
        """Return the factor of a source."""
        return self._factors.get(source, 1.0)

    def note(self, source: str, d2: float, size: int) -> None:
        """
        Note the squared distance of a measurement that is believed.

        Parameters
        ----------
        d2 : float, by the covariance with the factor
        size : int, 2 of a position, 3 of a pose

        """
        factor = self.factor(source) * math.exp(STEP if d2 > MEDIAN[size] else -STEP)
        self._factors[source] = min(max(factor, 1.0), MOST)

    def copy(self) -> 'StatedNoise':
        """Return a copy that does not change with this one."""
        other = StatedNoise()
        other._factors = self._factors.copy()
        return other


class RunSet:
    """All runs that are remembered; see the module."""

    def __init__(self) -> None:
        self.chain = OdometryChain()
        self.chain.noise_factor = ODOMETRY_SCALE**2
        self._runs: list[Run] = []
        self._main: Run | None = None
        """The newest run that is believed."""
        self._n_runs = 0
        self._noise = StatedNoise()

    def __iter__(self) -> Iterator[Run]:
        return iter(self._runs)

    def copy(self) -> 'RunSet':
        """Return a copy that does not change with this one, but for the chain of odometry."""
        other = RunSet()
        runs = {run.number: run.copy() for run in self._runs}
        other.chain, other._n_runs = self.chain, self._n_runs
        other._runs = list(runs.values())
        other._main = None if self._main is None else runs.get(self._main.number)
        other._noise = self._noise.copy()
        return other

    def empty(self) -> 'RunSet':
        """Return one without runs, along the same odometry."""
        other = RunSet()
        other.chain, other._n_runs = self.chain, self._n_runs
        return other

    def believes(self, number: int) -> bool:
        """Return whether a run is remembered and believed."""
        return any(run.believed for run in self._runs if run.number == number)

    def judge(
        self, stamp_ns: int, seen: Observation, source: str, of_graph: Track, *, solved: bool,
        begun: bool,
    ) -> Given:
        """
        Return the run that a measurement is given to, and what is decided anew on all runs.

        Parameters
        ----------
        seen : Observation, with the covariance that is stated
        of_graph : Track, pose of its node in the graph
        solved : bool, whether the graph is solved, so that the covariance of that is known
        begun : bool, whether what is in the graph before the first measurement counts as a run

        """
        seen = seen._replace(noise=self._noise.factor(source) * seen.noise)
        if self._main is None and solved and begun:
            self._main = Run(self._next_number(), stamp_ns, of_graph, believed=True)
            self._main.seconds = KNOWN_BEFORE
            self._runs.append(self._main)
        predicted = self._predicted(seen.node, of_graph if solved else None)
        main = self._main
        if main is None or predicted is None:
            prior = of_graph._replace(cov=np.diag((NOWHERE, NOWHERE, 0.3**2)))
            return Given(self._begin_run(stamp_ns, seen, prior, believed=True).number, True, 0.0)
        mine = predicted.innovation(seen)
        fits = mine.d2 <= gate(seen.size)
        late = stamp_ns < main.end_ns
        cov, noise = predicted.cov, seen.noise
        wide = cov[0, 0] + cov[1, 1] >= WIDE * (noise[0, 0] + noise[1, 1])
        run = None if late else self._join_other(stamp_ns, seen, mine if fits else None, wide=wide)
        if run is None and fits and (not wide or late):
            self._noise.note(source, mine.d2, seen.size)
            main.n += 1
            if not late:
                self._go_on(main, stamp_ns, predicted, mine)
            return Given(main.number, True, mine.d2)
        if run is None and late:
            return self._decided(Given(LONE, False, mine.d2), stamp_ns)
        if run is None:
            run = self._begin_run(stamp_ns, seen, predicted, believed=fits)
        return self._decided(Given(run.number, run.believed, mine.d2), stamp_ns)

    def _go_on(self, main: Run, stamp_ns: int, predicted: Track, mine: Innovation) -> None:
        """Let the run that is believed go on with a measurement that fits."""
        main.note_state(stamp_ns, predicted)
        main.count_time(stamp_ns)
        main.track = predicted.updated(mine)
        for other in self._runs:
            other.contradicted = other.contradicted or not other.believed

    def _predicted(self, node: int, of_graph: Track | None) -> Track | None:
        """
        Return where the robot is at a node by what is believed.

        The track of the main run knows nothing of loop closures, and the graph takes the errors
        of all measurements in it for independent; the one that knows more is returned.
        """
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
        """
        Begin with where the robot is by measurements that have left the graph.

        Parameters
        ----------
        stamp_ns : int, of the newest of these

        """
        self._main = Run(self._next_number(), stamp_ns, track, believed=True)
        self._main.seconds = KNOWN_BEFORE
        self._runs.append(self._main)

    def _cut(self, run: Run, state: int) -> tuple[int, int, int]:
        """Doubt the members of a run after a state."""
        stamp_ns = run.states[state][0]
        rest = run.cut_after(state, self._next_number())
        self._runs.append(rest)
        for each in self._runs:
            each.prices.pop(run.number, None)
        return run.number, rest.number, stamp_ns


def gate(size: int) -> float:
    """Return the squared distance beyond which a measurement of 2 or 3 numbers is in doubt."""
    return EVENT + MORE_OF_POSE * (size - 2)


# Number of runs that are remembered; time after which those of few members are forgotten [ns].
MOST_RUNS = 24
SHORT_LIVED_NS = 30_000_000_000
# Excess of the price of a believed run over that of a hopeless one.
HOPELESS = 50.0


def best_runs(runs: list[Run], chain: OdometryChain) -> list[tuple[Run, Transition]]:
    """
    Return the runs to believe, in the order of time, each with the way from the one before.

    Parameters
    ----------
    runs : list of Run, at least one

    """
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
                        price += EVENT  # no wrong run follows that they could be the beginning of
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
    """
    Return the runs without those that cannot win any more, and at most `MOST_RUNS` of them.

    Parameters
    ----------
    stamp_ns : int, of the newest measurement

    """
    price = max((run.price for run in runs if run.believed), default=0.0)
    runs = [run for run in runs if run.believed or not (
        (run.n < LEAST_MEMBERS and stamp_ns - run.end_ns > SHORT_LIVED_NS)
        or (run.contradicted and price > run.price + HOPELESS))]
    while len(runs) > MOST_RUNS:
        doubted = [run for run in runs if not run.believed]
        runs.remove(min(doubted, key=lambda run: run.seconds) if len(doubted) > 0
                    else min(runs, key=lambda run: run.begin_ns))
    return runs


def without_old(runs: list[Run], node: int, kept: Run | None, chain: OdometryChain) -> list[Run]:
    """
    Return the runs without those that ended before a node; their prices pass on to those after.

    The rest of the shortest path through all of them stays the same.

    Parameters
    ----------
    node : int, id of the first node that stays in the graph
    kept : Run, optional, that stays

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
