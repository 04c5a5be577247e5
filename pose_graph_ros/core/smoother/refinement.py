# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Refinement: from the estimate of an update, which is within its budget, to the minimum itself.

An update leaves linearization errors, and moves of less than `alpha` sigmas, where they hardly
change chi2. Along soft modes they can still add up to metres. A refinement solves for all cliques
that updates have solved for since the last one, checks all constraints there, linearizes those
with an error again, and repeats this until the errors are below `ENOUGH`. By Cauchy-Schwarz no
coordinate of any node is then further from the minimum than the root of that, in its posterior
sigmas. Each call does one iteration, and the graph is valid after each.
"""

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import tables as tb, transaction_log
from pose_graph_ros.core.graph.editing import touch
from pose_graph_ros.core.smoother import relinearization, tree_update

# Sum of the squared linearization errors at the end of a refinement [sigma^2].
ENOUGH = 1e-10
# `alpha` [sigma] and `budget_share` [sigma^2] of a refinement.
ALPHA = 1e-6
SHARE = 1e-13
# Relative rounding error of chi2.
ROUNDING = 1e-11
# How far above the lowest chi2 so far an iteration may end: Gauss-Newton goes uphill where it
# swings a soft mode [sigma^2].
UPHILL = 0.1
# Maximum number of iterations after an update.
MAX_ITERATIONS = 20
# Return codes of `refine`.
REFINED, UNFINISHED, INTERRUPTED, MORE_MEMORY, FAILED = range(5)


@kernel
def _touch_clique(head, c):  # type: ignore[no-untyped-def]
    pool_i, clique_i = tb.pool_i(head), tb.clique_i(head)
    v = pool_i[clique_i[c, tb.NODES]]
    transaction_log.log_node(head, v)
    touch(head, v)
    head[tb.N_RELINEARIZED] += 1


@kernel
def _touch_waiting(head):  # type: ignore[no-untyped-def]
    """Touch the cliques of waiting constraints and turned frames; eliminating linearizes them."""
    node_i, edge_i, observed_i = tb.node_i(head), tb.edge_i(head), tb.observed_i(head)
    waiting, clique_i, work_i = tb.waiting(head), tb.clique_i(head), tb.work_i(head)
    turned = work_i[2 * head[tb.NODE_ROOM]:]
    for n in range(head[tb.N_TURNED]):
        _touch_clique(head, clique_i[turned[n], tb.PARENT])
    for n in range(head[tb.N_WAITING]):
        entry = waiting[n]
        if entry >= 0:
            transaction_log.log_edge(head, entry)
            edge_i[entry, tb.EDGE_WAITS] = 0
            _touch_clique(head, edge_i[entry, tb.OWNER])
        else:
            k = -1 - entry
            transaction_log.log_observed(head, k)
            observed_i[k, tb.OBS_WAITS] = 0
            _touch_clique(head, node_i[observed_i[k, tb.OBS_NODE], tb.CLIQUE])
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def _solve(head):  # type: ignore[no-untyped-def]
    """Solve for the cliques that have changed since the last refinement, and check them."""
    head[tb.SINCE] = head[tb.REFINED]
    relinearization.solve_and_check(head)


@kernel
def _solve_from_the_root(head):  # type: ignore[no-untyped-def]
    node_i, clique_i, work_i = tb.node_i(head), tb.clique_i(head), tb.work_i(head)
    c = node_i[head[tb.NEWEST], tb.CLIQUE]
    while clique_i[c, tb.PARENT] >= 0:
        c = clique_i[c, tb.PARENT]
    work_i[0] = c
    head[tb.N_ROOTS] = 1
    head[tb.ITERATION] += 1
    _solve(head)


@kernel(allocates=True)
def _iterate(head):  # type: ignore[no-untyped-def]
    """Linearize what waits again, eliminate it and what is above it, and solve."""
    scalars = tb.scalars(head)
    chi2, error2 = scalars[tb.CHI2], scalars[tb.ERROR2_SUM]
    _touch_waiting(head)
    if head[tb.N_TOUCHED] == 0:
        return REFINED      # many errors, each of them negligible
    marked, affected = tree_update.mark(head)
    head[tb.ITERATION] += 1
    code = tree_update.refresh(head, marked, True)
    if code != tree_update.DONE:
        return MORE_MEMORY if code == tree_update.MORE_MEMORY else FAILED
    tree_update.forget_touched(head)
    head[tb.N_ELIMINATED] = len(affected)
    _solve(head)
    if not scalars[tb.CHI2] <= scalars[tb.LOWEST] + UPHILL or head[tb.ROUND] >= MAX_ITERATIONS:
        return FAILED
    head[tb.ROUND] += 1
    scalars[tb.LOWEST] = min(scalars[tb.LOWEST], scalars[tb.CHI2])
    least = ROUNDING * max(chi2, 1.0)
    # rounding errors cannot be reduced any further
    stalls = abs(scalars[tb.CHI2] - chi2) <= least and scalars[tb.ERROR2_SUM] > 0.5 * error2
    return REFINED if stalls or scalars[tb.ERROR2_SUM] <= ENOUGH else UNFINISHED


@kernel(allocates=True)
def _refine(head):  # type: ignore[no-untyped-def]
    scalars = tb.scalars(head)
    if head[tb.LISTED] != head[tb.UPDATE] - 1:
        head[tb.N_TURNED] = 0   # cliques that were listed may have been replaced
        _solve_from_the_root(head)
        head[tb.ROUND], scalars[tb.LOWEST] = 0, scalars[tb.CHI2]
    if head[tb.INTERRUPT] != 0:
        return INTERRUPTED
    code = _iterate(head) if scalars[tb.ERROR2_SUM] > ENOUGH else REFINED
    if head[tb.INTERRUPT] != 0 and code != MORE_MEMORY:
        return INTERRUPTED
    if code == REFINED:
        relinearization.forget_waiting(head)
        head[tb.REFINED] = head[tb.ITERATION] + 1
    elif code == UNFINISHED:
        head[tb.LISTED] = head[tb.UPDATE]
    return code


@kernel(signature=(tb.HEAD,), allocates=True)
def refine(head):  # type: ignore[no-untyped-def]
    """
    Return REFINED if the estimate is at the minimum, or UNFINISHED after an iteration towards it.

    INTERRUPTED: `INTERRUPT` of the head was set. MORE_MEMORY: the pools and the work space must
    grow to `NEED_F`, `NEED_I` and `NEED_WORK` of the head. FAILED: the iteration leads away from
    the minimum, or a node is not determined. After these three the caller has to roll back what
    `transaction_log.begin` has begun. The graph must have no touched nodes.
    """
    scalars = tb.scalars(head)
    alpha, share = scalars[tb.SETTING_ALPHA], scalars[tb.SETTING_SHARE]
    scalars[tb.SETTING_ALPHA], scalars[tb.SETTING_SHARE] = ALPHA, SHARE
    head[tb.N_RELINEARIZED] = head[tb.N_ELIMINATED] = 0
    head[tb.N_VISITED] = head[tb.N_ITERATIONS] = 0
    code = _refine(head)
    scalars[tb.SETTING_ALPHA], scalars[tb.SETTING_SHARE] = alpha, share
    if code in (REFINED, UNFINISHED):
        scalars[tb.LARGEST_MOVE] = transaction_log.largest_move(head)
        transaction_log.commit(head)
    return code
