# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: hidden nodes and factors, as tables of records."""

from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph import checks, editing, tables as tb, transaction_log
from pose_graph_ros.core.graph.checks import Ids
from pose_graph_ros.core.graph.constraints import FACTORS, Factors, full, NodeKind
from pose_graph_ros.core.graph.factors import energies, errors, write_energies
from pose_graph_ros.core.graph.graph_update import Energies, Gone, GraphRows, GraphUpdate, NextIds
from pose_graph_ros.core.graph.prior_rows import add_priors, priors_of
from pose_graph_ros.core.graph.priors import model, Prior

__all__ = ['Energies', 'Graph', 'GraphRows', 'GraphUpdate', 'NextIds']

# Number of rows and next id of each table.
COUNTERS = {'node': (tb.N_NODES, tb.NEXT_NODE), 'factor': (tb.N_FACTORS, tb.NEXT_FACTOR)}
# By kind, whether factors have each column of `Factors.constants`.
_HAS_CONSTANTS = np.array([np.isin(range(4), factor.constants) for factor in FACTORS.values()])


class Graph:
    """
    A pose graph, edited by `GraphUpdate`s only, each applied whole or not at all.

    Solvers work on its tables and write the poses of the hidden nodes.

    Nodes (biases included) and factors have *ids*: one counter for each of the two,
    ascending, and an id is never used again. The store has them in *rows*, in the
    order of their ids; rows move when others leave. Whoever keeps a number keeps an id; arrays of
    all nodes or factors (`poses`, `weights`, `is_bias`, ...) are by row. All are copies, but
    for `poses`. What asks for an id that is not in the graph raises ValueError, but for `.._rows`.
    """

    def __init__(self, original: 'Graph | None' = None) -> None:
        """Begin with an empty graph; one for a copy of another one is interrupted with that."""
        self.memory: tb.Memory = tb.Memory(None if original is None else original.memory)
        self.ensure(tb.FIRST_ROWS, tb.FIRST_ROWS)
        self.n_moves = 0    # how often `set_poses` or new measurements have moved the nodes
        self._updating = False

    @property
    def node_records(self) -> npt.NDArray[Any]:
        """Hidden nodes as `tables.NODE`, by row, a view."""
        return self.memory['nodes'][:self.n_nodes]

    @property
    def factor_records(self) -> npt.NDArray[Any]:
        """Factors as `tables.FACTOR`, by row, with rows for ends, a view."""
        return self.memory['factors'][:self.n_factors]

    # --- numbers and ids ------------------------------------------------------------------------

    @property
    def n_nodes(self) -> int:
        """Number of hidden nodes, biases included."""
        return int(self.memory.head[tb.N_NODES])

    @property
    def n_factors(self) -> int:
        """Number of factors, removed ones included."""
        return int(self.memory.head[tb.N_FACTORS])

    @property
    def n_edges(self) -> int:
        """Number of factors between nodes that are no biases, removed ones included."""
        return int(self.memory.head[tb.N_EDGES])

    @property
    def n_biases(self) -> int:
        """Number of hidden nodes that are biases."""
        return int(self.memory.head[tb.N_BIASES])

    @property
    def n_priors(self) -> int:
        """Number of dense priors."""
        return int(self.memory.head[tb.N_PRIORS])

    @property
    def newest_pose(self) -> int:
        """Id of the newest hidden node that is not a bias, or -1."""
        newest = int(self.memory.head[tb.NEWEST])
        return int(self.memory['node_id'][newest]) if newest >= 0 else -1

    @property
    def has_touched(self) -> bool:
        """Whether the next step of the smoother has nodes to eliminate again."""
        return bool(self.memory.head[tb.N_TOUCHED] > 0)

    @property
    def next_ids(self) -> NextIds:
        """Ids of the next new rows of an update."""
        return NextIds(*self.memory.head[tb.NEXT_NODE:tb.NEXT_FACTOR + 1].tolist())

    def _ids(self, table: str) -> Ids:
        n_rows, next_id = (int(self.memory.head[k]) for k in COUNTERS[table])
        return Ids(next_id, None if n_rows == next_id else self.memory[f'{table}_id'][:n_rows])

    @property
    def node_ids(self) -> IntArray:
        """Ids of all hidden nodes, ascending."""
        return self.memory['node_id'][:self.n_nodes].astype(np.int64)

    @property
    def factor_ids(self) -> IntArray:
        """Ids of all factors, ascending."""
        return self.memory['factor_id'][:self.n_factors].astype(np.int64)

    def node_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of hidden nodes, shape of `ids`; -1 where they have left the graph."""
        return self._ids('node').rows(ids)

    def factor_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of factors, as `node_rows`."""
        return self._ids('factor').rows(ids)

    def first_factor_from(self, number: int) -> int:
        """Return the row of the first factor with an id from one on."""
        ids = self.memory['factor_id'][:self.n_factors]
        return int(np.searchsorted(ids, ids.dtype.type(number)))

    def factors_on(self, nodes: IntArray) -> IntArray:
        """Return the ids of the factors with an end in some nodes."""
        chosen = np.zeros(self.n_nodes + 1, dtype=bool)    # the last one is for no end, -1
        chosen[self.node_rows(nodes)] = True
        return self.factor_ids[np.any(chosen[self.factor_records['ends']], axis=1)]

    # --- hidden nodes ---------------------------------------------------------------------------

    @property
    def poses(self) -> Poses:
        """Estimates of all hidden nodes in the map, a read-only view."""
        view = self.node_records['pose']
        view.flags.writeable = False
        return view

    def poses_of(self, ids: npt.ArrayLike) -> FloatArray:
        """Return the estimates of hidden nodes, shape (K, 3) for K ids, (3,) for one."""
        rows = self._ids('node').known(ids, 'hidden node')
        return np.asarray(self.node_records['pose'][rows])

    @property
    def fixed(self) -> BoolArray:
        """Whether hidden nodes keep their pose."""
        return np.asarray(self.node_records['fixed'] != 0)

    @property
    def is_bias(self) -> BoolArray:
        """Whether hidden nodes are biases."""
        return np.asarray(self.node_records['kind'] == np.uint8(NodeKind.BIAS))

    @property
    def is_pose(self) -> BoolArray:
        """Whether hidden nodes are poses."""
        return np.asarray(self.node_records['kind'] == np.uint8(NodeKind.POSE))

    @property
    def node_kind(self) -> npt.NDArray[Any]:
        """`NodeKind` of hidden nodes."""
        return self.node_records['kind'].copy()

    @property
    def dimension(self) -> npt.NDArray[Any]:
        """Numbers of coordinates of hidden nodes, 1 to 3."""
        return self.node_records['dimension'].astype(np.int64)

    @property
    def extent(self) -> FloatArray:
        """Lengths of the sides of the box around all poses, shape (2,) [m]."""
        x, y = self.poses[self.is_pose, :2].T   # much faster one by one
        return np.array((np.ptp(x), np.ptp(y))) if len(x) > 0 else np.zeros(2)

    # --- factors --------------------------------------------------------------------------------

    @property
    def factors(self) -> Factors:
        """All factors, by row, with their weights; their ends are ids."""
        return self._with_ids(self.factors_by_row)

    def factors_at(self, ids: npt.ArrayLike) -> Factors:
        """Return factors by id; their ends are ids."""
        return self._with_ids(self._factors_in(self._ids('factor').known(ids, 'factor')))

    @property
    def factors_by_row(self) -> Factors:
        """All factors, with rows for ends, as solvers need them."""
        return self._factors_in(slice(self.n_factors))

    def _factors_in(self, rows: IntArray | slice) -> Factors:
        """Return the factors in some rows, with rows for ends."""
        mean, information, weight, constants, kind, ends = (
            np.array(self.factor_records[field][rows])
            for field in ('mean', 'information', 'weight', 'constants', 'kind', 'ends'))
        return Factors(
            ends[:, 0], ends[:, 1], mean, full(information), kind, weight,
            np.where(_HAS_CONSTANTS[kind], constants, 0.0), ends[:, 2])

    def _with_ids(self, table: Factors) -> Factors:
        """Return a table with the ids of the nodes in place of their rows."""
        ids = self._ids('node').present
        return table if ids is None else table.renumbered(ids.__getitem__)

    @property
    def weights(self) -> FloatArray:
        """Weights of all factors."""
        return self.factor_records['weight'].copy()

    @property
    def priors(self) -> tuple[Prior, ...]:
        """All dense priors."""
        return priors_of(self.memory, self.node_ids)

    def rows(self) -> GraphRows:
        """Return all rows."""
        return GraphRows(
            self.poses.copy(), self.node_kind, self.fixed, self.factors, self.node_ids,
            self.factor_ids, self.next_ids, self.dimension, self.priors)

    # --- errors, at the estimate or at other poses of all hidden nodes, by row ------------------

    def energies(self, poses: Poses | None = None) -> Energies:
        """Return the energies of all factors and priors."""
        poses = self.poses if poses is None else poses
        factors = self.factors_by_row
        return Energies(
            energies(errors(poses, factors), factors.weighted_information),
            np.array([model(prior, poses[rows], self.is_pose[rows]).energy
                      for prior in self.priors for rows in (self.node_rows(prior.nodes),)]))

    def unweighted_energies(self, rows: IntArray) -> FloatArray:
        """Return the energies of the factors in some rows without their weights [sigma^2]."""
        out = np.empty(len(rows))
        write_energies(self.memory.head, rows, out)
        return out

    def errors(self, factors: Factors, poses: Poses | None = None) -> FloatArray:
        """Return the errors of factors with ids for ends, in the graph or not."""
        nodes = self._ids('node')
        if nodes.present is not None:
            factors = factors.renumbered(lambda ids: nodes.known(ids, 'hidden node'))
        return errors(self.poses if poses is None else poses, factors)

    # --- edits -----------------------------------------------------------------------------------

    def set_weights(self, weights: npt.NDArray[Any]) -> None:
        """Set the weights of all factors to what `weights` has returned."""
        changed = np.flatnonzero(weights != self.weights)
        self.apply(GraphUpdate(weigh=dict(zip(
            self.factor_ids[changed].tolist(), weights[changed].tolist(), strict=True))))

    def apply(self, update: GraphUpdate) -> None:
        """
        Apply an update; a GraphUpdateError for an invalid part leaves the graph unchanged.

        Between `begin` and `commit` or `rollback`, what leaves keeps its rows; `commit` takes them
        out. Otherwise they are taken out at once.
        """
        edits = update.edits
        if edits:
            self._check_edits(update)
        self._add(*checks.new_nodes(update), update.factors)
        if edits:
            self._edit(update)

    def _add(self, values: FloatArray, types: npt.NDArray[np.uint8], factors: Factors) -> None:
        """Add nodes, given by `checks.new_nodes`, and factors; raise GraphUpdateError if bad."""
        checked = False
        try:
            code = editing.add_rows(self.memory.head, values, types, factors.records, checked)
        except (TypeError, ValueError):
            code = editing.UNSOUND  # arrays of types that the kernel is not compiled for
        while code != editing.ADDED:
            if code == editing.NO_ROOM:
                self.ensure(self.n_nodes + len(types), self.n_factors + len(factors))
            else:
                values, factors = self._checked(values, types, factors)
                checked = True
            code = editing.add_rows(self.memory.head, values, types, factors.records, checked)

    def _check_edits(self, update: GraphUpdate) -> None:
        """Raise GraphUpdateError for unknown ids or invalid weights; new rows may be edited."""
        nodes = self._ids('node').extended(
            len(update.hidden) + len(update.biases) + len(update.landmarks))
        factors = self._ids('factor').extended(len(update.factors))
        for what, known, parts in (('hidden node', nodes, ('fix', 'free', 'remove_nodes')),
                                   ('factor', factors, ('remove', 'drop', 'weigh'))):
            for part in parts:
                checks.check_ids(part, getattr(update, part), what, known)
        checks.check_weights(update.weigh)
        for measured in update.measure:
            checks.check_ids('measure', measured.ids.tolist(), 'factor', factors)
        for n, prior in enumerate(update.priors):
            checks.check_ids(f'priors[{n}].nodes', prior.nodes, 'hidden node', nodes)

    def _edit(self, update: GraphUpdate) -> None:
        """Apply the edits of existing rows, which have been checked."""
        head = self.memory.head
        weights = {**dict.fromkeys(update.remove, 0.0), **update.weigh,
                   **dict.fromkeys(update.drop, editing.DROPPED)}
        if len(weights) > 0:
            ids = np.fromiter(weights, np.int64, len(weights))
            editing.set_weights(head, self.factor_rows(ids), np.fromiter(
                weights.values(), np.float64, len(weights)))
        for measured in update.measure:
            editing.measure(head, self.factor_rows(measured.ids), *map(
                np.ascontiguousarray, (measured.mean, measured.information)))
            self.n_moves += 1
        for nodes, fixed in ((update.fix, True), (update.free, False)):
            if len(nodes) > 0:
                editing.set_fixed(head, self.node_rows(nodes), fixed)
        if len(update.remove_nodes) > 0:
            editing.remove_nodes(head, self.node_rows(update.remove_nodes))
        if any(map(len, (update.fix, update.free, update.remove_nodes))):
            editing.find_newest_and_fixed(self.memory)
        if len(update.priors) > 0:
            self.ensure(self.n_nodes + len(update.priors), self.n_factors)
            add_priors(self.memory, update.priors, [
                self.node_rows(prior.nodes) for prior in update.priors])
        if not self._updating:
            editing.compact(self.memory)

    def _checked(self, values: FloatArray, types: npt.NDArray[np.uint8],
                 factors: Factors) -> tuple[FloatArray, Factors]:
        """Return new rows as arrays for the kernel; raise GraphUpdateError if one is invalid."""
        values = checks.checked_poses('biases' if np.any(types) else 'hidden', values)
        kind = np.concatenate((self.node_kind, types & 3))
        dimension = np.concatenate((self.dimension, 3 - (types >> 2)))
        checks.check(factors, kind, dimension, self._ids('node').extended(len(types)))
        return np.array(values, order='C'), Factors.of(np.array(factors.records, order='C'))

    def ensure(self, n_nodes: int, n_factors: int) -> None:
        """Make the tables and the transaction log large enough for a graph of this size."""
        memory, head = self.memory, self.memory.head
        n_nodes += int(head[tb.N_PRIORS])   # of which there is as much space as of nodes
        if n_nodes <= head[tb.NODE_ROOM] and n_factors <= head[tb.FACTOR_ROOM]:
            return
        for name, needed in (('node', n_nodes), ('factor', n_factors)):
            for table in (f'{name}s', f'{name}_id'):
                memory.ensure(table, needed, keep=int(head[COUNTERS[name][0]]))
        nodes, factors = (len(memory[name]) for name in ('nodes', 'factors'))
        # the rest costs address space: little of the log and the work space is ever written to
        for name, needed, used in (
                ('cliques', 2 * nodes, tb.N_CLIQUES),
                ('touched', nodes, tb.N_TOUCHED), ('freed', 4 * nodes, tb.N_FREED),
                ('waiting', factors, tb.N_WAITING),
                ('log', transaction_log.largest(nodes, factors), tb.LOG_END)):
            memory.ensure(name, needed, keep=int(head[used]))
        memory.ensure('work_i', 4 * nodes)
        head[tb.NODE_ROOM], head[tb.FACTOR_ROOM] = nodes, factors

    def set_poses(self, poses: Poses) -> None:
        """
        Set the estimates of all hidden nodes; headings are wrapped.

        All factors are linearized there, and the next step eliminates all nodes. A wrong shape
        or a number that is not finite raises GraphUpdateError.
        """
        if poses.shape != (self.n_nodes, 3) or not np.all(np.isfinite(poses)):
            raise GraphUpdateError(
                f'expected finite poses, shape {(self.n_nodes, 3)}, got shape {poses.shape}')
        self.node_records['pose'] = se2.wrapped(poses)
        self.n_moves += 1
        editing.restart(self.memory.head)

    def fill(self, rows: GraphRows) -> None:
        """
        Add all rows of another graph, with their ids, to this one; fixed nodes are fixed.

        The ids must be above those that this graph has or had, as in an empty one, and ascending.
        Raises GraphUpdateError if they are not, or a row is invalid.
        """
        types = (rows.node_kind + 4 * (3 - rows.dimension)).astype(np.uint8)
        self._append('node', rows.poses, types, Factors(), rows.node_ids, rows.next_ids.node)
        self._append('factor', rows.poses[:0], types[:0], rows.factors, rows.factor_ids,
                     rows.next_ids.factor)
        self.apply(GraphUpdate(fix=rows.node_ids[rows.fixed].tolist(), priors=rows.priors))

    def _append(self, name: str, values: FloatArray, types: npt.NDArray[np.uint8],
                factors: Factors, ids: IntArray, next_id: int) -> None:
        """Add new rows of one table with given ids instead of the next ones."""
        head, n_rows, counter = self.memory.head, *COUNTERS[name]
        begin, first = int(head[n_rows]), int(head[counter])
        self._add(values, types, factors)
        if len(ids) != head[n_rows] - begin or np.any(np.diff(ids, prepend=first - 1) <= 0):
            raise GraphUpdateError(f'{name}: expected ascending ids from {first} on, one a row')
        self.memory[f'{name}_id'][begin:head[n_rows]] = ids
        head[counter] = max(next_id, first, int(ids[-1]) + 1 if len(ids) > 0 else 0)

    def begin(self) -> None:
        """Begin an update; `rollback` reverts all edits and steps after it."""
        self._updating = True
        transaction_log.begin(self.memory.head)

    def commit(self) -> Gone:
        """End an update and keep its changes; return what has left, whose rows are taken out."""
        transaction_log.commit(self.memory.head)
        self.memory.clear_log()
        self._updating = False
        return editing.compact(self.memory)

    def rollback(self) -> None:
        """Revert all edits and steps since `begin`, bit for bit."""
        transaction_log.rollback(self.memory.head)
        self._updating = False
