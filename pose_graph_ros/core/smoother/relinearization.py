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


@kernel
def forget_waiting(head):  # type: ignore[no-untyped-def]
    """Empty the lists of waiting factors and turned frames without linearizing them again."""
    for n in range(head[tb.N_WAITING]):
        tb.factors(head)[tb.waiting(head)[n]].waits = 0
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def relinearize(head):  # type: ignore[no-untyped-def]
    """
    Linearize the worst waiting factors again, until 0.4 of the budget remains.

    The nodes of the relinearized factors are touched; the lists of the waiting are emptied.
    """
    allowed = 0.4 * budget(head)
    work_f, waiting, cliques = tb.work_f(head), tb.waiting(head), tb.cliques(head)
    work_i = tb.work_i(head)
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
        f = tb.factors(head)[e]
        f.waits = 0
        if _bin(f.error2 / allowed) < cut:
            head[tb.N_RELINEARIZED] += 1
            factors.linearize(head, e)
            for v in f.ends:
                if v >= 0:
                    transaction_log.log_node(head, v)
                    touch(head, v)
    for n in range(head[tb.N_TURNED]):
        c = turned[n]
        if _bin(cliques[c].slip_error2 / allowed) < cut:
            # the parent adds the update matrix again, at the present angle of the frame
            touch_clique(head, cliques[c].parent)
    head[tb.N_WAITING] = head[tb.N_TURNED] = 0


@kernel
def touch_clique(head, c):  # type: ignore[no-untyped-def]
    """Touch a clique, whose elimination linearizes something again."""
    v = tb.pool_i(head)[tb.cliques(head)[c].members]
    transaction_log.log_node(head, v)
    touch(head, v)
    head[tb.N_RELINEARIZED] += 1


@kernel
def _bin(ratio):  # type: ignore[no-untyped-def]
    """Return 0 for a ratio of 2 or more, and 1 more for each halving, up to 63."""
    if ratio <= 0.0:
        return 63
    return min(max(int(1.0 - math.floor(math.log2(ratio))), 0), 63)


@kernel
def budget(head):  # type: ignore[no-untyped-def]
    """Return the squared linearization error that a step may leave [sigma^2]."""
    scalars = tb.scalars(head)[0]
    return min(scalars.budget, scalars.share * scalars.n_moved)


@kernel
def solve_and_check(head):  # type: ignore[no-untyped-def]
    """
    Solve from the roots on the stack down; return the sum of the squared linearization errors.

    They are those of the factors of all nodes that the solve lists, each factor once, and of the
    listed turned frames. Factors with large errors wait to be linearized again, and frames with
    large errors stay listed.
    """
    back_substitute(head)
    scalars, cliques, waiting = tb.scalars(head)[0], tb.cliques(head), tb.waiting(head)
    work_i, work_f, iteration = tb.work_i(head), tb.work_f(head), head[tb.ITERATION]
    checks, turned = work_i[head[tb.NODE_ROOM]:], work_i[2 * head[tb.NODE_ROOM]:]
    large = factors.LEAST_FRACTION * scalars.share
    scalars.error2_sum = 0.0
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
                phi = clique_frames.present_turn(head, owner)
                frame = (phi, math.cos(phi), math.sin(phi))
            transaction_log.log_energy(head, e)
            scalars.chi2 -= f.energy
            factors.check(head, e, frame)
            scalars.chi2 += f.energy
            scalars.error2_sum += f.error2
            if f.error2 > large and f.waits == 0:
                f.waits = 1
                waiting[head[tb.N_WAITING]] = e
                head[tb.N_WAITING] += 1
    kept = 0
    for n in range(head[tb.N_TURNED]):
        c = turned[n]
        if cliques[c].n_frontal == 0:
            error2 = clique_frames.prior_error2(head, c, work_f)
        else:
            error2 = clique_frames.interface_error2(
                head, c, clique_frames.frame_slip(head, c), work_f)
        scalars.error2_sum += error2
        if error2 > large:
            cliques[c].slip_error2 = error2
            turned[kept] = c
            kept += 1
    head[tb.N_TURNED] = kept
    head[tb.N_ITERATIONS] += 1
    return scalars.error2_sum
