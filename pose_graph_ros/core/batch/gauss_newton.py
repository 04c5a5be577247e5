# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The parts of a Gauss-Newton iteration over all cliques of a graph: linearize, eliminate, solve.

The reference of each node is set to its pose before all constraints are linearized at the poses,
so the solution of the linear system is the step itself.

A chord step (`chord_step`) reuses the factorisation of an earlier iteration, so it only needs the
gradient at the new poses, a forward and a backward substitution. It takes a quarter of the time of
a whole iteration. Near the minimum it converges nearly as fast as Gauss-Newton; far from it, where
the Jacobians change fast, it does not converge.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel, NUMBER, ROWS
from pose_graph_ros.core.elimination.assembly import eliminate_clique
from pose_graph_ros.core.elimination.fronts import backward_rows, forward_rows, solve_rows
from pose_graph_ros.core.graph import factors, normal_equations, prior_rows, tables as tb


@kernel(signature=(tb.HEAD, ROWS))
def keep_poses(head, poses):  # type: ignore[no-untyped-def]
    """Copy the poses of all nodes into an array, shape (N, 3)."""
    node_f = tb.node_f(head)
    for v in range(head[tb.N_NODES]):
        for k in range(3):
            poses[v, k] = node_f[v, tb.POSE + k]


@kernel(signature=(tb.HEAD, ROWS))
def put_poses(head, poses):  # type: ignore[no-untyped-def]
    """Write the poses of all nodes, shape (N, 3), unchanged, and make them the references."""
    node_f = tb.node_f(head)
    for v in range(head[tb.N_NODES]):
        for k in range(3):
            node_f[v, tb.POSE + k] = poses[v, k]
    _refer_to_poses(head)


@kernel(signature=(tb.HEAD, ROWS))
def halve_step(head, poses):  # type: ignore[no-untyped-def]
    """Move all nodes half of the way back to earlier poses, shape (N, 3), as new references."""
    node_f = tb.node_f(head)
    for v in range(head[tb.N_NODES]):
        row = node_f[v]
        for k in range(2):
            row[tb.POSE + k] = 0.5 * (row[tb.POSE + k] + poses[v, k])
        turn = factors.wrap(row[tb.POSE + 2] - poses[v, 2])
        row[tb.POSE + 2] = factors.wrap(poses[v, 2] + 0.5 * turn)
    _refer_to_poses(head)


@kernel
def _refer_to_poses(head):  # type: ignore[no-untyped-def]
    """Make the poses the references of the unknowns."""
    node_f = tb.node_f(head)
    for v in range(head[tb.N_NODES]):
        factors.refer_to_pose(node_f[v])


@kernel(signature=(tb.HEAD,))
def linearize(head):  # type: ignore[no-untyped-def]
    """Make the poses the references and linearize all constraints there."""
    edge_f, observed_f = tb.edge_f(head), tb.observed_f(head)
    _refer_to_poses(head)
    for e in range(head[tb.N_EDGES]):
        if edge_f[e, tb.WEIGHT] > 0.0:
            factors.linearize(head, e)
    for k in range(head[tb.N_OBSERVED]):
        if observed_f[k, tb.WEIGHT] > 0.0:
            factors.linearize(head, -1 - k)


@kernel(signature=(tb.HEAD, NUMBER))
def eliminate(head, damping):  # type: ignore[no-untyped-def]
    """
    Eliminate all cliques with a damping lambda, which is 0 for a Gauss-Newton step.

    Return False if a node is not determined, which is `BAD_NODE` of the head.
    """
    scalars = tb.scalars(head)
    scalars[tb.DAMPING] = damping
    bad = -1
    for c in range(head[tb.N_PRIORS], head[tb.N_CLIQUES]):  # `symbolic.plant` puts priors first
        bad = eliminate_clique(head, c, False)
        if bad >= 0:
            head[tb.BAD_NODE] = bad
            break
    scalars[tb.DAMPING] = 0.0
    return bad < 0


@kernel
def _update_pose(f):  # type: ignore[no-untyped-def]
    """Set the pose of a node, given as its row, to reference plus solution."""
    f[tb.POSE] = f[tb.REF] + f[tb.DELTA]
    f[tb.POSE + 1] = f[tb.REF + 1] + f[tb.DELTA + 1]
    f[tb.POSE + 2] = factors.wrap(f[tb.REF + 2] + f[tb.DELTA + 2])


