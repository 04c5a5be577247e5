# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The memory of the engine: flat tables that grow, and how kernels access them.

Nodes, factors and cliques are rows of 2-D arrays, one of floats (`node_f`) and one
of integers (`node_i`) each, so that what a step needs of a row lies on two or three cache lines.
The values of a clique (its rows of R and its update matrix) lie in one pool, its list of nodes in
another.

Passing a dozen arrays to a kernel costs more than a step along a chain. A kernel that Python calls
therefore gets one array, the *head*: address and capacity of each table, then counters. A kernel
gets its tables from the head, which costs nothing: `tb.node_f(head)`. `Memory.ensure` alone makes
tables grow and updates their addresses.

The comments below are the reference of all columns and counters. A *stamp* is the value that a
counter (UPDATE, ITERATION or FRONT_SERIAL) had when something was done to a row; -1 in a list or
as a row means none. A name that stands for several columns is the first of them. The last name of
each group is the number of columns. Units: sigma^2 is the unit of energies.
"""

from collections.abc import Callable
import contextlib
import mmap
from typing import Any, Final

from numba import types
from numba.extending import intrinsic
import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.jit import INTEGERS
from pose_graph_ros.core.compiled.numba_internals import populate_array

HEAD = INTEGERS     # the type of the head, in signatures of kernels

# --- columns ------------------------------------------------------------------------------------

# node_f; a solve changes the columns before SCALE_T only.
#   POSE (3): pose in the map, theta in [-pi, pi) [m, m, rad]
#   DELTA (3): solution, the pose minus REF, theta not wrapped [m, m, rad]
#   SEEN (3): DELTA that the cliques below were last solved with [m, m, rad]
#   CHECKED_TURN: DELTA of the heading minus the angle of the clique's frame, when the node's
#       constraints were last checked [rad]
#   SCALE_T, SCALE_R: diagonal scales, roots of the information that the node's constraints have on
#       its position and on its heading [1/m, 1/rad]
#   REF (3): reference pose, constant until all nodes are linearized anew [m, m, rad]
POSE, DELTA, SEEN, CHECKED_TURN, SCALE_T, SCALE_R, REF, NODE_F = 0, 3, 6, 9, 10, 11, 12, 15
# node_i
#   CLIQUE: row of the clique that the node is frontal in
#   FACTOR_LIST: head of the list of its factors with a weight above 0; an entry is
#       4 * factor + side (0: END_I, 1: END_J, 2: END_K); LEAVES if `removal.compact` takes the
#       node out later
#   FIXED: 1 if the node keeps its pose
#   TOUCHED: 1 if the node is in the table `touched`
#   INDEX: place of the node in the present front; work space
#   FRONT: stamp (FRONT_SERIAL) of the front that INDEX is valid for
#   CHANGED: stamp (ITERATION) of the last move by more than alpha sigmas
#   NODE_LOGGED, SOLUTION_LOGGED: stamps (UPDATE) of the last log of the row, and of the columns
#       before SCALE_T alone
#   NODE_TYPE: `NodeKind` + 4 * number of coordinates less than three, which are and stay 0; so 0
#       for a pose
(CLIQUE, FACTOR_LIST, FIXED, TOUCHED, INDEX, FRONT, CHANGED, NODE_LOGGED, SOLUTION_LOGGED,
 NODE_TYPE, NODE_I) = range(11)

# factor_f; th is the DELTA of a heading, and "linearized" means at the last linearization.
#   MEAN (3): measured pose of j in i, or of i in the map [m, m, rad]
#   INFO (6): information xx, xy, xt, yy, yt, tt [1/m^2, 1/(m rad), 1/rad^2]
#   WEIGHT: what the information is multiplied by, 0 for a removed factor
#   OWN (2): translation of the mean in its own axes, R_z^T t_z [m], or the column OFFSET
#   OFFSET (2, 3 with one end): measured position, or pose, in the frame of i [m, m, rad], where an
#       error has one; its heading shares the column of LIN_COS
#   LIN_COS, LIN_SIN: of the linearized frame of the error, where it moves with the nodes
#   BIAS_T, BIAS_TH: what a bias that is the end j is multiplied by; BIAS_TH: of the third node;
#       share the columns of LIN_COS and LIN_SIN
#   LIN_ARM (2): linearized arm of the Jacobian [m]
#   LIN_TH: linearized th of i [rad]
#   LIN_K: linearized heading error without th of the nodes [rad]
#   ERROR2: squared linearization error, weighted [sigma^2]
#   ENERGY: e^T information e, weighted [sigma^2]
(MEAN, INFO, WEIGHT, OWN, LIN_COS, LIN_SIN, LIN_ARM, LIN_TH, LIN_K, ERROR2, ENERGY, FACTOR_F) = (
    0, 3, 9, 10, 12, 13, 14, 16, 17, 18, 19, 20)
OFFSET, BIAS_T, BIAS_TH = OWN, LIN_COS, LIN_SIN
# factor_i
#   END_I, END_J: nodes that it starts from and leads to; END_J: -1 for one end, in the map
#   END_K: third node, or -1
#   NEXT_I, NEXT_J, NEXT_K: next entries of the lists of END_I, END_J and END_K; NEXT_I: LEAVES if
#       `removal.compact` takes the factor out, as it does all factors of nodes that leave
#   FACTOR_KIND: `FactorKind`
#   FACTOR_CHECKED: stamp (ITERATION) of the last check of the linearization
#   FACTOR_WAITS: 1 if the factor is in the table `waiting`
#   FACTOR_LOGGED, ENERGY_LOGGED: stamps (UPDATE) of the last log of the row, and of ERROR2, ENERGY
#       and FACTOR_WAITS alone
#   OWNER: row of the clique that the factor was assembled in
(END_I, END_J, END_K, NEXT_I, NEXT_J, NEXT_K, FACTOR_KIND, FACTOR_CHECKED, FACTOR_WAITS,
 FACTOR_LOGGED, ENERGY_LOGGED, OWNER, FACTOR_I) = range(13)
# In place of a list's head or next entry: the row leaves the graph, and is in no list.
LEAVES = -2

# clique_i
#   PARENT, CHILD, SIBLING: rows of the parent, the first child and the next child of the parent;
#       in an unused row SIBLING is the next unused one
#   N_FRONTAL, N_SEPARATOR: numbers of frontal nodes (0 for a prior, -1 in an unused row) and
#       separator nodes
#   NODES: index in pool_i of its nodes, frontal ones first
#   VALUES: index in pool_f of its rows of R, with the update matrix behind them; see `prior_rows`
#   MARKED: stamp (FRONT_SERIAL) of the last marking for elimination; while marked cliques are
#       eliminated, the number of marked children that are left
#   BUILT: stamp (ITERATION) of the last elimination or solution
#   BORN, VALUES_BORN, CLIQUE_LOGGED: stamps (UPDATE) of taking the row, of taking the values, and
#       of the last log of the row
#   ANCHORED: 1 if a node at or below it is fixed or has a factor whose axes do not turn with
#       its clique
(PARENT, CHILD, SIBLING, N_FRONTAL, N_SEPARATOR, NODES, VALUES, MARKED, BUILT, BORN, VALUES_BORN,
 CLIQUE_LOGGED, ANCHORED, CLIQUE_I) = range(14)
# clique_f; see `clique_frames`.
#   TURN_SEEN: angle of the clique's frame that the parent was eliminated with [rad]
#   TURN_ZERO: mean DELTA of the separator's headings at the elimination of the clique [rad]
#   SLIP_ERROR2: squared error of the parent's linear model of the frame's turn since TURN_SEEN
#       [sigma^2]
#   TURN: angle of the frame during back-substitution [rad]; shares the column of SLIP_ERROR2
#   SLIP_SCALE: diagonal scale of the update matrix: the estimate of SLIP_ERROR2 is
#       SLIP_SCALE * turn^4 plus a term in turn^2 [sigma^2/rad^4]
#   DRIFT: upper bound of how far the separator has deformed since the clique was solved [sigma]
#   PRIOR_ENERGY: of a prior, its energy [sigma^2]; shares the column of TURN_ZERO
TURN_SEEN, TURN_ZERO, SLIP_ERROR2, SLIP_SCALE, DRIFT, CLIQUE_F = range(6)
TURN, PRIOR_ENERGY = SLIP_ERROR2, TURN_ZERO

# Tables by name, with their numbers of columns. Those with one column are 1-D:
#   node_id, factor_id: ids of the rows, ascending
#   pool_f, pool_i: values and node lists of cliques
#   log_f, log_i: transaction log
#   work_f, work_i: work space of kernels
#   scalars: sums and settings
#   touched: nodes to eliminate again in the next iteration
#   freed: pairs (clique, index in pool_f) to release on commit; index -1: the whole clique
#   waiting: factors to relinearize
FLOAT_TABLES: Final = {'node_f': NODE_F, 'factor_f': FACTOR_F, 'pool_f': 1, 'log_f': 1,
                       'work_f': 1, 'scalars': 1, 'clique_f': CLIQUE_F}
INT_TABLES: Final = {'node_i': NODE_I, 'factor_i': FACTOR_I, 'clique_i': CLIQUE_I, 'pool_i': 1,
                     'log_i': 1, 'work_i': 1, 'touched': 1, 'freed': 1, 'waiting': 1,
                     'node_id': 1, 'factor_id': 1}
NAMES: Final = (*FLOAT_TABLES, *INT_TABLES)

# --- the head: addresses and capacities first, then counters ------------------------------------

#   N_NODES, N_FACTORS, N_CLIQUES: rows in use; of cliques, unused rows included
#   FREE_CLIQUE: first unused row of the cliques
#   POOL_F_END, POOL_I_END: ends of what has ever been taken from the pools
#   N_TOUCHED, N_FREED, N_WAITING: numbers of entries of `touched`, `freed` and `waiting`
#   LOG_F_END, LOG_I_END: ends of the log
#   UPDATE, ITERATION, FRONT_SERIAL: number of the update, the iteration and the front
#   STRUCTURE: 1 if the next elimination needs a new ordering
#   NEED_F, NEED_I, NEED_WORK: capacities of pool_f, pool_i and work_f that a step lacks
#   BAD_NODE: node that is not determined
#   N_RELINEARIZED, N_ELIMINATED, N_VISITED, N_ITERATIONS: what the update did so far: constraints
#       (and clique frames) relinearized, nodes eliminated, cliques solved for, iterations
#   N_ROOTS: number of root cliques that back-substitution begins with
#   N_CHECKS, N_CHANGED, N_TURNED: numbers of nodes with constraints to check, of nodes that moved
#       by more than alpha sigmas, and of cliques whose frames turned; their lists are in work_i
#   NODE_ROOM, FACTOR_ROOM: capacity of all tables in nodes and factors
#   NEWEST: newest node that is a pose, or -1
#   SINCE: first stamp BUILT of the cliques that back-substitution has to solve for
#   REFINED: first ITERATION after the last refinement; cliques BUILT before it are at the optimum
#   LISTED: UPDATE that has listed all that the next iteration of a refinement linearizes again
#   ROUND: number of iterations of the refinement so far
#   INTERRUPT: set to 1 by another thread to end a refinement
#   NEXT_NODE, NEXT_FACTOR: ids of the next new rows
#   N_LEAVING: number of rows that `removal.compact` takes out after the update, without those that
#       leave because of the node that they are on
#   N_PRIORS, LOOSE: number of priors, and the first of those without a parent (SIBLING: the next)
(N_NODES, N_FACTORS, N_CLIQUES, FREE_CLIQUE, POOL_F_END, POOL_I_END, N_TOUCHED, N_FREED,
 N_WAITING, LOG_F_END, LOG_I_END, UPDATE, ITERATION, FRONT_SERIAL, STRUCTURE, NEED_F,
 NEED_I, NEED_WORK, BAD_NODE, N_RELINEARIZED, N_ELIMINATED, N_VISITED, N_ITERATIONS, N_ROOTS,
 N_CHECKS, N_CHANGED, N_TURNED, NODE_ROOM, FACTOR_ROOM, NEWEST, SINCE, REFINED, LISTED, ROUND,
 INTERRUPT, NEXT_NODE, NEXT_FACTOR, N_LEAVING, N_PRIORS, LOOSE, COUNTERS_END) = range(
     2 * len(NAMES), 2 * len(NAMES) + 41)
# Sizes of the blocks of the pools: exact up to 64 numbers, then in steps of an eighth.
SIZES: Final = [*range(65)]
while SIZES[-1] < 2**31:
    SIZES.append(int(np.ceil(1.125 * SIZES[-1])))
N_SIZES: Final = len(SIZES)
# Heads of the free lists of pool_f and pool_i, one for each size.
FREE_F, FREE_I = COUNTERS_END, COUNTERS_END + N_SIZES
HEAD_SIZE: Final = COUNTERS_END + 2 * N_SIZES

# scalars
#   ERROR2_SUM: sum of the squared linearization errors that the last iteration checked [sigma^2]
#   N_MOVED: number of nodes that the last iteration moved
#   SETTING_ALPHA, SETTING_BUDGET, SETTING_SHARE: `alpha` [sigma], `budget` and `budget_share`
#       [sigma^2] of `SmootherConfig`
#   DAMPING: damping of Levenberg-Marquardt, as a factor on the squared diagonal scales
#   CHI2: energy of all constraints, weighted [sigma^2]
#   ERROR2_BEFORE: ERROR2_SUM of the iteration before [sigma^2]
#   LOWEST: lowest CHI2 of the refinement so far [sigma^2]
#   LARGEST_MOVE: largest change of a coordinate of a position by the last iteration of it [m]
(ERROR2_SUM, N_MOVED, SETTING_ALPHA, SETTING_BUDGET, SETTING_SHARE, DAMPING, CHI2, ERROR2_BEFORE,
 LOWEST, LARGEST_MOVE, N_SCALARS) = range(11)

# Largest counter value that rows keep as a stamp of 32 bits; `restart_stamps` is due beyond it.
# FRONT_SERIAL reaches it after hours, UPDATE after some hundred days.
LAST_STAMP: Final = 2**30
COUNTERS_OF_STAMPS: Final = (UPDATE, ITERATION, FRONT_SERIAL, SINCE, REFINED, LISTED)
STAMPS: Final = {
    'node_i': (FRONT, CHANGED, NODE_LOGGED, SOLUTION_LOGGED),
    'factor_i': (FACTOR_CHECKED, FACTOR_LOGGED, ENERGY_LOGGED),
    'clique_i': (MARKED, BUILT, BORN, VALUES_BORN, CLIQUE_LOGGED),
}

# Capacity of a new table [rows]; rows never written to take no memory.
FIRST_ROWS: Final = 1024

IntHead = npt.NDArray[np.int64]


def _table(name: str) -> Callable[[Any], Any]:
    """Return an intrinsic that makes the array of a table from the head, without a call."""
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
factor_f = _table('factor_f')
pool_f = _table('pool_f')
log_f = _table('log_f')
work_f = _table('work_f')
scalars = _table('scalars')
clique_f = _table('clique_f')
node_i = _table('node_i')
factor_i = _table('factor_i')
clique_i = _table('clique_i')
pool_i = _table('pool_i')
log_i = _table('log_i')
work_i = _table('work_i')
touched = _table('touched')
freed = _table('freed')
waiting = _table('waiting')
node_id = _table('node_id')
factor_id = _table('factor_id')


def _pages(shape: int | tuple[int, int], dtype: type[np.generic]) -> npt.NDArray[Any]:
    """
    Return an array of zeros; a large one has pages of its own, which take memory when written to.

    NumPy would allocate huge pages and keep them after a table has grown out of them. The pages
    are private: a process that is forked from this one gets copies of those that it writes to.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if size < 2**18:
        return np.zeros(shape, dtype)
    pages = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without huge pages
        pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype).reshape(shape)


