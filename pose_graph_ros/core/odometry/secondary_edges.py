# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edges between hidden nodes from odometry sources other than the primary one."""

from pose_graph_ros.core.geometry import covariance
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.odometry.stream import OdometryStream


class SecondaryEdges:
    """
    Makes one edge per source between each two consecutive hidden nodes that its samples cover.

    The poses of a source are interpolated at the stamps of the nodes. A node without samples of
    the source close to its stamp is left out: the edge spans from the node before to the next.
    """

    def __init__(self) -> None:
        self.progress: dict[str, tuple[int, int]] = {}
        """By source: newest node that its samples cover (-1 for none), next node to check."""
        self.new: list[tuple[str, Edges]] = []
        """Edges not yet taken, each with its source; whoever takes them clears the list."""

    def skip_to(self, source: str, node: int, *, reached: bool) -> None:
        """
        Set where the edges of a source continue; it gets no edge from earlier nodes.

        Parameters
        ----------
        node : int, number of the hidden node, in the order of stamps
        reached : bool
            True if the next edge begins at this node; False if it begins at the first node, from
            this one on, that the samples of the source cover.

        """
        self.progress[source] = (node, node + 1) if reached else (-1, node)

    def extend(
        self, source: str, stream: OdometryStream, stamps_ns: IntArray, ids: IntArray,
    ) -> None:
        """
        Add the edges of a source up to its newest settled sample to `new`.

        Parameters
        ----------
        stream : OdometryStream, samples of the source
        stamps_ns, ids : ndarray of int64, shape (N,)
            Stamps [ns] of all hidden nodes, and their ids in the graph.

        """
        last, node = self.progress[source]
        while node < len(stamps_ns) and stamps_ns[node] <= stream.settled_ns:
            if stream.timeline.covers(int(stamps_ns[node]), closely=True):
                # no edge spans a restart
                if last >= 0 and not stamps_ns[last] < stream.restarted_ns <= stamps_ns[node]:
                    motion = stream.timeline.motion(int(stamps_ns[last]), int(stamps_ns[node]))
                    self.new.append((source, Edges(
                        [ids[last]], [ids[node]], [motion.increment],
                        [covariance.information(stream.covariance(motion))],
                        [EdgeKind.ODOMETRY])))
                last = node
            node += 1
        self.progress[source] = last, node
