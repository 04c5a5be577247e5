# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Back-substitution from the roots of the Bayes tree down, as far as values change.

A clique is visited if it was built in this iteration, or if a node of its separator has moved by
more than the wildfire threshold (M. Kaess et al., "iSAM2", IJRR 2012) since its solution was last
passed to the cliques below. The threshold is `alpha` times the sigma that the node's own
constraints give it. If the separator has moved as a rigid body, all nodes below are moved with it
(`rigid_propagation`). Nodes that have turned, and cliques whose frames have turned, are listed for
`relinearization`, which checks their linearization errors.
"""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.compiled.simd import fetch
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.elimination.fronts import solve_rows
from pose_graph_ros.core.graph import factors, prior_rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.pools import triangle_size
from pose_graph_ros.core.smoother.rigid_propagation import propagate, rigid_motion

# Energy of a constraint that is assumed to predict its linearization error from a turn [sigma^2].
USUAL_ENERGY = 0.1
# The constraints of a node that moves by more than this many times alpha are checked in any case.
CHECK_MOVE = 100.0
# Fraction of alpha that limits the moves of nodes and the drift of cliques where nothing below is
# tied to the map: there the effect of a move that is not passed down does not decay.
FREE_FRACTION = 0.35
# Return codes of `_update_child`.
LEFT, PROPAGATED, SOLVED = range(3)


@kernel
def _move(head, v, dx, dy, dth, phi, alpha):  # type: ignore[no-untyped-def]
    """
    Write the new solution of a node, and list the node if it has moved by more than alpha sigmas.

    phi is the angle of its clique's frame [rad].
    """
    node_f, node_i, scalars = tb.node_f(head), tb.node_i(head), tb.scalars(head)
    work_i, room = tb.work_i(head), head[tb.NODE_ROOM]
    f = node_f[v]
    transaction_log.log_solution(head, v)
    f[tb.DELTA], f[tb.DELTA + 1], f[tb.DELTA + 2] = dx, dy, dth
    f[tb.POSE], f[tb.POSE + 1] = f[tb.REF] + dx, f[tb.REF + 1] + dy
    f[tb.POSE + 2] = factors.wrap(f[tb.REF + 2] + dth)
    moved = max(abs(dx - f[tb.SEEN]), abs(dy - f[tb.SEEN + 1])) * f[tb.SCALE_T]
    turned = dth - f[tb.SEEN + 2]
    if moved > alpha or abs(turned) * f[tb.SCALE_R] > alpha:
        node_i[v, tb.CHANGED] = head[tb.ITERATION]
        work_i[3 * room + head[tb.N_CHANGED]] = v
        head[tb.N_CHANGED] += 1
    elif head[tb.SINCE] == head[tb.ITERATION]:
        return      # a refinement checks all nodes
    # approximate squared linearization error due to the turn since the last check
    turn2 = (dth - phi - f[tb.CHECKED_TURN]) ** 2
    error2 = turn2 * (turn2 * f[tb.SCALE_R] * f[tb.SCALE_R] + USUAL_ENERGY)
    if (error2 > scalars[tb.SETTING_SHARE] or moved > CHECK_MOVE * alpha
            or head[tb.SINCE] < head[tb.ITERATION]):
        f[tb.CHECKED_TURN] = dth - phi
        work_i[room + head[tb.N_CHECKS]] = v
        head[tb.N_CHECKS] += 1


@kernel
def _visit_pair(head, values, v, other, alpha):  # type: ignore[no-untyped-def]
    """Solve for the frontal node of a clique with one separator node, as along a chain."""
    node_f, pool_f = tb.node_f(head), tb.pool_f(head)
    r, f = pool_f[values:values + 18], node_f[other]
    a, b, c = f[tb.DELTA], f[tb.DELTA + 1], f[tb.DELTA + 2]
    z = (r[17] - (r[14] * a + r[15] * b + r[16] * c)) * r[13]
    y = (r[12] - (r[9] * a + r[10] * b + r[11] * c) - r[8] * z) * r[7]
    x = (r[6] - (r[3] * a + r[4] * b + r[5] * c) - r[2] * z - r[1] * y) * r[0]
    _move(head, v, x, y, z, 0.0, alpha)


@kernel
def _visit(head, c):  # type: ignore[no-untyped-def]
    """Solve for the frontal nodes of a clique."""
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    node_f, pool_f, work_f = tb.node_f(head), tb.pool_f(head), tb.work_f(head)
    row = clique_i[c]
    n_frontal, n_separator = row[tb.N_FRONTAL], row[tb.N_SEPARATOR]
    rows, n = 3 * n_frontal, 3 * (n_frontal + n_separator)
    nodes = pool_i[row[tb.NODES]:row[tb.NODES] + n_frontal + n_separator]
    phi = tb.clique_f(head)[c, tb.TURN]
    alpha = tb.scalars(head)[tb.SETTING_ALPHA]
    if row[tb.ANCHORED] == 0:
        alpha *= FREE_FRACTION
    if phi == 0.0 and n_frontal == 1 and n_separator == 1:
        if node_i[nodes[0], tb.FIXED] == 0:
            _visit_pair(head, row[tb.VALUES], nodes[0], nodes[1], alpha)
        return
    x = work_f[:n]
    cos, sin, px, py = 1.0, 0.0, 0.0, 0.0
    if phi != 0.0:
        cos, sin = math.cos(phi), math.sin(phi)
        f = node_f[nodes[n_frontal]]
        px, py = f[tb.POSE], f[tb.POSE + 1]
    for k in range(n_frontal, n_frontal + n_separator):
        f = node_f[nodes[k]]
        if phi == 0.0:
            x[3 * k], x[3 * k + 1], x[3 * k + 2] = f[tb.DELTA], f[tb.DELTA + 1], f[tb.DELTA + 2]
        else:
            x[3 * k], x[3 * k + 1], x[3 * k + 2] = clique_frames.local_delta(
                f, px, py, cos, sin, phi)
    solve_rows(pool_f[row[tb.VALUES]:], rows, n, x)
    for k in range(n_frontal):
        v = nodes[k]
        dx, dy, dth = x[3 * k], x[3 * k + 1], x[3 * k + 2]
        if phi != 0.0:
            dx, dy = clique_frames.map_delta(node_f[v], dx, dy, px, py, cos, sin)
            dth += phi
        if node_i[v, tb.FIXED] == 0:
            _move(head, v, dx, dy, dth, phi, alpha)


@kernel
def _set_turn(head, c, parent_turn):  # type: ignore[no-untyped-def]
    """Set the angle of a clique's frame; list the clique if its slip is large."""
    clique_i, clique_f, work_i = tb.clique_i(head), tb.clique_f(head), tb.work_i(head)
    f = clique_f[c]
    if clique_i[c, tb.ANCHORED] != 0:
        f[tb.TURN] = 0.0
        return
    f[tb.TURN] = clique_frames.present_turn(head, c)
    slip = f[tb.TURN] - f[tb.TURN_SEEN] - parent_turn
    slip2 = slip * slip
    error2 = slip2 * (slip2 * f[tb.SLIP_SCALE] + USUAL_ENERGY)
    if error2 > tb.scalars(head)[tb.SETTING_SHARE]:
        work_i[2 * head[tb.NODE_ROOM] + head[tb.N_TURNED]] = c
        head[tb.N_TURNED] += 1


