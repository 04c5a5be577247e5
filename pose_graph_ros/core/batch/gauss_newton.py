# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The parts of a Gauss-Newton iteration over all cliques of a graph: linearize, eliminate, solve.

The reference of each node is set to its pose before all factors are linearized at the poses,
so the solution of the linear system is the step itself.

A chord step reuses the factorisation of an earlier iteration, so it only needs the
gradient at the new poses, a forward and a backward substitution. It takes a quarter of the time of
a whole iteration. Near the minimum such steps, each corrected by the one before, converge faster
than Gauss-Newton; far from it, where the Jacobians change fast, they do not converge.
"""

import math

import numpy as np

from pose_graph_ros.core.batch.headings import solve_headings
from pose_graph_ros.core.batch.levenberg_marquardt import Last, secant_step
from pose_graph_ros.core.compiled.jit import FLAG, kernel, NUMBER, ROWS
from pose_graph_ros.core.elimination import assembly
from pose_graph_ros.core.elimination.fronts import backward_rows, forward_rows
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import FloatArray, Poses
from pose_graph_ros.core.graph import factors, normal_equations, prior_rows, tables as tb


@kernel(signature=(tb.HEAD, ROWS))
def put_poses(head, poses):  # type: ignore[no-untyped-def]
    """Write the poses of all nodes, shape (N, 3), unchanged, and make them the references."""
    for v in range(head[tb.N_NODES]):
        for m in range(3):
            tb.nodes(head)[v].pose[m] = poses[v, m]
        factors.refer_to_pose(tb.nodes(head)[v])


@kernel(signature=(tb.HEAD, NUMBER, FLAG))
def eliminate(head, damping, as_measured):  # type: ignore[no-untyped-def]
    """
    Eliminate all cliques with a damping lambda, which is 0 for a Gauss-Newton step.

    All factors are linearized at the poses, of a linear start by `factors.as_measured`. Return
    False if a node is not determined, which is `BAD_NODE` of the head, or if it is interrupted.
    """
    scalars = tb.scalars(head)[0]
    factors.linearize_all(head)
    if as_measured:
        factors.as_measured(head)
    scalars.damping, head[tb.BAD_NODE] = damping, -1
    for c in range(head[tb.N_PRIORS], head[tb.N_CLIQUES]):  # `symbolic.plant` puts priors first
        if head[tb.BAD_NODE] < 0 and tb.interrupt(head)[tb.ALL] == 0:
            head[tb.BAD_NODE] = assembly.eliminate_clique(head, c, False)
    scalars.damping = 0.0
    return head[tb.BAD_NODE] < 0 and tb.interrupt(head)[tb.ALL] == 0


@kernel(forceinline=True)
def _clique(head, c, right):  # type: ignore[no-untyped-def]
    """Return the nodes of a clique, how many are frontal, its values, and `right` of them."""
    row = tb.cliques(head)[c]
    n = row.n_frontal + row.n_separator
    members = tb.pool_i(head)[row.members:row.members + n]
    x = tb.work_f(head)[:3 * n + 3]
    for k in range(n):
        v = members[k]
        for m in range(3):
            x[3 * k + m] = right[v, m]
    return members, row.n_frontal, tb.pool_f(head)[row.values:], x


@kernel(signature=(tb.HEAD, ROWS, FLAG))
def step(head, right, chord):  # type: ignore[no-untyped-def]
    """
    Return the step of all nodes by the last factorisation, which overwrites `right`, (N, 3).

    It is the one from where that was done, or a chord step from the present poses. Then `right`
    is -b there, from `evaluate`.
    """
    n_priors, n_cliques = head[tb.N_PRIORS], head[tb.N_CLIQUES]
    for c in range(n_priors, n_cliques if chord else n_priors):
        members, n_frontal, values, x = _clique(head, c, right)
        forward_rows(values, 3 * n_frontal, 3 * len(members), x)
        for k in range(len(members)):
            v = members[k]
            for m in range(3):
                right[v, m] = x[3 * k + m]
    for c in range(n_cliques - 1, n_priors - 1, -1):
        members, n_frontal, values, x = _clique(head, c, right)
        backward_rows(values, 3 * n_frontal, 3 * len(members), x, not chord)
        for k in range(n_frontal):
            v = members[k]
            f = tb.nodes(head)[v]
            for m in range(3):
                right[v, m] = x[3 * k + m] if f.fixed == 0 else 0.0
    return right


@kernel(signature=(tb.HEAD, ROWS))
def move(head, step):  # type: ignore[no-untyped-def]
    """Move all nodes by a step; return the largest change of a coordinate [m, rad]."""
    largest = 0.0
    for v in range(head[tb.N_NODES]):
        f = tb.nodes(head)[v]
        for m in range(3):
            f.delta[m] += step[v, m]
            if not abs(step[v, m]) <= largest:     # also if it is NaN
                largest = abs(step[v, m])
            f.pose[m] = f.reference[m] + f.delta[m]
        f.pose[2] = factors.wrap(f.pose[2])
    return largest


@kernel(signature=(tb.HEAD, ROWS))
def evaluate(head, right):  # type: ignore[no-untyped-def]
    """
    Return chi2 at the poses and an estimate of its rounding error.

    `right`, shape (N, 3), receives -b: half the gradient of chi2, with negative sign.
    """
    nodes, cliques = tb.nodes(head), tb.cliques(head)
    pool_i, work = tb.pool_i(head), tb.work_f(head)
    right[:] = 0.0
    chi2 = gradient_sum = cancelled = reach = 0.0
    for e in range(head[tb.N_FACTORS]):
        if tb.factors(head)[e].weight > 0.0:
            energy, size, terms = normal_equations.gradient(head, e, right)
            chi2 += energy
            gradient_sum += size
            cancelled += terms
    for c in range(head[tb.N_CLIQUES] if head[tb.N_PRIORS] > 0 else 0):
        if not prior_rows.is_prior(head, c):
            continue
        row = cliques[c]
        n = row.n_separator
        chi2 += prior_rows.gradient(head, c, work)
        d, g = work[:3 * n], work[3 * n:6 * n]
        for k in range(n):
            v = pool_i[row.members + k]
            gradient_sum += abs(g[3 * k]) + abs(g[3 * k + 1])
            for m in range(3):
                right[v, m] -= g[3 * k + m]
                cancelled += abs(d[3 * k + m] * g[3 * k + m])
    for v in range(head[tb.N_NODES]):
        reach = max(reach, abs(nodes[v].pose[0]), abs(nodes[v].pose[1]))
    # rounding of a sum of many numbers, and of coordinates
    return chi2, 1e-12 * max(chi2, 1.0) + 2.0**-52 * (reach * gradient_sum + cancelled)


class CompiledSystem:
    """The `System` of `levenberg_marquardt` for a graph in tables whose cliques are planted."""

    def __init__(self, memory: tb.Memory) -> None:
        self._head = memory.head
        self._rows = memory['nodes'][:memory.head[tb.N_NODES]]
        self._right = np.zeros((len(self._rows), 3))     # -b
        self._last: Last = None

    @property
    def poses(self) -> Poses:
        return np.array(self._rows['pose'])

    def set_poses(self, poses: Poses) -> None:
        put_poses(self._head, poses)

    def evaluate(self) -> tuple[float, float]:
        chi2, rounding = evaluate(self._head, self._right)
        return chi2, rounding

    def step(self, damping: float, *, chord: bool) -> tuple[float, float]:
        if not chord and not eliminate(self._head, damping, False):
            return math.inf, 0.0
        found = secant_step(lambda right: step(self._head, right, chord), self._right,
                            self._last if chord else None)
        self._last = found, self._right.copy()
        return float(move(self._head, found)), float(np.vdot(self._right, found))


def heading_steps(memory: tb.Memory, derivative: FloatArray) -> FloatArray:
    """Return a chord step of the headings of nodes that are not fixed, (F,); nothing moves."""
    free = memory['nodes'][:memory.head[tb.N_NODES]]['fixed'] == 0
    right = np.zeros((len(free), 3))
    right[free, 2] = derivative
    step(memory.head, right, True)
    return right[free, 2]


def solve_chordal(memory: tb.Memory, poses: Poses, place: bool) -> Poses:
    """Solve as a `ChordalSolve` of `linear_starts` over planted cliques; changes the poses."""
    if place:
        put_poses(memory.head, poses)
    if not (eliminate(memory.head, 0.0, True) if place else solve_headings(memory.head, poses)):
        raise LinearSolveError('chordal start: singular')
    return poses + step(memory.head, np.zeros_like(poses), False) if place else poses
