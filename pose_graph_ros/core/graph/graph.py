# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: hidden nodes, edges and observed nodes, as struct of arrays."""

from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import editing, identities, tables as tb, transaction_log
from pose_graph_ros.core.graph.constraints import check, EdgeKind, Edges, full, ObservedNodes
from pose_graph_ros.core.graph.edit_checks import (
    check_ids,
    check_weights,
    checked_poses,
    integers,
    values,
)
from pose_graph_ros.core.graph.error_functions import edge_errors, energies, observed_errors
from pose_graph_ros.core.graph.graph_update import (
    Energies,
    GraphRows,
    GraphUpdate,
    NextIds,
    NO_EDGES,
    NO_POSES,
    NO_WEIGHTS,
    NOTHING_OBSERVED,
)
from pose_graph_ros.core.graph.tables import Memory

__all__ = [
    'NOTHING_OBSERVED',
    'NO_EDGES',
    'NO_POSES',
    'NO_WEIGHTS',
    'Energies',
    'Graph',
    'GraphRows',
    'GraphUpdate',
    'NextIds',
]

# Columns of edge_f with the column `Edges.bias`.
_BIAS_COLUMNS = [tb.BIAS_OFFSET, tb.BIAS_OFFSET + 1, tb.FACTOR_T, tb.FACTOR_TH]


