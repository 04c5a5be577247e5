# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The memory of the engine: tables of records that grow, and how kernels access them.

Each node, factor and clique is a record, so that what a step needs of it lies on two or three
cache lines: `nodes[v].pose[2]` in a kernel, `memory.nodes['pose'][:n]` in Python. The values of a
clique (its rows of R and its update matrix) lie in one pool, its list of nodes in another.

Passing a dozen arrays to a kernel costs more than a step along a chain. A kernel that Python calls
therefore gets one array, the *head*: address and capacity of each table, then counters. A kernel
gets its tables from the head, which costs nothing: `tb.nodes(head)`. `Memory.ensure` alone makes
tables grow and updates their addresses.

The comments below are the reference of all fields and counters. A *stamp* is the value that a
counter (UPDATE, ITERATION or FRONT_SERIAL) had when something was done to a row; -1 in a list or
as a row means none. Units: sigma^2 is the unit of energies.
"""

from collections.abc import Callable
import contextlib
from typing import Any, Final

from numba import from_dtype, types
from numba.extending import intrinsic
import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled import pages
from pose_graph_ros.core.compiled.jit import INTEGERS
from pose_graph_ros.core.compiled.numba_internals import populate_array
from pose_graph_ros.core.exceptions import INTERRUPTED, LinearSolveError
from pose_graph_ros.core.graph.constraints import RECORD

# Types of the head and of records of `Factors`, in signatures of kernels.
HEAD, RECORDS = INTEGERS, types.Array(from_dtype(RECORD), 1, 'C')

# --- records ------------------------------------------------------------------------------------

NODE: Final = np.dtype([
    ('pose', 'f8', (3,)),       # in the map, theta in [-pi, pi) [m, m, rad]
    ('delta', 'f8', (3,)),      # solution, the pose minus `reference`, theta not wrapped
    ('seen', 'f8', (3,)),       # `delta` that the cliques below were last solved with
    # heading of `delta` minus the angle of the clique's frame, when the node's factors were last
    # checked [rad]
    ('checked_turn', 'f8'),
    # diagonal scales: roots of the information that the factors of the node have on its position
    # and on its heading [1/m, 1/rad]
    ('scale_t', 'f8'),
    ('scale_r', 'f8'),
    ('reference', 'f8', (3,)),  # constant until all nodes are linearized anew [m, m, rad]
    ('front', 'i8'),            # stamp (FRONT_SERIAL) of the front that `index` is valid for
    ('changed', 'i8'),          # stamp (ITERATION) of the last move by more than alpha sigmas
    ('logged', 'i8'),           # stamp (UPDATE) of the last log of the row
    ('clique', 'i4'),           # row of the clique that the node is frontal in
    # head of the list of its factors with a weight above 0, whose entries are 4 * factor + the
    # index of the end; LEAVES if `editing.compact` takes the node out later
    ('factor_list', 'i4'),
    ('index', 'i4'),            # place of the node in the present front; work space
    ('kind', 'u1'),             # `NodeKind`
    ('dimension', 'u1'),        # number of its coordinates; the others are and stay 0
    ('fixed', 'u1'),            # 1 if the node keeps its pose
    ('touched', 'u1'),          # 1 if it is in the table `touched`; see `tree_update` for 2
], align=True)

# th is the heading of a node's `delta`, and "linearized" means at the last linearization.
FACTOR: Final = np.dtype([
    ('mean', 'f8', (3,)),       # measured pose of j in i, or of i in the map [m, m, rad]
    ('information', 'f8', (6,)),    # xx, xy, xt, yy, yt, tt [1/m^2, 1/(m rad), 1/rad^2]
    ('weight', 'f8'),           # what the information is multiplied by, 0 for a removed factor
    # what else the error depends on, as in `constraints.Factors`; of a relative error the
    # translation of the mean in its own axes, R_z^T t_z [m, m]
    ('constants', 'f8', (4,)),
    # cosine and sine of the linearized frame of the error, where it moves with the nodes
    ('lin_cos', 'f8'),
    ('lin_sin', 'f8'),
    ('lin_arm', 'f8', (2,)),    # linearized arm of the Jacobian [m]
    ('lin_th', 'f8'),           # linearized th of i [rad]
    ('lin_k', 'f8'),            # linearized heading error without th of the nodes [rad]
    ('ends', 'i4', (3,)),       # nodes i, j and k; j is -1 where it has one end, in the map
    ('next', 'i4', (3,)),       # next entries of the lists of these; LEAVES: see `factor_list`
    ('owner', 'i4'),            # row of the clique that the factor was assembled in
    ('kind', 'i4'),             # `FactorKind`
    ('error2', 'f8'),           # squared linearization error, weighted [sigma^2]
    ('energy', 'f8'),           # e^T information e, weighted [sigma^2]
    ('checked', 'i8'),          # stamp (ITERATION) of the last check of the linearization
    ('logged', 'i8'),           # stamp (UPDATE) of the last log of the row
    ('waits', 'i4'),            # 1 if the factor is in the table `waiting`
], align=True)
# In place of a list's head or next entry: the row leaves the graph, and is in no list.
LEAVES: Final = -2

CLIQUE: Final = np.dtype([
    # see `clique_frames`
    ('turn_seen', 'f8'),        # angle of its frame that the parent was eliminated with [rad]
    # mean heading of the separator's `delta` at the elimination of the clique [rad]
    ('turn_zero', 'f8'),
    ('turn', 'f8'),             # angle of its frame during back-substitution [rad]
    # squared error of the parent's linear model of the frame's turn since `turn_seen` [sigma^2]
    ('slip_error2', 'f8'),
    # diagonal scale of the update matrix: the estimate of `slip_error2` is slip_scale * turn^4
    # plus a term in turn^2 [sigma^2/rad^4]
    ('slip_scale', 'f8'),
    # upper bound of how far the separator has deformed since the clique was solved [sigma]
    ('drift', 'f8'),
    ('energy', 'f8'),           # of a prior [sigma^2]
    ('parent', 'i4'),
    ('child', 'i4'),            # the first child
    ('sibling', 'i4'),          # next child of the parent; in an unused row the next unused one
    ('n_frontal', 'i4'),        # number of frontal nodes: 0 for a prior, -1 in an unused row
    ('n_separator', 'i4'),
    ('members', 'i4'),          # index in pool_i of its nodes, frontal ones first
    # index in pool_f of its rows of R, with the update matrix behind them; see `prior_rows`
    ('values', 'i4'),
    # stamp (FRONT_SERIAL) of the last marking for elimination
    ('marked', 'i8'),
    ('built', 'i8'),            # stamp (ITERATION) of the last elimination or solution
    # stamps (UPDATE) of taking the row, of taking the values, and of the last log of the row
    ('born', 'i8'),
    ('values_born', 'i8'),
    ('logged', 'i8'),
    # 1 if a node at or below it is fixed or has a factor whose axes do not turn with its clique
    ('anchored', 'i4'),
], align=True)

SCALARS: Final = np.dtype([
    # squared linearization errors that the last iteration checked, and the one before [sigma^2]
    ('error2_sum', 'f8'),
    ('error2_before', 'f8'),
    ('n_moved', 'f8'),          # number of nodes that the last iteration moved
    # settings: `alpha` [sigma], `budget` and `budget_share` [sigma^2] of `SmootherConfig`
    ('alpha', 'f8'),
    ('budget', 'f8'),
    ('share', 'f8'),
    # damping of Levenberg-Marquardt, as a factor on the squared diagonal scales
    ('damping', 'f8'),
    ('chi2', 'f8'),             # energy of all factors and priors, weighted [sigma^2]
    ('lowest', 'f8'),           # lowest chi2 of the step or the refinement so far [sigma^2]
    # largest change of a coordinate of a position by the last iteration of the refinement [m]
    ('largest_move', 'f8'),
], align=True)

# Tables by name, with the type of their rows:
#   scalars: sums and settings, one record
#   node_id, factor_id: ids of the rows, ascending
#   pool_f, pool_i: values and node lists of cliques
#   log: the transaction log, in words of eight bytes
#   work_f, work_i: work space of kernels
#   touched: nodes to eliminate again in the next iteration
#   freed: pairs (clique, index in pool_f) to release on commit; index -1: the whole clique
#   waiting: factors to relinearize
#   interrupt: 1 if another thread wants the running kernel to end, for REFINEMENT and for ALL; a
#       graph and the copies that are solved for it have the same
TABLES: Final[dict[str, np.dtype[Any]]] = {
    'nodes': NODE, 'factors': FACTOR, 'cliques': CLIQUE, 'scalars': SCALARS,
    **{name: np.dtype(kind) for kind, names in (
        ('f8', ('pool_f', 'work_f')), ('i8', ('log', 'interrupt', 'touched', 'waiting')),
        ('i4', ('pool_i', 'work_i', 'freed', 'node_id', 'factor_id')),
    ) for name in names}}
NAMES: Final = tuple(TABLES)
REFINEMENT, ALL = range(2)
WORD: Final = 8     # bytes; the size of a record is a multiple of it

# --- the head: addresses and capacities first, then counters ------------------------------------

#   N_NODES, N_FACTORS, N_CLIQUES: rows in use; of cliques, unused rows included
#   N_BIASES, N_EDGES: nodes that are biases, and factors between nodes that are none
#   FREE_CLIQUE: first unused row of the cliques
#   POOL_F_END, POOL_I_END: ends of what has ever been taken from the pools
#   N_TOUCHED, N_FREED, N_WAITING: numbers of entries of `touched`, `freed` and `waiting`
#   LOG_END, LOGGED: end of the log, and the largest one since the log has given its pages back
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
#   FIXED: a fixed node, or -1; it stays near the root, see `symbolic.newest_last`
#   SINCE: first stamp BUILT of the cliques that back-substitution has to solve for
#   REFINED: first ITERATION after the last refinement; cliques BUILT before it are at the optimum
#   LISTED: UPDATE that has listed all that the next iteration of a refinement linearizes again
#   ROUND: number of iterations of the refinement so far
#   HEEDS: whose `interrupt` ends the running kernel, beside that for ALL
#   NEXT_NODE, NEXT_FACTOR: ids of the next new rows
#   N_LEAVING: number of rows that `editing.compact` takes out after the update, without those that
#       leave because of the node that they are on
#   N_PRIORS, LOOSE: number of priors, and the first of those without a parent (SIBLING: the next)
# A rollback restores the first ones, up to LOOSE.
(N_NODES, N_FACTORS, N_BIASES, N_EDGES, STRUCTURE, N_TOUCHED, N_WAITING, NEWEST, FIXED,
 NEXT_NODE, NEXT_FACTOR, N_LEAVING, N_PRIORS, LOOSE, N_CLIQUES, FREE_CLIQUE, POOL_F_END,
 POOL_I_END, N_FREED, LOG_END, UPDATE, ITERATION, FRONT_SERIAL, LOGGED, NEED_F, NEED_I,
 NEED_WORK, BAD_NODE, N_RELINEARIZED, N_ELIMINATED, N_VISITED, N_ITERATIONS, N_ROOTS, N_CHECKS,
 N_CHANGED, N_TURNED, NODE_ROOM, FACTOR_ROOM, SINCE, REFINED, LISTED, ROUND, HEEDS,
 COUNTERS_END) = range(2 * len(NAMES), 2 * len(NAMES) + 44)
# Number of sizes of blocks in the pools, the largest of which have 2**31 numbers.
N_SIZES: Final = 212
# Heads of the free lists of pool_f and pool_i, one for each size.
FREE_F, FREE_I = COUNTERS_END, COUNTERS_END + N_SIZES
HEAD_SIZE: Final = COUNTERS_END + 2 * N_SIZES

# Capacity of a new table [rows]; rows never written to take no memory.
FIRST_ROWS: Final = 4096


def _array(name: str, number: types.Type | None = None) -> Callable[[Any], Any]:
    """
    Return an intrinsic that makes the array of a table from the head, without a call.

    If a type of numbers of eight bytes is given, each record is a row of such numbers.
    """
    at, size = 2 * NAMES.index(name), TABLES[name].itemsize
    item = from_dtype(TABLES[name]) if number is None else number
    columns = 1 if number is None else size // WORD
    array_type = types.Array(item, 1 if columns == 1 else 2, 'C')

    def table(typing_context: Any, head: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            entries = context.make_array(signature.args[0])(context, builder, arguments[0]).data
            address, rows = (
                builder.load(builder.gep(entries, [context.get_constant(types.intp, at + k)]))
                for k in range(2))
            array = context.make_array(array_type)(context, builder)
            rest = () if columns == 1 else (columns,)
            shape = [rows, *(context.get_constant(types.intp, n) for n in rest)]
            strides = [context.get_constant(types.intp, n) for n in (size, *(WORD for _ in rest))]
            populate_array(
                array, builder.inttoptr(address, array.data.type), shape, strides,
                context.get_constant(types.intp, size // columns), None)
            return array._getvalue()  # noqa: SLF001  as all of Numba does
        return array_type(head), codegen

    made: Callable[[Any], Any] = intrinsic(table)
    return made


(nodes, factors, cliques, scalars, pool_f, work_f, log, interrupt, touched, waiting, pool_i,
 work_i, freed, node_id, factor_id) = map(_array, NAMES)
# the same memory as numbers of eight bytes
node_words, factor_words, clique_words, scalar_words = (
    _array(name, types.int64) for name in NAMES[:4])
log_numbers = _array('log', types.float64)


def as_bytes(table: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a view of rows without fields, which NumPy copies six times as fast."""
    return table.view(np.dtype((np.void, table.itemsize)))


