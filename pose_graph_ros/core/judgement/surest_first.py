# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A set of believed constraints of a whole graph: the surest ones first.

With S the covariance of the error that a constraint would have by what is believed already, it
passes the gate if `e^T S^-1 e` is small. A wrong one, whose error could be anything, passes with a
chance that is proportional to the volume of the gate, and so to sqrt(det S). So constraints are
believed in the order of this volume: first those that span little odometry, then those that these
make sure. Wrong ones meet a narrow gate in the end, also where many of them agree with each other.
Closures that no neighbour agrees with come later than others of the same volume.

None is believed where those that fit odometry could be wrong ones that fit by chance.

What is believed also shows how large errors really are. Where covariances are far too large, the
limits are lowered; else a wrong constraint would fit wherever the graph is claimed to be soft.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import gammainc

from pose_graph_ros.core.batch.truncated import TruncatedProblem
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.core.judgement.belief_rule import WRONG_ODDS
from pose_graph_ros.core.judgement.closures import GATE, NEAR
from pose_graph_ros.core.judgement.consistency import Closures, squared_distances
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.smoother import innovations
from pose_graph_ros.core.smoother.innovations import Innovations

# Factor on the volume of the surest constraint that passes, up to which others count as equal.
ROUND = 4.0
# Maximum number of rounds.
ROUNDS = 200
# Factor on the volume by the number of neighbours that agree: none, one, more.
ALONE = (1000.0, 30.0, 1.0)
# Maximum number of closures that one is compared with, in one direction.
MOST_COMPARED = 200
# A constraint that was thrown out this often is doubted.
THROWN_OUT = 2
# Number of believed constraints that lower the limits, share of them and its chi2 with three
# degrees of freedom, the factor that the limits keep above what they show, and the least limits.
ENOUGH, SHARE, SHARE_LIMIT = 50, 0.9, 6.25
MARGIN, LEAST_SCALE = 3.0, 0.02
# Volumes shrink: those above this times the volume of the round are not looked at in it.
REACH = 20.0
# Number of those with the smallest volumes, at least, that are looked at before all others, and
# their share; both double after each round in which most of these were believed.
SOME, SOME_SHARE = 200, 1.0 / 16.0
# Least size of a group of closures that agree. If wrong groups give as many that fit odometry with
# more than this chance, and so do wrong ones outside of groups, nothing is believed.
GROUP, BY_CHANCE = 3, 0.1
# Size of a place [m]; a candidate with more than this chance to fit tells nothing, and fewer than
# so many candidates tell too little.
PLACE = 20.0
MOST_CHANCE, ENOUGH_TELL = 0.5, 8
# What is not measured of an error could be anything within this [m, m, rad].
EXTENT = np.array([100.0, 100.0, 2.0 * np.pi])


def select(problem: TruncatedProblem, *, insured: bool = False) -> BoolArray | None:
    """
    Return a set of believed constraints, shape (M,), and lower the limits of the problem.

    None if the graph cannot be solved without any of them.

    Parameters
    ----------
    insured : bool
        Whether more is asked: a constraint with fewer than two neighbours that agree is believed
        only if a wrong one would hardly pass its gate, and none if chance explains all that fit
        odometry. What is kept out so is not allowed in later sets either.

    """
    believed = np.zeros(len(problem), dtype=bool)
    if not problem.solve(believed.astype(np.float64)):
        return None
    gates = _Gates(problem)
    if insured and not gates.show_more_than_chance():
        problem.allowed[:] = False
        return believed
    thrown = np.zeros(len(problem), dtype=np.int64)
    seen, scale, level, more = np.zeros(len(problem)), 1.0, 0.0, 1
    kept_out = np.zeros(len(problem), dtype=bool)

    def sure(numbers: IntArray, believed: BoolArray) -> IntArray:
        return numbers[gates.is_sure(numbers, believed, scale)] if insured else numbers

    for _ in range(ROUNDS):
        waiting = np.flatnonzero(~believed & (thrown < THROWN_OUT))
        gates.begin_round()
        n_some = 0
        passing = sure(gates.passing(waiting, scale, REACH * level), believed)
        if not np.any(gates.volume[passing] <= level):
            n_some = more * max(SOME, int(SOME_SHARE * len(waiting)))
            some = np.sort(gates.volume[waiting])[:n_some]
            passing = sure(gates.passing(waiting, scale, np.max(some, initial=0.0)), believed)
            if len(passing) == 0:
                everything = gates.passing(waiting, scale, np.inf)
                passing = sure(everything, believed)
                kept_out[:] = False
                kept_out[np.setdiff1d(everything, passing)] = True
            if len(passing) == 0:
                break
            level = max(level, ROUND * float(np.min(gates.volume[passing])))
        new = passing[gates.volume[passing] <= level]
        seen[new] = gates.share[new]
        believed[new] = True
        if np.sum(believed) >= ENOUGH:
            shown = float(np.quantile(seen[believed], SHARE)) * GATE / SHARE_LIMIT
            scale = min(max(MARGIN * shown, LEAST_SCALE), 1.0)
        if not problem.solve(believed.astype(np.float64), go_on=True):
            return None
        wrong = believed & (problem.energies() > problem.limits)
        if np.any(wrong):
            thrown[wrong] += 1
            believed[wrong] = False
            if not problem.solve(believed.astype(np.float64), go_on=True):
                return None
        more = 2 * more if 0 < n_some <= 2 * len(new) and not np.any(wrong) else 1
    problem.limits = scale * problem.limits
    problem.allowed &= ~kept_out
    return believed


