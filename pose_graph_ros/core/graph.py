# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose graph: hidden nodes, edges and observed nodes, as struct of arrays.

The graph is edited by `GraphUpdate`s alone, each applied whole or not at all. Solvers work on its
tables and write the poses of the hidden nodes.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core import editing, linearize, rows, se2, tables as tb, undo
from pose_graph_ros.core.constraints import check, check_shapes, Edges, ObservedNodes
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.tables import Memory

BoolArray = npt.NDArray[np.bool_]

# shared by all updates that do not have any
NO_POSES: Final[FloatArray] = np.empty((0, 3))
NO_EDGES: Final = Edges()
NOTHING_OBSERVED: Final = ObservedNodes()
NO_WEIGHTS: Final[Mapping[int, float]] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class GraphUpdate:
    """Everything that changes in one step; new hidden nodes are numbered from the end."""

    hidden: FloatArray = field(default_factory=lambda: NO_POSES)
    """Initial poses of new hidden nodes in the map, shape (N, 3) [m, m, rad]."""
    edges: Edges = field(default_factory=lambda: NO_EDGES)
    """New edges, also to the new hidden nodes."""
    observed: ObservedNodes = field(default_factory=lambda: NOTHING_OBSERVED)
    """New observed nodes, also on the new hidden nodes."""
    fix: Sequence[int] = ()
    """Hidden nodes that keep their pose from now on (the gauge)."""
    free: Sequence[int] = ()
    """Hidden nodes that no longer do."""
    remove_edges: Sequence[int] = ()
    """Edges that do not count any more: their weight becomes 0, their number stays theirs."""
    remove_observed: Sequence[int] = ()
    """Observed nodes that do not count any more."""
    weigh_edges: Mapping[int, float] = field(default_factory=lambda: NO_WEIGHTS)
    """New weights (factors on the information) of edges; a removed one comes back by it."""
    weigh_observed: Mapping[int, float] = field(default_factory=lambda: NO_WEIGHTS)
    """New weights of observed nodes."""


class Checkpoint(NamedTuple):
    """The counts, sums and lists that `Graph.undo` goes back to."""

    n_nodes: int
    n_edges: int
    n_observed: int
    structure: int
    scalars: FloatArray
    seeds: IntArray
    waiting: IntArray


class Energies(NamedTuple):
    """Energy of every constraint (weighted squared error, the "springs") and their sum."""

    edges: FloatArray
    observed: FloatArray

    @property
    def chi2(self) -> float:
        """Total energy; no factor 1/2."""
        return float(np.sum(self.edges) + np.sum(self.observed))


