# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Parts of the tree that move as a rigid body.

A constraint between two poses does not feel a common motion of both. If the separator of a clique
that is not anchored has moved like a rigid body, so does everything below it: it is *carried*,
pose by pose, instead of being solved for. Most of what a loop closure moves far away moves so.

What the separator's motion is off the rigid one, in sigmas of its nodes, adds up as the *drift* of
the clique. Beyond `SETTING_DRIFT` it is solved for, and the drift goes on to those below.
"""

import math

from pose_graph_ros.core import factors, tables as tb, undo
from pose_graph_ros.core.jit import kernel


@kernel
def rigid_motion(head, c, limit):  # type: ignore[no-untyped-def]
    """
    Fit a rigid motion to what the nodes of a clique's separator have moved in this iteration.

    Parameters
    ----------
    c : int
    limit : float
        How far off it may be [sigma].

    Returns
    -------
    off : float
        How far off it is, at the worst node; more than the limit if it is no rigid motion.
    turn : float
        The motion is `x -> R_turn (x - pivot) + goal`.
    pivot_x, pivot_y, goal_x, goal_y : float

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
    share = 1.0 / n
    turn *= share
    goal_x, goal_y = goal_x * share, goal_y * share
    pivot_x, pivot_y = goal_x + pivot_x * share, goal_y + pivot_y * share
    if n == 1:
        return 0.0, turn, pivot_x, pivot_y, goal_x, goal_y
    versine, sine = math.cos(turn) - 1.0, math.sin(turn)
    off = 0.0
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
        off = max(off, max(abs(dx), abs(dy)) * f[tb.STIFF_T], abs(dth - turn) * f[tb.STIFF_R])
        if off > limit:
            break
    return off, turn, pivot_x, pivot_y, goal_x, goal_y


@kernel
def carry(head, c, motion, stack, depth):  # type: ignore[no-untyped-def]
    """
    Move all nodes that are eliminated in a clique or below it.

    Parameters
    ----------
    c : int
    motion : tuple
        What `rigid_motion` returns.
    stack : ndarray of int32
        Free from `depth` on.
    depth : int

    Returns
    -------
    int
        How many nodes have been moved.

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
            undo.log_solution(head, v)
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
            stack[depth] = child
            depth += 1
            child = clique_i[child, tb.SIBLING]
    return moved
