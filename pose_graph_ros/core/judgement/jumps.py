# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Jumps of odometry: motions that it has not measured, such as slip of the wheels, or being carried.

All closures over a jump contradict odometry, by the same motion, and agree with one another. The
hypothesis is that one odometry edge is wrong: a closure from node i to node j shows how it was,

    x = (T_i O_ik)^-1 T_i z O_lj^-1

with O the motions before and after the edge, from k to l. In a trial the edge has this motion. It
is kept if the truncated cost falls by more than its price.

Wrong closures agree as well where places look alike, but on few places, and right ones contradict
them. So a jump has to be seen from several places, and those over it that are believed, and do not
agree with it, are lost by it.
"""

from collections.abc import Generator, Sequence
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.batch.truncated import Choice, ROUGH, TruncatedProblem
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import Graph, GraphRows
from pose_graph_ros.core.judgement import group_search, selection
from pose_graph_ros.core.judgement.closures import GATE
from pose_graph_ros.core.judgement.consistency import Closures, squared_distances
from pose_graph_ros.core.judgement.floors import floored
from pose_graph_ros.core.judgement.odometry_motions import Odometry, SIGMAS
from pose_graph_ros.core.judgement.strain import (
    gains_of,
    n_places,
    Place,
    PLACES,
    PRICE,
    scale_of,
    strained,
)

# Sigmas of the motion in a trial where it is only known roughly [m, m, rad].
LOOSE = np.array((30.0, 30.0, 3.0))
# Share of the closures that show a jump which must fit with it.
MOST_FIT = 0.75
# Share of all closures that a jump must explain where the others fit odometry by chance.
HALF = 0.5
# Limits of the search: jumps, closures that others are compared with, and trials for one jump.
MOST, MOST_SEEDS, MOST_TRIALS = 10, 60, 4
# Maximum number of retests of a trial.
RETESTS = 6
# Of the search of the edge: how many ends of closures beyond the place, and how many at most.
FURTHER, MOST_CUTS = 2, 16


class Jump(NamedTuple):
    """An odometry edge that is doubted."""

    edge: int
    """Its row in a copy of the graph, or its id."""
    ends: tuple[int, int]
    """Nodes between which it is; the closures do not tell which edge it is."""
    motion: FloatArray
    """What has moved the robot along the edge, by the closures, shape (3,) [m, m, rad]."""
    seen_by: IntArray
    """Numbers of the closures that the jump was found by."""

    def with_ids(self, edges: IntArray, nodes: IntArray) -> 'Jump':
        """
        Return the jump with ids in place of rows.

        Parameters
        ----------
        edges, nodes : ndarray of int, ids by row

        """
        begin, end = nodes[list(self.ends)].tolist()
        return self._replace(edge=int(edges[self.edge]), ends=(begin, end))


def best(problem: TruncatedProblem) -> tuple[Choice | None, tuple[Jump, ...]]:
    """Return the set of `selection.best`, insured, and jumps of odometry that lower its cost."""
    choice, jumps = selection.best(problem, insured=True), list[Jump]()
    while choice is not None and len(jumps) < MOST:
        found = _one_more(problem, choice)
        if found is None:
            break
        problem, choice, jump = found
        jumps.append(jump)
    return choice, tuple(jumps)


def _one_more(
    problem: TruncatedProblem, choice: Choice,
) -> tuple[TruncatedProblem, Choice, Jump] | None:
    odometry = Odometry(problem.graph)
    groups = group_search.groups(problem)
    scale, candidates = strained(problem, choice, odometry)
    price = PRICE * scale
    for place in candidates + to_the_end(places(
            problem.edges, choice.believed, choice.poses, odometry, groups)):
        trial = _with_jump(problem, choice, odometry, place, price)
        if trial is None:
            continue
        first, last, at, motion = _located(problem, trial, odometry, place, groups)
        other = with_motion(problem, odometry, at, motion)
        found = _decided(other, trial.believed)
        # where chance explains all that fit odometry, it would also give jumps that others fit
        by_chance = found is None or not np.any(other.allowed) or (
            not np.any(problem.allowed) and np.mean(found.believed) < HALF)
        if (found is not None and not by_chance
                and _is_better(problem, choice, other, found, price)
                and _is_needed(problem, other, found)):
            begin, end = odometry.nodes[[first, last]].tolist()
            return other, found, Jump(
                int(odometry.rows[at]), (begin, end), motion, place.members)
    return None


def _located(
    problem: TruncatedProblem, trial: Choice, odometry: Odometry, place: Place,
    groups: Sequence[IntArray],
) -> tuple[int, int, int, FloatArray]:
    """
    Return between which places a jump is, where the edge begins that is doubted, and its motion.

    Closures that end around the place tell more than those that it was found by.
    """
    ends = odometry.places(np.concatenate((problem.edges.i, problem.edges.j)))
    ends = np.unique(np.append(ends[ends >= 0], (place.first, place.last)))
    first, last = np.searchsorted(ends, (place.first, place.last)).tolist()
    cuts = ends[max(first - FURTHER, 0):last + FURTHER + 1]
    cuts = cuts[np.unique(np.linspace(0, len(cuts) - 1, MOST_CUTS).astype(np.int64))]
    outer = int(cuts[0]), int(cuts[-1])
    total = se2.between(*trial.poses[odometry.nodes[list(outer)]])
    lowest, found = np.inf, (*outer, *odometry.smallest_jump(*outer, *outer, total))
    tried = [(place.first, place.last, place.at, np.asarray(se2.between(
        *trial.poses[odometry.nodes[[place.at, place.at + 1]]])))]
    tried += [(begin, end, *odometry.smallest_jump(begin, end, *outer, total))
              for begin, end in pairwise(cuts.tolist())]
    around = trial.believed.copy()
    for group in groups:
        at_ends = odometry.places(np.concatenate((problem.edges.i[group], problem.edges.j[group])))
        around[group] |= bool(np.any((at_ends >= outer[0]) & (at_ends <= outer[1])))
    sets = [trial.believed] if np.array_equal(around, trial.believed) else [
        trial.believed, around]
    for (begin, end, at, motion), believed in product(tried, sets):
        other = with_motion(problem, odometry, at, motion, LOOSE)
        choice = other.choice(believed, ROUGH)
        if choice is None:
            continue
        choice = other.improved(choice, RETESTS, ROUGH)
        if choice.cost_by(problem.limits) < lowest:
            lowest = choice.cost_by(problem.limits)
            found = begin, end, at, np.asarray(se2.between(
                *choice.poses[odometry.nodes[[at, at + 1]]]))
    return found


def _decided(problem: TruncatedProblem, believed: BoolArray) -> Choice | None:
    """Return the set of `selection.best`, or the given one, improved, if it costs less."""
    given = problem.choice(believed)
    if given is not None:
        given = problem.improved(given)
    found = selection.best(problem, insured=True)
    if given is None or found is None:
        return found or given
    # with equal limits, as the first ones are never lower
    return found if found.cost <= given.cost_by(problem.limits) else given


def _with_jump(
    problem: TruncatedProblem, choice: Choice, odometry: Odometry, place: Place, price: float,
) -> Choice | None:
    """Return a set with a jump; None if it does not pay."""
    motion, = odometry.motion_at(
        np.array([place.at]), place.first, place.last, place.total)
    other = with_motion(problem, odometry, place.at, motion, LOOSE)
    believed = choice.believed.copy()
    believed[place.against], believed[place.members] = False, True
    trial = other.choice(believed, ROUGH)
    if trial is None:
        return None
    trial = other.improved(trial, RETESTS, ROUGH)
    fit = place.members[trial.believed[place.members]]
    if len(fit) < MOST_FIT * len(place.members) or n_places(
            trial.poses, problem.edges.rows(fit), odometry) < PLACES:
        return None
    return trial if _is_better(problem, choice, other, trial, price) else None


def _is_better(
    problem: TruncatedProblem, choice: Choice, other: TruncatedProblem, trial: Choice,
    price: float,
) -> bool:
    """Tell whether a jump lowers the cost by more than its price, with equal limits."""
    limits = np.minimum(problem.limits, other.limits)
    return trial.cost_by(limits) + price < choice.cost_by(limits)


def _is_needed(problem: TruncatedProblem, other: TruncatedProblem, found: Choice) -> bool:
    """Tell whether a set costs more without its jump, by how all odometry is bent."""
    gains, _ = gains_of(other, found, Odometry(other.graph))
    allowed, problem.allowed = problem.allowed, np.ones_like(problem.allowed)
    without = problem.choice(found.believed)
    without = without and problem.improved(without)
    problem.allowed = allowed
    return without is None or _is_better(
        problem, without, other, found, PRICE * scale_of(gains, problem.lowered()))


def with_motion(
    problem: TruncatedProblem, odometry: Odometry, at: int, motion: FloatArray,
    sigmas: FloatArray = SIGMAS,
) -> TruncatedProblem:
    """
    Return a problem with another motion along one edge of odometry.

    Parameters
    ----------
    odometry : Odometry, of its graph
    at : int, place in the chain that the edge begins at
    motion, sigmas : ndarray, shape (3,), and its sigmas, at least

    """
    rows = problem.graph.rows()._replace(poses=problem.start.copy())
    graph = Graph()
    graph.fill(rows_with_motion(rows, odometry, at, motion, sigmas))
    return TruncatedProblem(graph, problem.rows)


def rows_with_motion(
    rows: GraphRows, odometry: Odometry, at: int, motion: FloatArray, sigmas: FloatArray,
) -> GraphRows:
    """
    Return rows of a graph, which are changed, with another motion along one edge of odometry.

    Parameters
    ----------
    odometry, at, motion, sigmas : as in `with_motion`

    """
    row, edges, poses, moved = int(odometry.rows[at]), rows.edges, rows.poses, rows.is_pose
    edges.mean[row] = motion
    edges.information[row] = floored(edges.rows(np.array([row])), sigmas).information[0]
    k, l = odometry.nodes[[at, at + 1]]     # noqa: E741  as above
    moved[:l] = False
    change = se2.compose(se2.compose(poses[k], motion), se2.inverse(poses[l]))
    poses[moved] = se2.compose(change[None], poses[moved])
    return rows


def places(
    edges: Edges, believed: BoolArray, poses: FloatArray, odometry: Odometry,
    groups: Sequence[IntArray], *, most_seeds: int = MOST_SEEDS,
) -> Generator[None, None, list[Place]]:
    """
    Return where jumps may be, those that explain the most closures first; part by part.

    Parameters
    ----------
    edges : Edges, M closures, from earlier to later nodes
    believed : ndarray of bool, shape (M,)
    poses : ndarray, shape (N, 3), with what is believed
    groups : sequence of ndarray of int, closures that agree along the path
    most_seeds : int, number of closures that all others are compared with

    """
    usable = ((edges.kind == EdgeKind.LOOP_CLOSURE)
              & np.all(np.einsum('mii->mi', edges.information) > 0.0, axis=1))
    first, last = odometry.places(edges.i), odometry.places(edges.j)
    usable &= (first >= 0) & (last > first)
    doubted = np.flatnonzero(usable & ~believed)
    if len(doubted) * GATE <= PRICE:
        return []
    numbers = np.flatnonzero(usable)
    table = Closures(edges.i, edges.j, edges.mean, np.linalg.inv(np.where(
        usable[:, None, None], edges.information, np.eye(3))))
    found: dict[tuple[int, int], Place] = {}
    for seed in _seeds(doubted, groups, most_seeds):
        yield
        squared = squared_distances(
            odometry.chain, table, np.full(len(numbers), seed), numbers)
        agrees = np.zeros(len(edges), dtype=bool)
        agrees[numbers] = squared <= GATE
        agrees[seed] = True
        place = _place(seed, first, last, agrees & usable & ~believed,
                       usable & believed & ~agrees)
        if place is not None:
            place = place._replace(
                total=_shown_by(edges.rows(np.array([seed])), poses, odometry, place))
        if place is None or place.gain <= found.get(
                (place.first, place.last), place._replace(gain=0.0)).gain:
            continue
        if n_places(poses, edges.rows(place.members), odometry) >= PLACES:
            found[place.first, place.last] = place
    return sorted(found.values(), key=lambda place: (-place.gain, place.first))[:MOST_TRIALS]


def _seeds(doubted: IntArray, groups: Sequence[IntArray], most: int) -> list[int]:
    """Return doubted closures that others are compared with: of the largest groups, and others."""
    within = [group[np.isin(group, doubted)] for group in groups]
    within = sorted((group for group in within if len(group) > 0),
                    key=lambda group: (-len(group), int(group[0])))
    seeds = [int(group[len(group) // 2]) for group in within[:most // 2]]
    rest = np.setdiff1d(doubted, np.concatenate([np.empty(0, np.int64), *within]))
    n = min(len(rest), most - len(seeds))
    return seeds + rest[np.linspace(0, len(rest) - 1, n).astype(np.int64)].tolist()


def _place(
    seed: int, first: IntArray, last: IntArray, agrees: BoolArray, against: BoolArray,
) -> Place | None:
    """
    Return where a jump would explain the most closures, less those that it contradicts.

    Parameters
    ----------
    seed : int, it leads over the jump
    first, last : ndarray of int, shape (M,), places of the ends of closures
    agrees, against : ndarray of bool, doubted ones that agree with the seed, and believed others

    """
    begin, end = int(first[seed]), int(last[seed])
    change = np.zeros(end - begin + 1)
    for chosen, sign in ((agrees, 1.0), (against, -1.0)):
        np.add.at(change, np.clip(first[chosen], begin, end) - begin, sign)
        np.add.at(change, np.clip(last[chosen], begin, end) - begin, -sign)
    score = np.cumsum(change)[:-1]
    gain = GATE * float(np.max(score)) - PRICE
    if gain <= 0.0:
        return None
    k = int(np.argmax(score))
    n = int(np.argmin(np.append(score[k:] == score[k], False)))
    at = begin + k
    over = (first <= at) & (last >= at + n)
    return Place(gain, at, at + n, at + n // 2, np.zeros(3), np.flatnonzero(agrees & over),
                 np.flatnonzero(against & (first < at + n) & (last > at)))


def _shown_by(
    closure: Edges, poses: FloatArray, odometry: Odometry, place: Place,
) -> FloatArray:
    """Return the pose of the last place in the first one, as a closure shows it, shape (3,)."""
    first, last = poses[odometry.nodes[[place.first, place.last]]]
    end = se2.compose(se2.compose(poses[closure.i[0]], closure.mean[0]),
                      se2.between(poses[closure.j[0]], last))
    return np.asarray(se2.between(first, end))
