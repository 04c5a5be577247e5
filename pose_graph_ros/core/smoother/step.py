# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The loop of a step: eliminate, solve and relinearize until the linearization error is small.

The loop is one kernel, since in most steps its parts take less time than the Python between them
would. It returns to Python for more memory and for the batch fallback, and can be re-entered.

A step leaves linearization errors, and moves of less than `alpha` sigmas, where they hardly change
chi2. Along soft modes they can still add up to metres. A *refinement* solves for all cliques that
steps have solved for since the last one, checks all constraints there, linearizes those with an
error again, and repeats this until the errors are below `ENOUGH`. By Cauchy-Schwarz no coordinate
of any node is then further from the minimum than the root of that, in its posterior sigmas. Each
call of `refine` does one iteration, and the graph is valid after each.
"""

from pose_graph_ros.core.compiled.jit import INTEGER, kernel
from pose_graph_ros.core.graph import tables as tb, transaction_log
from pose_graph_ros.core.smoother import relinearization, tree_update
from pose_graph_ros.core.smoother.tree_update import (
    DIVERGED,
    DONE,
    INTERRUPTED,
    MORE_MEMORY,
    UNFINISHED,
)

# How `run` is entered: after an edit; again, with the memory that it has asked for; after the
# batch fallback, when there is no further fallback.
FIRST, RESUMED, AFTER_BATCH = range(3)
# Sum of the squared linearization errors at the end of a refinement [sigma^2].
ENOUGH = 1e-10
# `alpha` [sigma] and `budget_share` [sigma^2] of a refinement.
ALPHA = 1e-6
SHARE = 1e-13


@kernel
def _reset_counters(head):  # type: ignore[no-untyped-def]
    head[tb.N_RELINEARIZED] = head[tb.N_ELIMINATED] = 0
    head[tb.N_VISITED] = head[tb.N_ITERATIONS] = 0
    tb.scalars(head)[0].error2_before = 0.0


@kernel(signature=(tb.HEAD, INTEGER, INTEGER), allocates=True)    # the elimination does
def run(head, max_iterations, entered):  # type: ignore[no-untyped-def]
    """
    Return DONE once the estimate is up to date with all touched nodes and waiting constraints.

    UNFINISHED: linearization errors above the budget wait for the next update. After MORE_MEMORY
    the step is entered again as RESUMED (AFTER_BATCH if it was that before).
    """
    scalars = tb.scalars(head)[0]
    if entered == FIRST:
        _reset_counters(head)
    head[tb.N_TURNED] = 0   # cliques that were listed in the last update may have been replaced
    settled = True
    while True:
        # in the first iteration, the constraints that the last update has left over
        relinearization.relinearize(head)
        if head[tb.N_TOUCHED] == 0:
            break
        # all cliques from the touched nodes up to the roots are eliminated again
        marked, affected = tree_update.mark(head)
        head[tb.ITERATION] += 1
        head[tb.SINCE] = head[tb.ITERATION]
        if head[tb.STRUCTURE] != 0:
            code = tree_update.rebuild(head, marked, affected)
        else:
            code = tree_update.refresh(head, marked, False)
        if code != DONE:
            return code
        head[tb.STRUCTURE] = 0
        tree_update.forget_touched(head)
        head[tb.N_ELIMINATED] += len(affected)
        error2 = relinearization.solve_and_check(head)
        settled = error2 <= relinearization.budget(head)
        if settled:
            relinearization.forget_waiting(head)
            break
        # The iterations have diverged if the error is large, in sigma^2 and against chi2 (a false
        # constraint raises chi2 and all linearization errors with it), and either no iteration
        # remains, the last one has not halved it, or another can only increase it.
        out_of_iterations = head[tb.N_ITERATIONS] >= max_iterations
        before, scalars.error2_before = scalars.error2_before, error2
        small = error2 <= 1.0 or error2 <= 1e-3 * scalars.chi2
        if entered != AFTER_BATCH and not small and (
                out_of_iterations or 0.0 < before < 2.0 * error2 or not error2 < 1e6):
            return DIVERGED
        if out_of_iterations:
            break
    transaction_log.commit(head)
    return DONE if settled else UNFINISHED


@kernel(allocates=True)
def _iterate(head):  # type: ignore[no-untyped-def]
    """Linearize what waits again, eliminate it and what is above it, and solve."""
    scalars, factors, cliques = tb.scalars(head)[0], tb.factors(head), tb.cliques(head)
    turned = tb.work_i(head)[2 * head[tb.NODE_ROOM]:]
    chi2, error2 = scalars.chi2, scalars.error2_sum
    # eliminating the cliques linearizes the constraints in them
    for n in range(head[tb.N_TURNED]):
        relinearization.touch_clique(head, cliques[turned[n]].parent)
    for n in range(head[tb.N_WAITING]):
        e = tb.waiting(head)[n]
        transaction_log.log_factor(head, e)
        factors[e].waits = 0
        relinearization.touch_clique(head, factors[e].owner)
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0
    if head[tb.N_TOUCHED] == 0:
        return DONE      # many errors, each of them negligible
    marked, affected = tree_update.mark(head)
    head[tb.ITERATION] += 1
    code = tree_update.refresh(head, marked, True)
    if code != DONE:
        return code
    tree_update.forget_touched(head)
    head[tb.N_ELIMINATED], head[tb.SINCE] = len(affected), head[tb.REFINED]
    relinearization.solve_and_check(head)
    # Gauss-Newton goes uphill, by at most 0.1 sigma^2, where it swings a soft mode
    if not scalars.chi2 <= scalars.lowest + 0.1 or head[tb.ROUND] >= 20:
        return DIVERGED
    head[tb.ROUND] += 1
    scalars.lowest = min(scalars.lowest, scalars.chi2)
    least = 1e-11 * max(chi2, 1.0)  # rounding errors, which cannot be reduced any further
    stalls = abs(scalars.chi2 - chi2) <= least and scalars.error2_sum > 0.5 * error2
    return DONE if stalls or scalars.error2_sum <= ENOUGH else UNFINISHED


@kernel(signature=(tb.HEAD,), allocates=True)
def refine(head):  # type: ignore[no-untyped-def]
    """
    Return DONE if the estimate is at the minimum, or UNFINISHED after an iteration towards it.

    INTERRUPTED: `INTERRUPT` of the head was set. DIVERGED: the iteration leads away from the
    minimum. After all but the first two the caller has to roll back what `transaction_log.begin`
    has begun. The graph must have no touched nodes.
    """
    scalars, cliques = tb.scalars(head)[0], tb.cliques(head)
    alpha, share = scalars.alpha, scalars.share
    scalars.alpha, scalars.share = ALPHA, SHARE     # a rollback restores them, too
    _reset_counters(head)
    if head[tb.LISTED] != head[tb.UPDATE] - 1:
        head[tb.N_TURNED] = 0   # cliques that were listed may have been replaced
        # from the root down, for the cliques that have changed since the last refinement
        c = tb.nodes(head)[head[tb.NEWEST]].clique
        while cliques[c].parent >= 0:
            c = cliques[c].parent
        tb.work_i(head)[0] = c
        head[tb.N_ROOTS], head[tb.SINCE] = 1, head[tb.REFINED]
        head[tb.ITERATION] += 1
        relinearization.solve_and_check(head)
        head[tb.ROUND], scalars.lowest = 0, scalars.chi2
    if head[tb.INTERRUPT] != 0:
        return INTERRUPTED
    code = _iterate(head) if scalars.error2_sum > ENOUGH else DONE
    if head[tb.INTERRUPT] != 0 and code != MORE_MEMORY:
        return INTERRUPTED
    if code == DONE:
        relinearization.forget_waiting(head)
        head[tb.REFINED] = head[tb.ITERATION] + 1
    elif code == UNFINISHED:
        head[tb.LISTED] = head[tb.UPDATE]
    else:
        return code
    scalars.alpha, scalars.share = alpha, share
    scalars.largest_move = transaction_log.largest_move(head)
    transaction_log.commit(head)
    return code