class Memory:
    """Owns the tables and the head of one graph."""

    def __init__(self) -> None:
        self.head: IntHead = np.zeros(HEAD_SIZE, dtype=np.int64)
        self.head[FREE_CLIQUE] = self.head[NEWEST] = self.head[LOOSE] = -1
        self.head[FREE_F:] = -1
        self._tables: dict[str, npt.NDArray[Any]] = {}
        for name in NAMES:
            self.ensure(name, {'pool_f': 32, 'pool_i': 4}.get(name, 1) * FIRST_ROWS)
        self.ensure('work_f', 256)  # for `chain` and `relinearization`; fronts ask for more

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """Return a table with all its capacity; invalid after the next `ensure`."""
        return self._tables[name]

    def ensure(self, name: str, rows: int, *, keep: int = 0) -> None:
        """Make a table grow to at least a given number of rows."""
        at = 2 * NAMES.index(name)
        if name in self._tables and rows <= self.head[at + 1]:
            return
        columns = FLOAT_TABLES.get(name, 0) or INT_TABLES[name]
        dtype = np.float64 if name in FLOAT_TABLES else np.int32
        # unused pages cost address space only, so tables grow fast and are rarely copied
        capacity = max(rows, 4 * int(self.head[at + 1]))
        grown = _pages(capacity if columns == 1 else (capacity, columns), dtype)
        if keep > 0:
            grown[:keep] = self._tables[name][:keep]
        self._tables[name] = grown
        self.head[at], self.head[at + 1] = grown.ctypes.data, capacity

    def restart_stamps(self) -> None:
        """Set the counters of stamps and all stamps to 0; allowed between two updates only."""
        for name, columns in STAMPS.items():
            self._tables[name][:, columns] = 0
        self.head[list(COUNTERS_OF_STAMPS)] = 0
