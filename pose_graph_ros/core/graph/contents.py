# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is in the tables of a graph, by row and by id."""

from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import (
    Constraints,
    Edges,
    full,
    NodeKind,
    ObservedNodes,
)
from pose_graph_ros.core.graph.error_functions import edge_errors, energies, observed_errors
from pose_graph_ros.core.graph.graph_update import (
    Energies,
    GraphRows,
    GraphUpdate,
    NextIds,
)
from pose_graph_ros.core.graph.ids import Ids, known
from pose_graph_ros.core.graph.kinds import FACTORS
from pose_graph_ros.core.graph.prior_edits import priors_of
from pose_graph_ros.core.graph.priors import model, Prior
from pose_graph_ros.core.graph.tables import Memory

# Columns of edge_f with the column `Edges.bias`, for kinds of edges that have them.
_BIAS_COLUMNS = np.array((tb.OFFSET, tb.OFFSET + 1, tb.FACTOR_T, tb.FACTOR_TH))
_HAS_BIAS = {kind: list(factor.bias) for kind, factor in FACTORS.items() if factor.bias}


class GraphContents:
    """
    Nodes and constraints of a graph, for reading.

    Hidden nodes (biases included), edges and observed nodes have *ids*: one counter for each of
    the three, ascending, and an id is never used again. The store has them in *rows*, in the
    order of their ids; rows move when others leave. Whoever keeps a number keeps an id; arrays of
    all nodes or constraints (`poses`, `weights`, `is_bias`, ...) are by row.
    """

    def __init__(self) -> None:
        self.memory = Memory()

    @property
    def n_nodes(self) -> int:
        """Number of hidden nodes, biases included."""
        return int(self.memory.head[tb.N_NODES])

    @property
    def newest_pose(self) -> int:
        """Id of the newest hidden node that is not a bias, or -1."""
        newest = int(self.memory.head[tb.NEWEST])
        return int(self.memory['node_id'][newest]) if newest >= 0 else -1

    @property
    def node_ids(self) -> IntArray:
        """Ids of all hidden nodes, ascending, shape (N,), a copy."""
        return np.asarray(self._nodes.by_row(), dtype=np.int64)

    @property
    def edge_ids(self) -> IntArray:
        """Ids of all edges, ascending, shape (M,), a copy."""
        return np.asarray(self._edges.by_row(), dtype=np.int64)

    @property
    def observed_ids(self) -> IntArray:
        """Ids of all observed nodes, ascending, shape (K,), a copy."""
        return np.asarray(self._observed.by_row(), dtype=np.int64)

    @property
    def next_ids(self) -> NextIds:
        """Ids of the next new rows of an update."""
        return NextIds(*self.memory.head[tb.NEXT_NODE:tb.NEXT_OBSERVED + 1].tolist())

    def node_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of hidden nodes, shape of `ids`; -1 where they have left the graph."""
        return self._nodes.rows(ids)

    def edge_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of edges, shape of `ids`; -1 where they have left the graph."""
        return self._edges.rows(ids)

    def observed_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of observed nodes, shape of `ids`; -1 where they have left the graph."""
        return self._observed.rows(ids)

    @property
    def _nodes(self) -> Ids:
        return Ids.of(self.next_ids.node, self.memory['node_id'][:self.n_nodes])

    @property
    def _edges(self) -> Ids:
        return Ids.of(self.next_ids.edge, self.memory['edge_id'][:self.n_edges])

    @property
    def _observed(self) -> Ids:
        return Ids.of(
            self.next_ids.observed, self.memory['observed_id'][:self.n_observed])

    def _read_only(self, name: str, rows: int) -> npt.NDArray[Any]:
        """Return the rows of a table in use."""
        view = self.memory[name][:rows]
        view.flags.writeable = False
        return view

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
        return self._read_only('node_f', self.n_nodes)[:, tb.POSE:tb.POSE + 3]

    def poses_of(self, ids: npt.ArrayLike) -> FloatArray:
        """
        Return a copy of the estimates of hidden nodes, shape (K, 3) for K ids, (3,) for one.

        Raises ValueError if one has left the graph.
        """
        rows = known(self.node_rows(ids), ids, 'hidden node')
        return self.memory['node_f'][rows, tb.POSE:tb.POSE + 3]

    @property
    def fixed(self) -> BoolArray:
        """Whether hidden nodes keep their pose, shape (N,)."""
        return self.memory['node_i'][:self.n_nodes, tb.FIXED] != 0

    @property
    def is_bias(self) -> BoolArray:
        """Whether hidden nodes are biases, shape (N,)."""
        return self._is(NodeKind.BIAS)

    @property
    def is_pose(self) -> BoolArray:
        """Whether hidden nodes are poses, shape (N,)."""
        return self._is(NodeKind.POSE)

    @property
    def extent(self) -> FloatArray:
        """Lengths of the sides of the box around all poses, shape (2,) [m]."""
        x, y = self.poses[self.is_pose, :2].T   # much faster one by one
        return np.array((np.ptp(x), np.ptp(y))) if len(x) > 0 else np.zeros(2)

    def _is(self, kind: NodeKind) -> BoolArray:
        # a byte for each node, as an estimate asks for it
        types = self.memory['node_i'][:self.n_nodes, tb.NODE_TYPE].astype(np.uint8)
        return np.asarray(types & np.uint8(3) == np.uint8(kind))

    @property
    def node_kind(self) -> npt.NDArray[Any]:
        """`NodeKind` of hidden nodes, shape (N,)."""
        return self.memory['node_i'][:self.n_nodes, tb.NODE_TYPE] & 3

    @property
    def dimension(self) -> npt.NDArray[Any]:
        """Numbers of coordinates of hidden nodes, shape (N,), 1 to 3."""
        return 3 - (self.memory['node_i'][:self.n_nodes, tb.NODE_TYPE] >> 2)

    @property
    def edges(self) -> Edges:
        """All edges, by row, with their weights; their ends are ids."""
        return self._with_ids(self.edges_by_row)

    def edges_at(self, ids: npt.ArrayLike) -> Edges:
        """Return edges by id; their ends are ids. Raises ValueError if one has left the graph."""
        return self._with_ids(self._edges_in(known(self.edge_rows(ids), ids, 'edge')))

    @property
    def edges_by_row(self) -> Edges:
        """All edges, with rows for ends, as solvers need them."""
        return self._edges_in(slice(self.n_edges))

    def _edges_in(self, rows: IntArray | slice) -> Edges:
        """Return the edges in some rows, with rows for ends."""
        numbers, integers = self.memory['edge_f'][rows], self.memory['edge_i'][rows]
        kind, bias = integers[:, tb.EDGE_KIND], np.zeros((len(integers), 4))
        for each, columns in _HAS_BIAS.items():
            of_kind = np.flatnonzero(kind == each)[:, None]
            bias[of_kind, columns] = numbers[of_kind, _BIAS_COLUMNS[columns]]
        return Edges(
            integers[:, tb.END_I], integers[:, tb.END_J], numbers[:, tb.MEAN:tb.MEAN + 3].copy(),
            full(numbers[:, tb.INFO:tb.INFO + 6]), kind, numbers[:, tb.WEIGHT].copy(), bias,
            integers[:, tb.END_K])

    @property
    def observed(self) -> ObservedNodes:
        """All observed nodes, by row, with their weights; their nodes are ids."""
        return self._with_ids(self.observed_by_row)

    def observed_at(self, ids: npt.ArrayLike) -> ObservedNodes:
        """Return observed nodes by id, as `edges_at` does."""
        return self._with_ids(
            self._observed_in(known(self.observed_rows(ids), ids, 'observed node')))

    @property
    def observed_by_row(self) -> ObservedNodes:
        """All observed nodes, with rows for their nodes, as solvers need them."""
        return self._observed_in(slice(self.n_observed))

    def _observed_in(self, rows: IntArray | slice) -> ObservedNodes:
        """Return the observed nodes in some rows, with rows for their nodes."""
        numbers, integers = self.memory['observed_f'][rows], self.memory['observed_i'][rows]
        return ObservedNodes(
            integers[:, tb.OBS_NODE], numbers[:, tb.OFFSET:tb.OFFSET + 3].copy(),
            numbers[:, tb.MEAN:tb.MEAN + 3].copy(), full(numbers[:, tb.INFO:tb.INFO + 6]),
            integers[:, tb.OBS_KIND], numbers[:, tb.WEIGHT].copy())

    def _with_ids(self, table: Constraints) -> Constraints:
        """Return a table with the ids of the nodes in place of their rows."""
        ids = self._nodes.present
        return table if ids is None else table.renumbered(ids.__getitem__)

    def _with_rows(self, table: Constraints) -> Constraints:
        """Return a table with the rows of the nodes in place of their ids."""
        nodes = self._nodes
        return table if nodes.present is None else table.renumbered(
            lambda ids: known(nodes.rows(ids), ids, 'hidden node'))

    @property
    def weights(self) -> tuple[FloatArray, FloatArray]:
        """Weights of all edges and of all observed nodes."""
        return (self.memory['edge_f'][:self.n_edges, tb.WEIGHT].copy(),
                self.memory['observed_f'][:self.n_observed, tb.WEIGHT].copy())

    def rows(self) -> GraphRows:
        """Return a copy of all rows."""
        return GraphRows(
            self.poses.copy(), self.node_kind, self.fixed,
            Edges(*(column.copy() for column in self.edges.columns)),
            ObservedNodes(*(column.copy() for column in self.observed.columns)),
            self.node_ids, self.edge_ids, self.observed_ids, self.next_ids, self.dimension,
            self.priors)

    @property
    def priors(self) -> tuple[Prior, ...]:
        """All dense priors."""
        return priors_of(self.memory, self.node_ids)

    @property
    def n_priors(self) -> int:
        """Number of dense priors."""
        return int(self.memory.head[tb.N_PRIORS])

    def leaving(self) -> GraphUpdate:
        """Return what leaves the graph with the present update; it keeps its rows until then."""
        nodes, edges, observed = (
            ids[self.memory[table][:len(ids), column] == tb.LEAVES].tolist()
            for ids, table, column in ((self.node_ids, 'node_i', tb.EDGE_LIST),
                                       (self.edge_ids, 'edge_i', tb.NEXT_I),
                                       (self.observed_ids, 'observed_i', tb.OBS_NEXT)))
        return GraphUpdate(remove_nodes=nodes, drop_edges=edges, drop_observed=observed)

    def energies(self, poses: FloatArray | None = None) -> Energies:
        """Return the energies of all constraints, at other poses, shape (N, 3), if given."""
        poses = self.poses if poses is None else poses
        edges, observed = self.edges_by_row, self.observed_by_row
        return Energies(
            energies(edge_errors(poses, edges), edges.weighted_information),
            energies(observed_errors(poses, observed), observed.weighted_information),
            np.array([model(prior, poses[self.node_rows(prior.nodes)], self.is_pose[
                self.node_rows(prior.nodes)]).energy
                      for prior in self.priors]))

    def edge_errors(self, edges: Edges, poses: FloatArray | None = None) -> FloatArray:
        """
        Return the errors of edges at the estimate, shape (M, 3); see `error_functions`.

        Parameters
        ----------
        edges : Edges, with ids for ends, in the graph or not
        poses : ndarray, shape (N, 3), optional, of all hidden nodes, by row, in place of theirs

        """
        return edge_errors(self.poses if poses is None else poses, self._with_rows(edges))

    def observed_errors(
        self, observed: ObservedNodes, poses: FloatArray | None = None,
    ) -> FloatArray:
        """
        Return the errors of observed nodes at the estimate, shape (K, 3).

        Parameters
        ----------
        observed, poses : ObservedNodes, ndarray, as for `edge_errors`

        """
        return observed_errors(
            self.poses if poses is None else poses, self._with_rows(observed))
