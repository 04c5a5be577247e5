# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The best of several sets of believed constraints of a whole graph, by their truncated cost."""

import numpy as np

from pose_graph_ros.core.batch import gnc
from pose_graph_ros.core.batch.gnc import Surrogate
from pose_graph_ros.core.batch.truncated import Choice, ROUGH, TruncatedProblem
from pose_graph_ros.core.judgement import group_search, surest_first

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
    return group_search.improved(problem, min(solved, key=lambda choice: choice.cost))
