# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From the roots down as far as values move.

A clique is visited if it was built in this iteration, or if a node of its separator has moved
noticeably since the cliques below have seen it: by more than `alpha` of the sigma that the node's
own constraints give it. If the separator has moved as a rigid body, what is below is carried along
(`carrying`). Listed are the nodes that have turned, and the cliques whose frames have: their
constraints are to be looked at again (`relinearization`).
"""

import math

from pose_graph_ros.core import factors, frames, tables as tb, undo
from pose_graph_ros.core.carrying import carry, rigid_motion
from pose_graph_ros.core.cholesky import solve_rows, triangle_size
from pose_graph_ros.core.jit import kernel
from pose_graph_ros.core.vectors import fetch

# Constraints are looked at where the turn of a node could matter: linearization goes wrong where a
# heading changes. Of the energy of a constraint that much is assumed. Moves are looked at from so
# many times alpha on.
USUAL_ENERGY = 0.1
LOOK_AT_MOVE = 100.0
# Where nothing below is tied to the map, what is left unseen goes on undiminished: so much of
# alpha counts there, for the moves of nodes and for the drift of cliques.
FREE_SHARE = 0.35
# Answers of `_follow`.
LEFT, CARRIED, SOLVED = range(3)


@kernel
def _move(head, v, dx, dy, dth, phi, alpha):  # type: ignore[no-untyped-def]
    """
    Give a node its new solution, and note it if it has moved by more than alpha sigmas.

    phi is the angle of its clique's frame.
    """
    node_f, node_i, scalars = tb.node_f(head), tb.node_i(head), tb.scalars(head)
    work_i, room = tb.work_i(head), head[tb.NODE_ROOM]
    f = node_f[v]
    undo.log_solution(head, v)
    f[tb.DELTA], f[tb.DELTA + 1], f[tb.DELTA + 2] = dx, dy, dth
    f[tb.POSE], f[tb.POSE + 1] = f[tb.REF] + dx, f[tb.REF + 1] + dy
    f[tb.POSE + 2] = factors.wrap(f[tb.REF + 2] + dth)
    moved = max(abs(dx - f[tb.SEEN]), abs(dy - f[tb.SEEN + 1])) * f[tb.STIFF_T]
    turned = dth - f[tb.SEEN + 2]
    if moved <= alpha and abs(turned) * f[tb.STIFF_R] <= alpha:
        return
    node_i[v, tb.CHANGED] = head[tb.ITERATION]
    work_i[3 * room + head[tb.N_CHANGED]] = v
    head[tb.N_CHANGED] += 1
    # about the squared linearization error that the turn since the last look makes
    bent = (dth - phi - f[tb.LOOKED]) ** 2
    error2 = bent * (bent * f[tb.STIFF_R] * f[tb.STIFF_R] + USUAL_ENERGY)
    if error2 > scalars[tb.SETTING_SHARE] or moved > LOOK_AT_MOVE * alpha:
        f[tb.LOOKED] = dth - phi
        work_i[room + head[tb.N_LOOKS]] = v
        head[tb.N_LOOKS] += 1


@kernel
def _visit_pair(head, values, v, other, alpha):  # type: ignore[no-untyped-def]
    """Solve a clique of a node and a separator node, as along a chain."""
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
        alpha *= FREE_SHARE
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
            x[3 * k], x[3 * k + 1], x[3 * k + 2] = frames.local_delta(f, px, py, cos, sin, phi)
    solve_rows(pool_f[row[tb.VALUES]:], rows, n, x)
    for k in range(n_frontal):
        v = nodes[k]
        dx, dy, dth = x[3 * k], x[3 * k + 1], x[3 * k + 2]
        if phi != 0.0:
            dx, dy = frames.map_delta(node_f[v], dx, dy, px, py, cos, sin)
            dth += phi
        if node_i[v, tb.FIXED] == 0:
            _move(head, v, dx, dy, dth, phi, alpha)


@kernel
def _turn(head, c, parent_turn):  # type: ignore[no-untyped-def]
    """Note the angle of a clique's frame, and whether it has turned against its parent's."""
    clique_i, clique_f, work_i = tb.clique_i(head), tb.clique_f(head), tb.work_i(head)
    f = clique_f[c]
    if clique_i[c, tb.ANCHORED] != 0:
        f[tb.TURN] = 0.0
        return
    f[tb.TURN] = frames.present_turn(head, c)
    slip = f[tb.TURN] - f[tb.TURN_SEEN] - parent_turn
    slip2 = slip * slip
    error2 = slip2 * (slip2 * f[tb.SLIP_STIFF] + USUAL_ENERGY)
    if error2 > tb.scalars(head)[tb.SETTING_SHARE]:
        work_i[2 * head[tb.NODE_ROOM] + head[tb.N_TURNED]] = c
        head[tb.N_TURNED] += 1


@kernel
def _follow(head, c, stack, depth):  # type: ignore[no-untyped-def]
    """
    Find what the visit of its parent means for a clique.

    Returns
    -------
    int
        LEFT: its separator has not moved; CARRIED: as a rigid body, and all below has been carried
        along; SOLVED: it is to be solved for.

    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    clique_f = tb.clique_f(head)
    row, iteration = clique_i[c], head[tb.ITERATION]
    if row[tb.BUILT] == iteration:
        return SOLVED
    limit = FREE_SHARE * tb.scalars(head)[tb.SETTING_ALPHA]
    begin = row[tb.NODES] + row[tb.N_FRONTAL]
    for m in range(begin, begin + row[tb.N_SEPARATOR]):
        if node_i[pool_i[m], tb.CHANGED] == iteration:
            if row[tb.ANCHORED] != 0:
                return SOLVED
            left = limit - clique_f[c, tb.DRIFT]
            motion = rigid_motion(head, c, left)
            if motion[0] > left:
                return SOLVED
            if motion[0] > 0.0:
                undo.log_clique(head, c)
                clique_f[c, tb.DRIFT] += motion[0]
            tb.scalars(head)[tb.N_MOVED] += carry(head, c, motion, stack, depth)
            return CARRIED
    return SOLVED if clique_f[c, tb.DRIFT] > limit else LEFT


