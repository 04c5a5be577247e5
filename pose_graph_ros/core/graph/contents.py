# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is in the tables of a graph, by row and by id."""

from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.checks import Ids
from pose_graph_ros.core.graph.constraints import (
    Constraints,
    Edges,
    FACTORS,
    full,
    NodeKind,
    ObservedNodes,
)
from pose_graph_ros.core.graph.error_functions import edge_errors, energies, observed_errors
from pose_graph_ros.core.graph.graph_update import Energies, GraphRows, GraphUpdate, NextIds
from pose_graph_ros.core.graph.prior_rows import priors_of
from pose_graph_ros.core.graph.priors import model, Prior
from pose_graph_ros.core.graph.tables import Memory

# Number of rows and next id of each table.
COUNTERS = {'node': (tb.N_NODES, tb.NEXT_NODE), 'edge': (tb.N_EDGES, tb.NEXT_EDGE),
            'observed': (tb.N_OBSERVED, tb.NEXT_OBSERVED)}
# Columns of edge_f with the column `Edges.bias`, for kinds of edges that have them.
_BIAS_COLUMNS = np.array((tb.OFFSET, tb.OFFSET + 1, tb.FACTOR_T, tb.FACTOR_TH))
_HAS_BIAS = {kind: list(factor.bias) for kind, factor in FACTORS.items() if factor.bias}


