# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Hidden nodes leave where a place is driven often, and all parts of the engine forget them.

`window.thinning` decides which. Constraints in doubt are decided before they leave.
"""

from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.error_tuner import ErrorTuner
from pose_graph_ros.core.graph.graph_update import Left
from pose_graph_ros.core.io.capture import Parts
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.results import Forgotten
from pose_graph_ros.core.window.sparse_removal import sparse_removal
from pose_graph_ros.core.window.thinning import groups, removed, simplify, Thinning


class Thinner:
    """
    Keeps the graph at the size of the area.

    Parameters
    ----------
    smoother : IncrementalSmoother
    tuner : ErrorTuner
    parts : Parts, all others that forget

    """

    def __init__(self, smoother: IncrementalSmoother, tuner: ErrorTuner, parts: Parts) -> None:
        self._smoother, self._tuner, self._parts = smoother, tuner, parts
        self._thinning = Thinning()

    def step(self, config: ThinningConfig) -> None:
        """Let the nodes leave that are due."""
        parts = self._parts
        if config.cell == 0.0:
            return
        places = self._thinning.places(self._smoother, config, self._waiting())
        if places is None:
            return
        for group in groups(parts.graph, places):
            parts.judge.decide_leaving(group.nodes)
            gone = removed(
                self._smoother, sparse_removal(parts.graph, group.nodes))
            if gone is None:
                break
            forget(gone, parts, self._tuner)
            parts.nodes.table.thin(*group)
        for gone in simplify(self._smoother):
            forget(gone, parts, self._tuner)

    def _waiting(self) -> set[int]:
        """Return the ids of nodes on which constraints are to be added, or edges are to end."""
        parts, found = self._parts, set[int]()
        for queue in (parts.pipeline.queue, parts.quarantine):
            found.update(int(end[0]) for each in queue.edges for end in (each.edge.i, each.edge.j))
            found.update(each.attachment.node for each in queue.observed)
        return found


def forget(gone: Left | Forgotten, parts: Parts, tuner: ErrorTuner) -> None:
    """
    Let judge, reweighting, tuner and factors forget what has left the graph.

    Parameters
    ----------
    gone : Left or Forgotten, ids
    parts : Parts
    tuner : ErrorTuner

    """
    parts.judge.forget(gone.nodes, gone.edges, gone.observed)
    parts.reweighting.forget(gone.edges, gone.observed)
    tuner.forget(gone.nodes, gone.edges, gone.observed)