class Graph:
    """A pose graph; see the module's docstring."""

    def __init__(self) -> None:
        self.memory = Memory()
        """The tables, which solvers work on."""

    @property
    def n_nodes(self) -> int:
        """Number of hidden nodes."""
        return int(self.memory.head[tb.N_NODES])

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
        """Estimates of the hidden nodes in the map, shape (N, 3), a read-only view."""
        view = self.memory['node_f'][:self.n_nodes, tb.POSE:tb.POSE + 3]
        view.flags.writeable = False
        return view

    @property
    def fixed(self) -> BoolArray:
        """Hidden nodes that keep their pose, shape (N,)."""
        return self.memory['node_i'][:self.n_nodes, tb.FIXED] != 0

    @property
    def edges(self) -> Edges:
        """All edges, with their weights."""
        numbers = self.memory['edge_f'][:self.n_edges]
        integers = self.memory['edge_i'][:self.n_edges]
        return Edges(
            integers[:, tb.END_I], integers[:, tb.END_J], numbers[:, tb.MEAN:tb.MEAN + 3].copy(),
            _unpacked(numbers[:, tb.INFO:tb.INFO + 6]), integers[:, tb.EDGE_KIND],
            numbers[:, tb.WEIGHT].copy())

    @property
    def observed(self) -> ObservedNodes:
        """All observed nodes, with their weights."""
        numbers = self.memory['observed_f'][:self.n_observed]
        integers = self.memory['observed_i'][:self.n_observed]
        return ObservedNodes(
            integers[:, tb.OBS_NODE], numbers[:, tb.OBS_OFFSET:tb.OBS_OFFSET + 3].copy(),
            numbers[:, tb.MEAN:tb.MEAN + 3].copy(), _unpacked(numbers[:, tb.INFO:tb.INFO + 6]),
            integers[:, tb.OBS_KIND], numbers[:, tb.WEIGHT].copy())

    def apply(self, update: GraphUpdate) -> None:
        """
        Make the edits of one update, all of them or none.

        Raises
        ------
        GraphUpdateError
            If any part does not fit, saying which; the graph is unchanged then.

        """
        hidden, edges, observed = _checked_hidden(update.hidden), update.edges, update.observed
        n_nodes = self.n_nodes + len(hidden)
        n_edges, n_observed = self.n_edges + len(edges), self.n_observed + len(observed)
        _check_numbers('fix', update.fix, 'hidden nodes', n_nodes)
        _check_numbers('free', update.free, 'hidden nodes', n_nodes)
        _check_numbers('remove_edges', update.remove_edges, 'edges', n_edges)
        _check_numbers('remove_observed', update.remove_observed, 'observed nodes', n_observed)
        _check_weights('weigh_edges', update.weigh_edges, 'edges', n_edges)
        _check_weights('weigh_observed', update.weigh_observed, 'observed nodes', n_observed)
        self.ensure(n_nodes, n_edges, n_observed)
        # rows behind the end count for nothing until `start_rows`
        if len(edges) > 0:
            check_shapes(edges)
            if not rows.write_edges(self.memory.head, n_nodes, edges.i, edges.j, edges.mean,
                                    edges.information, edges.kind, edges.weight):
                check(edges, n_nodes)
        if len(observed) > 0:
            check_shapes(observed)
            if not rows.write_all_observed(
                    self.memory.head, n_nodes, observed.node, observed.offset, observed.mean,
                    observed.information, observed.kind, observed.weight):
                check(observed, n_nodes)
        if len(hidden) > 0:
            poses = self.memory['node_f'][self.n_nodes:n_nodes, tb.POSE:tb.POSE + 3]
            poses[:] = se2.wrapped(hidden)
        head = self.memory.head
        editing.start_rows(head, n_nodes, n_edges, n_observed)
        for e in update.remove_edges:
            editing.weigh_edge(head, int(e), 0.0)
        for k in update.remove_observed:
            editing.weigh_observed(head, int(k), 0.0)
        for e, weight in update.weigh_edges.items():
            editing.weigh_edge(head, int(e), float(weight))
        for k, weight in update.weigh_observed.items():
            editing.weigh_observed(head, int(k), float(weight))
        for node in update.fix:
            editing.set_fixed(head, int(node), 1)
        for node in update.free:
            editing.set_fixed(head, int(node), 0)

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
                      + edges * (tb.EDGE_F + 2) + observed * tb.OBS_F,
                      keep=int(head[tb.LOG_F_END]))
        memory.ensure('log_i', nodes * (tb.NODE_I + tb.CLIQUE_I + 16)
                      + edges * (tb.EDGE_I + 5) + observed * (tb.OBS_I + 2),
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

    def energies(self, poses: FloatArray | None = None) -> Energies:
        """Return the energies of all constraints, at other poses (N, 3) if given."""
        poses = self.poses if poses is None else poses
        edges, observed = self.edges, self.observed
        return Energies(
            linearize.energies(linearize.edge_errors(poses, edges), edges.weighted_information),
            linearize.energies(
                linearize.observed_errors(poses, observed), observed.weighted_information))

    def begin(self) -> Checkpoint:
        """Begin an update: everything from here on can be undone."""
        memory, head = self.memory, self.memory.head
        if head[tb.FRONT_SERIAL] > tb.LAST_STAMP or head[tb.UPDATE] > tb.LAST_STAMP:
            memory.restart_stamps()
        undo.begin(head)
        return Checkpoint(self.n_nodes, self.n_edges, self.n_observed, int(head[tb.STRUCTURE]),
                          memory['scalars'].copy(), memory['seeds'][:head[tb.N_SEEDS]].copy(),
                          memory['waiting'][:head[tb.N_WAITING]].copy())

    def undo(self, checkpoint: Checkpoint) -> None:
        """Undo the edits and steps since `begin`, bit for bit."""
        memory, head = self.memory, self.memory.head
        undo.undo(head)
        head[tb.N_NODES], head[tb.N_EDGES], head[tb.N_OBSERVED] = checkpoint[:3]
        head[tb.STRUCTURE] = checkpoint.structure
        memory['scalars'][:] = checkpoint.scalars
        for name, count, entries in (('seeds', tb.N_SEEDS, checkpoint.seeds),
                                     ('waiting', tb.N_WAITING, checkpoint.waiting)):
            head[count] = len(entries)
            memory[name][:len(entries)] = entries


_FULL: IntArray = np.array((0, 1, 2, 1, 3, 4, 2, 4, 5))


def _unpacked(upper: FloatArray) -> FloatArray:
    return upper[:, _FULL].reshape(-1, 3, 3)


def _checked_hidden(poses: FloatArray) -> FloatArray:
    hidden = np.asarray(poses, dtype=np.float64)
    if hidden.ndim != 2 or hidden.shape[1:] != (3,):
        raise GraphUpdateError(
            f'hidden: expected finite poses, shape (N, 3), got shape {hidden.shape}')
    if not np.all(np.isfinite(hidden)):
        raise GraphUpdateError(
            f'hidden: expected finite poses, shape (N, 3), got shape {hidden.shape} '
            f'with numbers that are not finite')
    return hidden


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