def n_supported(problem: TruncatedProblem) -> int:
    """Return the number of closures that at least two neighbours agree with."""
    return int(np.sum(_n_agreeing(problem, agreeing_pairs(problem)) >= 2))


class _Gates:
    """The gates of all constraints of a problem, as they were when each was last computed."""

    def __init__(self, problem: TruncatedProblem) -> None:
        self._problem = problem
        self._information = problem.edges.information
        measured = np.einsum('mii->mi', self._information) > 0.0
        filled = self._information + np.einsum('mi,ij->mij', ~measured, np.eye(3))
        with np.errstate(divide='ignore'):
            own = np.prod(np.where(measured, 1.0, EXTENT), axis=1) / np.sqrt(
                np.abs(np.linalg.det(filled)))
        self._pairs = agreeing_pairs(problem)
        self._agreeing = np.minimum(_n_agreeing(problem, self._pairs), 2)
        self._own = own * np.asarray(ALONE)[self._agreeing]
        self._covariances = np.full((len(problem), 3, 3), np.nan)
        """J P J^T of each; they never grow while more is believed."""
        self.volume = np.zeros(len(problem))
        self.share = np.zeros(len(problem))
        """Squared Mahalanobis distance, in limits."""
        self._present = np.zeros(len(problem), dtype=bool)
        """Which were computed in this round."""
        self._begin_with_odometry()

    def _begin_with_odometry(self) -> None:
        """
        Set the gates of closures to those by odometry alone, which are the largest.

        The tree of a graph without closures is as deep as the path is long, so those that are not
        among the surest are computed by it only later, when it is flat.
        """
        problem, chain = self._problem, OdometryChain(weighted=True)
        chain.extend(problem.graph)
        chained = np.zeros(problem.graph.n_nodes, dtype=bool)
        chained[chain.nodes] = True
        numbers = np.flatnonzero(chained[problem.edges.i] & chained[problem.edges.j])
        some = problem.edges.rows(numbers)
        pose, covariance = chain.between(some.i, some.j)
        # from the axes of the predicted pose to those of the measured one
        turn = np.zeros((len(numbers), 3))
        turn[:, 2] = pose[:, 2] - some.mean[:, 2]
        axes = se2.adjoint(turn)
        self._set(numbers, axes @ covariance @ np.swapaxes(axes, 1, 2))

    def begin_round(self) -> None:
        """Compute gates again where they are asked for, as the graph has changed."""
        self._present[:] = False

    def passing(self, waiting: IntArray, scale: float, reach: float) -> IntArray:
        """
        Return those that pass their gates.

        Parameters
        ----------
        waiting : ndarray of int, shape (K,), numbers of constraints
        scale : float, factor on the limits
        reach : float, volume that was computed last above which one is not looked at

        """
        near = waiting[self.volume[waiting] <= reach]
        if len(near) == 0:
            return near
        # as S only shrinks, what is outside of an old gate is outside of the present one
        old = np.nan_to_num(self._squared(near, self._problem.errors(near)), nan=0.0)
        limits = scale * self._problem.limits
        near = near[old <= limits[near]]
        self._compute(near[~self._present[near]])
        return near[self.share[near] <= scale]

    def is_sure(self, numbers: IntArray, believed: BoolArray, scale: float) -> BoolArray:
        """
        Return whether neighbours or the odds are for constraints that pass their gates.

        The chance of a wrong one to pass is the part of all errors that its gate lets through; the
        share of wrong ones is that of those that do not pass, or were not looked at yet.

        Parameters
        ----------
        numbers : ndarray of int, shape (K,)
        believed : ndarray of bool, shape (M,)
        scale : float, factor on the limits

        """
        chance = self._chances(numbers)
        n_believed, rest = np.sum(believed), ~believed
        passing = rest & (self.volume > 0.0) & (self.share <= scale)
        n_wrong = int(np.sum(rest)) - int(np.sum(passing))
        return (self._agreeing[numbers] >= 2) | (
            (n_wrong + 1.0) * chance < WRONG_ODDS * (n_believed + 1.0))

    def _chances(self, numbers: IntArray) -> FloatArray:
        """Return the chances of wrong constraints to pass their gates, shape (K,)."""
        alone = np.asarray(ALONE)[self._agreeing[numbers]]
        extent = np.maximum(self._problem.graph.extent, 1.0)
        ball = 4.0 / 3.0 * np.pi * self._problem.limits[numbers] ** 1.5
        return np.asarray(np.minimum(
            ball * self.volume[numbers] / alone / (np.prod(extent) * 2.0 * np.pi), 1.0))

    def show_more_than_chance(self) -> bool:
        """
        Tell whether more closures fit odometry than if all of them were wrong.

        Those of one place that agree with one another are one candidate. For each candidate that
        does not fit, and had the chance p to do so, p / (1 - p) wrong ones are expected that do.
        Where most gates are too wide to tell, nothing is held against those that fit.
        """
        numbers = np.arange(len(self._problem))
        if len(numbers) == 0:
            return True
        squared = self._squared(numbers, self._problem.errors(numbers))
        fits = ~(squared > self._problem.limits[numbers])
        group = self._places_that_agree()
        size = np.bincount(group)
        chance = np.bincount(group, self._chances(numbers)) / size
        tells = chance < MOST_CHANCE
        if np.sum(tells) < max(ENOUGH_TELL, 0.5 * len(size)):
            return True
        candidate_fits = 2 * np.bincount(group, fits) >= size
        for of_kind in (tells & (size >= GROUP), tells & (size < GROUP)):
            n_fit = int(np.sum(candidate_fits & of_kind))
            fell = chance[~candidate_fits & of_kind]
            # the chance of a Poisson distribution to reach n_fit
            if n_fit > 0 and gammainc(n_fit, np.sum(fell / (1.0 - fell))) < BY_CHANCE:
                return True
        return False

    def _places_that_agree(self) -> IntArray:
        """Return to which group each closure belongs, of those that agree within one place."""
        n = len(self._problem)
        _, agreeing = connected_components(coo_array(
            (np.ones(len(self._pairs[0])), self._pairs), shape=(n, n)), directed=False)
        place = np.floor(self._problem.graph.poses[self._problem.edges.i, :2] / PLACE)
        _, group = np.unique(np.column_stack((agreeing, place)), axis=0, return_inverse=True)
        return np.asarray(group.ravel())

    def _squared(self, numbers: IntArray, errors: FloatArray) -> FloatArray:
        return Innovations(errors, self._covariances[numbers]).squared_distances(
            self._information[numbers])

    def _compute(self, numbers: IntArray) -> None:
        """Compute gates by the present cliques."""
        problem, edges = self._problem, self._problem.edges.rows(numbers)
        errors, covariances = innovations.at_estimate(problem.graph.memory.head, edges)
        self._present[numbers] = True
        self._set(numbers, covariances)
        self.share[numbers] = self._squared(numbers, errors) / problem.limits[numbers]

    def _set(self, numbers: IntArray, covariances: FloatArray) -> None:
        self._covariances[numbers] = covariances
        grown = np.linalg.det(np.eye(3) + covariances @ self._information[numbers])
        self.volume[numbers] = self._own[numbers] * np.sqrt(np.maximum(grown, 1.0))


