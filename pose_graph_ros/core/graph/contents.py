# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is in the tables of a graph, by row and by id."""

from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.checks import Ids
from pose_graph_ros.core.graph.constraints import FACTORS, Factors, full, NodeKind
from pose_graph_ros.core.graph.error_functions import energies, errors
from pose_graph_ros.core.graph.graph_update import Energies, GraphRows, GraphUpdate, NextIds
from pose_graph_ros.core.graph.prior_rows import priors_of
from pose_graph_ros.core.graph.priors import model, Prior
from pose_graph_ros.core.graph.tables import Memory

# Number of rows and next id of each table.
COUNTERS = {'node': (tb.N_NODES, tb.NEXT_NODE), 'factor': (tb.N_FACTORS, tb.NEXT_FACTOR)}
# By kind, whether factors have each column of `Factors.constants`.
_HAS_CONSTANTS = np.array([np.isin(range(4), factor.constants) for factor in FACTORS.values()])

# By kind, whether factors are between nodes that are no biases.
_ARE_EDGES = np.array([factor.j not in {(), (NodeKind.BIAS,)} for factor in FACTORS.values()])


class GraphContents:
    """
    Nodes and factors of a graph, for reading.

    Hidden nodes (biases included) and factors have *ids*: one counter for each of the two,
    ascending, and an id is never used again. The store has them in *rows*, in the
    order of their ids; rows move when others leave. Whoever keeps a number keeps an id; arrays of
    all nodes or factors (`poses`, `weights`, `is_bias`, ...) are by row. All are copies, but
    for `poses`. What asks for an id that is not in the graph raises ValueError, but for `.._rows`.
    """

    def __init__(self) -> None:
        self.memory = Memory()

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
        return int(np.count_nonzero(_ARE_EDGES[self.factor_records['kind']]))

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
        return Ids.of(next_id, self.memory[f'{table}_id'][:n_rows])

    @property
    def node_ids(self) -> IntArray:
        """Ids of all hidden nodes, ascending."""
        return self._ids('node').by_row()

    @property
    def factor_ids(self) -> IntArray:
        """Ids of all factors, ascending."""
        return self._ids('factor').by_row()

    def node_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of hidden nodes, shape of `ids`; -1 where they have left the graph."""
        return self._ids('node').rows(ids)

    def factor_rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the rows of factors, as `node_rows`."""
        return self._ids('factor').rows(ids)

    def factors_on(self, nodes: IntArray) -> IntArray:
        """Return the ids of the factors with an end in some nodes."""
        chosen = np.zeros(self.n_nodes + 1, dtype=bool)    # the last one is for no end, -1
        chosen[self.node_rows(nodes)] = True
        return self.factor_ids[np.any(chosen[self.factor_records['ends']], axis=1)]

    def leaving(self) -> GraphUpdate:
        """Return what leaves the graph with the present update; it keeps its rows until then."""
        nodes, factors = (ids[links == tb.LEAVES].tolist() for ids, links in (
            (self.node_ids, self.node_records['factor_list']),
            (self.factor_ids, self.factor_records['next'][:, 0])))
        return GraphUpdate(remove_nodes=nodes, drop=factors)

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
        return self._is(NodeKind.BIAS)

    @property
    def is_pose(self) -> BoolArray:
        """Whether hidden nodes are poses."""
        return self._is(NodeKind.POSE)

    def _is(self, kind: NodeKind) -> BoolArray:
        return np.asarray(self.node_records['kind'] == np.uint8(kind))

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

    def _with_rows(self, table: Factors) -> Factors:
        """Return a table with the rows of the nodes in place of their ids."""
        nodes = self._ids('node')
        return table if nodes.present is None else table.renumbered(
            lambda ids: nodes.known(ids, 'hidden node'))

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

    def errors(self, factors: Factors, poses: Poses | None = None) -> FloatArray:
        """Return the errors of factors with ids for ends, in the graph or not."""
        return errors(self.poses if poses is None else poses, self._with_rows(factors))
