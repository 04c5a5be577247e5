# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The loop of a step: eliminate, solve and relinearize until the linearization error is small.

The loop is one kernel, since in most steps its parts take less time than the Python between them
would. It returns to Python for more memory and for the batch fallback, and can be re-entered.
"""

from pose_graph_ros.core.compiled.jit import INTEGER, kernel
from pose_graph_ros.core.graph import tables as tb, transaction_log
from pose_graph_ros.core.smoother import relinearization, tree_update

# How `run` is entered: after an edit; again, with the memory that it has asked for; after the
# batch fallback, when there is no further fallback.
FIRST, RESUMED, AFTER_BATCH = range(3)
# Return codes of `run`.
SETTLED, LEFT_OVER, MORE_MEMORY, BAD_PIVOT, DIVERGED = range(5)
# A step has only diverged if its squared linearization error is above this [sigma^2] and above
# this fraction of chi2. A false constraint raises chi2 and all linearization errors with it.
DOUBT = 1.0
DOUBT_RATIO = 1e-3
# Squared linearization error above which another iteration can only increase it [sigma^2].
HOPELESS = 1e6


@kernel
def _has_diverged(head, out_of_iterations):  # type: ignore[no-untyped-def]
    """
    Tell whether the iterations have diverged.

    That is so if the squared linearization error is large (DOUBT, DOUBT_RATIO) and either no
    iteration is left, the last one has not halved the error, or the error is above HOPELESS.
    """
    scalars = tb.scalars(head)
    error2, before = scalars[tb.ERROR2_SUM], scalars[tb.ERROR2_BEFORE]
    scalars[tb.ERROR2_BEFORE] = error2
    if error2 <= DOUBT or error2 <= DOUBT_RATIO * scalars[tb.CHI2]:
        return False
    return out_of_iterations or 0.0 < before < 2.0 * error2 or not error2 < HOPELESS


@kernel
def _reset_counters(head):  # type: ignore[no-untyped-def]
    head[tb.N_RELINEARIZED] = head[tb.N_ELIMINATED] = 0
    head[tb.N_VISITED] = head[tb.N_ITERATIONS] = 0
    tb.scalars(head)[tb.ERROR2_BEFORE] = 0.0


@kernel(signature=(tb.HEAD, INTEGER, INTEGER), allocates=True)    # the elimination does
def run(head, max_iterations, entered):  # type: ignore[no-untyped-def]
    """
    Return SETTLED once the estimate is up to date with all touched nodes and waiting constraints.

    LEFT_OVER: linearization errors above the budget wait for the next update. MORE_MEMORY: the
    pools and the work space must grow to `NEED_F`, `NEED_I` and `NEED_WORK` of the head, and the
    step be entered again as RESUMED (AFTER_BATCH if it was that before). BAD_PIVOT: node
    `BAD_NODE` of the head is not determined. DIVERGED. After the last two the caller has to roll
    the update back.

    Parameters
    ----------
    max_iterations : int
    entered : int, FIRST, RESUMED or AFTER_BATCH

    """
    if entered == FIRST:
        _reset_counters(head)
    head[tb.N_TURNED] = 0   # cliques that were listed in the last update may have been replaced
    settled = True
    while True:
        # in the first iteration, the constraints that the last update has left over
        relinearization.relinearize(head)
        if head[tb.N_TOUCHED] == 0:
            break
        code = tree_update.eliminate(head)
        if code != tree_update.DONE:
            return MORE_MEMORY if code == tree_update.MORE_MEMORY else BAD_PIVOT
        settled = relinearization.solve(head)
        if settled:
            break
        out_of_iterations = head[tb.N_ITERATIONS] >= max_iterations
        if _has_diverged(head, out_of_iterations) and entered != AFTER_BATCH:
            return DIVERGED
        if out_of_iterations:
            break
    transaction_log.commit(head)
    return SETTLED if settled else LEFT_OVER
