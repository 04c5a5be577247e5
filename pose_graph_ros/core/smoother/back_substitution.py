# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Back-substitution from the roots of the Bayes tree down, as far as values change.

A clique is visited if it was built in this iteration, or if a node of its separator has moved by
more than the wildfire threshold (M. Kaess et al., "iSAM2", IJRR 2012) since its solution was last
passed to the cliques below. The threshold is `alpha` times the sigma that the node's own
constraints give it. Nodes that have turned, and cliques whose frames have turned, are listed for
`step`, which checks their linearization errors.

The error of a constraint between two poses does not change with a common motion of both. So if the
separator of a clique that is not anchored has moved as a rigid body, that motion is applied to the
poses of all nodes below, and nothing is solved for. Most nodes far from a loop closure move this
way. The deviation of the separator's motion from the rigid one, in sigmas of its nodes, is added
to the *drift* of the clique. Above `FREE_FRACTION` of alpha the clique is solved for instead, and
its drift is added to that of its children.
"""

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.compiled.simd import fetch
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.elimination.fronts import backward_rows
from pose_graph_ros.core.graph import factors, prior_rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.pools import separator, triangle_size
from pose_graph_ros.core.smoother.tree_update import interrupted

# Energy of a constraint that is assumed to predict its linearization error from a turn [sigma^2].
USUAL_ENERGY = 0.1
# Fraction of `budget_share` from which on the error of a turned frame is computed: in a long chain
# many small ones add up.
SLIP_FRACTION = 0.1
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
    nodes, scalars = tb.nodes(head), tb.scalars(head)[0]
    work_i, room = tb.work_i(head), head[tb.NODE_ROOM]
    f = nodes[v]
    transaction_log.log_node(head, v)
    f.delta[0], f.delta[1], f.delta[2] = dx, dy, dth
    f.pose[0], f.pose[1] = f.reference[0] + dx, f.reference[1] + dy
    f.pose[2] = factors.wrap(f.reference[2] + dth)
    moved = max(abs(dx - f.seen[0]), abs(dy - f.seen[1])) * f.scale_t
    turned = dth - f.seen[2]
    if moved > alpha or abs(turned) * f.scale_r > alpha:
        nodes[v].changed = head[tb.ITERATION]
        work_i[3 * room + head[tb.N_CHANGED]] = v
        head[tb.N_CHANGED] += 1
    elif head[tb.SINCE] == head[tb.ITERATION]:
        return      # a refinement checks all nodes
    # approximate squared linearization error due to the turn since the last check
    turn2 = (dth - phi - f.checked_turn) ** 2
    error2 = 0.2 * turn2 * (turn2 * f.scale_r * f.scale_r + USUAL_ENERGY)
    if (error2 > scalars.share or moved > 100.0 * alpha or head[tb.SINCE] < head[tb.ITERATION]):
        f.checked_turn = dth - phi
        work_i[room + head[tb.N_CHECKS]] = v
        head[tb.N_CHECKS] += 1


@kernel
def _visit(head, c):  # type: ignore[no-untyped-def]
    """Solve for the frontal nodes of a clique."""
    nodes, row = tb.nodes(head), tb.cliques(head)[c]
    n_frontal, n = row.n_frontal, row.n_frontal + row.n_separator
    members, x = tb.pool_i(head)[row.members:row.members + n], tb.work_f(head)[:3 * n + 3]
    phi, alpha = row.turn, tb.scalars(head)[0].alpha
    if row.anchored == 0:
        alpha *= FREE_FRACTION
    cos, sin, px, py = 1.0, 0.0, 0.0, 0.0
    if phi != 0.0:
        versine, sin = factors.turned_by(phi)
        cos = 1.0 + versine
        f = nodes[members[n_frontal]]
        px, py = f.pose[0], f.pose[1]
    for k in range(n_frontal, n):
        f = nodes[members[k]]
        if phi == 0.0:
            x[3 * k], x[3 * k + 1], x[3 * k + 2] = f.delta[0], f.delta[1], f.delta[2]
        else:
            x[3 * k], x[3 * k + 1], x[3 * k + 2] = clique_frames.local_delta(
                f, px, py, cos, sin, phi)
    backward_rows(tb.pool_f(head)[row.values:], 3 * n_frontal, 3 * n, x, True)
    for k in range(n_frontal):
        v = members[k]
        dx, dy, dth = x[3 * k], x[3 * k + 1], x[3 * k + 2]
        if phi != 0.0:
            # the inverse of `local_delta`
            f = nodes[v]
            dx, dy = dx + f.reference[0] - px, dy + f.reference[1] - py
            dx, dy = (cos * dx - sin * dy + px - f.reference[0],
                      sin * dx + cos * dy + py - f.reference[1])
            dth += phi
        if nodes[v].fixed == 0:
            _move(head, v, dx, dy, dth, phi, alpha)


@kernel
def _rigid_motion(head, c, limit):  # type: ignore[no-untyped-def]
    """
    Return the rigid motion that fits this iteration's moves of the nodes of a clique's separator.

    First comes the largest deviation of a node from it, or any above the limit, at which the fit
    stops [sigma]; then its angle and the mean positions before and after it: it is
    `x -> R_turn (x - pivot) + goal`.
    """
    nodes, members, iteration = tb.nodes(head), separator(head, c), head[tb.ITERATION]
    turn = pivot_x = pivot_y = goal_x = goal_y = 0.0
    for v in members:
        f = nodes[v]
        goal_x += f.pose[0]
        goal_y += f.pose[1]
        if f.changed == iteration:
            turn += f.delta[2] - f.seen[2]
            pivot_x += f.seen[0] - f.delta[0]
            pivot_y += f.seen[1] - f.delta[1]
    weight = 1.0 / len(members)
    turn *= weight
    goal_x, goal_y = goal_x * weight, goal_y * weight
    pivot_x, pivot_y = goal_x + pivot_x * weight, goal_y + pivot_y * weight
    if len(members) == 1:
        return 0.0, turn, pivot_x, pivot_y, goal_x, goal_y
    versine, sine = factors.turned_by(turn)
    deviation = 0.0
    for v in members:
        f = nodes[v]
        dx = dy = dth = 0.0
        if f.changed == iteration:
            dx, dy = f.delta[0] - f.seen[0], f.delta[1] - f.seen[1]
            dth = f.delta[2] - f.seen[2]
        x, y = f.pose[0] - dx - pivot_x, f.pose[1] - dy - pivot_y
        dx -= goal_x - pivot_x + versine * x - sine * y
        dy -= goal_y - pivot_y + sine * x + versine * y
        deviation = max(deviation, max(abs(dx), abs(dy)) * f.scale_t, abs(dth - turn) * f.scale_r)
        if deviation > limit:
            break
    return deviation, turn, pivot_x, pivot_y, goal_x, goal_y


@kernel
def _propagate(head, c, motion, stack, depth):  # type: ignore[no-untyped-def]
    """Return the number of nodes at or below a clique, after moving them by a rigid motion."""
    nodes, cliques, pool_i = tb.nodes(head), tb.cliques(head), tb.pool_i(head)
    _, turn, pivot_x, pivot_y, goal_x, goal_y = motion
    versine, sine = factors.turned_by(turn)
    shift_x, shift_y = goal_x - pivot_x, goal_y - pivot_y
    bottom, moved = depth, 0
    stack[depth] = c
    depth += 1
    while depth > bottom:
        depth -= 1
        row = cliques[stack[depth]]
        for m in range(row.members, row.members + row.n_frontal):
            v = pool_i[m]
            transaction_log.log_node(head, v)
            f = nodes[v]
            x, y = f.pose[0] - pivot_x, f.pose[1] - pivot_y
            dx = shift_x + versine * x - sine * y
            dy = shift_y + sine * x + versine * y
            f.pose[0] += dx
            f.pose[1] += dy
            f.pose[2] = factors.wrap(f.pose[2] + turn)
            f.delta[0] += dx
            f.delta[1] += dy
            f.delta[2] += turn
            f.seen[0] += dx
            f.seen[1] += dy
            f.seen[2] += turn
        moved += row.n_frontal
        child = row.child
        while child >= 0:
            if cliques[child].n_frontal > 0:
                stack[depth] = child
                depth += 1
            child = cliques[child].sibling
    return moved


@kernel
def _update_child(head, c, stack, depth):  # type: ignore[no-untyped-def]
    """
    Update a clique after its parent was visited, as far as that takes no solve.

    Return _AS_IT_IS: its separator has not moved; _PROPAGATED: that has moved as a rigid body, and
    all nodes at and below the clique were moved with it; or _SOLVED: it is to be solved for.
    """
    row = tb.cliques(head)[c]
    if row.built >= head[tb.SINCE]:
        return _SOLVED
    limit = FREE_FRACTION * tb.scalars(head)[0].alpha
    for v in separator(head, c):
        if tb.nodes(head)[v].changed == head[tb.ITERATION]:
            if row.anchored != 0:
                return _SOLVED
            slack = limit - row.drift
            motion = _rigid_motion(head, c, slack)
            if motion[0] > slack:
                return _SOLVED
            if motion[0] > 0.0:
                transaction_log.log_clique(head, c)
                row.drift += motion[0]
            tb.scalars(head)[0].n_moved += _propagate(head, c, motion, stack, depth)
            return _PROPAGATED
    return _SOLVED if row.drift > limit else _AS_IT_IS


@kernel
def back_substitute(head):  # type: ignore[no-untyped-def]
    """Visit the cliques from the roots on the stack down; list the nodes to be checked."""
    cliques, pool_f = tb.cliques(head), tb.pool_f(head)
    work_i, nodes, scalars = tb.work_i(head), tb.nodes(head), tb.scalars(head)[0]
    stack, depth, turned = work_i, head[tb.N_ROOTS], work_i[2 * head[tb.NODE_ROOM]:]
    refines = head[tb.SINCE] < head[tb.ITERATION]
    n_visited = 0
    for k in range(depth):
        cliques[stack[k]].turn = 0.0
    head[tb.N_TURNED] = head[tb.N_CHECKS] = head[tb.N_CHANGED] = 0
    scalars.n_moved = 0.0
    while depth > 0:
        if interrupted(head):
            break   # the caller rolls back
        depth -= 1
        c = stack[depth]
        while c >= 0:
            _visit(head, c)
            cliques[c].built = head[tb.ITERATION]
            n_visited += 1
            turn = cliques[c].turn
            drift = cliques[c].drift
            if drift > 0.0:
                transaction_log.log_clique(head, c)
                cliques[c].drift = 0.0
            # the first child to be solved for comes next, the others go on the stack
            child, c = cliques[c].child, -1
            while child >= 0:
                if cliques[child].n_frontal == 0:
                    transaction_log.log_clique(head, child)
                    prior_rows.update_energy(head, child)
                    if prior_rows.turns(head, child):
                        turned[head[tb.N_TURNED]] = child
                        head[tb.N_TURNED] += 1
                    child = cliques[child].sibling
                    continue
                if drift > 0.0:
                    transaction_log.log_clique(head, child)
                    cliques[child].drift += drift
                code = _update_child(head, child, stack, depth)
                row = cliques[child]
                if code != _AS_IT_IS or refines:    # no turn nor slip if it is anchored
                    row.turn = clique_frames.present_turn(head, child)
                    slip2 = (row.turn - row.turn_seen - turn)**2
                    error2 = slip2 * (slip2 * row.slip_scale + USUAL_ENERGY)
                    if error2 > SLIP_FRACTION * scalars.share:
                        turned[head[tb.N_TURNED]] = child
                        head[tb.N_TURNED] += 1
                if code == _SOLVED:
                    # the rows of R are used once and are not in the cache
                    rows = 3 * row.n_frontal
                    size = triangle_size(rows, rows + 3 * row.n_separator)
                    for at in range(row.values, row.values + size, 8):
                        fetch(pool_f, at)
                    if c >= 0:
                        stack[depth] = c
                        depth += 1
                    c = child
                child = cliques[child].sibling
    changed = work_i[3 * head[tb.NODE_ROOM]:]
    for k in range(head[tb.N_CHANGED]):
        f = nodes[changed[k]]
        f.seen[0], f.seen[1], f.seen[2] = f.delta[0], f.delta[1], f.delta[2]
    scalars.n_moved += head[tb.N_CHANGED]
    head[tb.N_VISITED] += n_visited
