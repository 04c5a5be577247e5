# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Runs of measurements that agree with one another by odometry, and which runs to believe.

Where consecutive fixes do not agree, either some of them are wrong, or odometry is. Each has a
price in units of chi2:

- a run of wrong measurements costs `event`, and `rate` for each second that it lasts: errors live
  for seconds to minutes, so a hundred fixes within one correlation time count as one;
- two runs that are believed one after the other cost the squared Mahalanobis distance between
  them, or, if odometry has slipped in between, `event` and as much as a slip of this size is less
  likely than a fault of the receiver: slips are rarer and go less far, mostly not beyond the way.

`run_choice` finds the set of runs with the lowest price.
"""

from collections.abc import Mapping, Sequence
import copy
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import fit_motion
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.tracks import Innovation, Observation, Track

NO_OFFSET = np.zeros(3)


class Transition(NamedTuple):
    price: float
    # factor on the covariance of the odometry in between that explains the jump
    scale: float = 1.0
    # index of the state of the earlier run after which its members are wrong; -1 for none
    cut: int = -1


class Run:
    """Measurements that agree with one another, one after the other."""

    def __init__(self, number: int, stamp_ns: int, track: Track, *, believed: bool) -> None:
        self.number = number  # counts the runs
        self.believed = believed
        self.track = track  # by the newest member
        # heading at the first member without the run, and its variance; None if it is a pose
        self.expected: tuple[float, float] | None = None
        # the ways to believe it after an earlier run, by the number of that
        self.prices: dict[int, list[Transition]] = {}
        # stamps [ns] and tracks at some earlier times, the newest last
        self.states: list[tuple[int, Track]] = []
        # the first ones, while they may tell the heading
        self.members: tuple[Observation, ...] = ()
        self.before = 0.0  # price of what is believed before it, of runs that have left the graph
        # jumps of odometry up to it with these; see `run_set.Turn`
        self.jumps_before: tuple[tuple[int, int, float], ...] = ()
        # price of its direction, once its first member has left the graph
        self._turned: float | None = None
        self.restart(stamp_ns)

    def restart(self, stamp_ns: int) -> None:
        """Begin with the newest member, as something else was believed since the others."""
        self.begin_ns = self.end_ns = stamp_ns
        self.first = self.track  # pose at the first member, by the members after it as well
        self.n = 1
        self.seconds = 0.0  # how long it has lasted, without gaps [s]
        self.contradicted = False  # whether something else was believed since its newest member
        self.prices.clear()
        self.members = ()

    def copy(self) -> 'Run':
        other = copy.copy(self)
        other.prices = dict(self.prices)
        return other

    def add(self, stamp_ns: int, seen: Observation, track: Track, chain: OdometryChain) -> None:
        if len(self.members) == self.n < BELIEF.fitted_members:
            self.members += (seen,)
        self.n += 1
        self.count_time(stamp_ns)
        self.track = track
        if self.n <= BELIEF.begin_members and not self.believed:
            self._improve_begin(seen, chain)

    def predicted(self, seen: Observation, chain: OdometryChain) -> tuple[Track, Track, float]:
        """
        Return the pose at the begin and that at an observation, and the price of the turn.

        After an outage or a turn of the wheels on the spot the heading of odometry may be far
        off. So where the first positions lie as odometry says, but turned, they tell the heading.
        """
        end = self.track.moved(chain, seen.node)
        if (len(self.members) != self.n or self.expected is None or seen.size == 3
                or end.innovation(seen).d2 <= BELIEF.event):
            return self.first, end, 0.0
        begin = fitted((*self.members, seen), chain)
        if begin is None:
            return self.first, end, 0.0
        end = begin
        for member in self.members[1:]:
            end = end.moved(chain, member.node)
            end = end.updated(end.innovation(member))
        return begin, end.moved(chain, seen.node), BELIEF.event

    def count_time(self, stamp_ns: int) -> None:
        if stamp_ns > self.end_ns:
            self.seconds += min((stamp_ns - self.end_ns) * 1e-9, BELIEF.longest_wrong)
            self.end_ns = stamp_ns

    def _improve_begin(self, seen: Observation, chain: OdometryChain) -> None:
        if _way(chain, self.first.node, seen.node) > BELIEF.begin_way:
            return
        begin = self.first
        end = begin.moved(chain, seen.node)
        innovation = end.innovation(seen)
        # the jacobian by the pose at the beginning: a turn there moves the end
        back = np.eye(3)
        back[0, 2] = -(end.pose[1] - begin.pose[1])
        back[1, 2] = end.pose[0] - begin.pose[0]
        self.first = begin.updated(innovation._replace(jacobian=innovation.jacobian @ back))
        self.prices.clear()

    @property
    def price(self) -> float:
        """What it costs if its measurements are wrong."""
        return BELIEF.event + BELIEF.wrong_rate * self.seconds + self.turned

    @property
    def turned(self) -> float:
        """Price of a wrong path that is turned; an offset by one vector keeps its direction."""
        if self._turned is not None:
            return self._turned
        if self.expected is None or self.seconds < BELIEF.turn_after:
            return 0.0
        heading, variance = self.expected
        turn = float(se2.wrap(self.first.pose[2] - heading))
        d2 = turn**2 / (variance + float(self.first.cov[2, 2]))
        return min(max(d2 - BELIEF.turn_allowed, 0.0), BELIEF.most_of_turn)

    def note_state(self, stamp_ns: int, track: Track) -> None:
        """Note where the robot was, if it was not noted lately, and fewer of the older times."""
        if len(self.states) == 0 or stamp_ns - self.states[-1][0] >= BELIEF.noted_every_ns:
            self.states = [*_thinned(self.states, stamp_ns)[1 - BELIEF.noted:], (stamp_ns, track)]

    def ways_after(self, other: 'Run', chain: OdometryChain) -> Sequence[Transition]:
        if other.end_ns > self.begin_ns or (
                other.number not in self.prices and self.first.node < other.track.node):
            return ()
        if other.number not in self.prices:
            self.prices[other.number] = self._ways_after(other, chain)
        return self.prices[other.number]

    def _ways_after(self, other: 'Run', chain: OdometryChain) -> list[Transition]:
        ways = [self._price_of_jump(other.track, chain)]
        if ways[0].price <= BELIEF.cut_above or self.n < BELIEF.least_members:
            return ways
        # the last members may be the beginning of an error that grows
        cuts = []
        for cut, (stamp_ns, track) in enumerate(other.states):
            d2 = self._jump(track, chain).d2
            if d2 <= BELIEF.event:
                cuts.append(Transition(
                    d2 + BELIEF.wrong_rate * (other.end_ns - stamp_ns) * 1e-9, 1.0, cut))
        return [*ways, min(cuts)] if len(cuts) > 0 else ways

    def _jump(self, track: Track, chain: OdometryChain) -> Innovation:
        """Return the jump to the beginning of the run from what odometry predicts."""
        begin = Observation(self.first.node, NO_OFFSET, self.first.pose, self.first.cov)
        return track.moved(chain, begin.node).bent(track.pose).innovation(begin)

    def _price_of_jump(self, track: Track, chain: OdometryChain) -> Transition:
        jump, _, cov, d2, _ = self._jump(track, chain)
        if d2 <= BELIEF.event:
            return Transition(d2)
        if self.n < BELIEF.least_members:
            return Transition(math.inf)
        way = _way(chain, track.node, self.first.node)
        price = slip_price(math.hypot(jump[0], jump[1]), 0.5 * float(cov[0, 0] + cov[1, 1]), way)
        turn2 = float(jump[2]**2 / (cov[2, 2] + BELIEF.slip_heading**2))
        return Transition(min(BELIEF.event + price + turn2, d2), self._scale(track, jump, chain))

    def carry(self, chain: OdometryChain, nodes: IntArray) -> dict[int, int]:
        """Take poses to nodes that stay; return new indices of the states left by old ones."""
        gone = {*nodes.tolist()}
        kept = [k for k, state in enumerate(self.states) if state[1].node not in gone]
        self.states = [self.states[k] for k in kept]
        if any(member.node in gone for member in self.members):
            self.members = ()
        if self.first.node in gone:
            self._turned = self.turned
            self.first = self.first.carried(chain, nodes)
        self.track = self.track.carried(chain, nodes)
        return {old: new for new, old in enumerate(kept)}

    def states_left(self, kept: Mapping[int, Mapping[int, int]]) -> None:
        """Adapt the ways from other runs, by their numbers, to what `carry` has returned."""
        for number in kept.keys() & self.prices.keys():
            self.prices[number] = [
                way._replace(cut=kept[number].get(way.cut, -1)) for way in self.prices[number]
                if way.cut < 0 or way.cut in kept[number]]

    def cut_after(self, state: int, number: int) -> 'Run':
        """
        Return a run of the members after a noted state, after taking them away from this one.
        """
        stamp_ns, track = self.states[state]
        rest = Run(number, stamp_ns, track, believed=False)
        rest.track, rest.end_ns = self.track, self.end_ns
        rest.seconds = (self.end_ns - stamp_ns) * 1e-9
        rest.n = max(int(self.n * rest.seconds / max(self.seconds, 1e-9)), 1)
        rest.contradicted, rest.before, rest.jumps_before = True, self.before, self.jumps_before
        self.seconds = max(self.seconds - rest.seconds, 0.0)
        self.end_ns, self.track, self.states = stamp_ns - 1, track, self.states[:state]
        return rest

    def _scale(self, track: Track, jump: FloatArray, chain: OdometryChain) -> float:
        """Return the factor on the covariance of odometry that makes a jump one of 1 sigma."""
        begin = track._replace(cov=np.zeros((3, 3)))
        gap = begin.moved(chain, self.first.node).cov[:2, :2]
        size2 = float(jump[0]**2 + jump[1]**2)
        along = float(jump[:2] @ gap @ jump[:2]) / max(size2, 1e-12)
        return max(size2 / max(along, 0.03**2), 1.0)


def _thinned(states: list[tuple[int, Track]], now_ns: int) -> list[tuple[int, Track]]:
    """Return the states without those whose neighbours' ages differ by less than a factor."""
    kept: list[tuple[int, Track]] = []
    for k, state in enumerate(states):
        after = states[k + 1][0] if k + 1 < len(states) else now_ns
        before = kept[-1][0] if len(kept) > 0 else None
        if before is None or now_ns - before > BELIEF.noted_ratio * (now_ns - after):
            kept.append(state)
    return kept


