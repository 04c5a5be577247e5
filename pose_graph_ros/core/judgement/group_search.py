# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Improve a set of believed closures by taking groups of them in or out.

A retest changes one closure at a time, and cannot leave a set in which a group of wrong closures
keeps right ones out: each right one contradicts the graph that the group has bent. Closures that
agree with one another are right or wrong together. So whole groups are tried, each by a solution
from the start, and a trial is kept where its truncated cost is lower.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pose_graph_ros.core.batch.truncated import Choice, ROUGH, TruncatedProblem
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.judgement.closures import GATE
from pose_graph_ros.core.judgement.surest_first import agreeing_pairs

# Limits of the search: rounds, trials of groups to take in and to take out in one, and nodes times
# trials of all rounds.
ROUNDS, MOST_IN, MOST_OUT, WORK = 4, 30, 10, 60_000
# Maximum number of retests of a trial.
RETESTS = 4
# Least reduction of the truncated cost, that of one constraint [sigma^2].
LEAST_GAIN = GATE


def improved(problem: TruncatedProblem, choice: Choice) -> Choice:
    """Return a set that no group taken in or out lowers the truncated cost of."""
    all_groups, given = groups(problem), choice
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


def groups(problem: TruncatedProblem) -> list[IntArray]:
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
    return out[:MOST_IN] + others[:MOST_OUT]
