# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Rigid propagation: subtrees of the Bayes tree that move as a rigid body.

The error of a constraint between two poses does not change with a common motion of both. If the
separator of a clique that is not anchored has moved as a rigid body, all nodes below have the same
motion. It is applied to their poses, and nothing is solved for. Most nodes far from a loop closure
move this way.

The deviation of the separator's motion from the rigid one, in sigmas of its nodes, is added to the
*drift* of the clique. Above `FREE_FRACTION` of alpha (`back_substitution`) the clique is solved
for instead, and its drift is added to that of its children.
"""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import factors, tables as tb, transaction_log


@kernel
def rigid_motion(head, c, limit):  # type: ignore[no-untyped-def]
    """
    Return the rigid motion that fits this iteration's moves of the nodes of a clique's separator.

    Parameters
    ----------
    c : int, clique
    limit : float, deviation at which the fit stops [sigma]

    Returns
    -------
    deviation : float, largest deviation of a node from the motion, or any above the limit [sigma]
    turn : float, angle of the motion `x -> R_turn (x - pivot) + goal` [rad]
    pivot_x, pivot_y, goal_x, goal_y : float
        Mean position of the separator before and after the motion, in the map [m].

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
def propagate(head, c, motion, stack, depth):  # type: ignore[no-untyped-def]
    """
    Return the number of nodes at or below a clique, after moving them by a rigid motion.

    Parameters
    ----------
    c : int, clique
    motion : tuple, from `rigid_motion`
    stack : ndarray of int32, work space from `depth` on
    depth : int

    """
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
