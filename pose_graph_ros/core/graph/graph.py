# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: hidden nodes, edges and observed nodes, as struct of arrays."""

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import editing, tables as tb, transaction_log
from pose_graph_ros.core.graph.constraints import check, EdgeKind, Edges, full, ObservedNodes
from pose_graph_ros.core.graph.error_functions import edge_errors, energies, observed_errors
from pose_graph_ros.core.graph.tables import Memory

# Empty parts of updates.
NO_POSES: Final[FloatArray] = np.empty((0, 3))
NO_EDGES: Final = Edges()
NOTHING_OBSERVED: Final = ObservedNodes()
NO_WEIGHTS: Final[Mapping[int, float]] = MappingProxyType({})

# Columns of edge_f with the column `Edges.bias`.
_BIAS_COLUMNS = [tb.BIAS_OFFSET, tb.BIAS_OFFSET + 1, tb.FACTOR_T, tb.FACTOR_TH]


class GraphUpdate(NamedTuple):
    """An edit of a graph; new hidden nodes, edges and observed nodes get the next numbers."""

    hidden: FloatArray = NO_POSES
    """Initial poses of new hidden nodes in the map, shape (N, 3) [m, m, rad]."""
    edges: Edges = NO_EDGES
    """New edges, possibly to the new hidden nodes."""
    observed: ObservedNodes = NOTHING_OBSERVED
    """New observed nodes, possibly on the new hidden nodes."""
    fix: Sequence[int] = ()
    """Hidden nodes that keep their pose from now on (the gauge)."""
    free: Sequence[int] = ()
    """Hidden nodes that are no longer fixed."""
    remove_edges: Sequence[int] = ()
    """Edges whose weight becomes 0; they keep their numbers."""
    remove_observed: Sequence[int] = ()
    """Observed nodes whose weight becomes 0."""
    weigh_edges: Mapping[int, float] = NO_WEIGHTS
    """New weights (factors on the information) of edges, by number; removed edges may get one."""
    weigh_observed: Mapping[int, float] = NO_WEIGHTS
    """New weights of observed nodes, by number."""
    biases: FloatArray = NO_POSES
    """
    Initial values of new biases, shape (S, 3) [sigma, sigma, rad]: hidden nodes that are numbered
    after those of `hidden`.
    """


class Energies(NamedTuple):
    """Energies of all constraints: weighted squared errors [sigma^2]."""

    edges: FloatArray
    """Shape (M,)."""
    observed: FloatArray
    """Shape (K,)."""

    @property
    def chi2(self) -> float:
        """Sum of the energies, without a factor 1/2."""
        return float(np.sum(self.edges) + np.sum(self.observed))


class GraphRows(NamedTuple):
    """Copies of all rows of a graph."""

    poses: FloatArray
    """Estimates of all hidden nodes, biases included, shape (N, 3) [m, m, rad]."""
    is_bias: BoolArray
    fixed: BoolArray
    edges: Edges
    observed: ObservedNodes


