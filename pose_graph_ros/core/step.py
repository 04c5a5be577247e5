# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The loop of a step: eliminate, solve, linearize again, until the estimate is good.

It is one kernel, since in most steps its parts take less time than Python would between them.
Where it needs Python, for memory or for another way, it says so and can be entered again.
"""

from pose_graph_ros.core import elimination, relinearization, tables as tb, undo
from pose_graph_ros.core.jit import kernel

# How `run` is entered: after an update; again, with the memory that it has asked for; where all
# poses are new, so that there is no other way left; after a chain was extended.
FIRST, RESUMED, RESCUED, EXTENDED = range(4)
# Its answers.
SETTLED, LEFT_OVER, MORE_MEMORY, BAD_PIVOT, ASTRAY = range(5)
# Where a step leaves more squared linearization error than this [sigma^2], and than this fraction
# of chi2 (a false constraint strains the graph, and all its errors), it has not worked ...
DOUBT = 1.0
DOUBT_RATIO = 1e-3
# ... if there is no iteration left, or the last one has not at least halved it, or there is so
# much of it that the next one can only make it worse.
HOPELESS = 1e6


@kernel
def _is_astray(head, out_of_iterations):  # type: ignore[no-untyped-def]
    """Tell whether the last iteration gives reason to doubt that the next ones lead anywhere."""
    scalars = tb.scalars(head)
    error2, before = scalars[tb.ERROR2_SUM], scalars[tb.ERROR2_BEFORE]
    scalars[tb.ERROR2_BEFORE] = error2
    if error2 <= DOUBT or error2 <= DOUBT_RATIO * scalars[tb.CHI2]:
        return False
    return out_of_iterations or 0.0 < before < 2.0 * error2 or not error2 < HOPELESS


@kernel
def _count_anew(head):  # type: ignore[no-untyped-def]
    head[tb.N_RELINEARIZED] = head[tb.N_ELIMINATED] = 0
    head[tb.N_VISITED] = head[tb.N_ITERATIONS] = 0
    tb.scalars(head)[tb.ERROR2_BEFORE] = 0.0


@kernel(allocates=True)    # the elimination does
def run(head, max_iterations, entered):  # type: ignore[no-untyped-def]
    """
    Bring the estimate up to date with all seeds and with what waits.

    Returns
    -------
    int
        SETTLED; LEFT_OVER: linearization errors above the budget wait for the next update;
        MORE_MEMORY: `NEED_F`, `NEED_I` and `NEED_WORK` of the head say how much, then it goes on
        as RESUMED, or as RESCUED again; BAD_PIVOT: `BAD_NODE` of the head is not determined;
        ASTRAY: the iterations lead nowhere. After the last two the update is still to be undone.

    """
    extended = entered == EXTENDED
    if extended or entered == FIRST:
        _count_anew(head)
    head[tb.N_TURNED] = 0   # the frames that had turned may be gone by now
    settled = True
    while True:
        if extended:
            head[tb.N_ELIMINATED] = 1
        else:
            # in the first iteration, what the last update has left over
            relinearization.relinearize(head)
            if head[tb.N_SEEDS] == 0:
                break
            code = elimination.eliminate(head)
            if code != elimination.DONE:
                return MORE_MEMORY if code == elimination.MORE_MEMORY else BAD_PIVOT
        settled = relinearization.solve(head)
        if settled:
            break
        if extended:
            # the node has its place already, whatever becomes of the next iterations
            undo.commit(head)
            undo.begin(head)
            extended = False
            continue
        out_of_iterations = head[tb.N_ITERATIONS] >= max_iterations
        if _is_astray(head, out_of_iterations) and entered != RESCUED:
            return ASTRAY
        if out_of_iterations:
            break
    undo.commit(head)
    return SETTLED if settled else LEFT_OVER