@kernel
def _fetch_rows(head, c):  # type: ignore[no-untyped-def]
    """Have the rows of R of a clique fetched: they are used once, and then from memory."""
    clique_i, pool_f = tb.clique_i(head), tb.pool_f(head)
    row = clique_i[c]
    rows, begin = 3 * row[tb.N_FRONTAL], row[tb.VALUES]
    size = triangle_size(rows, rows + 3 * row[tb.N_SEPARATOR])
    for at in range(begin, begin + size, 8):
        fetch(pool_f, at)


@kernel
def back_substitute(head):  # type: ignore[no-untyped-def]
    """Visit the cliques from the roots on the stack down; list the nodes to be looked at."""
    clique_i, clique_f, work_i = tb.clique_i(head), tb.clique_f(head), tb.work_i(head)
    node_f, scalars = tb.node_f(head), tb.scalars(head)
    stack, depth = work_i, head[tb.N_ROOTS]
    n_visited = 0
    for k in range(depth):
        clique_f[stack[k], tb.TURN] = 0.0
    head[tb.N_TURNED] = head[tb.N_LOOKS] = head[tb.N_CHANGED] = 0
    scalars[tb.N_MOVED] = 0.0
    while depth > 0:
        depth -= 1
        c = stack[depth]
        while c >= 0:
            _visit(head, c)
            n_visited += 1
            turn = clique_f[c, tb.TURN]
            drift = clique_f[c, tb.DRIFT]
            if drift > 0.0:
                undo.log_clique(head, c)
                clique_f[c, tb.DRIFT] = 0.0
            # one child at once, the others later
            child, c = clique_i[c, tb.CHILD], -1
            while child >= 0:
                if drift > 0.0:
                    undo.log_clique(head, child)
                    clique_f[child, tb.DRIFT] += drift
                due = _follow(head, child, stack, depth)
                if due != LEFT:
                    _turn(head, child, turn)
                if due == SOLVED:
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
