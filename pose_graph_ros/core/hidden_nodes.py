# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Hidden nodes: when odometry makes them, and what every source of odometry says of them.

One source of odometry leads: the samples at which a node is due are its samples, and its motion
ties each node to the one before. If it falls so far behind another one that it must be silent,
that one leads from there on. Every other source ties the nodes too, at whose stamps its own
samples are interpolated; a source without samples there ties the next nodes on both sides.
"""

from collections.abc import Callable, Iterator
import math
from typing import cast

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.binding import Anchor
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.constraints import EdgeKind, Edges
from pose_graph_ros.core.measurements import Answer, OdometrySample
from pose_graph_ros.core.motion import Motion
from pose_graph_ros.core.odometry_stream import LOOSE, OdometryStream
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.sources import OdometrySource

# A source says nothing of an instant between two samples that are further apart [ns].
LARGEST_GAP_NS = 1_000_000_000

MakeNode = Callable[[FloatArray, FloatArray | None, str], int]
"""Takes the pose of the first node, or pose and information of an edge; returns the row or -1."""


class HiddenNodes:
    """
    The hidden nodes by stamp, and the odometry that makes them.

    Parameters
    ----------
    config : BackendConfig
    make_node : callable
        Takes the mean of the edge to a new node, shape (3,), its information, shape (3, 3), and
        the name of the source; for the first node its pose and None. Returns the row of the node
        in the graph, or -1 if there is none: it is then tried again at the next sample.

    """

    def __init__(self, config: BackendConfig, make_node: MakeNode) -> None:
        self._config = config
        self._make_node = make_node
        self._stamps = GrowingArray((), np.int64)
        self._rows = GrowingArray((), np.int64)
        self._drivers = GrowingArray((), np.int64)
        self._odometry = GrowingArray((3,), np.float64)
        self.streams: dict[str, OdometryStream] = {}
        """By the name of the source."""
        self.lead = ''
        """Source that makes the nodes; empty before the first odometry."""
        self._base = np.zeros(3)
        """Its pose at the newest node."""
        self._tied: dict[str, tuple[int, int]] = {}
        """For each source the newest node that it ties (-1: none), and the next to look at."""
        self.edges: list[tuple[str, Edges]] = []
        """By other sources than the leading one; whoever takes them empties the list."""

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps_ns(self) -> IntArray:
        """Stamps of the hidden nodes [ns], a read-only view."""
        return cast('IntArray', self._stamps.read_only)

    @property
    def rows(self) -> IntArray:
        """Their rows in the graph, a read-only view."""
        return cast('IntArray', self._rows.read_only)

    @property
    def odometry(self) -> FloatArray:
        """Where odometry alone puts the nodes, shape (N, 3), a read-only view."""
        return cast('FloatArray', self._odometry.read_only)

    @property
    def covered_ns(self) -> int:
        """Up to which stamp [ns] everything is settled; -1 before the first odometry."""
        return self.streams[self.lead].settled_ns if self.lead != '' else -1

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample of the leading source [ns]."""
        return self.streams[self.lead].newest_ns if self.lead != '' else -1

    def take(self, sample: OdometrySample, source: str) -> Answer:
        """Take an odometry sample, and make what nodes and edges are due."""
        stream = self.streams.get(source)
        if stream is None:
            stream = OdometryStream(self._config.odometry.get(source, OdometrySource()))
            self.streams[source] = stream
            self._tied[source] = -1, 0
        answer = stream.add(sample)
        self._grow(source, stream.settle())
        return answer

    def finish(self) -> None:
        """Settle all samples: no older ones are expected any more."""
        for source, stream in self.streams.items():
            self._grow(source, stream.settle(everything=True))
        ready = [name for name in self._preferred()
                 if name in self.streams and self.streams[name].settled_ns >= 0]
        if self.lead == '' and len(ready) > 0:
            self._begin(ready[0])
            self._tie()

    def _grow(self, source: str, settled: Iterator[int]) -> None:
        for stamp_ns in settled:
            if source == self.lead:
                self._extend(stamp_ns)
        stream = self.streams[source]
        patience_ns = round(self._config.odometry_patience * 1e9)
        if stream.settled_ns < 0:
            return
        if self.lead == '':
            # the preferred source may be a little later than others
            if source == self._preferred()[0] or (
                    stream.settled_ns - stream.timeline.stamps_ns[0] >= patience_ns):
                self._begin(source)
        elif source != self.lead and stream.settled_ns > self.newest_ns + patience_ns:
            self._follow(source)
        self._tie()

    def _preferred(self) -> list[str]:
        """Return the sources in the order in which they are to lead."""
        named = [name for name in self._config.odometry if name in self.streams]
        others = [name for name in self.streams if name not in named]
        first = [name for name in self._config.odometry if name not in self.streams][:1]
        return sorted(named + first, key=list(self._config.odometry).index) + others

    def _begin(self, source: str) -> None:
        """Make the first node; a source begins to lead."""
        self.lead, timeline = source, self.streams[source].timeline
        first_ns = int(timeline.stamps_ns[0])
        pose = timeline.pose(first_ns)
        self._append(first_ns, self._make_node(pose, None, source), pose, pose)
        self._catch_up()

    def _catch_up(self) -> None:
        """Make the nodes that are due at settled samples after the newest node."""
        stamps = self.streams[self.lead].timeline.stamps_ns.copy()
        for stamp_ns in stamps[np.searchsorted(stamps, self.stamps_ns[-1], side='right'):]:
            self._extend(int(stamp_ns))

    def _append(
        self, stamp_ns: int, row: int, base: FloatArray, odometry: FloatArray,
    ) -> None:
        self._odometry.append_one(odometry)
        self._stamps.append_one(stamp_ns)
        self._rows.append_one(row)
        self._drivers.append_one(list(self.streams).index(self.lead))
        self._base = base
        node = len(self) - 1
        self._tied[self.lead] = node, node + 1

    def _extend(self, stamp_ns: int) -> None:
        """Make a node at a settled sample of the leading source, if one is due."""
        stream = self.streams[self.lead]
        pose, last_ns = stream.timeline.pose(stamp_ns), int(self.stamps_ns[-1])
        difference = pose - self._base
        if not self._config.nodes.due(
                math.hypot(difference[0], difference[1]), abs(float(se2.wrap(difference[2]))),
                (stamp_ns - last_ns) * 1e-9):
            return
        motion = stream.timeline.motion(last_ns, stamp_ns)
        self._make(stamp_ns, motion.increment, stream.covariance(motion), pose)

    def _make(
        self, stamp_ns: int, mean: FloatArray, noise: FloatArray, base: FloatArray,
    ) -> None:
        row = self._make_node(mean, covariance.information(noise), self.lead)
        if row >= 0:
            self._append(stamp_ns, row, base, se2.compose(self.odometry[-1], mean))

    def _follow(self, source: str) -> None:
        """Let another source lead: the one that did is silent."""
        old = self.streams[self.lead]
        for stamp_ns in old.settle(everything=True):
            self._extend(stamp_ns)
        self._tie()
        self.lead, timeline = source, self.streams[source].timeline
        last_ns = int(self.stamps_ns[-1])
        if timeline.covers(last_ns):
            self._base = timeline.pose(last_ns)
        else:
            # it began later: what was in between is not known
            begin_ns = int(timeline.stamps_ns[0])
            motion = old.timeline.motion(last_ns, old.settled_ns)
            time = (begin_ns - old.settled_ns) * 1e-9
            loose = np.array((LOOSE[0] + time, LOOSE[0] + time, LOOSE[1] + 0.1 * time))
            self._make(begin_ns, motion.increment, old.covariance(motion) + np.diag(loose**2),
                       timeline.pose(begin_ns))
        self._catch_up()

    def _tie(self) -> None:
        """Add the edges of the sources that do not lead."""
        if len(self.streams) == 1:
            return
        stamps = self.stamps_ns
        for source, stream in self.streams.items():
            if source == self.lead:
                continue
            last, node = self._tied[source]
            while node < len(stamps) and stamps[node] <= stream.settled_ns:
                if stream.timeline.covers(int(stamps[node]), LARGEST_GAP_NS):
                    if last >= 0:
                        motion = stream.timeline.motion(int(stamps[last]), int(stamps[node]))
                        self.edges.append((source, Edges(
                            [self.rows[last]], [self.rows[node]], [motion.increment],
                            [covariance.information(stream.covariance(motion))],
                            [EdgeKind.ODOMETRY])))
                    last = node
                node += 1
            self._tied[source] = last, node

    def anchor(self, stamp_ns: int) -> Anchor | None:
        """
        Return a stamp as seen from the last hidden node before it; None if no odometry tells.

        The stamp is not before the first node and not after `covered_ns`.
        """
        node = int(np.searchsorted(self.stamps_ns, stamp_ns, side='right')) - 1
        node_ns, row = int(self.stamps_ns[node]), int(self.rows[node])
        names = list(self.streams)
        # who made the next node knows the motion to it; after the newest node it is who leads
        candidates = [self.lead if node + 1 == len(self)
                      else names[self._drivers.values[node + 1]]]
        candidates += [name for name in names if name not in candidates]
        for name in candidates:
            stream = self.streams[name]
            if stream.timeline.covers(node_ns) and stream.timeline.covers(stamp_ns):
                motion = stream.timeline.motion(node_ns, stamp_ns)
                return Anchor(row, motion.increment, stream.covariance(motion, floor=False))
        return None

    def newest(self) -> tuple[Motion, FloatArray, FloatArray]:
        """Return motion since the newest node, its covariance, and odometry as it came."""
        stream = self.streams[self.lead]
        motion, raw = stream.newest(int(self.stamps_ns[-1]))
        return motion, stream.covariance(motion, floor=False), raw
