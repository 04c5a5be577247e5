# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose graph: hidden nodes, edges and observed nodes, as struct of arrays.

The graph is edited by `GraphUpdate`s alone, each applied whole or not at all, and can go back to
an earlier checkpoint. Solvers read it and write the poses of the hidden nodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import cast, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core import linearize, se2
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.constraints import check, Edges, ObservedNodes
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.se2 import FloatArray

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class GraphUpdate:
    """Everything that changes in one step; new hidden nodes are numbered from the end."""

    hidden: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    """Initial poses of new hidden nodes in the map, shape (N, 3) [m, m, rad]."""
    edges: Edges = field(default_factory=Edges)
    """New edges, also to the new hidden nodes."""
    observed: ObservedNodes = field(default_factory=ObservedNodes)
    """New observed nodes, also on the new hidden nodes."""
    fix: Sequence[int] = ()
    """Hidden nodes that keep their pose from now on (the gauge)."""
    free: Sequence[int] = ()
    """Hidden nodes that no longer do."""


class Checkpoint(NamedTuple):
    """What `Graph.restore` needs to undo every later edit."""

    n_nodes: int
    n_edges: int
    n_observed: int
    poses: FloatArray
    fixed: BoolArray


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
        self._poses = GrowingArray((3,), np.float64)
        self._fixed = GrowingArray((), np.bool_)
        self._edges = {
            'i': GrowingArray((), np.int64), 'j': GrowingArray((), np.int64),
            'mean': GrowingArray((3,), np.float64),
            'information': GrowingArray((3, 3), np.float64),
            'kind': GrowingArray((), np.uint8)}
        self._observed = {
            'node': GrowingArray((), np.int64), 'offset': GrowingArray((3,), np.float64),
            'mean': GrowingArray((3,), np.float64),
            'information': GrowingArray((3, 3), np.float64),
            'kind': GrowingArray((), np.uint8)}

    @property
    def n_nodes(self) -> int:
        """Number of hidden nodes."""
        return len(self._poses)

    @property
    def poses(self) -> FloatArray:
        """Estimates of the hidden nodes in the map, shape (N, 3), a read-only view."""
        return cast('FloatArray', self._poses.read_only)

    @property
    def fixed(self) -> BoolArray:
        """Hidden nodes that keep their pose, shape (N,), a read-only view."""
        return cast('BoolArray', self._fixed.read_only)

    @property
    def edges(self) -> Edges:
        """All edges, read-only views."""
        return Edges(**{name: column.read_only for name, column in self._edges.items()})

    @property
    def observed(self) -> ObservedNodes:
        """All observed nodes, read-only views."""
        return ObservedNodes(
            **{name: column.read_only for name, column in self._observed.items()})

    def apply(self, update: GraphUpdate) -> None:
        """
        Make the edits of one update, all of them or none.

        Raises
        ------
        GraphUpdateError
            If any part does not fit, saying which; the graph is unchanged then.

        """
        hidden = np.asarray(update.hidden, dtype=np.float64)
        if hidden.ndim != 2 or hidden.shape[1:] != (3,) or not np.all(np.isfinite(hidden)):
            raise GraphUpdateError(
                f'hidden: expected finite poses, shape (N, 3), got shape {hidden.shape}'
                + ('' if hidden.ndim != 2 or hidden.shape[1:] != (3,)
                   else ' with numbers that are not finite'))
        n_nodes = self.n_nodes + len(hidden)
        for name, nodes in (('fix', update.fix), ('free', update.free)):
            outside = [node for node in nodes
                       if not (isinstance(node, int | np.integer) and 0 <= node < n_nodes)]
            if len(outside) > 0:
                raise GraphUpdateError(
                    f'{name}: expected hidden nodes in 0..{n_nodes - 1}, got {outside[0]}')
        check(update.edges, n_nodes)
        check(update.observed, n_nodes)

        self._poses.append(se2.wrapped(hidden))
        self._fixed.append(np.zeros(len(hidden), dtype=bool))
        self._fixed.values[list(update.fix)] = True
        self._fixed.values[list(update.free)] = False
        for table, columns in ((update.edges, self._edges), (update.observed, self._observed)):
            for item in fields(table):
                columns[item.name].append(getattr(table, item.name))

    def set_poses(self, poses: FloatArray) -> None:
        """Write the estimates of all hidden nodes, shape (N, 3); headings are wrapped."""
        if poses.shape != (self.n_nodes, 3) or not np.all(np.isfinite(poses)):
            raise GraphUpdateError(
                f'expected finite poses, shape {(self.n_nodes, 3)}, got shape {poses.shape}')
        self._poses.values[:] = se2.wrapped(poses)

    def energies(self, poses: FloatArray | None = None) -> Energies:
        """Return the energies of all constraints, at other poses (N, 3) if given."""
        poses = self.poses if poses is None else poses
        edges, observed = self.edges, self.observed
        return Energies(
            linearize.energies(linearize.edge_errors(poses, edges), edges.information),
            linearize.energies(linearize.observed_errors(poses, observed), observed.information))

    def checkpoint(self) -> Checkpoint:
        """Remember the present state."""
        return Checkpoint(self.n_nodes, len(self._edges['i']), len(self._observed['node']),
                          self.poses.copy(), self.fixed.copy())

    def restore(self, checkpoint: Checkpoint) -> None:
        """Undo every edit since the checkpoint, bit for bit."""
        self._poses.truncate(checkpoint.n_nodes)
        self._fixed.truncate(checkpoint.n_nodes)
        for column in self._edges.values():
            column.truncate(checkpoint.n_edges)
        for column in self._observed.values():
            column.truncate(checkpoint.n_observed)
        self._poses.values[:] = checkpoint.poses
        self._fixed.values[:] = checkpoint.fixed
