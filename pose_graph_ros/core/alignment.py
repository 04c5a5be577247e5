# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The motion that takes the graph from the odometry frame into the map, found once and checked.

What was measured in the map waits until it tells how the odometry frame lies in it. Where most of
it may be wrong or the drive too short, only the bank of filters that also decides what to believe
(`belief`) knows how sure the heading is: it counts all that may have happened. Later the same
bank tells whether the graph was aligned by what turns out to be wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import product
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.belief import learning as ln
from pose_graph_ros.core.belief.bank import Bank, is_believed, Odometry
from pose_graph_ros.core.belief.rows import measured, Records
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.geometry.se2 import FloatArray, Poses, PoseVector
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.factors import errors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.fixes import FixJudge
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.sources.settings import SOURCES

# Sigma of the heading by which the graph is aligned, and of a measured one that does it alone: the
# user may set a pose, or a compass be all that there is [rad].
KNOWN, MEASURED_ALONE = 0.3, 0.5
# The graph is aligned anew if its heading is off by more than both [sigma, rad]; the solver
# corrects smaller differences.
OFF_SIGMAS, OFF = 4.0, 0.3
FIRST_CHECK = 8  # number of measurements at which that is looked at first
# Exponents of 2 of the variances of odometry and of sources that are tried, in units of those that
# are claimed or given. With noise of odometry that is far too large the heading is forgotten
# before it is known; with noise that is too small, or a scale that is off by a fifth, odometry
# and fixes contradict one another.
NOISES = (0.0, 0.0), (-6.0, 0.0), (6.0, 0.0), (0.0, 6.0)


class AlignmentState(Enum):
    """Whether the pose of the odometry frame in the map is known."""

    LOCAL = 'local'  # no positions in the map yet: the map is the odometry frame of the start
    # there are positions, but the angle between odometry and map is not known yet
    UNALIGNED = 'unaligned'
    ALIGNED = 'aligned'  # the graph lies in the map


@dataclass(frozen=True, slots=True)
class SavedAlignment:
    """Saved state of the alignment."""

    state: str
    sigma: float | None  # standard deviation of the angle [rad]; None for infinite
    next_verdict: int  # number of measurements at which the angle is checked next


class _Found(NamedTuple):
    sigma: float  # of the angle [rad]
    T_map_graph: FloatArray | None = None  # shape (3,); None while the angle is not known


class _Assumed(NamedTuple):
    """What a bank on all that waits takes to be so."""

    mirrored: bool  # the y axis of odometry points to the wrong side
    noise: tuple[float, float]  # one of `NOISES`
    prior: float  # logarithm of the probability of the noise


