# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One update of the back end, which is applied completely or rolled back."""

from types import TracebackType
from typing import Self

from pose_graph_ros.core.alignment.monitor import AlignmentMonitor
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.judge import Judge
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.smoother.results import UpdateResult
from pose_graph_ros.core.sources.constraint_queue import Queue
from pose_graph_ros.core.sources.factor_builder import FactorBuilder


class Transaction:
    """
    Context manager in which an update is built and solved.

    If the solver fails or the context raises an `Exception`, it restores the poses of the graph,
    the state of the alignment, and the records of factor builder and judge. It suppresses the
    exception and stores its message in `failure`. The smoother rolls back its own changes, bit for
    bit.

    Parameters
    ----------
    graph : Graph
    nodes : HiddenNodes
    alignment : AlignmentMonitor
    factors : FactorBuilder
    judge : Judge

    """

    def __init__(
        self, graph: Graph, nodes: HiddenNodes, alignment: AlignmentMonitor,
        factors: FactorBuilder, judge: Judge,
    ) -> None:
        self._graph, self._nodes, self._alignment = graph, nodes, alignment
        self._factors, self._judge = factors, judge
        self._before = alignment.copy()
        self._poses: tuple[FloatArray, FloatArray] | None = None
        self.queue = Queue()
        """The new constraints."""
        self.result = UpdateResult(Status.CONVERGED, '', 0, 0, 0, 0)
        """Result of the solver."""
        self.failure = ''
        """Why the update was rolled back; empty if it succeeded."""

    def add(self, queue: Queue) -> Queue:
        """Return the new constraints after storing them."""
        self.queue = queue
        return queue

    def move_graph(self, T_map_graph: FloatArray) -> None:
        """Move all nodes, frozen ones too, by a rigid motion, shape (3,) [m, m, rad]."""
        poses = self._graph.poses.copy()
        self._poses = poses, self._nodes.table.frozen.copy()
        self._graph.set_poses(se2.compose(T_map_graph, poses))
        self._nodes.table.move_frozen(T_map_graph)

    @property
    def moved_back(self) -> bool:
        """Whether the nodes were moved and restored, so that all must be eliminated again."""
        return self.failure != '' and self._poses is not None

    def solved(self, result: UpdateResult) -> None:
        """Store the result of the solver; raise LinearSolveError if it failed."""
        if result.status is Status.FAILED:
            raise LinearSolveError(result.reason)
        self.result = result

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool:
        if error is None:
            return False
        self._factors.rollback()
        self._judge.rollback()
        if self._poses is not None:
            poses, frozen = self._poses
            self._graph.set_poses(poses)
            self._nodes.table.set_frozen(frozen)
        self._alignment.restore(self._before)
        self.failure = str(error)
        if not isinstance(error, LinearSolveError):
            self.failure = f'{type(error).__name__}: {error}'
        return isinstance(error, Exception)
