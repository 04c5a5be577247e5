# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The best of several sets of believed constraints of a whole graph, by their truncated cost."""

import numpy as np

from pose_graph_ros.core.batch import gnc
from pose_graph_ros.core.batch.gnc import Surrogate
from pose_graph_ros.core.batch.truncated import Choice, ROUGH, TruncatedProblem
from pose_graph_ros.core.config import CLOSURE_FLOORS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.judgement import group_search, surest_first

FLOORS = np.array(CLOSURE_FLOORS)
# Number of closures with neighbours that agree, from which on the record speaks for the others.
SUPPORTED = 50
# Entries of the factorisation with all of them, per node, above which some must be wrong.
MOST_NUMBERS = 400
# Added to an information, relative to its largest entry, before it is inverted.
_SINGULAR = 1e-12


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


def floored(edges: Edges, sigmas: FloatArray = FLOORS) -> Edges:
    """
    Return edges with the variances of their errors raised to at least those given.

    What is not measured, and so has an infinite variance, stays so.

    Parameters
    ----------
    edges : Edges
    sigmas : ndarray, shape (3,), in the frames of the measured poses [m, m, rad]

    """
    information = edges.information
    most = np.max(np.abs(information), axis=(1, 2), initial=0.0)
    covariance = np.linalg.inv(
        information + _SINGULAR * most[:, None, None] * np.eye(3))
    missing = np.maximum(sigmas**2 - np.einsum('mii->mi', covariance), 0.0)
    # (C + D)^-1 = I (1 + D I)^-1 with D the diagonal of what is missing
    softer = information @ np.linalg.inv(np.eye(3) + missing[:, :, None] * information)
    softer = 0.5 * (softer + softer.transpose(0, 2, 1))
    return Edges(edges.i, edges.j, edges.mean, softer, edges.kind, edges.weight, edges.bias)


def forward(edges: Edges) -> Edges:
    """Return the same edges, each leading from the smaller row to the larger one."""
    back = np.flatnonzero(edges.i > edges.j)
    if len(back) == 0:
        return edges
    i, j = edges.i.copy(), edges.j.copy()
    mean, information = edges.mean.copy(), edges.information.copy()
    i[back], j[back] = edges.j[back], edges.i[back]
    # the error of the inverse is the error, moved from the end to the start
    mean[back] = se2.inverse(edges.mean[back])
    adjoint = se2.adjoint(mean[back])
    information[back] = adjoint.transpose(0, 2, 1) @ information[back] @ adjoint
    return Edges(i, j, mean, information, edges.kind, edges.weight, edges.bias)