class Alignment:
    """
    Aligns the graph with the map as soon as measurements tell its heading.

    After that the heading is compared with what the bank says of all measurements, each time that
    their number has doubled since it was replaced.
    """

    def __init__(self, nodes: HiddenNodes, fixes: FixJudge) -> None:
        self._nodes, self._fixes = nodes, fixes
        self.state = AlignmentState.LOCAL
        self.sigma = np.inf  # standard deviation of the angle when it was found [rad]
        self._next_check = FIRST_CHECK
        self.forget()

    def forget(self) -> None:
        """Look at all that waits anew, as nodes have left the graph."""
        self._banks, self._sources = dict[_Assumed, Bank](), list[str]()
        # the newest that the banks have, by source and stamp, and how many they ever had
        self._seen, self._n_seen = dict[tuple[str, int], None](), 0

    def find(self, graph: Graph, waiting: Sequence[Queued]) -> FloatArray | None:
        """
        Return the motion of the graph into the map if it is found, and update the state.

        It has the shape (3,), and is None if the graph is aligned already, or the angle is not
        known well enough.
        """
        waiting = [each for each in waiting if each.is_in_map]
        if self.is_aligned or not any(each.is_placed for each in waiting):
            return None
        found, alone = self._by_bank(graph, waiting), _by_heading(graph, waiting)
        if alone.sigma <= MEASURED_ALONE and (
                found.T_map_graph is None or alone.sigma < found.sigma):
            found = alone
        self.state = (AlignmentState.UNALIGNED if found.T_map_graph is None
                      else AlignmentState.ALIGNED)
        self.sigma = found.sigma
        return found.T_map_graph

    def _assume(self, sources: list[str]) -> None:
        """Begin with empty banks for some sources."""
        self.forget()
        self._sources, given = sources, self._fixes.known(sources).point
        of_all = ln.Known((), odometry=True, sources=tuple(range((len(given) - 2) // 3)))
        white = [ln.axes_of(source)[0] for source in of_all.sources]
        for mirrored, noise in product((False, True), NOISES):
            more = {ln.WAY: noise[0], ln.TURN: noise[0]} | dict.fromkeys(white, noise[1])
            prior = ln.log_prior(ln.moved(ln.claimed(len(white)), more), of_all)
            self._banks[_Assumed(mirrored, noise, prior)] = Bank(ln.noise_at(tuple(
                exponent + more.get(axis, 0.0) for axis, exponent in enumerate(given))))

    def _rows(self, waiting: Sequence[Queued]) -> Records:
        """Return rows for what the banks do not have yet."""
        new = [each for each in waiting if (each.source, each.stamp_ns) not in self._seen]
        self._seen |= dict.fromkeys((each.source, each.stamp_ns) for each in new)
        # no more than wait at most: the older ones do not come again
        for key in list(self._seen)[:-SOURCES.most_unaligned] if len(new) > 0 else ():
            del self._seen[key]
        rows = measured(Factors.joined([each.factor for each in new]),
                        [each.stamp_ns for each in new], np.arange(len(new)).tolist())
        own = [new[k] for k in rows['id'].tolist()]
        rows['id'] += self._n_seen
        self._n_seen += len(new)
        rows['source'] = [min(self._sources.index(one.source), BANK.sources - 1) for one in own]
        rows['judged'] = [not self._fixes.trusts(one.source, one.measured) for one in own]
        return rows

    def _by_bank(self, graph: Graph, waiting: Sequence[Queued]) -> _Found:
        """Return the motion that the hypotheses on all positions tell."""
        sources = sorted({each.source for each in waiting})
        if not {*sources} <= {*self._sources}:
            self._assume(sources)
        rows, likely = self._rows(waiting), dict[_Assumed, float]()
        self._fixes.prepare()
        odometry = self._fixes.odometry()
        for assumed, bank in self._banks.items():
            if len(rows) > 0:
                bank.insert(*(_mirrored(rows, odometry) if assumed.mirrored else (rows, odometry)))
            bank.decide()
            if len(bank) > SOURCES.most_unaligned:
                bank.forget(np.arange(self._n_seen - len(waiting), self._n_seen), len(waiting))
            likely[assumed] = bank.evidence + assumed.prior
        straight, turned_over = ([each for each in self._banks if each.mirrored is of]
                                 for of in (False, True))
        best = max(straight, key=lambda each: likely[each])
        bank = self._banks[best]
        if len(bank) == 0:
            return _Found(np.inf)
        # as with a left-handed frame
        is_mirrored = (max(likely[each] for each in turned_over)
                       > likely[best] + BANK.noise_evidence)
        weights = [math.exp(likely[each] - likely[best]) for each in straight]
        some = [self._banks[each] for each in straight]
        off = se2.wrap(np.array([each.spread.pose[2] for each in some]) - bank.spread.pose[2])
        sigma = math.sqrt(np.average(
            np.array([each.heading_sigma for each in some])**2 + off**2, weights=weights))
        if sigma > KNOWN or is_mirrored or not np.any(is_believed(bank.told(0).choice)):
            return _Found(sigma)
        node = int(bank.rows['node'][-1])
        return _Found(sigma, se2.compose(bank.spread.pose, se2.inverse(graph.poses_of(node))))

    def check(self, graph: Graph) -> FloatArray | None:
        """
        Return new poses of all rows of the graph if its heading is wrong.

        The poses are those of odometry, moved into the map, shape (N, 3), with biases of 0; None
        if the heading is not checked or not wrong.
        """
        if self.is_aligned and len(self._banks) > 0:
            self.forget()   # nothing waits any more
        bank, nodes, n_seen = self._fixes.bank, self._nodes, self._fixes.n_seen
        # where the robot was put elsewhere by hand, the path is not that of odometry
        if (not self.is_aligned or n_seen < self._next_check or len(nodes.relocated) > 0
                or len(bank) == 0 or bank.done < len(bank)):
            return None
        node, pose = int(bank.rows['node'][-1]), bank.spread.pose
        if graph.node_rows(node) < 0 or node < nodes.ids[nodes.n_frozen]:
            return None
        off = abs(float(se2.wrap(pose[2] - graph.poses_of(node)[2])))
        if off <= OFF or off <= OFF_SIGMAS * bank.heading_sigma:
            return None
        self._next_check = 2 * n_seen
        ids = nodes.ids[nodes.n_frozen:]
        rows, there = graph.node_rows(ids), nodes.odometry[np.searchsorted(ids, node)]
        moved = se2.compose(se2.compose(pose, se2.inverse(there)), nodes.odometry)
        # what is no hidden node of the path any more keeps its place beside the oldest one
        kept = rows >= 0
        moved, rows = moved[kept], rows[kept]
        poses = se2.compose(moved[0], se2.between(graph.poses[rows[0]], graph.poses))
        poses[graph.is_bias] = 0.0
        poses[rows] = moved
        return poses

    @property
    def is_aligned(self) -> bool:
        """Whether the graph lies in the map."""
        return self.state is AlignmentState.ALIGNED

    def saved(self) -> SavedAlignment:
        """Return the state."""
        return SavedAlignment(
            self.state.value, float(self.sigma) if np.isfinite(self.sigma) else None,
            self._next_check)

    def load(self, saved: SavedAlignment) -> None:
        """Set the state to a saved one."""
        self.state = AlignmentState(saved.state)
        self.sigma = np.inf if saved.sigma is None else saved.sigma
        self._next_check = saved.next_verdict


def _mirrored(rows: Records, odometry: Odometry) -> tuple[Records, Odometry]:
    """Return rows of measurements and odometry as if the y axis of the robot were turned over."""
    given = rows.copy()
    given['offset'] *= (1.0, -1.0, -1.0)
    return given, odometry._replace(
        poses=odometry.poses * (1.0, -1.0, -1.0),
        sums=odometry.sums * (1.0, -1.0, -1.0, 1.0, 1.0, 1.0),
        errors=odometry.errors._replace(rate=-odometry.errors.rate))


def _by_heading(graph: Graph, waiting: Sequence[Queued]) -> _Found:
    """Return the motion by the most certain heading, at its position or at those of others."""
    if all(each.factor.kind[0] == FactorKind.POSITION for each in waiting):
        return _Found(np.inf)
    observed = Factors.joined([each.factor for each in waiting])
    sigma, full = np.full(len(observed), np.inf), observed.kind == FactorKind.GLOBAL_POSE
    placed = observed.kind != FactorKind.HEADING
    sigma[full] = np.sqrt(np.linalg.inv(observed.information[full])[:, 2, 2])
    sigma[~placed] = observed.information[~placed, 2, 2]**-0.5
    best = int(np.argmin(sigma))
    predicted = se2.compose(graph.poses_of(observed.i), observed.offset)
    theta = float(se2.wrap(observed.mean[best, 2] - predicted[best, 2]))
    used = np.array([best]) if full[best] else np.flatnonzero(placed)
    weight = np.trace(observed.information[used, :2, :2], axis1=1, axis2=2)
    shift = np.average(
        observed.mean[used, :2] - predicted[used, :2] @ se2.rotation(theta).T, axis=0,
        weights=weight)
    return _Found(float(sigma[best]), np.array((*shift, theta)))


def guess(poses: Poses, newest: PoseVector, observed: Factors) -> tuple[FloatArray, FloatArray]:
    """
    Return a shift of the graph into the map and a covariance while the angle is not known.

    The graph is shifted, without a turn, onto the most certain position. The covariance is that of
    the shifted pose of the robot in map axes. With d the distance from there and an angle that is
    uniform on the circle, the mean square error of each coordinate is d^2, that of the heading
    pi^2 / 3.
    """
    certainty = np.trace(observed.information[:, :2, :2], axis1=1, axis2=2)
    best = int(np.argmax(certainty))
    first = observed.rows(slice(best, best + 1))
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(first.mean[0, 2])
    shift = -(turn @ errors(poses, first)[0])
    shift[2] = 0.0
    where = se2.compose(poses[first.i], first.offset)[0]
    variance = float(np.sum((newest[:2] - where[:2])**2) + 2.0 / certainty[best])
    return shift, np.diag((variance, variance, UNKNOWN_HEADING_VARIANCE))
