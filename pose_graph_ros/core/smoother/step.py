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

After a solve the factors of nodes that have turned are checked, and so are the frames of cliques
that have turned against their parents' frames. If their squared linearization errors add up to
more than the budget of the step, the largest of them are linearized again, and their nodes are
touched: for the next iteration, or for the next step if they are within `LEFT_OVER` budgets. This
is fluid relinearization (M. Kaess et al., "iSAM2", IJRR 2012), here with whitened errors.
"""

import math

from pose_graph_ros.core.compiled.jit import INTEGER, kernel
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.graph import factors, tables as tb, transaction_log
from pose_graph_ros.core.graph.rows import forget_touched, touch
from pose_graph_ros.core.smoother import tree_update
from pose_graph_ros.core.smoother.back_substitution import back_substitute

# How `run` is entered: after an edit; again, with the memory that it has asked for; after the
# batch fallback, when there is no further fallback.
FIRST, RESUMED, AFTER_BATCH = range(3)
# Sum of the squared linearization errors at the end of a refinement [sigma^2].
ENOUGH = 1e-10
# Number of budgets that a step may leave to the next one, which eliminates most of these cliques
# anyway.
LEFT_OVER = 10.0
# chi2 of loops above which the budget of a step grows with it [sigma^2], at most so many times.
# More would be seen along soft modes: there a pose is off by the root of what is left, in sigmas.
LARGE, MOST_LARGER = 200.0, 5.0
# `alpha` [sigma] and `budget_share` [sigma^2] of a refinement.
ALPHA = 1e-6
SHARE = 1e-13


@kernel(signature=(tb.HEAD, INTEGER, INTEGER), allocates=True)    # the elimination does
def run(head, max_iterations, entered):  # type: ignore[no-untyped-def]
    """
    Return DONE once the estimate is up to date with all touched nodes and waiting constraints.

    UNFINISHED: linearization errors above `LEFT_OVER` budgets wait for the next update. After
    MORE_MEMORY the step is entered again as RESUMED (AFTER_BATCH if it was that before).
    """
    scalars = tb.scalars(head)[0]
    if entered == FIRST:
        head[tb.N_RELINEARIZED:tb.N_ITERATIONS + 1] = 0
        scalars.error2_before = 0.0
    head[tb.HEEDS] = tb.ALL
    if entered != RESUMED:
        scalars.lowest = scalars.chi2
    head[tb.N_TURNED] = 0   # cliques that were listed in the last update may have been replaced
    settled = True
    while True:
        # in the first iteration, the constraints that the last update has left over
        relinearize(head)
        if head[tb.N_TOUCHED] == 0:
            break
        # all cliques from the touched nodes up to the roots are eliminated again
        marked, affected = tree_update.mark(head)
        head[tb.ITERATION] += 1
        head[tb.SINCE] = head[tb.ITERATION]
        if head[tb.STRUCTURE] != 0:
            code, rows = tree_update.reordered(head, marked, affected)
        else:
            code, rows = tree_update.renewed(head, marked)
        if code == tree_update.DONE:
            code = tree_update.eliminate(head, rows)
        if code != tree_update.DONE:
            return code
        head[tb.STRUCTURE] = 0
        forget_touched(head)
        head[tb.N_ELIMINATED] += len(affected)
        back_substitute(head)
        error2 = check(head)
        if tree_update.interrupted(head):
            return tree_update.INTERRUPTED
        settled = leave_over(head, error2)
        if settled:
            break
        # The iterations have diverged if the error is large, in sigma^2 and against the lowest
        # chi2 of the step (a false constraint raises chi2 and all errors with it), and either no
        # iteration remains, the last one has doubled it, or another can only increase it.
        out_of_iterations = head[tb.N_ITERATIONS] >= max_iterations
        before, scalars.error2_before = scalars.error2_before, error2
        scalars.lowest = min(scalars.lowest, scalars.chi2)
        large = error2 > 1.0 and error2 > 1e-3 * scalars.lowest
        if entered == AFTER_BATCH:  # it may swing about what the batch has found, but not leave it
            large = large and scalars.chi2 > 2.0 * scalars.lowest + 1.0
        if large and (out_of_iterations or 0.0 < before < 0.5 * error2 or not error2 < 1e6):
            return tree_update.DIVERGED
        if out_of_iterations:
            break
    transaction_log.commit(head)
    return tree_update.DONE if settled else tree_update.UNFINISHED


@kernel(allocates=True)
def _iterate(head):  # type: ignore[no-untyped-def]
    """Linearize what waits again, eliminate it and what is above it, and solve."""
    scalars, cliques = tb.scalars(head)[0], tb.cliques(head)
    turned = tb.work_i(head)[2 * head[tb.NODE_ROOM]:]
    chi2, error2 = scalars.chi2, scalars.error2_sum
    # eliminating the cliques linearizes the constraints in them
    for n in range(head[tb.N_TURNED]):
        _touch_clique(head, cliques[turned[n]].parent)
    for n in range(head[tb.N_WAITING]):
        e = tb.waiting(head)[n]
        transaction_log.log_factor(head, e)
        tb.factors(head)[e].waits = 0
        _touch_clique(head, tb.factors(head)[e].owner)
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0
    if head[tb.N_TOUCHED] == 0:
        return tree_update.DONE      # many errors, each of them negligible
    marked, affected = tree_update.mark(head)
    head[tb.ITERATION] += 1
    code, rows = tree_update.renewed(head, marked)
    if code == tree_update.DONE:
        code = tree_update.eliminate(head, rows)
    if code != tree_update.DONE:
        return code
    forget_touched(head)
    head[tb.N_ELIMINATED], head[tb.SINCE] = len(affected), head[tb.REFINED]
    back_substitute(head)
    check(head)
    # Gauss-Newton goes uphill, by at most 1 sigma^2, where it swings a soft mode
    if not scalars.chi2 <= scalars.lowest + 1.0 or head[tb.ROUND] >= 20:
        return tree_update.DIVERGED
    head[tb.ROUND] += 1
    scalars.lowest = min(scalars.lowest, scalars.chi2)
    least = 1e-11 * max(chi2, 1.0)  # rounding errors, which cannot be reduced any further
    stalls = abs(scalars.chi2 - chi2) <= least and scalars.error2_sum > 0.5 * error2
    return tree_update.DONE if stalls or scalars.error2_sum <= ENOUGH else tree_update.UNFINISHED


@kernel(signature=(tb.HEAD,), allocates=True)
def refine(head):  # type: ignore[no-untyped-def]
    """
    Return DONE if the estimate is at the minimum, or UNFINISHED after an iteration towards it.

    DIVERGED: the iteration leads away from the minimum. After all but the first two the caller has
    to roll back what `transaction_log.begin` has begun. The graph must have no touched nodes.
    """
    scalars, cliques = tb.scalars(head)[0], tb.cliques(head)
    alpha, share = scalars.alpha, scalars.share
    scalars.alpha, scalars.share = ALPHA, SHARE     # a rollback restores them, too
    head[tb.N_RELINEARIZED:tb.N_ITERATIONS + 1] = 0
    if head[tb.LISTED] != head[tb.UPDATE] - 1:
        head[tb.N_TURNED] = 0   # cliques that were listed may have been replaced
        # from the root down, for the cliques that have changed since the last refinement
        c = tb.nodes(head)[head[tb.NEWEST]].clique
        while cliques[c].parent >= 0:
            c = cliques[c].parent
        tb.work_i(head)[0] = c
        head[tb.N_ROOTS], head[tb.SINCE] = 1, head[tb.REFINED]
        head[tb.ITERATION] += 1
        back_substitute(head)
        check(head)
        head[tb.ROUND], scalars.lowest = 0, scalars.chi2
    if tree_update.interrupted(head):
        return tree_update.INTERRUPTED
    code = _iterate(head) if scalars.error2_sum > ENOUGH else tree_update.DONE
    if tree_update.interrupted(head) and code != tree_update.MORE_MEMORY:
        return tree_update.INTERRUPTED
    if code == tree_update.DONE:
        _forget_waiting(head)
        head[tb.REFINED] = head[tb.ITERATION] + 1
    elif code == tree_update.UNFINISHED:
        head[tb.LISTED] = head[tb.UPDATE]
    else:
        return code
    scalars.alpha, scalars.share = alpha, share
    scalars.largest_move = transaction_log.largest_move(head)
    transaction_log.commit(head)
    return code


@kernel
def _forget_waiting(head):  # type: ignore[no-untyped-def]
    """Empty the lists of waiting factors and turned frames without linearizing them again."""
    for n in range(head[tb.N_WAITING]):
        tb.factors(head)[tb.waiting(head)[n]].waits = 0
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def leave_over(head, error2):  # type: ignore[no-untyped-def]
    """Tell whether a step may leave its errors; those within one budget are forgotten."""
    if error2 <= _budget(head):
        _forget_waiting(head)
    return error2 <= LEFT_OVER * _budget(head)


@kernel
def relinearize(head):  # type: ignore[no-untyped-def]
    """
    Linearize the worst waiting factors again, until 0.1 of the budget remains.

    The nodes of the relinearized factors are touched; the lists of the waiting are emptied.
    """
    allowed = 0.1 * _budget(head)
    waiting, cliques = tb.waiting(head), tb.cliques(head)
    # sums of the errors by powers of two of their ratio to `allowed`, largest first
    bins = tb.work_f(head)[:64]
    bins[:] = 0.0
    left, cut = 0.0, 0
    for n in range(head[tb.N_WAITING]):
        error2 = tb.factors(head)[waiting[n]].error2
        bins[_bin(error2 / allowed)] += error2
        left += error2
    turned = tb.work_i(head)[2 * head[tb.NODE_ROOM]:]
    for n in range(head[tb.N_TURNED]):
        error2 = cliques[turned[n]].slip_error2
        bins[_bin(error2 / allowed)] += error2
        left += error2
    while cut < 64 and left > allowed:
        left -= bins[cut]
        cut += 1
    for n in range(head[tb.N_WAITING]):
        e = waiting[n]
        transaction_log.log_factor(head, e)
        f = tb.factors(head)[e]
        f.waits = 0
        if _bin(f.error2 / allowed) < cut:
            head[tb.N_RELINEARIZED] += 1
            factors.linearize(head, e)
            for v in f.ends:
                if v >= 0:
                    touch(head, v)
    for n in range(head[tb.N_TURNED]):
        c = turned[n]
        if _bin(cliques[c].slip_error2 / allowed) < cut:
            # the parent adds the update matrix again, at the present angle of the frame
            _touch_clique(head, cliques[c].parent)
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def _touch_clique(head, c):  # type: ignore[no-untyped-def]
    """Touch a clique, whose elimination linearizes something again."""
    v = tb.pool_i(head)[tb.cliques(head)[c].members]
    touch(head, v)
    head[tb.N_RELINEARIZED] += 1


@kernel
def _bin(ratio):  # type: ignore[no-untyped-def]
    """Return 0 for a ratio of 2 or more, and 1 more for each halving, up to 63."""
    if ratio <= 0.0:
        return 63
    return min(max(int(1.0 - math.floor(math.log2(ratio))), 0), 63)


@kernel
def _budget(head):  # type: ignore[no-untyped-def]
    """Return the squared linearization error that a step may leave [sigma^2]."""
    scalars = tb.scalars(head)[0]
    # what positions add to chi2, and a contradiction by more than usual, does not count
    loops = float(head[tb.N_EDGES] - head[tb.N_NODES])
    larger = min(max(min(scalars.chi2, loops) / LARGE, 1.0), MOST_LARGER)
    return min(larger * scalars.budget, scalars.share * scalars.n_moved)


@kernel
def check(head):  # type: ignore[no-untyped-def]
    """
    Return the sum of the squared linearization errors after a solve.

    They are those of the factors of all nodes that the solve lists, each factor once, and of the
    listed turned frames. Factors with large errors wait to be linearized again, and frames with
    large errors stay listed.
    """
    scalars, cliques, waiting = tb.scalars(head)[0], tb.cliques(head), tb.waiting(head)
    work_i, iteration = tb.work_i(head), head[tb.ITERATION]
    checks, turned = work_i[head[tb.NODE_ROOM]:], work_i[2 * head[tb.NODE_ROOM]:]
    large = factors.LEAST_FRACTION * scalars.share
    chi2, error2_sum = scalars.chi2, 0.0
    owner, frame = -1, factors.NO_TURN  # those that follow each other often have the same owner
    for n in range(head[tb.N_CHECKS]):
        at = tb.nodes(head)[checks[n]].factor_list
        while at >= 0:
            e, f = at >> 2, tb.factors(head)[at >> 2]
            at = f.next[at & 3]
            if f.checked == iteration:
                continue
            f.checked = iteration
            if f.owner != owner:
                owner = f.owner
                phi = (cliques[owner].turn if cliques[owner].built == iteration
                       else clique_frames.present_turn(head, owner))
                versine, sine = factors.turned_by(phi)
                frame = (phi, 1.0 + versine, sine)
            transaction_log.log_factor(head, e)
            chi2 -= f.energy
            factors.check(head, e, frame)
            chi2 += f.energy
            error2_sum += f.error2
            if f.error2 > large and f.waits == 0:
                f.waits = 1
                waiting[head[tb.N_WAITING]] = e
                head[tb.N_WAITING] += 1
    kept = 0
    for n in range(head[tb.N_TURNED]):
        c = turned[n]
        error2 = clique_frames.slip_error2(head, c, tb.work_f(head))
        error2_sum += error2
        if error2 > large:
            cliques[c].slip_error2 = error2
            turned[kept] = c
            kept += 1
    head[tb.N_TURNED] = kept
    head[tb.N_ITERATIONS] += 1
    scalars.chi2, scalars.error2_sum = chi2, error2_sum
    return error2_sum