@kernel(signature=(tb.HEAD,))
def gauss_newton_step(head):  # type: ignore[no-untyped-def]
    """Solve for all nodes and move them; return the largest change of a coordinate [m, rad]."""
    node_f, pool_f, work_f = tb.node_f(head), tb.pool_f(head), tb.work_f(head)
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    largest = 0.0
    for c in range(head[tb.N_CLIQUES] - 1, head[tb.N_PRIORS] - 1, -1):
        row = clique_i[c]
        n_frontal, n_all = row[tb.N_FRONTAL], row[tb.N_FRONTAL] + row[tb.N_SEPARATOR]
        nodes = pool_i[row[tb.NODES]:row[tb.NODES] + n_all]
        n = 3 * n_all
        x = work_f[:n]
        for k in range(n_frontal, n_all):
            f = node_f[nodes[k]]
            x[3 * k], x[3 * k + 1], x[3 * k + 2] = f[tb.DELTA], f[tb.DELTA + 1], f[tb.DELTA + 2]
        at = row[tb.VALUES]
        solve_rows(pool_f[at:], 3 * n_frontal, n, x)
        for k in range(n_frontal):
            v = nodes[k]
            if node_i[v, tb.FIXED] != 0:
                continue
            f = node_f[v]
            for m in range(3):
                f[tb.DELTA + m] = x[3 * k + m]
                largest = _larger(largest, x[3 * k + m])
            _update_pose(f)
    return largest


@kernel(signature=(tb.HEAD, ROWS))
def chord_step(head, right):  # type: ignore[no-untyped-def]
    """
    Move all nodes by a step from the present poses, with the factorisation of an earlier step.

    `right`, -b at the poses from `evaluate`, shape (N, 3), is overwritten by the step. Return the
    largest change of a coordinate [m, rad].
    """
    node_f, pool_f, work_f = tb.node_f(head), tb.pool_f(head), tb.work_f(head)
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    n_priors, n_cliques = head[tb.N_PRIORS], head[tb.N_CLIQUES]
    for c in range(n_priors, n_cliques):
        row = clique_i[c]
        n_frontal, n_all = row[tb.N_FRONTAL], row[tb.N_FRONTAL] + row[tb.N_SEPARATOR]
        nodes = pool_i[row[tb.NODES]:row[tb.NODES] + n_all]
        n = 3 * n_all
        x = work_f[:n]
        for k in range(n_all):
            v = nodes[k]
            for m in range(3):
                x[3 * k + m] = right[v, m]
        at = row[tb.VALUES]
        forward_rows(pool_f[at:], 3 * n_frontal, n, x)
        for k in range(n_all):
            v = nodes[k]
            for m in range(3):
                right[v, m] = x[3 * k + m]
    largest = 0.0
    for c in range(n_cliques - 1, n_priors - 1, -1):
        row = clique_i[c]
        n_frontal, n_all = row[tb.N_FRONTAL], row[tb.N_FRONTAL] + row[tb.N_SEPARATOR]
        nodes = pool_i[row[tb.NODES]:row[tb.NODES] + n_all]
        rows, n = 3 * n_frontal, 3 * n_all
        x = work_f[:n]
        for k in range(n_all):
            v = nodes[k]
            for m in range(3):
                x[3 * k + m] = right[v, m]
        at = row[tb.VALUES]
        backward_rows(pool_f[at:], rows, n, x)
        for k in range(n_frontal):
            v = nodes[k]
            f = node_f[v]
            fixed = node_i[v, tb.FIXED] != 0
            for m in range(3):
                right[v, m] = 0.0 if fixed else x[3 * k + m]
                f[tb.DELTA + m] += right[v, m]
                largest = _larger(largest, right[v, m])
            if not fixed:
                _update_pose(f)
    return largest


@kernel
def _larger(largest, number):  # type: ignore[no-untyped-def]
    """Return the larger of `largest` and the magnitude of a number, NaN if one of them is NaN."""
    number = abs(number)
    return largest if number <= largest else number


@kernel(signature=(tb.HEAD, ROWS))
def evaluate(head, right):  # type: ignore[no-untyped-def]
    """
    Return chi2 at the poses and an estimate of its rounding error.

    `right`, shape (N, 3), receives -b: half the gradient of chi2, with negative sign.
    """
    node_f, edge_f, observed_f = tb.node_f(head), tb.edge_f(head), tb.observed_f(head)
    right[:] = 0.0
    chi2 = gradient_sum = cancelled = reach = 0.0
    for e in range(head[tb.N_EDGES]):
        if edge_f[e, tb.WEIGHT] > 0.0:
            energy, size, terms = normal_equations.gradient(head, e, right)
            chi2 += energy
            gradient_sum += size
            cancelled += terms
    for k in range(head[tb.N_OBSERVED]):
        if observed_f[k, tb.WEIGHT] > 0.0:
            energy, size, terms = normal_equations.gradient(head, -1 - k, right)
            chi2 += energy
            gradient_sum += size
            cancelled += terms
    energy, size, terms = _add_priors(head, right)
    chi2 += energy
    gradient_sum += size
    cancelled += terms
    for v in range(head[tb.N_NODES]):
        reach = max(reach, abs(node_f[v, tb.POSE]), abs(node_f[v, tb.POSE + 1]))
    # rounding of a sum of many numbers, and of coordinates
    return chi2, 1e-12 * max(chi2, 1.0) + 2.0**-52 * (
        reach * gradient_sum + cancelled)