@kernel
def _update_child(head, c, stack, depth):  # type: ignore[no-untyped-def]
    """
    Update a clique after its parent was visited, as far as that takes no solve.

    Return LEFT: its separator has not moved; PROPAGATED: its separator has moved as a rigid body,
    and all nodes at and below the clique were moved with it; or SOLVED: it is to be solved for.
    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    clique_f = tb.clique_f(head)
    row, iteration = clique_i[c], head[tb.ITERATION]
    if row[tb.BUILT] >= head[tb.SINCE]:
        return SOLVED
    limit = FREE_FRACTION * tb.scalars(head)[tb.SETTING_ALPHA]
    begin = row[tb.NODES] + row[tb.N_FRONTAL]
    for m in range(begin, begin + row[tb.N_SEPARATOR]):
        if node_i[pool_i[m], tb.CHANGED] == iteration:
            if row[tb.ANCHORED] != 0:
                return SOLVED
            slack = limit - clique_f[c, tb.DRIFT]
            motion = rigid_motion(head, c, slack)
            if motion[0] > slack:
                return SOLVED
            if motion[0] > 0.0:
                transaction_log.log_clique(head, c)
                clique_f[c, tb.DRIFT] += motion[0]
            tb.scalars(head)[tb.N_MOVED] += propagate(head, c, motion, stack, depth)
            return PROPAGATED
    return SOLVED if clique_f[c, tb.DRIFT] > limit else LEFT


@kernel
def _fetch_rows(head, c):  # type: ignore[no-untyped-def]
    """Prefetch the rows of R of a clique, which are used once and are not in the cache."""
    clique_i, pool_f = tb.clique_i(head), tb.pool_f(head)
    row = clique_i[c]
    rows, begin = 3 * row[tb.N_FRONTAL], row[tb.VALUES]
    size = triangle_size(rows, rows + 3 * row[tb.N_SEPARATOR])
    for at in range(begin, begin + size, 8):
        fetch(pool_f, at)


@kernel
def back_substitute(head):  # type: ignore[no-untyped-def]
    """Visit the cliques from the roots on the stack down; list the nodes to be checked."""
    clique_i, clique_f, work_i = tb.clique_i(head), tb.clique_f(head), tb.work_i(head)
    node_f, scalars = tb.node_f(head), tb.scalars(head)
    stack, depth = work_i, head[tb.N_ROOTS]
    refines = head[tb.SINCE] < head[tb.ITERATION]
    n_visited = 0
    for k in range(depth):
        clique_f[stack[k], tb.TURN] = 0.0
    head[tb.N_TURNED] = head[tb.N_CHECKS] = head[tb.N_CHANGED] = 0
    scalars[tb.N_MOVED] = 0.0
    while depth > 0:
        if refines and head[tb.INTERRUPT] != 0:
            break   # the caller rolls back
        depth -= 1
        c = stack[depth]
        while c >= 0:
            _visit(head, c)
            clique_i[c, tb.BUILT] = head[tb.ITERATION]
            n_visited += 1
            turn = clique_f[c, tb.TURN]
            drift = clique_f[c, tb.DRIFT]
            if drift > 0.0:
                transaction_log.log_clique(head, c)
                clique_f[c, tb.DRIFT] = 0.0
            # the first child to be solved for comes next, the others go on the stack
            child, c = clique_i[c, tb.CHILD], -1
            while child >= 0:
                if clique_i[child, tb.N_FRONTAL] == 0:
                    transaction_log.log_clique(head, child)
                    prior_rows.update_energy(head, child)
                    if prior_rows.turns(head, child):
                        work_i[2 * head[tb.NODE_ROOM] + head[tb.N_TURNED]] = child
                        head[tb.N_TURNED] += 1
                    child = clique_i[child, tb.SIBLING]
                    continue
                if drift > 0.0:
                    transaction_log.log_clique(head, child)
                    clique_f[child, tb.DRIFT] += drift
                code = _update_child(head, child, stack, depth)
                if code != LEFT or refines:
                    _set_turn(head, child, turn)
                if code == SOLVED:
                    _fetch_rows(head, child)
                    if c >= 0:
                        stack[depth] = c
                        depth += 1
                    c = child
                child = clique_i[child, tb.SIBLING]
    changed = work_i[3 * head[tb.NODE_ROOM]:]
    for k in range(head[tb.N_CHANGED]):
        f = node_f[changed[k]]
        f[tb.SEEN], f[tb.SEEN + 1], f[tb.SEEN + 2] = (
            f[tb.DELTA], f[tb.DELTA + 1], f[tb.DELTA + 2])
    scalars[tb.N_MOVED] += head[tb.N_CHANGED]
    head[tb.N_VISITED] += n_visited
