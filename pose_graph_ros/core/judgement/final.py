# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The best set of believed loop closures of a whole graph, at the end of a stream or of a file.

It is a function of the graph alone, while what is believed before depends on the order in which
measurements come. `select` believes the surest ones first; `best` compares that with other sets.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import gammainc

from pose_graph_ros.core.batch import final_optimization, optimizer
from pose_graph_ros.core.batch.optimizer import Start, Status
from pose_graph_ros.core.batch.truncated import Choice, ROUGH, Surrogate, TruncatedProblem
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.closure_trial import copied_rows, losses_in_rows
from pose_graph_ros.core.judgement.closures import (
    Closures,
    floored,
    forward,
    GATE,
    squared_distances,
)
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.smoother.covariances import Innovations, innovations


def select(problem: TruncatedProblem, *, insured: bool = False) -> BoolArray | None:
    """
    Return a set of believed constraints, shape (M,), and lower the limits of the problem.

    With S the covariance of the error that a constraint would have by what is believed already, it
    passes the gate if `e^T S^-1 e` is small. A wrong one, whose error could be anything, passes
    with a chance that is proportional to the volume of the gate, and so to sqrt(det S). So they
    are believed in the order of this volume: first those that span little odometry, then those
    that these make sure. Wrong ones meet a narrow gate in the end, also where many of them agree.
    Closures that no neighbour agrees with come later than others of the same volume.

    What is believed also shows how large errors really are. Where covariances are far too large,
    the limits are lowered; else a wrong one would fit wherever the graph is claimed to be soft.

    None if the graph cannot be solved without any of them. `insured` asks for more: a constraint
    with fewer than two neighbours that agree is believed only if a wrong one would hardly pass its
    gate, and none if chance explains all that fit odometry; what is kept out so is not allowed
    later either.
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

    for _ in range(BELIEF.most_rounds):
        waiting = np.flatnonzero(~believed & (thrown < BELIEF.thrown_out))
        gates.begin_round()
        n_some = 0
        passing = sure(gates.passing(waiting, scale, BELIEF.volume_reach * level), believed)
        if not np.any(gates.volume[passing] <= level):
            share = int(BELIEF.first_volumes_share * len(waiting))
            n_some = more * max(BELIEF.first_volumes, share)
            some = np.sort(gates.volume[waiting])[:n_some]
            passing = sure(gates.passing(waiting, scale, np.max(some, initial=0.0)), believed)
            if len(passing) == 0:
                everything = gates.passing(waiting, scale, np.inf)
                passing = sure(everything, believed)
                kept_out[:] = False
                kept_out[np.setdiff1d(everything, passing)] = True
            if len(passing) == 0:
                break
            level = max(level, BELIEF.round_factor * float(np.min(gates.volume[passing])))
        new = passing[gates.volume[passing] <= level]
        seen[new] = gates.share[new]
        believed[new] = True
        if np.sum(believed) >= BELIEF.limits_from:
            largest = float(np.quantile(seen[believed], BELIEF.limits_share))
            shown = largest * GATE / BELIEF.limits_chi2
            scale = min(max(BELIEF.limits_margin * shown, BELIEF.least_limits), 1.0)
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
            own = np.prod(np.where(measured, 1.0, BELIEF.error_extent), axis=1) / np.sqrt(
                np.abs(np.linalg.det(filled)))
        self._pairs = agreeing_pairs(problem)
        self._agreeing = np.minimum(_n_agreeing(problem, self._pairs), 2)
        self._own = own * np.asarray(BELIEF.lonely_factors)[self._agreeing]
        # J P J^T of each; they never grow while more is believed
        self._covariances = np.full((len(problem), 3, 3), np.nan)
        self.volume = np.zeros(len(problem))
        self.share = np.zeros(len(problem))  # squared Mahalanobis distance, in limits
        self._present = np.zeros(len(problem), dtype=bool)  # which were computed in this round
        self._begin_with_odometry()

    def _begin_with_odometry(self) -> None:
        """Set gates by odometry, the largest: it is quicker than the tree without closures."""
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
        """Tell for which constraints that pass their neighbours speak, or the odds."""
        chance = self._chances(numbers)
        n_believed, rest = np.sum(believed), ~believed
        passing = rest & (self.volume > 0.0) & (self.share <= scale)
        n_wrong = int(np.sum(rest)) - int(np.sum(passing))
        return (self._agreeing[numbers] >= 2) | (
            (n_wrong + 1.0) * chance < BELIEF.wrong_odds * (n_believed + 1.0))

    def _chances(self, numbers: IntArray) -> FloatArray:
        """Return the chances of wrong constraints to pass their gates, shape (K,)."""
        alone = np.asarray(BELIEF.lonely_factors)[self._agreeing[numbers]]
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
        tells = chance < BELIEF.telling_chance
        if np.sum(tells) < max(BELIEF.least_telling, 0.5 * len(size)):
            return True
        candidate_fits = 2 * np.bincount(group, fits) >= size
        for of_kind in (tells & (size >= BELIEF.group_size), tells & (size < BELIEF.group_size)):
            n_fit = int(np.sum(candidate_fits & of_kind))
            fell = chance[~candidate_fits & of_kind]
            # the chance of a Poisson distribution to reach n_fit
            if n_fit > 0 and gammainc(n_fit, np.sum(fell / (1.0 - fell))) < BELIEF.by_chance:
                return True
        return False

    def _places_that_agree(self) -> IntArray:
        """Return to which group each closure belongs, of those that agree within one place."""
        n = len(self._problem)
        _, agreeing = connected_components(coo_array(
            (np.ones(len(self._pairs[0])), self._pairs), shape=(n, n)), directed=False)
        place = np.floor(self._problem.graph.poses[self._problem.edges.i, :2] / BELIEF.place_size)
        _, group = np.unique(np.column_stack((agreeing, place)), axis=0, return_inverse=True)
        return np.asarray(group.ravel())

    def _squared(self, numbers: IntArray, errors: FloatArray) -> FloatArray:
        return Innovations(errors, self._covariances[numbers]).squared_distances(
            self._information[numbers])

    def _compute(self, numbers: IntArray) -> None:
        problem, edges = self._problem, self._problem.edges.rows(numbers)
        errors, covariances = innovations(problem.graph.memory.head, edges)
        self._present[numbers] = True
        self._set(numbers, covariances)
        self.share[numbers] = self._squared(numbers, errors) / problem.limits[numbers]

    def _set(self, numbers: IntArray, covariances: FloatArray) -> None:
        self._covariances[numbers] = covariances
        grown = np.linalg.det(np.eye(3) + covariances @ self._information[numbers])
        self.volume[numbers] = self._own[numbers] * np.sqrt(np.maximum(grown, 1.0))


def _n_agreeing(problem: TruncatedProblem, pairs: tuple[IntArray, IntArray]) -> IntArray:
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
    for shift in range(1, min(len(usable), BELIEF.pairs_of_each)):
        close = np.flatnonzero(first[shift:] - first[:-shift] <= BELIEF.near)
        if len(close) == 0:
            break
        close = close[np.abs(second[close + shift] - second[close]) <= BELIEF.near]
        pairs.append(np.column_stack((close, close + shift)))
    if len(pairs) == 0:
        return none, none
    a, b = np.concatenate(pairs).T
    noise = np.asarray(np.linalg.inv(closures.information[usable]), dtype=np.float64)
    table = Closures(closures.i[usable], closures.j[usable], closures.mean[usable], noise)
    agree = squared_distances(chain, table, a, b) <= GATE
    return usable[a[agree]], usable[b[agree]]


def best(problem: TruncatedProblem, *, insured: bool = False) -> Choice | None:
    """
    Return the set with the lowest truncated cost; None if the graph cannot be solved.

    All constraints are believed if they contradict nothing. Otherwise the sets compared are none,
    and those of `select` and of graduated non-convexity, each after retests.
    """
    everything = np.ones(len(problem), dtype=bool)
    dense = problem.factorisation(everything.astype(np.float64)) > BELIEF.most_numbers * (
        problem.graph.n_nodes)
    if not dense and (not insured or n_supported(problem) >= BELIEF.supported):
        choice = problem.choice(everything, ROUGH)
        if choice is not None and np.all(choice.energies <= problem.limits):
            return problem.choice(everything)
    first = select(problem, insured=insured)
    sets = [*([] if first is None else [first]), np.zeros(len(problem), dtype=bool)]
    choices = [problem.choice(believed) for believed in sets]
    choices.append(problem.graduated(Surrogate.TRUNCATED))
    solved = [problem.improved(choice) for choice in choices if choice is not None]
    if len(solved) == 0:
        return None
    return _improved_by_groups(problem, min(solved, key=lambda choice: choice.cost))


# Least reduction of the truncated cost, that of one constraint [sigma^2].
LEAST_GAIN = GATE


def _improved_by_groups(problem: TruncatedProblem, choice: Choice) -> Choice:
    """
    Return a set that no group taken in or out lowers the truncated cost of.

    A retest changes one closure at a time, and cannot leave a set in which a group of wrong ones
    keeps right ones out: each right one contradicts the graph that the group has bent. Closures
    that agree with one another are right or wrong together.
    """
    all_groups, given = _groups(problem), choice
    left = BELIEF.group_work // max(problem.graph.n_nodes, 1)
    tried: set[int] = set()     # first members of groups, in or out of the present choice
    for _ in range(BELIEF.group_rounds):
        before = choice
        for group in _to_try(problem, choice, all_groups):
            if left == 0 or int(group[0]) in tried:
                continue
            left -= 1
            tried.add(int(group[0]))
            believed = choice.believed.copy()
            believed[group] = problem.allowed[group] & (np.mean(believed[group]) < 0.5)
            trial = problem.choice(believed, ROUGH)
            if trial is not None:
                trial = problem.improved(trial, BELIEF.group_retests, ROUGH)
                if trial.cost < choice.cost - LEAST_GAIN:
                    choice = trial
                    tried.clear()
        if choice is before:
            break
    if choice is given:
        return choice
    return problem.improved(problem.choice(choice.believed) or choice)


def _groups(problem: TruncatedProblem) -> list[IntArray]:
    """Return the groups of at least two closures that agree, by their numbers."""
    a, b = agreeing_pairs(problem)
    n = len(problem)
    n_groups, label = connected_components(
        coo_array((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)
    order = np.argsort(label, kind='stable')
    parts = np.split(order, np.cumsum(np.bincount(label, minlength=n_groups))[:-1])
    return [part for part in parts if len(part) > 1]


def _to_try(
    problem: TruncatedProblem, choice: Choice, groups: list[IntArray],
) -> list[IntArray]:
    """Return the groups to try: the largest ones that are out, then those in that fit worst."""
    shares, inside = choice.energies / problem.limits, choice.believed
    out = [group for group in groups if np.mean(inside[group]) < 0.5
           and np.any(problem.allowed[group])]
    others = [group for group in groups if np.mean(inside[group]) >= 0.5]
    out.sort(key=lambda group: (-len(group), int(group[0])))
    others.sort(key=lambda group: (-float(np.mean(shares[group])), int(group[0])))
    return out[:BELIEF.groups_in] + others[:BELIEF.groups_out]


CONFIG = SolverConfig(max_iterations=100)


def decide(
    graph: Graph, reweighting: Reweighting, ids: IntArray, forced: IntArray, inside: BoolArray,
) -> Choice | None:
    """
    Return which loop closures to believe, with poses by row; None if the graph cannot be solved.

    All closures are taken out, the rest is solved with robust weights computed from initial
    values. With more than `most_at_end` nodes and closures it is `inside`, improved.
    """
    rows, forced = graph.edge_rows(ids), graph.edge_rows(forced)
    copy = _copy(graph, np.union1d(rows, forced))
    if graph.n_nodes + len(rows) > BELIEF.most_at_end:
        problem = TruncatedProblem(copy, rows, start=copy.poses.copy())
        present = problem.choice(inside)
        return None if present is None else problem.improved(present, BELIEF.retests_at_end)
    weights = dict.fromkeys(rows.tolist(), 0.0) | dict.fromkeys(forced.tolist(), 1.0)
    copy.apply(GraphUpdate(weigh_edges=weights))
    others = losses_in_rows(graph, reweighting)
    for row, weight in weights.items():
        others.set_base_weight(row, weight, edge=True)
    starts = (Start.CHORDAL, Start.JOINT, Start.PRESENT)
    result = optimizer.optimize_from_linear_start(copy, CONFIG, starts)
    if result.status is not Status.FAILED and len(others) > 0:
        result = final_optimization.optimize(copy, others, CONFIG, optimizer.optimize)
    if result.status is Status.FAILED:
        return None
    problem = TruncatedProblem(copy, rows, start=copy.poses.copy())
    return best(problem, insured=True)


def _copy(graph: Graph, closures: IntArray) -> Graph:
    """Return a copy of a graph in which closures have the information to decide by; by row."""
    rows, copy = copied_rows(graph), Graph()
    edges = rows.edges
    columns = edges.i.copy(), edges.j.copy(), edges.mean.copy(), edges.information.copy()
    own = floored(forward(edges.rows(closures)))
    for column, values in zip(
            columns, (own.i, own.j, own.mean, own.information), strict=True):
        column[closures] = values
    copy.fill(rows._replace(edges=Edges(*columns, edges.kind, edges.weight, edges.bias, edges.k)))
    return copy
