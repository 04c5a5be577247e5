# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Fluid relinearization: which factors are linearized again after a solve.

The factors of nodes that have turned are checked, and so are the frames of cliques that have
turned against their parents' frames. If their squared linearization errors add up to more than the
budget of the step, the largest of them are linearized again, and their nodes are touched for the
next iteration (M. Kaess et al., "iSAM2", IJRR 2012, here with whitened errors).
"""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.graph import factors, tables as tb, transaction_log
from pose_graph_ros.core.graph.rows import touch
from pose_graph_ros.core.smoother.back_substitution import back_substitute


@kernel(forceinline=True)
def set_waits(head, e, waits):  # type: ignore[no-untyped-def]
    """Note whether a factor is listed as waiting, 1 or 0; return what was noted before."""
    row = tb.factors(head)[e]
    before, row.waits = row.waits, waits
    return before


@kernel
def _check_factor(head, e, frame):  # type: ignore[no-untyped-def]
    """
    Evaluate a factor at the present estimate; it waits if its linearization error is large.

    Frame is the turn of its clique, as for `factors.check`.
    """
    scalars, f = tb.scalars(head)[0], tb.factors(head)[e]
    transaction_log.log_energy(head, e)
    scalars.chi2 -= f.energy
    factors.check(head, e, frame)
    scalars.chi2 += f.energy
    scalars.error2_sum += f.error2
    large = f.error2 > factors.LEAST_FRACTION * scalars.share
    if large and set_waits(head, e, 1) == 0:
        tb.waiting(head)[head[tb.N_WAITING]] = e
        head[tb.N_WAITING] += 1


@kernel
def _check(head):  # type: ignore[no-untyped-def]
    """Check the factors of all listed nodes, each factor once."""
    scalars, work_i = tb.scalars(head)[0], tb.work_i(head)
    iteration = head[tb.ITERATION]
    checks = work_i[head[tb.NODE_ROOM]:]
    scalars.error2_sum = 0.0
    owner, frame = -1, factors.NO_TURN  # those that follow each other often have the same owner
    for n in range(head[tb.N_CHECKS]):
        at = tb.nodes(head)[checks[n]].factor_list
        while at >= 0:
            e, f = at >> 2, tb.factors(head)[at >> 2]
            if f.checked != iteration:
                f.checked = iteration
                if f.owner != owner:
                    owner = f.owner
                    phi = clique_frames.present_turn(head, owner)
                    frame = (phi, math.cos(phi), math.sin(phi))
                _check_factor(head, e, frame)
            at = f.next[at & 3]


@kernel
def _check_turned(head):  # type: ignore[no-untyped-def]
    """Add the errors of the listed turned frames to the sum, and keep the large ones listed."""
    scalars, cliques, work_i = tb.scalars(head)[0], tb.cliques(head), tb.work_i(head)
    turned = work_i[2 * head[tb.NODE_ROOM]:]
    kept = 0
    for k in range(head[tb.N_TURNED]):
        c = turned[k]
        if cliques[c].n_frontal == 0:
            error2 = clique_frames.prior_error2(head, c, tb.work_f(head))
        else:
            slip = clique_frames.frame_slip(head, c)
            error2 = clique_frames.interface_error2(head, c, slip, tb.work_f(head))
        scalars.error2_sum += error2
        if error2 > factors.LEAST_FRACTION * scalars.share:
            cliques[c].slip_error2 = error2
            turned[kept] = c
            kept += 1
    head[tb.N_TURNED] = kept


@kernel
def forget_waiting(head):  # type: ignore[no-untyped-def]
    """Empty the lists of waiting factors and turned frames without linearizing them again."""
    for n in range(head[tb.N_WAITING]):
        set_waits(head, tb.waiting(head)[n], 0)
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def relinearize(head):  # type: ignore[no-untyped-def]
    """
    Linearize the worst waiting factors again, until 0.4 of the budget remains.

    The nodes of the relinearized factors are touched; the lists of the waiting are emptied.
    """
    allowed = 0.4 * _budget(head)
    work_f, waiting, cliques = tb.work_f(head), tb.waiting(head), tb.cliques(head)
    pool_i, work_i = tb.pool_i(head), tb.work_i(head)
    # sums of the errors by powers of two of their ratio to `allowed`, largest first
    bins = work_f[:64]
    bins[:] = 0.0
    left, cut = 0.0, 0
    for n in range(head[tb.N_WAITING]):
        error2 = tb.factors(head)[waiting[n]].error2
        bins[_bin(error2 / allowed)] += error2
        left += error2
    turned = work_i[2 * head[tb.NODE_ROOM]:]
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
        set_waits(head, e, 0)
        f = tb.factors(head)[e]
        if _bin(f.error2 / allowed) < cut:
            head[tb.N_RELINEARIZED] += 1
            factors.linearize(head, e)
            for v in f.ends:
                if v >= 0:
                    _touch(head, v)
    for n in range(head[tb.N_TURNED]):
        c = turned[n]
        if _bin(cliques[c].slip_error2 / allowed) < cut:
            # the parent adds the update matrix again, at the present angle of the frame
            head[tb.N_RELINEARIZED] += 1
            _touch(head, pool_i[cliques[cliques[c].parent].members])
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def _touch(head, v):  # type: ignore[no-untyped-def]
    transaction_log.log_node(head, v)
    touch(head, v)


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
    return min(scalars.budget, scalars.share * scalars.n_moved)


@kernel
def solve_and_check(head):  # type: ignore[no-untyped-def]
    """
    Solve from the roots on the stack down; return the sum of the squared linearization errors.

    The factors with large errors wait to be linearized again.
    """
    back_substitute(head)
    _check(head)
    _check_turned(head)
    head[tb.N_ITERATIONS] += 1
    return tb.scalars(head)[0].error2_sum


@kernel
def solve(head):  # type: ignore[no-untyped-def]
    """
    Solve from the roots on the stack down; return whether the linearization errors are small.

    If they are, no constraint waits any more.
    """
    if solve_and_check(head) <= _budget(head):
        forget_waiting(head)
        return True
    return False
