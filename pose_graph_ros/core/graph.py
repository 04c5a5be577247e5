# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose graph: hidden nodes, edges and observed nodes, as struct of arrays.

The graph is edited by `GraphUpdate`s alone, each applied whole or not at all. Solvers work on its
tables and write the poses of the hidden nodes.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from numba import types
import numpy as np
import numpy.typing as npt

from pose_graph_ros.core import editing, linearize, se2, tables as tb, undo
from pose_graph_ros.core.constraints import check, EdgeKind, Edges, full, ObservedNodes
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.jit import compile_only
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.tables import Memory

BoolArray = npt.NDArray[np.bool_]

# shared by all updates that do not have any
NO_POSES: Final[FloatArray] = np.empty((0, 3))
NO_EDGES: Final = Edges()
NOTHING_OBSERVED: Final = ObservedNodes()
NO_WEIGHTS: Final[Mapping[int, float]] = MappingProxyType({})

_NUMBERS, _INTEGERS, _POSES, _MATRICES, _KINDS = (
    types.float64[::1], types.int64[::1], types.float64[:, ::1], types.float64[:, :, ::1],
    types.uint8[::1])
_ADD_ROWS = (
    _INTEGERS, _POSES, _POSES, _INTEGERS, _INTEGERS, _POSES, _MATRICES, _KINDS, _NUMBERS, _POSES,
    _INTEGERS, _POSES, _POSES, _MATRICES, _KINDS, _NUMBERS, types.boolean)
# Where the tables keep the column `Edges.bias`.
_BIAS_COLUMNS = [tb.BIAS_OFFSET, tb.BIAS_OFFSET + 1, tb.FACTOR_T, tb.FACTOR_TH]


class GraphUpdate(NamedTuple):
    """Everything that changes in one step; new hidden nodes are numbered from the end."""

    hidden: FloatArray = NO_POSES
    """Initial poses of new hidden nodes in the map, shape (N, 3) [m, m, rad]."""
    edges: Edges = NO_EDGES
    """New edges, also to the new hidden nodes."""
    observed: ObservedNodes = NOTHING_OBSERVED
    """New observed nodes, also on the new hidden nodes."""
    fix: Sequence[int] = ()
    """Hidden nodes that keep their pose from now on (the gauge)."""
    free: Sequence[int] = ()
    """Hidden nodes that no longer do."""
    remove_edges: Sequence[int] = ()
    """Edges that do not count any more: their weight becomes 0, their number stays theirs."""
    remove_observed: Sequence[int] = ()
    """Observed nodes that do not count any more."""
    weigh_edges: Mapping[int, float] = NO_WEIGHTS
    """New weights (factors on the information) of edges; a removed one comes back by it."""
    weigh_observed: Mapping[int, float] = NO_WEIGHTS
    """New weights of observed nodes."""
    biases: FloatArray = NO_POSES
    """
    Initial values of new biases, shape (S, 3) [sigma, sigma, rad]: hidden nodes too, numbered
    after those of `hidden`.
    """


class Energies(NamedTuple):
    """Energy of every constraint (weighted squared error, the "springs") and their sum."""

    edges: FloatArray
    observed: FloatArray

    @property
    def chi2(self) -> float:
        """Total energy; no factor 1/2."""
        return float(np.sum(self.edges) + np.sum(self.observed))


class GraphRows(NamedTuple):
    """All rows of a graph; nothing in them changes later."""

    poses: FloatArray
    """Estimates of all hidden nodes, shape (N, 3), biases included."""
    is_bias: BoolArray
    """Shape (N,)."""
    fixed: BoolArray
    """Shape (N,)."""
    edges: Edges
    observed: ObservedNodes