def _n_agreeing(problem: TruncatedProblem, pairs: tuple[IntArray, IntArray]) -> IntArray:
    """Return for each constraint the number of neighbouring closures that agree with it."""
    count = np.zeros(len(problem), dtype=np.int64)
    for numbers in pairs:
        np.add.at(count, numbers, 1)
    return count


def agreeing_pairs(problem: TruncatedProblem) -> tuple[IntArray, IntArray]:
    """Return the numbers of neighbouring closures that agree with each other, shape (P,) each."""
    closures, chain, none = problem.edges, OdometryChain(), np.empty(0, dtype=np.int64)
    usable = np.flatnonzero((closures.kind == EdgeKind.LOOP_CLOSURE)
                            & np.all(np.einsum('mii->mi', closures.information) > 0.0, axis=1))
    chain.extend(problem.graph)
    if len(usable) == 0 or len(chain) < 2:
        return none, none
    ends = chain.travel(np.concatenate((closures.i[usable], closures.j[usable]))).reshape(2, -1)
    first, second = np.min(ends, axis=0), np.max(ends, axis=0)
    order = np.argsort(first, kind='stable')
    first, second, usable = first[order], second[order], usable[order]
    pairs = []
    for shift in range(1, min(len(usable), MOST_COMPARED)):
        close = np.flatnonzero(first[shift:] - first[:-shift] <= NEAR)
        if len(close) == 0:
            break
        close = close[np.abs(second[close + shift] - second[close]) <= NEAR]
        pairs.append(np.column_stack((close, close + shift)))
    if len(pairs) == 0:
        return none, none
    a, b = np.concatenate(pairs).T
    noise = np.asarray(np.linalg.inv(closures.information[usable]), dtype=np.float64)
    table = Closures(closures.i[usable], closures.j[usable], closures.mean[usable], noise)
    agree = squared_distances(chain, table, a, b) <= GATE
    return usable[a[agree]], usable[b[agree]]
