# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The memory of the engine: flat tables that grow, and how kernels get at them.

Nodes, edges, observed nodes and cliques are rows of 2-D arrays, one array of numbers and one of
integers each, so that what a step needs of a row lies on two or three cache lines. The values of
a clique (its rows of R and its update matrix) and its list of nodes lie in two pools.

Handing a dozen arrays to a kernel costs more than a step along a chain. A kernel that Python calls
therefore gets one array, the *head*: counters, and the address and capacity of each table.
Every kernel asks it for the tables that it works on, which costs nothing: `tb.node_f(head)`. The
addresses are taken anew whenever a table grows, in `Memory.ensure` alone.
"""

from collections.abc import Callable
import mmap
from typing import Any, Final

from numba import types
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array
import numpy as np
import numpy.typing as npt

# --- columns ------------------------------------------------------------------------------------

# node_f: pose in the map (theta wrapped), solution (pose minus reference, theta not wrapped), the
# solution that the cliques below have seen, the turn against the clique's frame when its
# constraints were last looked at: what a solution changes; square roots of the information that
# the node's constraints have on position and on heading, reference
POSE, DELTA, SEEN, LOOKED, STIFF_T, STIFF_R, REF, NODE_F = 0, 3, 6, 9, 10, 11, 12, 15
# node_i: clique that it is frontal in; heads of the lists of edges (2 * edge + side) and of
# observed nodes; whether it is fixed; whether it is a seed of the next elimination; index in a
# front and the stamp that makes it valid; stamp of the last change that matters; undo log of the
# row and of the solution alone; whether it is a bias and no pose
(CLIQUE, EDGE_LIST, OBSERVED_LIST, FIXED, SEEDED, INDEX, FRONT, CHANGED, NODE_UNDO, SOLUTION_UNDO,
 IS_BIAS, NODE_I) = range(12)

# edge_f: mean, information (xx, xy, xt, yy, yt, tt), weight; translation of the mean in its own
# axes; linearization: t_j - t_i, cos and sin of the direction of the measured frame, solution of
# the heading of i, constant of the heading error; squared linearization error, energy
(MEAN, INFO, WEIGHT, OWN_T, LIN_D, LIN_COS, LIN_SIN, LIN_TH, LIN_K, ERROR2, ENERGY, EDGE_F) = (
    0, 3, 9, 10, 12, 14, 15, 16, 17, 18, 19, 20)
# An edge to a bias keeps other things in the same places: the offset, which is an arm of i; the
# arm in map axes at the linearization; the factors of the bias. Its error lies in map axes, so
# there is no direction to keep.
BIAS_OFFSET, BIAS_ARM, FACTOR_T, FACTOR_TH = OWN_T, LIN_D, LIN_COS, LIN_SIN
# edge_i: ends; next entries of the lists of both ends; `EdgeKind`; stamp of the last check;
# whether it waits to be relinearized; undo log of the row and of error, energy and waiting alone;
# the clique that it was assembled in
(END_I, END_J, NEXT_I, NEXT_J, EDGE_KIND, EDGE_CHECKED, EDGE_WAITS, EDGE_UNDO, ENERGY_UNDO,
 OWNER, EDGE_I) = range(11)

# observed_f: mean, information, weight as for edges; offset; solution of the heading at the
# linearization, constant of the heading error; squared linearization error, energy
OBS_OFFSET, OBS_TH, OBS_K, OBS_ERROR2, OBS_ENERGY, OBS_F = 10, 13, 14, 15, 16, 17
# observed_i: hidden node, next entry of its list, `ObservedKind`, stamp, flag and log as for edges
OBS_NODE, OBS_NEXT, OBS_KIND, OBS_CHECKED, OBS_WAITS, OBS_UNDO, OBS_I = range(7)

# clique_i: parent (-1: root), first child, next sibling; numbers of frontal and of separator
# nodes; where its nodes and values lie in the pools; stamps: to be eliminated again (and then a
# counter); iteration that built it; updates that took it, took its values, logged it; whether a
# node at or below it is fixed, observed or tied to a bias
(PARENT, CHILD, SIBLING, N_FRONTAL, N_SEPARATOR, NODES, VALUES, MARKED, BUILT, BORN, VALUES_BORN,
 CLIQUE_UNDO, ANCHORED, CLIQUE_I) = range(14)
# clique_f: angle of the clique's frame that the parent was eliminated with; mean solution of the
# headings of the separator when the clique was eliminated; squared error of the parent's model of
# what it has turned since; how stiff the update matrix is against that, about (see `frames`); how
# many sigmas its separator may have moved in itself since the clique was solved for. While the
# solution is passed down, the angle of the frame is where that error will be.
TURN_SEEN, TURN_ZERO, SLIP_ERROR2, SLIP_STIFF, DRIFT, CLIQUE_F = range(6)
TURN = SLIP_ERROR2

FLOAT_TABLES: Final = {'node_f': NODE_F, 'edge_f': EDGE_F, 'observed_f': OBS_F, 'pool_f': 1,
                       'log_f': 1, 'work_f': 1, 'scalars': 1, 'clique_f': CLIQUE_F}
INT_TABLES: Final = {'node_i': NODE_I, 'edge_i': EDGE_I, 'observed_i': OBS_I,
                     'clique_i': CLIQUE_I, 'pool_i': 1, 'log_i': 1, 'work_i': 1, 'seeds': 1,
                     'freed': 1, 'waiting': 1}
NAMES: Final = (*FLOAT_TABLES, *INT_TABLES)

# --- the head: addresses and capacities first, then counters ------------------------------------

# NEWEST is the newest node that is a pose, or -1
(N_NODES, N_EDGES, N_OBSERVED, N_CLIQUES, FREE_CLIQUE, POOL_F_END, POOL_I_END, N_SEEDS, N_FREED,
 N_WAITING, LOG_F_END, LOG_I_END, UPDATE, ITERATION, FRONT_SERIAL, STRUCTURE, NEED_F,
 NEED_I, NEED_WORK, BAD_NODE, N_RELINEARIZED, N_ELIMINATED, N_VISITED, N_ITERATIONS, N_ROOTS,
 N_LOOKS, N_CHANGED, N_TURNED, NODE_ROOM, EDGE_ROOM, OBSERVED_ROOM, NEWEST, COUNTERS_END) = range(
     2 * len(NAMES), 2 * len(NAMES) + 33)
# heads of the free lists of the pools, one for each size class
SIZES: Final = [*range(65)]
while SIZES[-1] < 2**31:
    SIZES.append(int(np.ceil(1.125 * SIZES[-1])))
N_SIZES: Final = len(SIZES)
FREE_F, FREE_I = COUNTERS_END, COUNTERS_END + N_SIZES
HEAD_SIZE: Final = COUNTERS_END + 2 * N_SIZES

# scalars: sum of the squared linearization errors of the constraints that were looked at, how many
# nodes have moved, settings of the step, three zeros, energy of the whole, that sum one iteration
# before
(ERROR2_SUM, N_MOVED, SETTING_ALPHA, SETTING_BUDGET, SETTING_SHARE, DAMPING, ZEROS, CHI2,
 ERROR2_BEFORE, N_SCALARS) = (0, 1, 2, 3, 4, 5, 6, 9, 10, 11)

# Counters whose values are written into rows as stamps of 32 bits begin anew beyond this: in some
# hundred days, or hours, for that of the fronts.
LAST_STAMP: Final = 2**30
COUNTERS_OF_STAMPS: Final = (UPDATE, ITERATION, FRONT_SERIAL)
STAMPS: Final = {
    'node_i': (FRONT, CHANGED, NODE_UNDO, SOLUTION_UNDO),
    'edge_i': (EDGE_CHECKED, EDGE_UNDO, ENERGY_UNDO),
    'observed_i': (OBS_CHECKED, OBS_UNDO),
    'clique_i': (MARKED, BUILT, BORN, VALUES_BORN, CLIQUE_UNDO),
}

# Tables of so many bytes lie on pages of their own. What they have left costs address space alone,
# so they grow by much: seldom is a table copied.
OWN_PAGES: Final = 2**18
GROWTH: Final = 4
# What is not written to is not there, so a small graph never grows out of its first tables.
FIRST_ROWS: Final = 1024

IntHead = npt.NDArray[np.int64]


def _table(name: str) -> Callable[[Any], Any]:
    """Return an intrinsic that makes a table's array from the head, without any call."""
    at, number, columns = 2 * NAMES.index(name), types.int32, INT_TABLES.get(name, 0)
    if name in FLOAT_TABLES:
        number, columns = types.float64, FLOAT_TABLES[name]
    array_type = types.Array(number, 1 if columns == 1 else 2, 'C')
    size = number.bitwidth // 8

    def table(typing_context: Any, head: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            entries = context.make_array(signature.args[0])(context, builder, arguments[0]).data
            address, rows = (
                builder.load(builder.gep(entries, [context.get_constant(types.intp, at + k)]))
                for k in range(2))
            array = context.make_array(array_type)(context, builder)
            rest = () if columns == 1 else (columns,)
            shape = [rows, *(context.get_constant(types.intp, n) for n in rest)]
            strides = [context.get_constant(types.intp, n)
                       for n in (columns * size, *(size for _ in rest))]
            populate_array(
                array, builder.inttoptr(address, array.data.type), shape, strides,
                context.get_constant(types.intp, size), None)
            return array._getvalue()  # noqa: SLF001  as all of Numba does
        return array_type(head), codegen

    made: Callable[[Any], Any] = intrinsic(table)
    return made


node_f = _table('node_f')
edge_f = _table('edge_f')
observed_f = _table('observed_f')
pool_f = _table('pool_f')
log_f = _table('log_f')
work_f = _table('work_f')
scalars = _table('scalars')
clique_f = _table('clique_f')
node_i = _table('node_i')
edge_i = _table('edge_i')
observed_i = _table('observed_i')
clique_i = _table('clique_i')
pool_i = _table('pool_i')
log_i = _table('log_i')
work_i = _table('work_i')
seeds = _table('seeds')
freed = _table('freed')
waiting = _table('waiting')


def _pages(shape: int | tuple[int, int], dtype: type[np.generic]) -> npt.NDArray[Any]:
    """
    Return an array of zeros, a large one on pages of its own: they take memory when written to.

    What NumPy allocates is taken in huge pages, and stays with the process when a table has grown
    out of it: together as much again as the tables hold.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if size < OWN_PAGES:
        return np.zeros(shape, dtype)
    return np.frombuffer(mmap.mmap(-1, size), dtype).reshape(shape)


class Memory:
    """Owns the tables and the head of one graph."""

    def __init__(self) -> None:
        self.head: IntHead = np.zeros(HEAD_SIZE, dtype=np.int64)
        self.head[FREE_CLIQUE] = self.head[NEWEST] = -1
        self.head[FREE_F:] = -1
        self._tables: dict[str, npt.NDArray[Any]] = {}
        for name in NAMES:
            self.ensure(name, FIRST_ROWS)
        self.ensure('pool_f', 32 * FIRST_ROWS)
        self.ensure('pool_i', 4 * FIRST_ROWS)
        self.ensure('work_f', 256)  # whatever the fronts take, the chain and the bins take this

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """Return a table with all its capacity; stale after the next `ensure`."""
        return self._tables[name]

    def capacity(self, name: str) -> int:
        """Return how many rows a table holds."""
        return int(self.head[2 * NAMES.index(name) + 1])

    def ensure(self, name: str, rows: int, *, keep: int = 0) -> None:
        """
        Make a table hold so many rows.

        Parameters
        ----------
        name : str
        rows : int
        keep : int
            Rows in use; what lies behind them may be lost.

        """
        at = 2 * NAMES.index(name)
        if name in self._tables and rows <= self.head[at + 1]:
            return
        columns = FLOAT_TABLES.get(name, 0) or INT_TABLES[name]
        dtype = np.float64 if name in FLOAT_TABLES else np.int32
        capacity = max(rows, GROWTH * int(self.head[at + 1]))
        grown = _pages(capacity if columns == 1 else (capacity, columns), dtype)
        if keep > 0:
            grown[:keep] = self._tables[name][:keep]
        self._tables[name] = grown
        self.head[at], self.head[at + 1] = grown.ctypes.data, capacity

    def restart_stamps(self) -> None:
        """Let the counters of stamps begin anew; between two updates alone."""
        for name, columns in STAMPS.items():
            self._tables[name][:, columns] = 0
        self.head[list(COUNTERS_OF_STAMPS)] = 0
