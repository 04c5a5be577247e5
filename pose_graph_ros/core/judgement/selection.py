# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The best of several sets of believed constraints of a whole graph, by their truncated cost.

A retest changes one closure at a time, and cannot leave a set in which a group of wrong closures
keeps right ones out: each right one contradicts the graph that the group has bent. Closures that
agree with one another are right or wrong together. So whole groups are taken in or out, each by a
solution from the start, and a trial is kept where its truncated cost is lower.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pose_graph_ros.core.batch import gnc
from pose_graph_ros.core.batch.gnc import Surrogate
from pose_graph_ros.core.batch.truncated import Choice, ROUGH, TruncatedProblem
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.judgement import surest_first
from pose_graph_ros.core.judgement.closures import GATE

# Number of closures with neighbours that agree, from which on the record speaks for the others.
SUPPORTED = 50
# Entries of the factorisation with all of them, per node, above which some must be wrong.
MOST_NUMBERS = 400


def best(problem: TruncatedProblem, *, insured: bool = False) -> Choice | None:
    """
    Return the set with the lowest truncated cost; None if the graph cannot be solved.

    All constraints are believed if they contradict nothing. Otherwise the sets compared are none,
    and those of `surest_first` and of graduated non-convexity, each after retests.

    Parameters
    ----------
    problem : TruncatedProblem, its limits may be lowered
    insured : bool, whether more is asked of those without support; see `surest_first.select`

    """
    everything = np.ones(len(problem), dtype=bool)
    dense = problem.factorisation(everything.astype(np.float64)) > MOST_NUMBERS * (
        problem.graph.n_nodes)
    if not dense and (not insured or surest_first.n_supported(problem) >= SUPPORTED):
        choice = problem.choice(everything, ROUGH)
        if choice is not None and np.all(choice.energies <= problem.limits):
            return problem.choice(everything)
    first = surest_first.select(problem, insured=insured)
    sets = [*([] if first is None else [first]), np.zeros(len(problem), dtype=bool)]
    choices = [problem.choice(believed) for believed in sets]
    choices.append(gnc.select(problem, Surrogate.TRUNCATED))
    solved = [problem.improved(choice) for choice in choices if choice is not None]
    if len(solved) == 0:
        return None
    return _improved_by_groups(problem, min(solved, key=lambda choice: choice.cost))


# Limits of the search: rounds, trials of groups to take in and to take out in one, and nodes times
# trials of all rounds.
ROUNDS, MOST_IN, MOST_OUT, WORK = 4, 30, 10, 60_000
# Maximum number of retests of a trial.
RETESTS = 4
# Least reduction of the truncated cost, that of one constraint [sigma^2].
LEAST_GAIN = GATE


def _improved_by_groups(problem: TruncatedProblem, choice: Choice) -> Choice:
    """Return a set that no group taken in or out lowers the truncated cost of."""
    all_groups, given = _groups(problem), choice
    left = WORK // max(problem.graph.n_nodes, 1)
    tried: set[int] = set()     # first members of groups, in or out of the present choice
    for _ in range(ROUNDS):
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
                trial = problem.improved(trial, RETESTS, ROUGH)
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
    a, b = surest_first.agreeing_pairs(problem)
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
    return out[:MOST_IN] + others[:MOST_OUT]
