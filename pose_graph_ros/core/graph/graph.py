# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: hidden nodes and factors, as tables of records."""

from collections.abc import Collection
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import IntArray, Poses
from pose_graph_ros.core.graph import checks, editing, removal, tables as tb, transaction_log
from pose_graph_ros.core.graph.constraints import NodeKind
from pose_graph_ros.core.graph.contents import COUNTERS, GraphContents
from pose_graph_ros.core.graph.graph_update import (
    Energies,
    FIRST_EDIT,
    Gone,
    GraphRows,
    GraphUpdate,
    NextIds,
    NO_FACTORS,
)
from pose_graph_ros.core.graph.prior_rows import add_priors

__all__ = ['Energies', 'Graph', 'GraphRows', 'GraphUpdate', 'NextIds']

def _integers(numbers: Collection[int]) -> IntArray:
    return np.fromiter(numbers, np.int64, len(numbers))


class Graph(GraphContents):
    """
    A pose graph, edited by `GraphUpdate`s only, each applied whole or not at all.

    Solvers work on its tables and write the poses of the hidden nodes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.n_moves = 0    # how often `set_poses` or new measurements have moved the nodes
        self._updating = False

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
        edits = any(len(part) > 0 for part in update[FIRST_EDIT:])
        if edits:
            self._check_edits(update)
        others = checks.other_nodes(update.biases, update.dimensions, update.landmarks)
        columns: tuple[npt.NDArray[Any], ...] = ()
        checked = False
        try:
            columns = update.hidden, *others, update.factors.records
            code = editing.add_rows(self.memory.head, *columns, checked)
        except (TypeError, ValueError):
            code = editing.UNSOUND  # arrays of types that the kernel is not compiled for
        while code != editing.ADDED:
            if code == editing.NO_ROOM:
                self.ensure(self.n_nodes + len(update.hidden) + len(others[0]),
                            self.n_factors + len(update.factors))
            else:
                columns, checked = self._checked_columns(update, others), True
            code = editing.add_rows(self.memory.head, *columns, checked)
        if edits:
            self._edit(update)

    def _check_edits(self, update: GraphUpdate) -> None:
        """Raise GraphUpdateError for unknown ids or invalid weights; new rows may be edited."""
        nodes = self._ids('node').extended(
            len(update.hidden) + len(update.biases) + len(update.landmarks))
        factors = self._ids('factor').extended(len(update.factors))
        for what, known, parts in (('hidden node', nodes, ('fix', 'free', 'remove_nodes')),
                                   ('factor', factors, ('remove', 'drop'))):
            for part in parts:
                checks.check_ids(part, getattr(update, part), what, known)
        checks.check_weights('weigh', update.weigh, 'factor', factors)
        for measured in update.measure:
            checks.check_ids('measure', measured.ids.tolist(), 'factor', factors)
        for n, prior in enumerate(update.priors):
            checks.check_ids(f'priors[{n}].nodes', prior.nodes, 'hidden node', nodes)

    def _edit(self, update: GraphUpdate) -> None:
        """Apply the edits of existing rows, which have been checked."""
        head = self.memory.head
        for ids, values in ((update.remove, [0.0] * len(update.remove)),
                            (update.weigh, update.weigh.values()),
                            (update.drop, [editing.DROPPED] * len(update.drop))):
            if len(ids) > 0:
                editing.set_weights(
                    head, _integers(ids), np.fromiter(values, np.float64, len(ids)))
        for measured in update.measure:
            editing.measure(head, _integers(measured.ids), *map(
                np.ascontiguousarray, (measured.mean, measured.information)))
            self.n_moves += 1
        for nodes, fixed in ((update.fix, True), (update.free, False)):
            if len(nodes) > 0:
                editing.set_fixed(head, _integers(nodes), fixed)
        if len(update.remove_nodes) > 0:
            removal.remove_nodes(head, _integers(update.remove_nodes))
        if len(update.priors) > 0:
            self.ensure(self.n_nodes + len(update.priors), self.n_factors)
            add_priors(self.memory, update.priors, [
                self.node_rows(prior.nodes) for prior in update.priors])
        if not self._updating:
            removal.compact(self.memory)

    def _checked_columns(
        self, update: GraphUpdate, others: tuple[npt.NDArray[Any], ...],
    ) -> tuple[npt.NDArray[Any], ...]:
        """Return new rows as arrays for the kernel; raise GraphUpdateError if one is invalid."""
        hidden = checks.checked_poses('hidden', update.hidden)
        others = (checks.checked_poses('biases', others[0]), *others[1:])
        kind, dimension = (np.concatenate((present, np.full(len(hidden), usual), new))
                           for present, usual, new in (
                               (self.node_kind, 0, others[1] & 3),
                               (self.dimension, 3, 3 - (others[1] >> 2))))
        nodes = self._ids('node').extended(len(hidden) + len(others[0]))
        factors = update.factors if len(update.factors) > 0 else NO_FACTORS
        checks.check(factors, kind, dimension, nodes)
        return tuple(np.array(column, order='C')
                     for column in (hidden, *others, factors.records))

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
        self._append('node', GraphUpdate(hidden=rows.poses), rows.node_ids, rows.next_ids.node)
        begin = self.n_nodes - len(rows.poses)
        new = self.node_records[begin:]
        new['kind'] = rows.node_kind
        new['dimension'] = rows.dimension if rows.dimension is not None else np.where(
            rows.node_kind == NodeKind.LANDMARK, 2, 3)
        poses = np.flatnonzero(self.is_pose)
        self.memory.head[tb.NEWEST] = poses[-1] if len(poses) > 0 else -1
        self._append('factor', GraphUpdate(factors=rows.factors), rows.factor_ids,
                     rows.next_ids.factor)
        self.apply(GraphUpdate(
            fix=self.node_ids[begin:][rows.fixed].tolist(), priors=rows.priors))

    def _append(
        self, name: str, update: GraphUpdate, ids: IntArray, next_id: int,
    ) -> None:
        """Add new rows of one table with given ids instead of the next ones."""
        head, n_rows, counter = self.memory.head, *COUNTERS[name]
        begin, first = int(head[n_rows]), int(head[counter])
        self.apply(update)
        if len(ids) != head[n_rows] - begin or np.any(np.diff(ids, prepend=first - 1) <= 0):
            raise GraphUpdateError(f'{name}: expected ascending ids from {first} on, one a row')
        self.memory[f'{name}_id'][begin:head[n_rows]] = ids
        head[counter] = max(next_id, first, int(ids[-1]) + 1 if len(ids) > 0 else 0)

    def begin(self) -> None:
        """Begin an update; `rollback` reverts all edits and steps after it."""
        self._updating = True
        if not transaction_log.begin(self.memory.head):
            self.memory.restart_stamps()
            transaction_log.begin(self.memory.head)

    def commit(self) -> Gone:
        """End an update and keep its changes; return what has left, whose rows are taken out."""
        if self.memory.head[tb.LOG_END] > 0:  # else a step has done so
            transaction_log.commit(self.memory.head)
        self._updating = False
        return removal.compact(self.memory)

    def rollback(self) -> None:
        """Revert all edits and steps since `begin`, bit for bit."""
        transaction_log.rollback(self.memory.head)
        self._updating = False
