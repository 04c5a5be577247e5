# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The oldest hidden nodes leave the graph, and all parts of the engine forget what was on them.

`window.policy` decides which. Their poses are frozen where they are, and what their constraints
told stays in the graph as a prior on its oldest nodes. A fixed node, the gauge of a graph that is
not aligned with the map, is frozen with the others but stays in the graph until it is freed: a
prior of poses relative to it says nothing about where they are in the map.
"""

import numpy as np

from pose_graph_ros.core.config import BackendConfig, Prior, WindowConfig
from pose_graph_ros.core.error_tuner import ErrorTuner
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph_update import Left
from pose_graph_ros.core.graph.incidence import constraints_on
from pose_graph_ros.core.io.capture import Parts
from pose_graph_ros.core.measurements import rejected
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.results import Forgotten
from pose_graph_ros.core.thinner import forget, Thinner
from pose_graph_ros.core.window.policy import n_leaving
from pose_graph_ros.core.window.sparse_removal import sparse_marginalization
from pose_graph_ros.core.window.thinning import Places, relative_noise, removed

# After a failure of the solver no node leaves before so many new ones have come.
REST = 20


class Forgetting:
    """
    Keeps the graph within its window.

    Parameters
    ----------
    smoother : IncrementalSmoother
    tuner : ErrorTuner
    parts : Parts, all others that forget

    """

    def __init__(self, smoother: IncrementalSmoother, tuner: ErrorTuner, parts: Parts) -> None:
        self._smoother, self._tuner, self._parts = smoother, tuner, parts
        self._thinner = Thinner(smoother, tuner, parts)
        self._joint: FloatArray | None = None
        """
        Pose of the oldest node in the graph, seen from the last frozen one, shape (3,), if that
        was frozen before the graph was aligned with the map; else None.
        """
        self._rest = 0
        """Number of hidden nodes from which on more of them may leave."""

    def step(self, config: BackendConfig) -> None:
        """Let the nodes leave that are due, by the window and by thinning."""
        if len(self._parts.nodes) == 0 or self._parts.graph.has_touched:
            return
        if config.window.is_limited:
            self._step_of_window(config.window)
        self._thinner.step(config.thinning)

    def restored(self) -> None:
        """Tell that the parts have got a saved state."""
        nodes, parts = self._parts.nodes, self._parts
        if nodes.n_frozen > 0 and not parts.alignment.is_aligned:
            last, first = nodes.poses(parts.graph)[nodes.n_frozen - 1:nodes.n_frozen + 1]
            self._joint = se2.between(last, first)

    def _step_of_window(self, window: WindowConfig) -> None:
        """Let the nodes beyond the window leave, if a group is due."""
        nodes = self._parts.nodes
        n = n_leaving(window, nodes.table)
        if n > 0:
            parts = self._parts
            n = n_leaving(window, nodes.table, parts.pipeline.needed_ns(
                aligned=parts.alignment.is_aligned))
        if n > 0 and len(nodes) >= self._rest:
            self._forget(n, window.prior)

    def _forget(self, n: int, prior: Prior) -> None:
        """Let the n oldest nodes leave, with a dense or a sparse prior instead."""
        parts, graph, nodes = self._parts, self._parts.graph, self._parts.nodes
        first = nodes.n_frozen + n
        # the oldest one that stays may have been thinned out
        rows = graph.node_rows(nodes.ids[first:])
        row = int(rows[rows >= 0][0])
        # fixed ones of before may have been freed meanwhile
        leaving = graph.node_ids[:row][~graph.is_bias[:row] & ~graph.fixed[:row]]
        self._follow_alignment()
        stays = graph.is_pose & ~np.isin(graph.node_ids, leaving)
        biases = np.array(self._tuner.leave(
            *constraints_on(graph, leaving), int(graph.node_ids[np.argmax(stays)])),
            dtype=np.int64)
        leaving = np.sort(np.concatenate((leaving, biases)))
        decided = parts.judge.decide_leaving(*constraints_on(graph, leaving))
        self._smoother.linearize(leaving)
        poses = nodes.recent_poses(graph)
        anchors = self._other_anchors(first)
        gone = self._gone(leaving, prior)
        if gone is None:
            self._tuner.stay()
            return
        forget(gone, parts, self._tuner, decided)
        if anchors is not None:
            nodes.table.thin(*anchors)
        nodes.forget(poses[:n])
        if not parts.alignment.is_aligned:
            self._joint = se2.between(poses[n - 1], poses[n])
        parts.alignment.forget(int(nodes.ids[first]))
        parts.pipeline.seen.forget(nodes.last_frozen_ns)
        self._refuse(leaving)

    def _gone(self, leaving: IntArray, prior: Prior) -> Left | Forgotten | None:
        """Return what has left with nodes; None, and they all stay, if the solver has failed."""
        gone = None if prior is Prior.DENSE else removed(
            self._smoother, sparse_marginalization(self._parts.graph, leaving))
        if gone is not None:
            return gone
        try:
            return self._smoother.forget(leaving)
        except GraphUpdateError:
            self._parts.pipeline.counts['solver', 'failed'] += 1
            self._rest = len(self._parts.nodes) + REST
            return None

    def _other_anchors(self, first: int) -> Places | None:
        """
        Return the places of anchors of thinned nodes that leave, those before a number, in others.

        None if there are none.
        """
        table, graph = self._parts.nodes.table, self._parts.graph
        thinned = table.thinned.places()
        leave = np.unique(thinned.anchors[(thinned.anchors < first) & (thinned.numbers >= first)])
        if len(leave) == 0:
            return None
        kept = np.setdiff1d(np.arange(first, len(table)), thinned.numbers)
        ends, starts = graph.poses_of(table.ids[leave]), graph.poses_of(table.ids[kept])
        nearest = np.array([np.argmin(np.hypot(*(starts[:, :2] - end[:2]).T)) for end in ends])
        ids, anchors = table.ids[leave], table.ids[kept[nearest]]
        return Places(ids, anchors, se2.between(starts[nearest], ends),
                      relative_noise(self._smoother, anchors, ids))

    def _follow_alignment(self) -> None:
        """
        Join the path from before the alignment to the graph again, once.

        The angle at which it was moved into the map was a first guess, which is better known by
        now.
        """
        nodes, joint = self._parts.nodes, self._joint
        if joint is None or not self._parts.alignment.is_aligned:
            return
        self._joint = None
        oldest = nodes.recent_poses(self._parts.graph)[0]
        last = se2.compose(oldest, se2.inverse(joint))
        nodes.table.move_frozen(se2.compose(last, se2.inverse(nodes.table.frozen[-1])))

    def _refuse(self, nodes: IntArray) -> None:
        """Count constraints that were to be added to nodes that have left."""
        pipeline, gone = self._parts.pipeline, {*nodes.tolist()}
        for queue in (pipeline.queue, self._parts.quarantine):
            for source in queue.drop(gone):
                pipeline.count(source, rejected(
                    'before_window', 'its hidden node left the graph before it was added'))