class GraphContents:
    """
    Nodes and constraints of a graph, for reading.

    Hidden nodes (biases included), edges and observed nodes have *ids*: one counter for each of
    the three, ascending, and an id is never used again. The store has them in *rows*, in the
    order of their ids; rows move when others leave. Whoever keeps a number keeps an id; arrays of
    all nodes or constraints (`poses`, `weights`, `is_bias`, ...) are by row. All are copies, but
    for `poses`. What asks for an id that is not in the graph raises ValueError, but for `.._rows`.
    """

    def __init__(self) -> None:
        self.memory = Memory()

    # --- numbers and ids ------------------------------------------------------------------------

    @property
    def n_nodes(self) -> int:
        """Number of hidden nodes, biases included."""
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
        return NextIds(*self.memory.head[tb.NEXT_NODE:tb.NEXT_OBSERVED + 1].tolist())

    def _ids(self, table: str) -> Ids:
        n_rows, next_id = (int(self.memory.head[k]) for k in COUNTERS[table])
        return Ids.of(next_id, self.memory[f'{table}_id'][:n_rows])

    @property
    def node_ids(self) -> IntArray:
        """Ids of all hidden nodes, ascending."""
        return self._ids('node').by_row()

    @property
    def edge_ids(self) -> IntArray:
        """Ids of all edges, ascending."""
        return self._ids('edge').by_row()

    @property
    def observed_ids(self) -> IntArray:
        """Ids of all observed nodes, ascending."""
        return self._ids('observed').by_row()

    def node_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of hidden nodes, shape of `ids`; -1 where they have left the graph."""
        return self._ids('node').rows(ids)

    def edge_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of edges, as `node_rows`."""
        return self._ids('edge').rows(ids)

    def observed_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of observed nodes, as `node_rows`."""
        return self._ids('observed').rows(ids)

    def constraints_on(self, nodes: IntArray) -> tuple[IntArray, IntArray]:
        """Return the ids of the edges and of the observed nodes with an end in some nodes."""
        chosen = np.zeros(self.n_nodes + 1, dtype=bool)    # the last one is for no third end, -1
        chosen[self.node_rows(nodes)] = True
        ends = self.memory['edge_i'][:self.n_edges, tb.END_I:tb.END_K + 1]
        seen = self.memory['observed_i'][:self.n_observed, tb.OBS_NODE]
        return self.edge_ids[np.any(chosen[ends], axis=1)], self.observed_ids[chosen[seen]]

    def leaving(self) -> GraphUpdate:
        """Return what leaves the graph with the present update; it keeps its rows until then."""
        nodes, edges, observed = (
            ids[self.memory[table][:len(ids), column] == tb.LEAVES].tolist()
            for ids, table, column in ((self.node_ids, 'node_i', tb.EDGE_LIST),
                                       (self.edge_ids, 'edge_i', tb.NEXT_I),
                                       (self.observed_ids, 'observed_i', tb.OBS_NEXT)))
        return GraphUpdate(remove_nodes=nodes, drop_edges=edges, drop_observed=observed)

    # --- hidden nodes ---------------------------------------------------------------------------

    @property
    def poses(self) -> Poses:
        """Estimates of all hidden nodes in the map, a read-only view."""
        view = self.memory['node_f'][:self.n_nodes]
        view.flags.writeable = False
        return view[:, tb.POSE:tb.POSE + 3]

    def poses_of(self, ids: npt.ArrayLike) -> FloatArray:
        """Return the estimates of hidden nodes, shape (K, 3) for K ids, (3,) for one."""
        rows = self._ids('node').known(ids, 'hidden node')
        return self.memory['node_f'][rows, tb.POSE:tb.POSE + 3]

    @property
    def fixed(self) -> BoolArray:
        """Whether hidden nodes keep their pose."""
        return self.memory['node_i'][:self.n_nodes, tb.FIXED] != 0

    @property
    def is_bias(self) -> BoolArray:
        """Whether hidden nodes are biases."""
        return self._is(NodeKind.BIAS)

    @property
    def is_pose(self) -> BoolArray:
        """Whether hidden nodes are poses."""
        return self._is(NodeKind.POSE)

    def _is(self, kind: NodeKind) -> BoolArray:
        # a byte for each node, as an estimate asks for it
        types = self.memory['node_i'][:self.n_nodes, tb.NODE_TYPE].astype(np.uint8)
        return np.asarray(types & np.uint8(3) == np.uint8(kind))

    @property
    def node_kind(self) -> npt.NDArray[Any]:
        """`NodeKind` of hidden nodes."""
        return self.memory['node_i'][:self.n_nodes, tb.NODE_TYPE] & 3

    @property
    def dimension(self) -> npt.NDArray[Any]:
        """Numbers of coordinates of hidden nodes, 1 to 3."""
        return 3 - (self.memory['node_i'][:self.n_nodes, tb.NODE_TYPE] >> 2)

    @property
    def extent(self) -> FloatArray:
        """Lengths of the sides of the box around all poses, shape (2,) [m]."""
        x, y = self.poses[self.is_pose, :2].T   # much faster one by one
        return np.array((np.ptp(x), np.ptp(y))) if len(x) > 0 else np.zeros(2)

    # --- constraints ----------------------------------------------------------------------------

    @property
    def edges(self) -> Edges:
        """All edges, by row, with their weights; their ends are ids."""
        return self._with_ids(self.edges_by_row)

    def edges_at(self, ids: npt.ArrayLike) -> Edges:
        """Return edges by id; their ends are ids."""
        return self._with_ids(self._edges_in(self._ids('edge').known(ids, 'edge')))

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
        """Return observed nodes by id; their nodes are ids."""
        return self._with_ids(self._observed_in(self._ids('observed').known(ids, 'observed node')))

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
        ids = self._ids('node').present
        return table if ids is None else table.renumbered(ids.__getitem__)

    def _with_rows(self, table: Constraints) -> Constraints:
        """Return a table with the rows of the nodes in place of their ids."""
        nodes = self._ids('node')
        return table if nodes.present is None else table.renumbered(
            lambda ids: nodes.known(ids, 'hidden node'))

    @property
    def weights(self) -> tuple[FloatArray, FloatArray]:
        """Weights of all edges and of all observed nodes."""
        return (self.memory['edge_f'][:self.n_edges, tb.WEIGHT].copy(),
                self.memory['observed_f'][:self.n_observed, tb.WEIGHT].copy())

    @property
    def priors(self) -> tuple[Prior, ...]:
        """All dense priors."""
        return priors_of(self.memory, self.node_ids)

    def rows(self) -> GraphRows:
        """Return all rows."""
        return GraphRows(
            self.poses.copy(), self.node_kind, self.fixed, self.edges, self.observed,
            self.node_ids, self.edge_ids, self.observed_ids, self.next_ids, self.dimension,
            self.priors)

    # --- errors, at the estimate or at other poses of all hidden nodes, by row ------------------

    def energies(self, poses: Poses | None = None) -> Energies:
        """Return the energies of all constraints."""
        poses = self.poses if poses is None else poses
        edges, observed = self.edges_by_row, self.observed_by_row
        return Energies(
            energies(edge_errors(poses, edges), edges.weighted_information),
            energies(observed_errors(poses, observed), observed.weighted_information),
            np.array([model(prior, poses[rows], self.is_pose[rows]).energy
                      for prior in self.priors for rows in (self.node_rows(prior.nodes),)]))

    def edge_errors(self, edges: Edges, poses: Poses | None = None) -> FloatArray:
        """Return the errors of edges with ids for ends, in the graph or not."""
        return edge_errors(self.poses if poses is None else poses, self._with_rows(edges))

    def observed_errors(
        self, observed: ObservedNodes, poses: Poses | None = None,
    ) -> FloatArray:
        """Return the errors of observed nodes with ids for nodes, in the graph or not."""
        return observed_errors(
            self.poses if poses is None else poses, self._with_rows(observed))
