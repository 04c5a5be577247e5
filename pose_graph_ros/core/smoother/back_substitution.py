# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Back-substitution from the roots of the Bayes tree down, as far as values change.

A clique is visited if it was built in this iteration, or if a node of its separator has moved by
more than the wildfire threshold (M. Kaess et al., "iSAM2", IJRR 2012) since its solution was last
passed to the cliques below. The threshold is `alpha` times the sigma that the node's own
constraints give it. Nodes that have turned, and cliques whose frames have turned, are listed for
`relinearization`, which checks their linearization errors.

The error of a constraint between two poses does not change with a common motion of both. So if the
separator of a clique that is not anchored has moved as a rigid body, that motion is applied to the
poses of all nodes below, and nothing is solved for. Most nodes far from a loop closure move this
way. The deviation of the separator's motion from the rigid one, in sigmas of its nodes, is added
to the *drift* of the clique. Above `FREE_FRACTION` of alpha the clique is solved for instead, and
its drift is added to that of its children.
"""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.compiled.simd import fetch
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.elimination.fronts import solve_rows
from pose_graph_ros.core.graph import factors, prior_rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.pools import triangle_size

# Energy of a constraint that is assumed to predict its linearization error from a turn [sigma^2].
USUAL_ENERGY = 0.1
# Fraction of alpha that limits the moves of nodes and the drift of cliques where nothing below is
# tied to the map: there the effect of a move that is not passed down does not decay.
FREE_FRACTION = 0.35
# How a clique is updated after its parent (`_update_child`).
_AS_IT_IS, _PROPAGATED, _SOLVED = range(3)


@kernel
def _move(head, v, dx, dy, dth, phi, alpha):  # type: ignore[no-untyped-def]
    """
    Write the new solution of a node, and list the node if it has moved by more than alpha sigmas.

    The frame of its clique has the angle phi.
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
    if (error2 > scalars[tb.SETTING_SHARE] or moved > 100.0 * alpha
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
def _rigid_motion(head, c, limit):  # type: ignore[no-untyped-def]
    """
    Return the rigid motion that fits this iteration's moves of the nodes of a clique's separator.

    First comes the largest deviation of a node from it, or any above the limit, at which the fit
    stops [sigma]; then its angle and the mean positions before and after it: it is
    `x -> R_turn (x - pivot) + goal`.
    """
    node_f, node_i = tb.node_f(head), tb.node_i(head)
    clique_i, pool_i = tb.clique_i(head), tb.pool_i(head)
    begin = clique_i[c, tb.NODES] + clique_i[c, tb.N_FRONTAL]
    n = clique_i[c, tb.N_SEPARATOR]
    iteration = head[tb.ITERATION]
    turn = pivot_x = pivot_y = goal_x = goal_y = 0.0
    for m in range(begin, begin + n):
        v = pool_i[m]
        f = node_f[v]
        goal_x += f[tb.POSE]
        goal_y += f[tb.POSE + 1]
        if node_i[v, tb.CHANGED] == iteration:
            turn += f[tb.DELTA + 2] - f[tb.SEEN + 2]
            pivot_x += f[tb.SEEN] - f[tb.DELTA]
            pivot_y += f[tb.SEEN + 1] - f[tb.DELTA + 1]
    weight = 1.0 / n
    turn *= weight
    goal_x, goal_y = goal_x * weight, goal_y * weight
    pivot_x, pivot_y = goal_x + pivot_x * weight, goal_y + pivot_y * weight
    if n == 1:
        return 0.0, turn, pivot_x, pivot_y, goal_x, goal_y
    versine, sine = math.cos(turn) - 1.0, math.sin(turn)
    deviation = 0.0
    for m in range(begin, begin + n):
        v = pool_i[m]
        f = node_f[v]
        dx = dy = dth = 0.0
        if node_i[v, tb.CHANGED] == iteration:
            dx, dy = f[tb.DELTA] - f[tb.SEEN], f[tb.DELTA + 1] - f[tb.SEEN + 1]
            dth = f[tb.DELTA + 2] - f[tb.SEEN + 2]
        x, y = f[tb.POSE] - dx - pivot_x, f[tb.POSE + 1] - dy - pivot_y
        dx -= goal_x - pivot_x + versine * x - sine * y
        dy -= goal_y - pivot_y + sine * x + versine * y
        deviation = max(deviation, max(abs(dx), abs(dy)) * f[tb.SCALE_T],
                        abs(dth - turn) * f[tb.SCALE_R])
        if deviation > limit:
            break
    return deviation, turn, pivot_x, pivot_y, goal_x, goal_y


@kernel
def _propagate(head, c, motion, stack, depth):  # type: ignore[no-untyped-def]
    """Return the number of nodes at or below a clique, after moving them by a rigid motion."""
    node_f, clique_i, pool_i = tb.node_f(head), tb.clique_i(head), tb.pool_i(head)
    _, turn, pivot_x, pivot_y, goal_x, goal_y = motion
    cos, sin = math.cos(turn), math.sin(turn)
    bottom, moved = depth, 0
    stack[depth] = c
    depth += 1
    while depth > bottom:
        depth -= 1
        row = clique_i[stack[depth]]
        for m in range(row[tb.NODES], row[tb.NODES] + row[tb.N_FRONTAL]):
            v = pool_i[m]
            transaction_log.log_solution(head, v)
            f = node_f[v]
            x, y = f[tb.POSE] - pivot_x, f[tb.POSE + 1] - pivot_y
            x, y = cos * x - sin * y + goal_x, sin * x + cos * y + goal_y
            dx, dy = x - f[tb.POSE], y - f[tb.POSE + 1]
            f[tb.POSE], f[tb.POSE + 1] = x, y
            f[tb.POSE + 2] = factors.wrap(f[tb.POSE + 2] + turn)
            f[tb.DELTA] += dx
            f[tb.DELTA + 1] += dy
            f[tb.DELTA + 2] += turn
            f[tb.SEEN] += dx
            f[tb.SEEN + 1] += dy
            f[tb.SEEN + 2] += turn
        moved += row[tb.N_FRONTAL]
        child = row[tb.CHILD]
        while child >= 0:
            if clique_i[child, tb.N_FRONTAL] > 0:
                stack[depth] = child
                depth += 1
            child = clique_i[child, tb.SIBLING]
    return moved


@kernel
def _update_child(head, c, stack, depth):  # type: ignore[no-untyped-def]
    """
    Update a clique after its parent was visited, as far as that takes no solve.

    Return _AS_IT_IS: its separator has not moved; _PROPAGATED: that has moved as a rigid body, and
    all nodes at and below the clique were moved with it; or _SOLVED: it is to be solved for.
    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    clique_f = tb.clique_f(head)
    row, iteration = clique_i[c], head[tb.ITERATION]
    if row[tb.BUILT] >= head[tb.SINCE]:
        return _SOLVED
    limit = FREE_FRACTION * tb.scalars(head)[tb.SETTING_ALPHA]
    begin = row[tb.NODES] + row[tb.N_FRONTAL]
    for m in range(begin, begin + row[tb.N_SEPARATOR]):
        if node_i[pool_i[m], tb.CHANGED] == iteration:
            if row[tb.ANCHORED] != 0:
                return _SOLVED
            slack = limit - clique_f[c, tb.DRIFT]
            motion = _rigid_motion(head, c, slack)
            if motion[0] > slack:
                return _SOLVED
            if motion[0] > 0.0:
                transaction_log.log_clique(head, c)
                clique_f[c, tb.DRIFT] += motion[0]
            tb.scalars(head)[tb.N_MOVED] += _propagate(head, c, motion, stack, depth)
            return _PROPAGATED
    return _SOLVED if clique_f[c, tb.DRIFT] > limit else _AS_IT_IS


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
                if code != _AS_IT_IS or refines:
                    _set_turn(head, child, turn)
                if code == _SOLVED:
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