MOST = {'pool_f': 2**31 - 1}  # rows; cliques have indices of 32 bits into these
MOST_LOGGED = 2**20     # words of the log that keep their pages when it is empty: 8 MB


class Memory:
    """Owns the tables and the head of one graph, which is interrupted with that of another."""

    def __init__(self, another: 'Memory | None' = None) -> None:
        self.head = np.zeros(HEAD_SIZE, dtype=np.int64)
        self.head[FREE_CLIQUE] = self.head[NEWEST] = self.head[FIXED] = self.head[LOOSE] = -1
        self.head[FREE_F:] = -1
        self._tables: dict[str, npt.NDArray[Any]] = {}
        # `Graph` adds those of its rows; with 8 MB for values, graphs of some thousand nodes never
        # copy them; fronts ask for more work space than `chain` and `step` need
        for name, rows in (('scalars', 1), ('interrupt', 2), ('pool_f', 256 * FIRST_ROWS),
                           ('pool_i', 4 * FIRST_ROWS), ('work_f', 256)):
            self.ensure(name, rows)
        if another is not None:
            self._tables['interrupt'] = another['interrupt']
            self.head[2 * NAMES.index('interrupt')] = another['interrupt'].ctypes.data

    @property
    def interrupted(self) -> bool:
        """Whether another thread wants all to end that is done with the graph."""
        return bool(self['interrupt'][ALL])

    def check(self) -> None:
        """Raise LinearSolveError if it is interrupted."""
        if self.interrupted:
            raise LinearSolveError(INTERRUPTED)

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """Return a table with all its capacity; invalid after the next `ensure`."""
        return self._tables[name]

    def take(self, other: 'Memory') -> None:
        """
        Take over what another one has, which is not used any more.

        The head stays the same array: who has it must not go on with tables that are freed.
        """
        self.head[:], self._tables = other.head, other._tables  # noqa: SLF001

    def clear_log(self) -> None:
        """Give back the pages of the log, which is empty now, if an update has filled many."""
        if self.head[LOGGED] > MOST_LOGGED:
            pages.give_back(self._tables['log'])
            self.head[LOGGED] = 0

    def empty(self, name: str) -> None:
        """Let go of what a table holds, and start it anew with few rows."""
        del self._tables[name]
        self.ensure(name, FIRST_ROWS)

    def ensure(self, name: str, rows: int, *, keep: int = 0) -> None:
        """Make a table grow to at least a given number of rows, else raise LinearSolveError."""
        at = 2 * NAMES.index(name)
        have = int(self.head[at + 1]) if name in self._tables else 0
        if name in self._tables and rows <= have:
            return
        most = MOST.get(name, np.iinfo(np.int64).max)
        if rows > most:
            raise LinearSolveError(f'{name}: expected at most {most} rows, got {rows}')
        # unused pages cost address space only, so tables grow fast and are rarely copied; but no
        # system gives more at once than it has
        for wanted in (4 * have, have + have // 4, rows):
            capacity = min(max(rows, wanted), most)
            with contextlib.suppress(OSError, MemoryError, OverflowError):
                grown = pages.zeros((capacity,), TABLES[name])
                break
        else:
            raise LinearSolveError(f'{name}: no memory for {rows} rows')
        if keep > 0:
            as_bytes(grown)[:keep] = as_bytes(self._tables[name])[:keep]
        self._tables[name] = grown
        self.head[at], self.head[at + 1] = grown.ctypes.data, capacity
