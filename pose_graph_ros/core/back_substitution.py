# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From the roots down as far as values move, and what that means for the constraints there.

A clique is visited if it was built in this iteration, or if a node of its separator has moved
noticeably since the cliques below have seen it: by more than `alpha` of the sigma that the node's
own constraints give it. The constraints of nodes that have turned are then looked at again.
"""

import math

from pose_graph_ros.core import factors, frames, tables as tb, undo
from pose_graph_ros.core.cholesky import solve_rows
from pose_graph_ros.core.elimination import add_seed
from pose_graph_ros.core.jit import kernel

# A constraint is worth linearizing again from this fraction of its share of the budget on.
LEAST_SHARE = 0.01
# What linearizing again leaves of the budget.
LEFT_OVER = 0.4
# Constraints are looked at where the turn of a node could matter: linearization goes wrong where a
# heading changes. Of the energy of a constraint that much is assumed. Moves are looked at from so
# many times alpha on.
USUAL_ENERGY = 0.1
LOOK_AT_MOVE = 100.0


@kernel
def _move(head, v, dx, dy, dth, phi, alpha):  # type: ignore[no-untyped-def]
    """
    Give a node its new solution; phi is the angle of its clique's frame.

    Returns
    -------
    int
        0: the cliques below need not know; 1: they must; 2: its constraints are to be looked at
        as well.

    """
    node_f, node_i = tb.node_f(head), tb.node_i(head)
    f = node_f[v]
    undo.log_solution(head, v)
    f[tb.DELTA], f[tb.DELTA + 1], f[tb.DELTA + 2] = dx, dy, dth
    f[tb.POSE], f[tb.POSE + 1] = f[tb.REF] + dx, f[tb.REF + 1] + dy
    f[tb.POSE + 2] = factors.wrap(f[tb.REF + 2] + dth)
    moved = max(abs(dx - f[tb.SEEN]), abs(dy - f[tb.SEEN + 1])) * f[tb.STIFF_T]
    turned = dth - f[tb.SEEN + 2]
    if moved <= alpha and abs(turned) * f[tb.STIFF_R] <= alpha:
        return 0
    f[tb.SEEN], f[tb.SEEN + 1], f[tb.SEEN + 2] = dx, dy, dth
    node_i[v, tb.CHANGED] = head[tb.ITERATION]
    tb.scalars(head)[tb.N_MOVED] += 1.0
    # about the squared linearization error that the turn since the last look makes
    bent = (dth - phi - f[tb.LOOKED]) ** 2
    error2 = bent * (bent * f[tb.STIFF_R] * f[tb.STIFF_R] + USUAL_ENERGY)
    if error2 <= tb.scalars(head)[tb.SETTING_SHARE] and moved <= LOOK_AT_MOVE * alpha:
        return 1
    f[tb.LOOKED] = dth - phi
    return 2


@kernel
def _visit_pair(head, values, v, other, alpha):  # type: ignore[no-untyped-def]
    """Solve a clique of a node and a separator node, as along a chain; answers of `_move`."""
    node_f, pool_f = tb.node_f(head), tb.pool_f(head)
    r, f = pool_f[values:values + 21], node_f[other]
    a, b, c = f[tb.DELTA], f[tb.DELTA + 1], f[tb.DELTA + 2]
    z = (r[20] - (r[17] * a + r[18] * b + r[19] * c)) * r[16]
    y = (r[13] - (r[10] * a + r[11] * b + r[12] * c) - r[9] * z) * r[8]
    x = (r[6] - (r[3] * a + r[4] * b + r[5] * c) - r[2] * z - r[1] * y) * r[0]
    return _move(head, v, x, y, z, 0.0, alpha)


@kernel
def _visit(head, c, alpha, looks, n_looks):  # type: ignore[no-untyped-def]
    """Solve for the frontal nodes of a clique; return how many nodes are to be looked at."""
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    node_f, pool_f, work_f = tb.node_f(head), tb.pool_f(head), tb.work_f(head)
    row = clique_i[c]
    n_frontal, n_separator = row[tb.N_FRONTAL], row[tb.N_SEPARATOR]
    rows, n = 3 * n_frontal, 3 * (n_frontal + n_separator)
    nodes = pool_i[row[tb.NODES]:row[tb.NODES] + n_frontal + n_separator]
    phi = _turn(head, c)
    if phi == 0.0 and n_frontal == 1 and n_separator == 1:
        v = nodes[0]
        if node_i[v, tb.FIXED] == 0 and _visit_pair(
                head, row[tb.VALUES], v, nodes[1], alpha) == 2:
            looks[n_looks] = v
            n_looks += 1
        return n_looks
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
    solve_rows(pool_f[row[tb.VALUES]:row[tb.VALUES] + rows * (n + 1)], rows, n, x)
    for k in range(n_frontal):
        v = nodes[k]
        dx, dy, dth = x[3 * k], x[3 * k + 1], x[3 * k + 2]
        if phi != 0.0:
            dx, dy = frames.map_delta(node_f[v], dx, dy, px, py, cos, sin)
            dth += phi
        if node_i[v, tb.FIXED] == 0 and _move(
                head, v, dx, dy, dth, phi, alpha) == 2:
            looks[n_looks] = v
            n_looks += 1
    return n_looks


@kernel
def _turn(head, c):  # type: ignore[no-untyped-def]
    """Turn the frame of a clique with its separator; return its angle."""
    clique_i, clique_f, work_i = tb.clique_i(head), tb.clique_f(head), tb.work_i(head)
    if clique_i[c, tb.ANCHORED] != 0:
        return 0.0
    phi = frames.present_turn(head, c)
    if phi != clique_f[c, tb.TURN]:
        undo.log_clique(head, c)
        clique_f[c, tb.TURN] = phi
    slip = frames.frame_slip(head, c)
    slip2 = slip * slip
    error2 = slip2 * (slip2 * clique_f[c, tb.SLIP_STIFF] + USUAL_ENERGY)
    if error2 > tb.scalars(head)[tb.SETTING_SHARE]:
        work_i[2 * head[tb.N_NODES] + head[tb.N_TURNED]] = c
        head[tb.N_TURNED] += 1
    return phi


@kernel
def _is_due(head, c, iteration):  # type: ignore[no-untyped-def]
    """Tell whether a clique was built in this iteration, or has a separator that has moved."""
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    row = clique_i[c]
    if row[tb.BUILT] == iteration:
        return True
    begin = row[tb.NODES] + row[tb.N_FRONTAL]
    for m in range(begin, begin + row[tb.N_SEPARATOR]):
        if node_i[pool_i[m], tb.CHANGED] == iteration:
            return True
    return False


@kernel
def _back_substitute(head, alpha):  # type: ignore[no-untyped-def]
    """Visit the cliques from the roots on the stack down; list the nodes to be looked at."""
    clique_i, work_i = tb.clique_i(head), tb.work_i(head)
    n_nodes = head[tb.N_NODES]
    stack, looks = work_i, work_i[n_nodes:]
    depth, n_looks, n_visited = head[tb.N_ROOTS], 0, 0
    iteration = head[tb.ITERATION]
    head[tb.N_TURNED] = 0
    tb.scalars(head)[tb.N_MOVED] = 0.0
    while depth > 0:
        depth -= 1
        c = stack[depth]
        while c >= 0:
            n_looks = _visit(head, c, alpha, looks, n_looks)
            n_visited += 1
            # one child at once, the others later
            child, c = clique_i[c, tb.CHILD], -1
            while child >= 0:
                if _is_due(head, child, iteration):
                    if c >= 0:
                        stack[depth] = c
                        depth += 1
                    c = child
                child = clique_i[child, tb.SIBLING]
    head[tb.N_CHANGED] = n_looks
    head[tb.N_VISITED] += n_visited


@kernel
def _wait(head, entry):  # type: ignore[no-untyped-def]
    waiting = tb.waiting(head)
    waiting[head[tb.N_WAITING]] = entry
    head[tb.N_WAITING] += 1


@kernel
def _look_at_edge(head, e):  # type: ignore[no-untyped-def]
    """Evaluate an edge at the present estimate and keep the sums."""
    edge_f, scalars, edge_i = tb.edge_f(head), tb.scalars(head), tb.edge_i(head)
    undo.log_energy(head, e)
    f = edge_f[e]
    scalars[tb.CHI2] -= f[tb.ENERGY]
    factors.check_edge(head, e, tb.clique_f(head)[tb.edge_i(head)[e, tb.OWNER], tb.TURN])
    scalars[tb.CHI2] += f[tb.ENERGY]
    scalars[tb.ERROR2_SUM] += f[tb.ERROR2]
    if f[tb.ERROR2] > LEAST_SHARE * scalars[tb.SETTING_SHARE] and edge_i[e, tb.EDGE_WAITS] == 0:
        edge_i[e, tb.EDGE_WAITS] = 1
        _wait(head, e)


@kernel
def _look_at_observed(head, k):  # type: ignore[no-untyped-def]
    """Evaluate an observed node at the present estimate and keep the sums."""
    observed_f, scalars, observed_i = tb.observed_f(head), tb.scalars(head), tb.observed_i(head)
    undo.log_observed(head, k)
    f = observed_f[k]
    scalars[tb.CHI2] -= f[tb.OBS_ENERGY]
    factors.check_observed(head, k)
    scalars[tb.CHI2] += f[tb.OBS_ENERGY]
    scalars[tb.ERROR2_SUM] += f[tb.OBS_ERROR2]
    if (f[tb.OBS_ERROR2] > LEAST_SHARE * scalars[tb.SETTING_SHARE]
            and observed_i[k, tb.OBS_WAITS] == 0):
        observed_i[k, tb.OBS_WAITS] = 1
        _wait(head, -1 - k)


@kernel
def _look(head):  # type: ignore[no-untyped-def]
    """Look at the constraints of all nodes on the list, at each once, and sum up."""
    edge_f = tb.edge_f(head)
    observed_f = tb.observed_f(head)
    scalars = tb.scalars(head)
    node_i = tb.node_i(head)
    edge_i = tb.edge_i(head)
    observed_i = tb.observed_i(head)
    work_i = tb.work_i(head)
    iteration = head[tb.ITERATION]
    looks = work_i[head[tb.N_NODES]:]
    scalars[tb.ERROR2_SUM] = 0.0
    for n in range(head[tb.N_CHANGED]):
        v = looks[n]
        entry = node_i[v, tb.EDGE_LIST]
        while entry >= 0:
            e, side = entry >> 1, entry & 1
            if edge_i[e, tb.EDGE_CHECKED] != iteration:
                edge_i[e, tb.EDGE_CHECKED] = iteration
                if edge_f[e, tb.WEIGHT] > 0.0:
                    _look_at_edge(head, e)
            entry = edge_i[e, tb.NEXT_J if side == 1 else tb.NEXT_I]
        k = node_i[v, tb.OBSERVED_LIST]
        while k >= 0:
            if observed_f[k, tb.WEIGHT] > 0.0:
                _look_at_observed(head, k)
            k = observed_i[k, tb.OBS_NEXT]


@kernel
def _look_at_turned(head):  # type: ignore[no-untyped-def]
    """Add what frames have turned against those of their parents to the sum; keep the worst."""
    scalars, clique_f, work_i = tb.scalars(head), tb.clique_f(head), tb.work_i(head)
    turned = work_i[2 * head[tb.N_NODES]:]
    kept = 0
    for k in range(head[tb.N_TURNED]):
        c = turned[k]
        slip = frames.frame_slip(head, c)
        error2 = frames.interface_error2(head, c, slip, tb.work_f(head))
        scalars[tb.ERROR2_SUM] += error2
        if error2 > LEAST_SHARE * scalars[tb.SETTING_SHARE]:
            clique_f[c, tb.SLIP_ERROR2] = error2
            turned[kept] = c
            kept += 1
    head[tb.N_TURNED] = kept


@kernel
def forget_waiting(head):  # type: ignore[no-untyped-def]
    """Leave the constraints that wait as they are: together they are linear enough."""
    edge_i, observed_i, waiting = tb.edge_i(head), tb.observed_i(head), tb.waiting(head)
    for n in range(head[tb.N_WAITING]):
        entry = waiting[n]
        if entry >= 0:
            edge_i[entry, tb.EDGE_WAITS] = 0
        else:
            observed_i[-1 - entry, tb.OBS_WAITS] = 0
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def _error2(head, entry):  # type: ignore[no-untyped-def]
    edge_f, observed_f = tb.edge_f(head), tb.observed_f(head)
    if entry >= 0:
        return edge_f[entry, tb.ERROR2]
    return observed_f[-1 - entry, tb.OBS_ERROR2]


@kernel
def _relinearize_worst(head, allowed):  # type: ignore[no-untyped-def]
    """
    Linearize the worst of the waiting constraints again, so that the rest has `allowed` at most.

    Their nodes become seeds of the next elimination, and nothing waits any more.
    """
    work_f = tb.work_f(head)
    edge_i = tb.edge_i(head)
    observed_i = tb.observed_i(head)
    waiting = tb.waiting(head)
    clique_f, clique_i, pool_i = tb.clique_f(head), tb.clique_i(head), tb.pool_i(head)
    work_i = tb.work_i(head)
    # sums by powers of two below what is allowed, largest first
    bins = work_f[:64]
    bins[:] = 0.0
    left, cut = 0.0, 0
    for n in range(head[tb.N_WAITING]):
        error2 = _error2(head, waiting[n])
        bins[_bin(error2 / allowed)] += error2
        left += error2
    turned = work_i[2 * head[tb.N_NODES]:]
    for n in range(head[tb.N_TURNED]):
        error2 = clique_f[turned[n], tb.SLIP_ERROR2]
        bins[_bin(error2 / allowed)] += error2
        left += error2
    while cut < 64 and left > allowed:
        left -= bins[cut]
        cut += 1
    for n in range(head[tb.N_WAITING]):
        entry = waiting[n]
        worst = _bin(_error2(head, entry) / allowed) < cut
        if entry >= 0:
            undo.log_edge(head, entry)
            edge_i[entry, tb.EDGE_WAITS] = 0
            if worst:
                head[tb.N_RELINEARIZED] += 1
                factors.linearize_edge(head, entry)
                _seed(head, edge_i[entry, tb.END_I])
                _seed(head, edge_i[entry, tb.END_J])
        else:
            k = -1 - entry
            undo.log_observed(head, k)
            observed_i[k, tb.OBS_WAITS] = 0
            if worst:
                head[tb.N_RELINEARIZED] += 1
                factors.linearize_observed(head, k)
                _seed(head, observed_i[k, tb.OBS_NODE])
    for n in range(head[tb.N_TURNED]):
        c = turned[n]
        if _bin(clique_f[c, tb.SLIP_ERROR2] / allowed) < cut:
            # its parent takes the update matrix in anew, as it has turned
            head[tb.N_RELINEARIZED] += 1
            _seed(head, pool_i[clique_i[clique_i[c, tb.PARENT], tb.NODES]])
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def _seed(head, v):  # type: ignore[no-untyped-def]
    undo.log_node(head, v)
    add_seed(head, v)


@kernel
def _bin(ratio):  # type: ignore[no-untyped-def]
    """Return 0 for a ratio of 2 or more, then one more for each halving."""
    if ratio <= 0.0:
        return 63
    return min(max(int(1.0 - math.floor(math.log2(ratio))), 0), 63)


@kernel
def _budget(head):  # type: ignore[no-untyped-def]
    """Return the squared linearization error that a step may leave."""
    scalars = tb.scalars(head)
    return min(scalars[tb.SETTING_BUDGET], scalars[tb.SETTING_SHARE] * scalars[tb.N_MOVED])


@kernel
def solve(head):  # type: ignore[no-untyped-def]
    """
    Solve from the roots on the stack down, and see how far that is from linear.

    Returns
    -------
    bool
        Whether it is within the budget. If not, the constraints that matter wait.

    """
    scalars = tb.scalars(head)
    _back_substitute(head, scalars[tb.SETTING_ALPHA])
    _look(head)
    _look_at_turned(head)
    head[tb.N_ITERATIONS] += 1
    if scalars[tb.ERROR2_SUM] <= _budget(head):
        forget_waiting(head)
        return True
    return False


@kernel
def relinearize(head):  # type: ignore[no-untyped-def]
    """Linearize the worst of what waits again; the nodes there become seeds."""
    _relinearize_worst(head, LEFT_OVER * _budget(head))