@kernel
def _add_priors(head, right):  # type: ignore[no-untyped-def]
    """
    Add the priors to -b, shape (N, 3).

    Return their energies, the sum of the magnitudes of their gradients by a position, and that of
    the terms that cancel each other in their energies.
    """
    clique_i, pool_i, work = tb.clique_i(head), tb.pool_i(head), tb.work_f(head)
    energies = gradients = cancelled = 0.0
    for c in range(head[tb.N_CLIQUES] if head[tb.N_PRIORS] > 0 else 0):
        if not prior_rows.is_prior(head, c):
            continue
        row = clique_i[c]
        n = row[tb.N_SEPARATOR]
        energies += prior_rows.gradient(head, c, work)
        d, g = work[:3 * n], work[3 * n:6 * n]
        for k in range(n):
            v = pool_i[row[tb.NODES] + k]
            gradients += abs(g[3 * k]) + abs(g[3 * k + 1])
            for m in range(3):
                right[v, m] -= g[3 * k + m]
                cancelled += abs(d[3 * k + m] * g[3 * k + m])
    return energies, gradients, cancelled


@kernel(signature=(tb.HEAD, ROWS))
def product_with_step(head, right):  # type: ignore[no-untyped-def]
    """Return the scalar product of an array, shape (N, 3), and the last step (DELTA)."""
    node_f = tb.node_f(head)
    total = 0.0
    for v in range(head[tb.N_NODES]):
        for k in range(3):
            total += right[v, k] * node_f[v, tb.DELTA + k]
    return total


@kernel(signature=(tb.HEAD,))
def settle(head):  # type: ignore[no-untyped-def]
    """
    Evaluate all constraints and bring the tables into the state after a step of the smoother.

    If the sum of the squared linearization errors exceeds the smoother's budget, the constraints
    with large errors are listed in `waiting`, to be linearized again in its next step.
    """
    node_f, edge_f, observed_f = tb.node_f(head), tb.edge_f(head), tb.observed_f(head)
    edge_i, observed_i = tb.edge_i(head), tb.observed_i(head)
    scalars, waiting = tb.scalars(head), tb.waiting(head)
    for v in range(head[tb.N_NODES]):
        f = node_f[v]
        for k in range(3):
            f[tb.SEEN + k] = f[tb.DELTA + k]
    chi2 = error2 = 0.0
    for e in range(head[tb.N_EDGES]):
        edge_i[e, tb.EDGE_WAITS] = 0
        if edge_f[e, tb.WEIGHT] > 0.0:
            factors.check(head, e, factors.NO_TURN)
            chi2 += edge_f[e, tb.ENERGY]
            error2 += edge_f[e, tb.ERROR2]
    for k in range(head[tb.N_OBSERVED]):
        observed_i[k, tb.OBS_WAITS] = 0
        if observed_f[k, tb.WEIGHT] > 0.0:
            factors.check(head, -1 - k, factors.NO_TURN)
            chi2 += observed_f[k, tb.ENERGY]
            error2 += observed_f[k, tb.ERROR2]
    scalars[tb.CHI2] = chi2
    prior_rows.add_energies(head)
    head[tb.N_WAITING] = head[tb.N_TURNED] = head[tb.REFINED] = head[tb.LISTED] = 0
    if not 0.0 < scalars[tb.SETTING_BUDGET] < error2:
        return
    threshold = factors.LEAST_FRACTION * scalars[tb.SETTING_SHARE]
    for e in range(head[tb.N_EDGES]):
        if edge_f[e, tb.ERROR2] > threshold:
            edge_i[e, tb.EDGE_WAITS] = 1
            waiting[head[tb.N_WAITING]] = e
            head[tb.N_WAITING] += 1
    for k in range(head[tb.N_OBSERVED]):
        if observed_f[k, tb.ERROR2] > threshold:
            observed_i[k, tb.OBS_WAITS] = 1
            waiting[head[tb.N_WAITING]] = -1 - k
            head[tb.N_WAITING] += 1


class CompiledSystem:
    """The `System` of `levenberg_marquardt` for a graph in tables whose cliques are planted."""

    def __init__(self, head: tb.IntHead) -> None:
        self._head = head
        # -b, and the best poses
        self._right, self._best = np.empty((2, int(head[tb.N_NODES]), 3))

    def keep_poses(self) -> None:
        keep_poses(self._head, self._best)

    def restore_poses(self) -> None:
        put_poses(self._head, self._best)

    def halve_step(self) -> None:
        halve_step(self._head, self._best)

    def evaluate(self) -> tuple[float, float]:
        chi2, rounding = evaluate(self._head, self._right)
        return chi2, rounding

    def step(self, damping: float, *, chord: bool) -> float:
        if chord:
            return float(chord_step(self._head, self._right))
        linearize(self._head)
        return float(gauss_newton_step(self._head)) if eliminate(self._head, damping) else math.inf

    def decrease(self) -> float:
        return float(product_with_step(self._head, self._right))

    def settle(self) -> None:
        settle(self._head)