class Graph:
    """A pose graph; see the module's docstring."""

    def __init__(self) -> None:
        self.memory = Memory()
        """The tables, which solvers work on."""
        compile_only(editing.add_rows, _ADD_ROWS)   # `apply` converts other arrays

    @property
    def n_nodes(self) -> int:
        """Number of hidden nodes, biases included."""
        return int(self.memory.head[tb.N_NODES])

    @property
    def newest_pose(self) -> int:
        """The newest hidden node that is no bias, or -1."""
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
    def poses(self) -> FloatArray:
        """Estimates of all hidden nodes in the map, shape (N, 3), a read-only view."""
        view = self.memory['node_f'][:self.n_nodes, tb.POSE:tb.POSE + 3]
        view.flags.writeable = False
        return view

    @property
    def fixed(self) -> BoolArray:
        """Hidden nodes that keep their pose, shape (N,)."""
        return self.memory['node_i'][:self.n_nodes, tb.FIXED] != 0

    @property
    def is_bias(self) -> BoolArray:
        """Hidden nodes that are biases and no poses, shape (N,)."""
        return self.memory['node_i'][:self.n_nodes, tb.IS_BIAS] != 0

    @property
    def edges(self) -> Edges:
        """All edges, with their weights."""
        return self.edges_at(slice(self.n_edges))

    def edges_at(self, rows: IntArray | slice) -> Edges:
        """Return some edges, by their numbers."""
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
        """Return some observed nodes, by their numbers."""
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

    def apply(self, update: GraphUpdate) -> None:
        """
        Make the edits of one update, all of them or none.

        Raises
        ------
        GraphUpdateError
            If any part does not fit, saying which; the graph is unchanged then.

        """
        hidden, edges, observed, *by_number, biases = update
        edits = any(map(len, by_number))
        if edits:
            self._check_edits(update)
        columns, checked = (hidden, biases, *edges.columns, *observed.columns), False
        try:
            code = editing.add_rows(self.memory.head, *columns, checked)
        except (TypeError, ValueError):
            code = editing.UNSOUND  # other arrays than those that it is compiled for
        while code != editing.ADDED:
            if code == editing.NO_ROOM:
                self.ensure(*self._sizes_after(update))
            else:
                columns, checked = self._checked_columns(update), True
            code = editing.add_rows(self.memory.head, *columns, checked)
        if edits:
            self._edit(update)

    def _sizes_after(self, update: GraphUpdate) -> tuple[int, int, int]:
        """Return how many hidden nodes, edges and observed nodes there will be."""
        return (self.n_nodes + len(update.hidden) + len(update.biases),
                self.n_edges + len(update.edges), self.n_observed + len(update.observed))

    def _check_edits(self, update: GraphUpdate) -> None:
        """Refuse numbers and weights that do not fit the graph with its new rows."""
        n_nodes, n_edges, n_observed = self._sizes_after(update)
        _check_numbers('fix', update.fix, 'hidden nodes', n_nodes)
        _check_numbers('free', update.free, 'hidden nodes', n_nodes)
        _check_numbers('remove_edges', update.remove_edges, 'edges', n_edges)
        _check_numbers('remove_observed', update.remove_observed, 'observed nodes', n_observed)
        _check_weights('weigh_edges', update.weigh_edges, 'edges', n_edges)
        _check_weights('weigh_observed', update.weigh_observed, 'observed nodes', n_observed)

    def _edit(self, update: GraphUpdate) -> None:
        """Make the edits of rows that are there, which have been checked."""
        for what, rows in (
                (editing.WEIGH_EDGE, dict.fromkeys(update.remove_edges, 0.0)),
                (editing.WEIGH_OBSERVED, dict.fromkeys(update.remove_observed, 0.0)),
                (editing.WEIGH_EDGE, update.weigh_edges),
                (editing.WEIGH_OBSERVED, update.weigh_observed),
                (editing.FIX, dict.fromkeys(update.fix, 1.0)),
                (editing.FIX, dict.fromkeys(update.free, 0.0))):
            for number, value in rows.items():
                editing.edit(self.memory.head, what, int(number), float(value))

    def _checked_columns(self, update: GraphUpdate) -> tuple[npt.NDArray[Any], ...]:
        """Refuse rows that are not sound; return them as the kernel wants them."""
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
        """Make all tables hold a graph of such a size, and one update of all of it."""
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
            memory.capacity(name) for name in ('node_f', 'edge_f', 'observed_f'))
        # what follows is address space: of the log and of the work space little is ever touched
        for name in ('clique_f', 'clique_i'):
            memory.ensure(name, 2 * nodes, keep=int(head[tb.N_CLIQUES]))
        memory.ensure('seeds', nodes, keep=int(head[tb.N_SEEDS]))
        memory.ensure('freed', 4 * nodes, keep=int(head[tb.N_FREED]))
        memory.ensure('work_i', 4 * nodes)
        memory.ensure('waiting', edges + observed, keep=int(head[tb.N_WAITING]))
        memory.ensure('log_f', nodes * (tb.NODE_F + tb.STIFF_T + tb.CLIQUE_F)
                      + edges * (tb.EDGE_F + 2) + observed * tb.OBS_F + tb.N_SCALARS,
                      keep=int(head[tb.LOG_F_END]))
        memory.ensure('log_i', nodes * (tb.NODE_I + tb.CLIQUE_I + 16)
                      + edges * (tb.EDGE_I + 6) + observed * (tb.OBS_I + 3),
                      keep=int(head[tb.LOG_I_END]))
        head[tb.NODE_ROOM], head[tb.EDGE_ROOM], head[tb.OBSERVED_ROOM] = nodes, edges, observed

    def set_poses(self, poses: FloatArray) -> None:
        """
        Write the estimates of all hidden nodes, shape (N, 3); headings are wrapped.

        Everything is linearized there, and eliminated anew at the next step.
        """
        if poses.shape != (self.n_nodes, 3) or not np.all(np.isfinite(poses)):
            raise GraphUpdateError(
                f'expected finite poses, shape {(self.n_nodes, 3)}, got shape {poses.shape}')
        rows = self.memory['node_f'][:self.n_nodes]
        rows[:, tb.POSE:tb.POSE + 3] = se2.wrapped(poses)
        editing.restart(self.memory.head)

    def rows(self) -> GraphRows:
        """Return a copy of all rows."""
        return GraphRows(
            self.poses.copy(), self.is_bias, self.fixed,
            Edges(*(column.copy() for column in self.edges.columns)),
            ObservedNodes(*(column.copy() for column in self.observed.columns)))

    def fill(self, rows: GraphRows) -> None:
        """
        Write all rows of another graph into this empty one.

        Raises
        ------
        GraphUpdateError
            If they are not sound.

        """
        poses, is_bias, fixed, edges, observed = rows
        self.apply(GraphUpdate(hidden=poses))
        memory, head = self.memory, self.memory.head
        memory['node_i'][:len(poses), tb.IS_BIAS] = is_bias
        head[tb.NEWEST] = np.flatnonzero(~is_bias)[-1] if not np.all(is_bias) else -1
        self.apply(GraphUpdate(
            edges=edges, observed=observed, fix=np.flatnonzero(fixed).tolist()))

    def take_over(self, other: 'Graph', poses: FloatArray) -> None:
        """Copy all rows of another graph into this empty one, with poses (N, 3) of their own."""
        self.fill(other.rows()._replace(poses=poses))

    def energies(self, poses: FloatArray | None = None) -> Energies:
        """Return the energies of all constraints, at other poses (N, 3) if given."""
        poses = self.poses if poses is None else poses
        edges, observed = self.edges, self.observed
        return Energies(
            linearize.energies(linearize.edge_errors(poses, edges), edges.weighted_information),
            linearize.energies(
                linearize.observed_errors(poses, observed), observed.weighted_information))

    def begin(self) -> None:
        """Begin an update: everything from here on can be undone."""
        if not undo.begin(self.memory.head):
            self.memory.restart_stamps()
            undo.begin(self.memory.head)

    def undo(self) -> None:
        """Undo the edits and steps since `begin`, bit for bit."""
        undo.undo(self.memory.head)


def _checked_poses(name: str, poses: FloatArray) -> FloatArray:
    array = np.asarray(poses, dtype=np.float64)
    if array.ndim != 2 or array.shape[1:] != (3,):
        raise GraphUpdateError(
            f'{name}: expected finite poses, shape (N, 3), got shape {array.shape}')
    if not np.all(np.isfinite(array)):
        raise GraphUpdateError(
            f'{name}: expected finite poses, shape (N, 3), got shape {array.shape} '
            f'with numbers that are not finite')
    return array


def _check_numbers(name: str, numbers: Iterable[int], what: str, size: int) -> None:
    for number in numbers:
        if not (isinstance(number, int | np.integer) and 0 <= number < size):
            raise GraphUpdateError(f'{name}: expected {what} in 0..{size - 1}, got {number}')


def _check_weights(name: str, weights: Mapping[int, float], what: str, size: int) -> None:
    _check_numbers(name, weights, what, size)
    for number, weight in weights.items():
        if not (np.isfinite(weight) and weight >= 0.0):
            raise GraphUpdateError(
                f'{name}: expected a finite weight that is not negative, got {weight} '
                f'for number {number}')
