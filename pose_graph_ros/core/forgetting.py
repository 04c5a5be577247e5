# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Hidden nodes leave the graph, and all parts of the engine forget what was on them.

By the window the oldest ones leave. Their poses are frozen where they are, and what their
constraints told stays in the graph as a prior on its oldest nodes. A fixed node, the gauge of a
graph that is not aligned with the map, is frozen with the others but stays in the graph until it
is freed: a prior of poses relative to it says nothing about where they are in the map.

By thinning, nodes leave where a place is driven often, as `window.thinning` decides.
"""

from collections.abc import Iterator
import math

import numpy as np

from pose_graph_ros.core import error_tuner, exceptions, measurements, transaction
from pose_graph_ros.core.config import BackendConfig, ThinningConfig, WindowConfig, WindowPrior
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph_update import Gone, GraphUpdate
from pose_graph_ros.core.judgement.verdicts import Verdict
from pose_graph_ros.core.odometry.node_table import NodeTable
from pose_graph_ros.core.parts import Parts
from pose_graph_ros.core.window import sparse_removal as sr, thinning as th


def n_leaving(config: WindowConfig, table: NodeTable, needed_ns: int | None = None) -> int:
    """
    Return how many of the nodes in the graph leave it: the oldest ones.

    Where a group ends depends on the nodes alone, not on when it is asked for, so the same drive
    gives the same groups, however often the graph is updated. The last node up to `needed_ns`
    stays until it is twice as old as the window.
    """
    n_kept = len(table) - table.n_frozen
    leaving = min(_beyond(config, table, 1.0), n_kept - sr.LIMITS.newest)
    if leaving > 0 and needed_ns is not None:
        at = int(np.searchsorted(table.stamps_ns, needed_ns, side='right')) - 1 - table.n_frozen
        if 0 <= at < leaving:
            leaving = max(at, min(_beyond(config, table, sr.LIMITS.longest_hold), leaving))
    return max(leaving, 0)


def _beyond(config: WindowConfig, table: NodeTable, factor: float) -> int:
    """Return how many nodes lie beyond the window times a factor, in whole groups."""
    n, first = len(table), table.n_frozen
    # as integers: stamps as floats would be rounded to 0.2 us
    since_ns, second_ns = table.stamps_ns[first:] - table.stamps_ns[0], 1e9 * config.seconds
    travelled, most = table.travelled, 0
    for places, newest, limit, group in (
            (np.arange(first, n), n, math.ceil(factor * config.nodes),
             max(math.floor(sr.LIMITS.group * config.nodes), 1)),
            (since_ns, int(since_ns[-1]), round(factor * second_ns),
             max(round(sr.LIMITS.group * second_ns), 1)),
            (travelled, float(travelled[-1]), factor * config.metres,
             sr.LIMITS.group * config.metres)):
        if limit > 0:
            begin = math.floor((newest - limit) // group) * group
            most = max(most, int(np.searchsorted(places, begin)))
    return most


class Forgetting:
    """
    Keeps the graph within its window, and at the size of the area.

    Whatever leaves, its owners are asked before (`_ask`), the solver takes the update that was
    computed from that, and if it succeeds, all owners are told the same (`_tell`).
    """

    def __init__(self, tuner: error_tuner.ErrorTuner, parts: Parts) -> None:
        self._tuner, self._parts = tuner, parts
        # pose of the oldest node in the graph, seen from the last frozen one, shape (3,), if that
        # was frozen before the graph was aligned with the map; else None
        self._joint: FloatArray | None = None
        self._rest = 0  # number of hidden nodes from which on more of them may leave
        self._thinning, self._n_made = th.Thinning(), 0
        self._work: Iterator[None] = iter(())

    def step(self, config: BackendConfig) -> None:
        """Let the nodes leave that are due, by the window and by thinning."""
        if len(self._parts.nodes) == 0 or self._parts.graph.has_touched or (
                self._parts.graph.memory.interrupted):
            return
        nodes, window = self._parts.nodes, config.window
        n = n_leaving(window, nodes) if max(window.nodes, window.seconds, window.metres) > 0 else 0
        if n > 0:
            n = n_leaving(window, nodes, self._parts.pipeline.needed_ns)
        if n > 0 and len(nodes) >= self._rest:
            try:
                self._freeze(n, window.prior)
            except exceptions.GraphUpdateError:
                self._parts.pipeline.counts['solver', 'failed'] += 1
                self._rest = len(nodes) + sr.LIMITS.rest
        self._step_of_thinning(config.thinning)

    def restored(self) -> None:
        """Tell that the parts have got a saved state."""
        nodes, parts = self._parts.nodes, self._parts
        if nodes.n_frozen > 0 and not parts.alignment.is_aligned:
            last, first = nodes.poses(parts.graph)[nodes.n_frozen - 1:nodes.n_frozen + 1]
            self._joint = se2.between(last, first)

    def _ask(self, nodes: IntArray, factors: IntArray, *,
             measured: bool) -> tuple[IntArray, list[Verdict]]:
        """
        Ask the owners of hidden nodes, and of further factors, what they must keep of them.

        With the nodes come the biases that nothing needs without them, if measurements leave, and
        what is known of the factors only until they leave. Ids are ascending.
        """
        factors = np.union1d(self._parts.graph.factors_on(nodes), factors)
        # the judge may change weights
        judged = self._parts.judge.decide_leaving(factors)
        biases = self._tuner.leaving(factors) if measured else []
        return np.union1d(nodes, biases).astype(np.int64), judged

    def _tell(self, gone: Gone, judged: list[Verdict], places: th.Places) -> None:
        """Let all owners forget what has left the graph."""
        self._parts.judge.forget(gone.nodes, gone.factors, judged)
        self._parts.reweighting.forget(gone.factors)
        self._tuner.forget(gone.nodes, gone.factors)
        self._parts.nodes.thin(*places)

    def _solve(self, update: GraphUpdate | None) -> Gone | None:
        """
        Return what has left with an update; None if there is none, or the solver fails.

        Rounding may have made an approximation invalid.
        """
        if update is None:
            return None
        nodes = np.array(update.remove_nodes, dtype=np.int64)
        with_nodes = self._parts.graph.factors_on(nodes)
        gone = Gone(nodes, np.union1d(with_nodes, update.drop).astype(np.int64))
        return gone if transaction.succeeds(self._parts.smoother, update) else None

    def _step_of_thinning(self, config: ThinningConfig) -> None:
        """Let groups of nodes leave, or of old measurements in the map, if some are due."""
        if config.cell == 0.0:
            self._work = iter(())
            return
        # a bag is replayed with many new nodes from step to step
        n_made = len(self._parts.nodes)
        new, self._n_made = max(n_made - self._n_made, 1), n_made
        for _ in range(min(new, sr.LIMITS.pieces)):
            if next(self._work, self) is self:
                self._work = self._thinned(config)
                if next(self._work, self) is self:
                    return

    def _thinned(self, config: ThinningConfig) -> Iterator[None]:
        """Yield after each change of the graph; others may have changed it before the next."""
        parts, graph = self._parts, self._parts.graph
        # a fixed node that is frozen stays in the graph, but stands for no others
        first = int(parts.nodes.ids[parts.nodes.n_frozen])
        places = self._thinning.places(
            parts.smoother, config, len(parts.nodes), self._held(), first)
        if places is None:
            return
        older = graph.node_ids[graph.is_pose][:-config.newest]
        while self._thinning.measurements_are_due(graph):
            older = older[graph.node_rows(older) >= 0]
            segment = th.next_segment(graph, older, places.nodes)
            if segment is None:
                break
            inside = np.isin(places.nodes, segment.poses)
            group = self._present(places.rows(inside), config)
            if not self._leave(group, segment.factors, measured=True):
                break
            places, older = places.rows(~inside), older[older >= segment.after]
            yield
        # others leave with their measurements
        before = places.nodes < th.first_of(th.carriers(graph))
        for chosen in th.groups(graph, self._present(places.rows(before), config)):
            group = self._present(chosen, config)
            if len(group.nodes) > 0:
                self._leave(group)
                yield
        while any(self._leave(th.NOWHERE, edges)
                  for edges in sr.crowded_edges(graph, config.newest)):
            yield
        parts.nodes.drop_samples(config.newest)
        parts.pipeline.seen.forget(parts.nodes.newest_ns - sr.LIMITS.repeated_ns)

    def _present(self, places: th.Places, config: ThinningConfig) -> th.Places:
        """Return the places, as they are now, of those nodes that may still leave."""
        there = self._parts.graph.node_rows(np.stack((places.nodes, places.anchors))) >= 0
        free = np.all(there, axis=0) & ~np.isin(places.nodes, self._held())
        return th.certain(self._parts.smoother, places.nodes[free], places.anchors[free], config)

    def _leave(self, places: th.Places, factors: IntArray = sr.NONE, *,
               measured: bool = False) -> bool:
        """Let nodes and further factors leave, few others in their place; tell if they did."""
        nodes, judged = self._ask(places.nodes, factors, measured=measured)
        gone = self._solve(sr.sparse_removal(self._parts.graph, nodes, factors))
        if gone is not None:
            self._tell(gone, judged, places)
        return gone is not None

    def _held(self) -> IntArray:
        """Return the ids of nodes that do not leave, as something is to be added to them."""
        waiting = (*self._parts.pipeline.queue, *self._parts.quarantine)
        return np.array([node for each in waiting for node in each.nodes], dtype=np.int64)

    def _freeze(self, n: int, prior: WindowPrior) -> None:
        """Let the n oldest nodes leave, with a dense or a sparse prior instead."""
        parts, graph, nodes = self._parts, self._parts.graph, self._parts.nodes
        first = nodes.n_frozen + n
        # the oldest one that stays may have been thinned out
        rows = graph.node_rows(nodes.ids[first:])
        row = int(rows[rows >= 0][0])
        # fixed ones of before may have been freed meanwhile
        leaving = graph.node_ids[:row][graph.is_pose[:row] & ~graph.fixed[:row]]
        if self._joint is not None and parts.alignment.is_aligned:
            # join the path from before the alignment to the graph again, once: the angle at which
            # it was moved into the map was a first guess, which is better known by now
            last = se2.compose(nodes.recent_poses(graph)[0], se2.inverse(self._joint))
            self._joint = None
            nodes.move_frozen(se2.compose(last, se2.inverse(nodes.frozen[-1])))
        leaving, judged = self._ask(leaving, sr.NONE, measured=True)
        parts.smoother.linearize(leaving)
        # anchors of thinned nodes that leave have a place in others
        poses, thinned = nodes.recent_poses(graph), nodes.places()
        anchors, numbers = thinned['anchors'], thinned['numbers']
        leave = np.unique(anchors[(anchors < first) & (numbers >= first)])
        kept = np.setdiff1d(np.arange(first, len(nodes)), numbers)
        ends, starts = graph.poses_of(nodes.ids[leave]), graph.poses_of(nodes.ids[kept])
        nearest = [int(np.argmin(np.hypot(*(starts[:, :2] - end[:2]).T))) for end in ends]
        places = th.Places.now(parts.smoother, nodes.ids[leave], nodes.ids[kept[nearest]])
        gone = None if prior is WindowPrior.DENSE else self._solve(
            sr.sparse_marginalization(graph, leaving))
        if gone is None:
            gone = parts.smoother.forget(leaving)
        self._tell(gone, judged, places)
        nodes.forget(poses[:n])
        if not parts.alignment.is_aligned:
            self._joint = se2.between(poses[n - 1], poses[n])
        parts.alignment.forget()
        parts.pipeline.seen.forget(nodes.last_frozen_ns)
        # constraints that were to be added to nodes that have left
        left = {*leaving.tolist()}
        for queue in (parts.pipeline.queue, parts.quarantine):
            lost = [each for each in queue if not left.isdisjoint(each.nodes)]
            queue[:] = [each for each in queue if left.isdisjoint(each.nodes)]
            for each in lost:
                parts.pipeline.count(each.source, measurements.rejected(
                    'before_window', 'its hidden node left the graph before it was added'))