class Graph:
    """
    A pose graph, edited by `GraphUpdate`s only, each applied whole or not at all.

    Hidden nodes (biases included), edges and observed nodes have *ids*: one counter for each of
    the three, ascending, and an id is never used again. The store has them in *rows*, in the
    order of their ids; rows move when others leave. Whoever keeps a number keeps an id; arrays of
    all nodes or constraints (`poses`, `weights`, `is_bias`, ...) are by row.

    Solvers work on its tables and write the poses of the hidden nodes.
    """

    def __init__(self) -> None:
        self.memory = Memory()
        self.n_moves = 0
        """How often `set_poses` has moved the nodes."""

    @property
    def n_nodes(self) -> int:
        """Number of hidden nodes, biases included."""
        return int(self.memory.head[tb.N_NODES])

    @property
    def newest_pose(self) -> int:
        """Id of the newest hidden node that is not a bias, or -1."""
        return int(self.memory.head[tb.NEWEST])

    @property
    def node_ids(self) -> IntArray:
        """Ids of all hidden nodes, ascending, shape (N,), read-only."""
        return identities.read_only(np.arange(self.n_nodes))

    @property
    def edge_ids(self) -> IntArray:
        """Ids of all edges, ascending, shape (M,), read-only."""
        return identities.read_only(np.arange(self.n_edges))

    @property
    def observed_ids(self) -> IntArray:
        """Ids of all observed nodes, ascending, shape (K,), read-only."""
        return identities.read_only(np.arange(self.n_observed))

    @property
    def next_ids(self) -> NextIds:
        """Ids of the next new rows of an update."""
        return NextIds(self.n_nodes, self.n_edges, self.n_observed)

    def node_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of hidden nodes, shape of `ids`; -1 where they have left the graph."""
        return identities.rows_of(self.node_ids, ids)

    def edge_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of edges, shape of `ids`; -1 where they have left the graph."""
        return identities.rows_of(self.edge_ids, ids)

    def observed_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of observed nodes, shape of `ids`; -1 where they have left the graph."""
        return identities.rows_of(self.observed_ids, ids)

    @property
    def n_edges(self) -> int:
        """Number of edges, removed ones included."""
        return int(self.memory.head[tb.N_EDGES])

    @property
    def n_observed(self) -> int:
        """Number of observed nodes, removed ones included."""
        return int(self.memory.head[tb.N_OBSERVED])

    @property
    def has_touched(self) -> bool:
        """Whether the next step of the smoother has nodes to eliminate again."""
        return bool(self.memory.head[tb.N_TOUCHED] > 0)

    @property
    def poses(self) -> FloatArray:
        """Estimates of all hidden nodes in the map, shape (N, 3) [m, m, rad], a read-only view."""
        view = self.memory['node_f'][:self.n_nodes, tb.POSE:tb.POSE + 3]
        view.flags.writeable = False
        return view

    def poses_of(self, ids: npt.ArrayLike) -> FloatArray:
        """
        Return a copy of the estimates of hidden nodes, shape (K, 3) for K ids, (3,) for one.

        Raises ValueError if one has left the graph.
        """
        rows = identities.known(self.node_rows(ids), ids, 'hidden node')
        return self.memory['node_f'][rows, tb.POSE:tb.POSE + 3]

    @property
    def fixed(self) -> BoolArray:
        """Whether hidden nodes keep their pose, shape (N,)."""
        return self.memory['node_i'][:self.n_nodes, tb.FIXED] != 0

    @property
    def is_bias(self) -> BoolArray:
        """Whether hidden nodes are biases, not poses, shape (N,)."""
        return self.memory['node_i'][:self.n_nodes, tb.IS_BIAS] != 0

    @property
    def edges(self) -> Edges:
        """All edges, by row, with their weights; their ends are ids."""
        return self._edges_in(slice(self.n_edges))

    def edges_at(self, ids: npt.ArrayLike) -> Edges:
        """Return edges by id; their ends are ids. Raises ValueError if one has left the graph."""
        return self._edges_in(identities.known(self.edge_rows(ids), ids, 'edge'))

    def _edges_in(self, rows: IntArray | slice) -> Edges:
        """Return the edges in some rows."""
        numbers, integers = self.memory['edge_f'][rows], self.memory['edge_i'][rows]
        kind, bias = integers[:, tb.EDGE_KIND], np.zeros((len(integers), 4))
        to_bias = np.flatnonzero(kind == EdgeKind.BIAS)
        bias[to_bias] = numbers[to_bias[:, None], _BIAS_COLUMNS]
        return Edges(
            integers[:, tb.END_I], integers[:, tb.END_J], numbers[:, tb.MEAN:tb.MEAN + 3].copy(),
            full(numbers[:, tb.INFO:tb.INFO + 6]), kind, numbers[:, tb.WEIGHT].copy(), bias)

    @property
    def observed(self) -> ObservedNodes:
        """All observed nodes, by row, with their weights; their nodes are ids."""
        return self._observed_in(slice(self.n_observed))

    def observed_at(self, ids: npt.ArrayLike) -> ObservedNodes:
        """Return observed nodes by id, as `edges_at` does."""
        return self._observed_in(identities.known(self.observed_rows(ids), ids, 'observed node'))

    def _observed_in(self, rows: IntArray | slice) -> ObservedNodes:
        """Return the observed nodes in some rows."""
        numbers, integers = self.memory['observed_f'][rows], self.memory['observed_i'][rows]
        return ObservedNodes(
            integers[:, tb.OBS_NODE], numbers[:, tb.OBS_OFFSET:tb.OBS_OFFSET + 3].copy(),
            numbers[:, tb.MEAN:tb.MEAN + 3].copy(), full(numbers[:, tb.INFO:tb.INFO + 6]),
            integers[:, tb.OBS_KIND], numbers[:, tb.WEIGHT].copy())

    @property
    def weights(self) -> tuple[FloatArray, FloatArray]:
        """Weights of all edges and of all observed nodes."""
        return (self.memory['edge_f'][:self.n_edges, tb.WEIGHT].copy(),
                self.memory['observed_f'][:self.n_observed, tb.WEIGHT].copy())

    def set_weights(self, weights: tuple[FloatArray, FloatArray]) -> None:
        """Set the weights of all edges and observed nodes to what `weights` has returned."""
        edges, observed = (
            {int(row): float(wanted[row]) for row in np.flatnonzero(wanted != present)}
            for wanted, present in zip(weights, self.weights, strict=True))
        self.apply(GraphUpdate(weigh_edges=edges, weigh_observed=observed))

    def apply(self, update: GraphUpdate) -> None:
        """Apply an update; a GraphUpdateError for an invalid part leaves the graph unchanged."""
        hidden, edges, observed, *by_number, biases = update
        edits = any(map(len, by_number))
        if edits:
            self._check_edits(update)
        columns, checked = (hidden, biases, *edges.columns, *observed.columns), False
        try:
            code = editing.add_rows(self.memory.head, *columns, checked)
        except (TypeError, ValueError):
            code = editing.UNSOUND  # arrays of types that the kernel is not compiled for
        while code != editing.ADDED:
            if code == editing.NO_ROOM:
                self.ensure(*self._sizes_after(update))
            else:
                columns, checked = self._checked_columns(update), True
            code = editing.add_rows(self.memory.head, *columns, checked)
        if edits:
            self._edit(update)

    def _sizes_after(self, update: GraphUpdate) -> tuple[int, int, int]:
        """Return the numbers of hidden nodes, edges and observed nodes after an update."""
        return (self.n_nodes + len(update.hidden) + len(update.biases),
                self.n_edges + len(update.edges), self.n_observed + len(update.observed))

    def _check_edits(self, update: GraphUpdate) -> None:
        """Raise GraphUpdateError for invalid numbers or weights; those of new rows are valid."""
        n_nodes, n_edges, n_observed = self._sizes_after(update)
        check_ids('fix', update.fix, 'hidden nodes', n_nodes)
        check_ids('free', update.free, 'hidden nodes', n_nodes)
        check_ids('remove_edges', update.remove_edges, 'edges', n_edges)
        check_ids('remove_observed', update.remove_observed, 'observed nodes', n_observed)
        check_weights('weigh_edges', update.weigh_edges, 'edges', n_edges)
        check_weights('weigh_observed', update.weigh_observed, 'observed nodes', n_observed)

    def _edit(self, update: GraphUpdate) -> None:
        """Apply the edits of existing rows, which have been checked."""
        head = self.memory.head
        for weigh, removed, weights in (
                (editing.weigh_edges, update.remove_edges, update.weigh_edges),
                (editing.weigh_observed, update.remove_observed, update.weigh_observed)):
            if len(removed) > 0:
                weigh(head, integers(removed), np.zeros(len(removed)))
            if len(weights) > 0:
                weigh(head, integers(weights), values(weights))
        for nodes, fixed in ((update.fix, True), (update.free, False)):
            if len(nodes) > 0:
                editing.set_fixed(head, integers(nodes), fixed)

    def _checked_columns(self, update: GraphUpdate) -> tuple[npt.NDArray[Any], ...]:
        """Return new rows as arrays for the kernel; raise GraphUpdateError if one is invalid."""
        hidden, biases = (
            checked_poses(name, getattr(update, name)) for name in ('hidden', 'biases'))
        edges, observed = update.edges, update.observed
        is_bias = np.concatenate((
            self.is_bias, np.zeros(len(hidden), dtype=bool), np.ones(len(biases), dtype=bool)))
        for table in (edges, observed):
            if len(table) > 0:
                check(table, is_bias)
        edges = edges if len(edges) > 0 else NO_EDGES
        observed = observed if len(observed) > 0 else NOTHING_OBSERVED
        return tuple(np.array(column, order='C')
                     for column in (hidden, biases, *edges.columns, *observed.columns))

    def ensure(self, n_nodes: int, n_edges: int, n_observed: int) -> None:
        """
        Make the tables and the transaction log large enough for a graph.

        Parameters
        ----------
        n_nodes, n_edges, n_observed : int, numbers of hidden nodes, edges and observed nodes

        """
        memory, head = self.memory, self.memory.head
        if (n_nodes <= head[tb.NODE_ROOM] and n_edges <= head[tb.EDGE_ROOM]
                and n_observed <= head[tb.OBSERVED_ROOM]):
            return
        for name, needed, used in (
                ('node', n_nodes, self.n_nodes), ('edge', n_edges, self.n_edges),
                ('observed', n_observed, self.n_observed)):
            for suffix in ('_f', '_i'):
                memory.ensure(name + suffix, needed, keep=used)
        nodes, edges, observed = (
            len(memory[name]) for name in ('node_f', 'edge_f', 'observed_f'))
        # the rest costs address space: little of the log and the work space is ever written to
        for name in ('clique_f', 'clique_i'):
            memory.ensure(name, 2 * nodes, keep=int(head[tb.N_CLIQUES]))
        memory.ensure('touched', nodes, keep=int(head[tb.N_TOUCHED]))
        memory.ensure('freed', 4 * nodes, keep=int(head[tb.N_FREED]))
        memory.ensure('work_i', 4 * nodes)
        memory.ensure('waiting', edges + observed, keep=int(head[tb.N_WAITING]))
        memory.ensure('log_f', nodes * (tb.NODE_F + tb.SCALE_T + tb.CLIQUE_F)
                      + edges * (tb.EDGE_F + 2) + observed * tb.OBS_F + tb.N_SCALARS,
                      keep=int(head[tb.LOG_F_END]))
        memory.ensure('log_i', nodes * (tb.NODE_I + tb.CLIQUE_I + 16)
                      + edges * (tb.EDGE_I + 6) + observed * (tb.OBS_I + 3),
                      keep=int(head[tb.LOG_I_END]))
        head[tb.NODE_ROOM], head[tb.EDGE_ROOM], head[tb.OBSERVED_ROOM] = nodes, edges, observed

    def set_poses(self, poses: FloatArray) -> None:
        """
        Set the estimates of all hidden nodes, shape (N, 3) [m, m, rad]; headings are wrapped.

        All constraints are linearized there, and the next step eliminates all nodes. A wrong shape
        or a number that is not finite raises GraphUpdateError.
        """
        if poses.shape != (self.n_nodes, 3) or not np.all(np.isfinite(poses)):
            raise GraphUpdateError(
                f'expected finite poses, shape {(self.n_nodes, 3)}, got shape {poses.shape}')
        rows = self.memory['node_f'][:self.n_nodes]
        rows[:, tb.POSE:tb.POSE + 3] = se2.wrapped(poses)
        self.n_moves += 1
        editing.restart(self.memory.head)

    def rows(self) -> GraphRows:
        """Return a copy of all rows."""
        return GraphRows(
            self.poses.copy(), self.is_bias, self.fixed,
            Edges(*(column.copy() for column in self.edges.columns)),
            ObservedNodes(*(column.copy() for column in self.observed.columns)))

    def fill(self, rows: GraphRows) -> None:
        """Add all rows of another graph to this empty one; GraphUpdateError if one is invalid."""
        poses, is_bias, fixed, edges, observed = rows
        self.append_nodes(poses, is_bias)
        self.apply(GraphUpdate(
            edges=edges, observed=observed, fix=np.flatnonzero(fixed).tolist()))

    def append_nodes(self, poses: FloatArray, is_bias: BoolArray) -> None:
        """
        Add hidden nodes, poses and biases in any order.

        Parameters
        ----------
        poses : ndarray, shape (N, 3), poses and values of biases
        is_bias : ndarray of bool, shape (N,)

        """
        begin, newest = self.n_nodes, self.newest_pose
        self.apply(GraphUpdate(hidden=poses))
        self.memory['node_i'][begin:begin + len(poses), tb.IS_BIAS] = is_bias
        rows = np.flatnonzero(~is_bias)
        self.memory.head[tb.NEWEST] = begin + rows[-1] if len(rows) > 0 else newest

    def energies(self, poses: FloatArray | None = None) -> Energies:
        """Return the energies of all constraints, at other poses, shape (N, 3), if given."""
        poses = self.poses if poses is None else poses
        edges, observed = self.edges, self.observed
        return Energies(
            energies(self.edge_errors(edges, poses), edges.weighted_information),
            energies(self.observed_errors(observed, poses), observed.weighted_information))

    def edge_errors(self, edges: Edges, poses: FloatArray | None = None) -> FloatArray:
        """
        Return the errors of edges at the estimate, shape (M, 3); see `error_functions`.

        Parameters
        ----------
        edges : Edges, with ids for ends, in the graph or not
        poses : ndarray, shape (N, 3), optional, of all hidden nodes, by row, in place of theirs

        """
        return edge_errors(self.poses if poses is None else poses, edges)

    def observed_errors(
        self, observed: ObservedNodes, poses: FloatArray | None = None,
    ) -> FloatArray:
        """
        Return the errors of observed nodes at the estimate, shape (K, 3).

        Parameters
        ----------
        observed, poses : ObservedNodes, ndarray, as for `edge_errors`

        """
        return observed_errors(self.poses if poses is None else poses, observed)

    def begin(self) -> None:
        """Begin an update; `rollback` reverts all edits and steps after it."""
        if not transaction_log.begin(self.memory.head):
            self.memory.restart_stamps()
            transaction_log.begin(self.memory.head)

    def rollback(self) -> None:
        """Revert all edits and steps since `begin`, bit for bit."""
        transaction_log.rollback(self.memory.head)