def fitted(seen: Sequence[Observation], chain: OdometryChain) -> Track | None:
    """Return the pose at the first position that puts odometry on all, or None."""
    begin = Track(seen[0].node, np.zeros(3), np.zeros((3, 3)))
    here = np.array([se2.transform(
        begin.moved(chain, each.node).pose[None], each.offset[None, :2])[0] for each in seen])
    there = np.array([each.mean[:2] for each in seen])
    variance = float(np.mean([np.trace(each.noise) for each in seen])) / 2.0
    spread = float(np.sum((here - here.mean(axis=0))**2))
    if variance > BELIEF.fitted_heading**2 * spread:
        return None
    pose = fit_motion(here, there)
    off = there - se2.transform(pose, here)
    if float(np.sum(off**2)) > BELIEF.fitted_d2 * len(seen) * variance:
        return None
    lever = float(np.sum(here.mean(axis=0)**2)) / spread
    position = variance * (1.0 / len(seen) + lever)
    return Track(seen[0].node, pose, np.diag((position, position, variance / spread)))


def slip_price(size: float, variance: float, way: float) -> float:
    """
    Return how much less likely a slip of odometry is than a fault of a receiver, as twice the log.

    Both have sizes [m] with a Cauchy density in the plane, broadened by the variance of a
    coordinate of what odometry predicts over a way [m].
    """
    slip, fault = (0.5 * math.log(scale**2 + variance) - 1.5 * math.log(
        scale**2 + variance + size**2) for scale in (BELIEF.slip, BELIEF.fault))
    unmoved = min(max((size - way) / BELIEF.unmoved_way, 0.0), 1.0)
    return max(2.0 * (math.log(BELIEF.slips_rarer) + fault - slip) + BELIEF.unmoved * unmoved, 0.0)


def _way(chain: OdometryChain, begin: int, end: int) -> float:
    first, last = chain.travel(np.array((begin, end))).tolist()
    return float(last - first)


def odometry_between(graph: Graph, begin: int, end: int) -> IntArray:
    """
    Return the ids of odometry edges between two nodes, or of those around them if they are one.
    """
    factors = graph.factor_records
    odometry = np.flatnonzero(factors['kind'] == FactorKind.ODOMETRY)
    i, j, _ = graph.node_ids[factors['ends'][odometry]].T
    inside = (i < end) & (j > begin) if end > begin else (i == end) | (j == end)
    return np.asarray(graph.factor_ids[odometry[inside]])