class Graph:
    """
    A pose graph, edited by `GraphUpdate`s only, each applied whole or not at all.

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
        """Newest hidden node that is not a bias, or -1."""
        return int(self.memory.head[tb.NEWEST])

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
        """All edges, with their weights."""
        return self.edges_at(slice(self.n_edges))

    def edges_at(self, rows: IntArray | slice) -> Edges:
        """Return the edges with the given numbers."""
        numbers, integers = self.memory['edge_f'][rows], self.memory['edge_i'][rows]
        kind, bias = integers[:, tb.EDGE_KIND], np.zeros((len(integers), 4))
        to_bias = np.flatnonzero(kind == EdgeKind.BIAS)
        bias[to_bias] = numbers[to_bias[:, None], _BIAS_COLUMNS]
        return Edges(
            integers[:, tb.END_I], integers[:, tb.END_J], numbers[:, tb.MEAN:tb.MEAN + 3].copy(),
            full(numbers[:, tb.INFO:tb.INFO + 6]), kind, numbers[:, tb.WEIGHT].copy(), bias)

    @property
    def observed(self) -> ObservedNodes:
        """All observed nodes, with their weights."""
        return self.observed_at(slice(self.n_observed))

    def observed_at(self, rows: IntArray | slice) -> ObservedNodes:
        """Return the observed nodes with the given numbers."""
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
        _check_numbers('fix', update.fix, 'hidden nodes', n_nodes)
        _check_numbers('free', update.free, 'hidden nodes', n_nodes)
        _check_numbers('remove_edges', update.remove_edges, 'edges', n_edges)
        _check_numbers('remove_observed', update.remove_observed, 'observed nodes', n_observed)
        _check_weights('weigh_edges', update.weigh_edges, 'edges', n_edges)
        _check_weights('weigh_observed', update.weigh_observed, 'observed nodes', n_observed)

    def _edit(self, update: GraphUpdate) -> None:
        """Apply the edits of existing rows, which have been checked."""
        head = self.memory.head
        for weigh, removed, weights in (
                (editing.weigh_edges, update.remove_edges, update.weigh_edges),
                (editing.weigh_observed, update.remove_observed, update.weigh_observed)):
            if len(removed) > 0:
                weigh(head, _integers(removed), np.zeros(len(removed)))
            if len(weights) > 0:
                weigh(head, _integers(weights), _values(weights))
        for nodes, fixed in ((update.fix, True), (update.free, False)):
            if len(nodes) > 0:
                editing.set_fixed(head, _integers(nodes), fixed)

    def _checked_columns(self, update: GraphUpdate) -> tuple[npt.NDArray[Any], ...]:
        """Return new rows as arrays for the kernel; raise GraphUpdateError if one is invalid."""
        hidden, biases = (
            _checked_poses(name, getattr(update, name)) for name in ('hidden', 'biases'))
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
            energies(edge_errors(poses, edges), edges.weighted_information),
            energies(observed_errors(poses, observed), observed.weighted_information))

    def begin(self) -> None:
        """Begin an update; `rollback` reverts all edits and steps after it."""
        if not transaction_log.begin(self.memory.head):
            self.memory.restart_stamps()
            transaction_log.begin(self.memory.head)

    def rollback(self) -> None:
        """Revert all edits and steps since `begin`, bit for bit."""
        transaction_log.rollback(self.memory.head)


def _checked_poses(name: str, poses: FloatArray) -> FloatArray:
    array = np.asarray(poses, dtype=np.float64)
    has_shape = array.ndim == 2 and array.shape[1:] == (3,)
    if not has_shape or not np.all(np.isfinite(array)):
        raise GraphUpdateError(
            f'{name}: expected finite poses, shape (N, 3), got shape {array.shape}'
            + ' with numbers that are not finite' * has_shape)
    return array


def _integers(numbers: Collection[int]) -> IntArray:
    return np.fromiter(numbers, np.int64, len(numbers))


def _values(weights: Mapping[int, float]) -> FloatArray:
    return np.fromiter(weights.values(), np.float64, len(weights))


def _check_numbers(name: str, numbers: Collection[int], what: str, size: int) -> None:
    if len(numbers) == 0:
        return
    array = np.array(list(numbers))
    if array.dtype.kind not in 'iu' or not 0 <= array.min() <= array.max() < size:
        # looks for the first one, and lets integers of other types pass
        for number in numbers:
            if not (isinstance(number, int | np.integer) and 0 <= number < size):
                raise GraphUpdateError(f'{name}: expected {what} in 0..{size - 1}, got {number}')


def _check_weights(name: str, weights: Mapping[int, float], what: str, size: int) -> None:
    _check_numbers(name, weights, what, size)
    values = _values(weights)
    if not np.all(np.isfinite(values) & (values >= 0.0)):
        number, weight = next(item for item in weights.items() if not 0.0 <= item[1] < np.inf)
        raise GraphUpdateError(
            f'{name}: expected a finite weight that is not negative, got {weight} '
            f'for number {number}')
