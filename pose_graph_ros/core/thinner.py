# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Hidden nodes leave where a place is driven often, and all parts of the engine forget them.

`window.thinning` decides which. Constraints in doubt are decided before they leave.
"""

from collections.abc import Iterator

import numpy as np

from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.error_tuner import ErrorTuner
from pose_graph_ros.core.graph.graph_update import GraphUpdate, Left
from pose_graph_ros.core.graph.incidence import constraints_on
from pose_graph_ros.core.io.capture import Parts
from pose_graph_ros.core.judgement.judge import Leaving
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.results import Forgotten
from pose_graph_ros.core.window.bias_cuts import cut_chains
from pose_graph_ros.core.window.segments import carriers, first_of, next_segment, Segment
from pose_graph_ros.core.window.sparse_removal import NONE, old_closures, sparse_removal
from pose_graph_ros.core.window.thinning import (
    certain,
    Crowd,
    groups,
    Places,
    removed,
    simplify,
    Thinning,
)

# A measurement that comes twice is refused the second time, if it is not older than that [ns].
REPEATED_NS = 3600 * 1_000_000_000
# In each step one group leaves for each new node, but not more than this.
MOST_PIECES = 20
# Loop closures between nodes that stay, for each pose, above which the oldest ones become priors.
MOST_OLD_CLOSURES = 0.5


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
        self._work: Iterator[None] = iter(())
        self._n_made = 0

    def step(self, config: ThinningConfig) -> None:
        """Let groups of nodes leave, or of old measurements in the map, if some are due."""
        if config.cell == 0.0:
            self._work = iter(())
            return
        # a bag is replayed with many new nodes from step to step
        n_made = len(self._parts.nodes)
        new, self._n_made = max(n_made - self._n_made, 1), n_made
        for _ in range(min(new, MOST_PIECES)):
            if next(self._work, self) is self:
                self._work = self._steps(config)
                if next(self._work, self) is self:
                    return

    def _steps(self, config: ThinningConfig) -> Iterator[None]:
        """Yield after each change of the graph; others may have changed it before the next."""
        parts, smoother = self._parts, self._smoother
        # a fixed node that is frozen stays in the graph, but stands for no others
        first = int(parts.nodes.ids[parts.nodes.n_frozen])
        places = self._thinning.places(
            smoother, config, len(parts.nodes), self._held(), first)
        if places is None:
            return
        older = parts.graph.node_ids[parts.graph.is_pose][:-config.newest]
        while self._thinning.measurements_are_due(parts.graph):
            older = older[parts.graph.node_rows(older) >= 0]
            segment = next_segment(parts.graph, older, places.nodes)
            if segment is None:
                break
            inside = np.isin(places.nodes, segment.poses)
            group = self._present(places.rows(inside), config)
            if not self._measurements_leave(segment, group):
                break
            places, older = places.rows(~inside), older[older >= segment.after]
            yield
        # others leave with their measurements
        before = places.nodes < first_of(*carriers(parts.graph))
        places = self._present(places.rows(before), config)
        for chosen in groups(parts.graph, places):
            group = self._present(chosen, config)
            if len(group.nodes) == 0:
                continue
            decided = parts.judge.decide_leaving(*constraints_on(parts.graph, group.nodes))
            self._leave(group, sparse_removal(parts.graph, group.nodes), decided)
            yield
        nobody = places.rows(np.zeros(len(places.nodes), dtype=bool))
        while len(closures := old_closures(parts.graph, config.newest, MOST_OLD_CLOSURES)) > 0:
            decided = parts.judge.decide_leaving(closures, NONE)
            if not self._leave(
                    nobody, sparse_removal(parts.graph, NONE, closures), decided):
                break
            yield
        for gone in simplify(smoother):
            forget(gone, parts, self._tuner, None)
            yield
        parts.nodes.drop_samples(config.newest)
        parts.pipeline.seen.forget(parts.nodes.newest_ns - REPEATED_NS)

    def _present(self, places: Places, config: ThinningConfig) -> Places:
        """Return the places, as they are now, of those nodes that may still leave."""
        graph = self._parts.graph
        there = (graph.node_rows(places.nodes) >= 0) & (graph.node_rows(places.anchors) >= 0)
        free = there & ~np.isin(places.nodes, list(self._held()))
        return certain(self._smoother, Crowd(places.nodes[free], places.anchors[free]), config)

    def _measurements_leave(self, segment: Segment, group: Places) -> bool:
        """
        Let the measurements of a stretch leave, and a group of its nodes; tell whether they did.

        Parameters
        ----------
        segment : Segment
        group : Places

        """
        graph = self._parts.graph
        edges, observed = constraints_on(graph, group.nodes)
        edges = np.union1d(edges, segment.edges)
        observed = np.union1d(observed, segment.observed)
        # what is decided may have another weight
        decided = self._parts.judge.decide_leaving(edges, observed)
        biases = np.array(self._tuner.leave(edges, observed, segment.after), dtype=np.int64)
        cuts = cut_chains(graph, biases)
        update = None if cuts is None else sparse_removal(
            graph, np.sort(np.concatenate((group.nodes, biases))), segment.edges,
            segment.observed, cuts)
        return self._leave(group, update, decided)

    def _leave(self, group: Places, update: GraphUpdate | None, decided: Leaving) -> bool:
        """
        Let nodes leave with an update; tell whether they did.

        Parameters
        ----------
        group : Places
        update : GraphUpdate, optional; None if they cannot leave
        decided : Leaving, on their constraints

        """
        gone = removed(self._smoother, update)
        if gone is None:
            self._tuner.stay()
            return False
        forget(gone, self._parts, self._tuner, decided)
        self._parts.nodes.table.thin(*group)
        return True

    def _held(self) -> set[int]:
        """Return the ids of nodes that do not leave, as something is to be added to them."""
        parts, found = self._parts, set(self._tuner.needed)
        for queue in (parts.pipeline.queue, parts.quarantine):
            found.update(int(end[0]) for each in queue.edges for end in (each.edge.i, each.edge.j))
            found.update(each.attachment.node for each in queue.observed)
        return found


def forget(
    gone: Left | Forgotten, parts: Parts, tuner: ErrorTuner, decided: Leaving | None,
) -> None:
    """
    Let judge, reweighting, tuner and factors forget what has left the graph.

    Parameters
    ----------
    gone : Left or Forgotten, ids
    parts : Parts
    tuner : ErrorTuner
    decided : Leaving, optional, on the constraints; None if none of them is judged

    """
    parts.judge.forget(gone.nodes, gone.edges, gone.observed, decided)
    parts.reweighting.forget(gone.edges, gone.observed)
    tuner.forget(gone.nodes, gone.edges, gone.observed)
