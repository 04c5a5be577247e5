# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Hidden nodes: when odometry makes them, and what every source of odometry says of them.

One source of odometry leads: the samples at which a node is due are its samples, and its motion
ties each node to the one before. If it is silent for longer than the patience, another one leads
from its last sample on. Every other source ties the nodes too, at whose stamps its own samples
are interpolated; a source without samples there ties the next nodes on both sides.

Who leads from when on follows from the stamps alone, as long as the samples of all sources come
in the order of their stamps but for the reorder window: at an instant that a source has settled
all that was before it is there.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
import math
from typing import cast

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.binding import Anchor
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.constraints import EdgeKind, Edges
from pose_graph_ros.core.measurements import Answer, OdometrySample
from pose_graph_ros.core.motion import Pose, wrap_one
from pose_graph_ros.core.odometry_stream import OdometryStream, SavedStream
from pose_graph_ros.core.saved_columns import as_matrix, as_pose, Integers, Matrix, Rows3
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.unheard import unheard_motion


@dataclass(frozen=True, slots=True)
class SavedBridge:
    """Motion from the newest node to where the leading source began to lead."""

    mean: Pose
    covariance: Matrix


@dataclass(frozen=True, slots=True)
class SavedNodes:
    """The hidden nodes by stamp, and who made them."""

    stamps_ns: Integers
    """Shape (H,)."""
    rows: Integers
    """In the graph, shape (H,)."""
    odometry: Rows3
    """Where odometry alone puts them, shape (H, 3)."""
    leads: tuple[str, ...]
    """Sources of odometry that made them, one after the other ..."""
    leads_after_ns: Integers
    """... each with the stamp after which it did."""
    lead_ns: int
    base_ns: int
    base: Pose
    bridge: SavedBridge | None
    streams: Mapping[str, SavedStream]


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
        self._odometry = GrowingArray((3,), np.float64)
        self.streams: dict[str, OdometryStream] = {}
        """By the name of the source."""
        self._leads: list[tuple[int, str]] = []
        """Who leads, each with the stamp after which it does."""
        self._lead_ns = -1
        """Stamp of the newest sample at which the leading source may have made a node."""
        self._base_ns, self._base = -1, (0.0, 0.0, 0.0)
        """From there, by its pose, it says how far it is to the next node: the newest node ..."""
        self._bridge: tuple[FloatArray, FloatArray] | None = None
        """... or what was known of the motion from there when it began to lead, (3,), (3, 3)."""
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
    def lead(self) -> str:
        """Source that makes the nodes; empty before the first one."""
        return self._leads[-1][1] if self._leads else ''

    @property
    def n_leads(self) -> int:
        """How often a source began to lead."""
        return len(self._leads)

    @property
    def covered_ns(self) -> int:
        """Up to which stamp [ns] everything is settled; -1 before the first odometry."""
        return self._lead_ns

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample of the leading source [ns]."""
        return self.streams[self.lead].newest_ns if self._leads else -1

    def configure(self, config: BackendConfig) -> None:
        """
        Take other settings, for nodes and edges that are made from now on.

        The motion since the newest node makes one edge: its noise is then by the new ones.
        """
        self._config = config
        for name, stream in self.streams.items():
            stream.configure(config.odometry_source(name))

    @property
    def _patience_ns(self) -> int:
        return round(self._config.odometry_patience * 1e9)

    def take(self, sample: OdometrySample, source: str) -> Answer:
        """Take an odometry sample, and make what nodes and edges are due."""
        stream = self.streams.get(source) or self._make_stream(source)
        answer = stream.add(sample)
        self._go_on(source, stream.settle())
        return answer

    def _make_stream(self, source: str) -> OdometryStream:
        stream = OdometryStream(self._config.odometry_source(source))
        self.streams[source] = stream
        self._tied[source] = -1, 0
        return stream

    def finish(self) -> None:
        """Settle all samples: no older ones are expected any more."""
        for source, stream in list(self.streams.items()):
            self._go_on(source, stream.settle(stream.newest_ns))
        ready = [name for name in self._preferred() if self._began(name) is not None]
        if not self._leads and len(ready) > 0:
            self._begin(ready[0])
            self._tie()

    def _go_on(self, source: str, settled: Iterable[tuple[int, Pose]]) -> None:
        """Do what follows from the settled samples of a source."""
        for stamp_ns, pose in settled:
            if not self._leads:
                self._choose(stamp_ns)
            elif stamp_ns - self._lead_ns > self._patience_ns:
                self._look_for_silence(source, stamp_ns)
            if self._leads and source == self.lead and stamp_ns > self._lead_ns:
                self._extend(stamp_ns, pose)
        self._tie()

    def _preferred(self) -> list[str]:
        """Return the sources in the order in which they are to lead."""
        named = [name for name in self._config.odometry if name in self.streams]
        return named + [name for name in self.streams if name not in named]

    def _began(self, source: str) -> int | None:
        return self.streams[source].first_after(-1)

    def _choose(self, settled_ns: int) -> None:
        """
        Let a source begin to lead, as all is known up to an instant.

        The preferred one begins at once; it may be later than others, but no more than their
        patience.
        """
        preferred = self._preferred()
        first = next(iter(self._config.odometry), preferred[0])
        instants = []
        for name in preferred:
            begin_ns = self._began(name)
            if begin_ns is not None and name != first:
                begin_ns = self.streams[name].first_after(begin_ns + self._patience_ns - 1)
            if begin_ns is not None and begin_ns <= settled_ns:
                instants.append(begin_ns)
        if len(instants) > 0:
            until_ns = min(instants)
            self._begin(next(name for name in preferred
                             if (self._began(name) or until_ns + 1) <= until_ns))

    def _begin(self, source: str) -> None:
        """Make the first node."""
        stream = self.streams[source]
        first_ns = self._began(source)
        assert first_ns is not None
        for _ in stream.settle(first_ns):
            pass
        pose = stream.timeline.poses[0]
        self._leads.append((-1, source))
        self._lead_ns = self._base_ns = first_ns
        x, y, theta = pose.tolist()
        self._append(
            first_ns, self._make_node(pose.copy(), None, source), (x, y, theta), pose.copy())
        self._catch_up()

    def _look_for_silence(self, source: str, settled_ns: int) -> None:
        """Let another source lead if the one that does was silent before a settled sample."""
        lead, last_ns = self.lead, self._lead_ns
        others = [name for name in self._preferred() if name != lead]
        while True:
            # its next sample, before which it is silent
            next_ns = settled_ns if source == lead else self.streams[lead].first_after(last_ns)
            until_ns = settled_ns + 1 if next_ns is None else min(next_ns, settled_ns + 1)
            after = (self.streams[name].first_after(last_ns + self._patience_ns)
                     for name in others)
            there = [instant_ns for instant_ns in after
                     if instant_ns is not None and instant_ns < until_ns]
            if len(there) > 0:
                self._follow(last_ns, min(there))
                return
            if next_ns is None or next_ns >= settled_ns:
                return
            last_ns = next_ns

    def _follow(self, last_ns: int, instant_ns: int) -> None:
        """Let another source lead after the last sample of the one that does, now silent."""
        old = self.streams[self.lead]
        for stamp_ns, pose in old.settle(last_ns):
            self._extend(stamp_ns, pose)
        source = next(
            name for name in self._preferred() if name != self.lead
            and (self.streams[name].first_after(last_ns) or instant_ns + 1) <= instant_ns)
        stream = self.streams[source]
        for _ in stream.settle(instant_ns):
            pass
        self._tie()
        timeline, node_ns = stream.timeline, int(self.stamps_ns[-1])
        self._leads.append((last_ns, source))
        if self._bridge is None and timeline.covers(node_ns):
            self._base_ns = node_ns
        else:
            # it began later than the newest node
            begin_ns = int(timeline.stamps_ns[0])
            self._bridge = self._moved(old, min(begin_ns, last_ns))
            self._base_ns = begin_ns
            if begin_ns > last_ns:
                self._bridge = self._bridged(
                    *unheard_motion(old.timeline, last_ns, begin_ns, old.saved_ns))
        x, y, theta = timeline.pose(self._base_ns).tolist()
        self._base, self._lead_ns = (x, y, theta), last_ns
        self._catch_up()

    def put_elsewhere(self, mean: FloatArray, noise: FloatArray) -> int:
        """
        Make a node just after the newest odometry, for a robot that was put elsewhere by hand.

        All odometry is to be settled. What it tells of the motion up to there counts no more.

        Parameters
        ----------
        mean : ndarray, shape (3,)
            Where the robot is now, seen from the newest node.
        noise : ndarray, shape (3, 3)

        Returns
        -------
        row : int
            Of the new node, or -1 if it could not be made.

        """
        timeline = self.streams[self.lead].timeline
        moved = self._moved(self.streams[self.lead], self._lead_ns)[0]
        row = self._make_node(mean, covariance.information(noise), self.lead)
        if row < 0:
            return row
        x, y, theta = timeline.poses[-1].tolist()
        stamp_ns = max(self._lead_ns, int(self.stamps_ns[-1])) + 1
        self._append(stamp_ns, row, (x, y, theta), se2.compose(self.odometry[-1], moved))
        self._base_ns = self._lead_ns
        # no other source ties the place before to the one after
        for source in self.streams:
            if source != self.lead:
                self._tied[source] = -1, len(self) - 1
        return row

    def _catch_up(self) -> None:
        """Make the nodes that are due at settled samples of a source that has begun to lead."""
        source = self.lead
        timeline = self.streams[source].timeline
        begin = int(np.searchsorted(timeline.stamps_ns, self._lead_ns, side='right'))
        samples = zip(timeline.stamps_ns[begin:].tolist(), timeline.poses[begin:].tolist(),
                      strict=True)
        for stamp_ns, (x, y, theta) in list(samples):
            if stamp_ns - self._lead_ns > self._patience_ns:
                self._look_for_silence(source, stamp_ns)
            if self.lead != source:
                return  # the one that leads now has caught up
            self._extend(stamp_ns, (x, y, theta))

    def _append(self, stamp_ns: int, row: int, base: Pose, odometry: FloatArray) -> None:
        self._odometry.append_one(odometry)
        self._stamps.append_one(stamp_ns)
        self._rows.append_one(row)
        self._base_ns, self._base, self._bridge = stamp_ns, base, None
        node = len(self) - 1
        self._tied[self.lead] = node, node + 1

    def _extend(self, stamp_ns: int, pose: Pose) -> None:
        """Make a node at a settled sample of the leading source, if one is due."""
        self._lead_ns, base = stamp_ns, self._base
        if self._bridge is None and not self._config.nodes.due(
                math.hypot(pose[0] - base[0], pose[1] - base[1]),
                abs(wrap_one(pose[2] - base[2])), (stamp_ns - self._base_ns) * 1e-9):
            return
        mean, noise = self._moved(self.streams[self.lead], stamp_ns)
        row = self._make_node(mean, covariance.information(noise), self.lead)
        if row >= 0:
            self._append(stamp_ns, row, pose, se2.compose(self.odometry[-1], mean))

    def _moved(
        self, stream: OdometryStream, stamp_ns: int, *, floor: bool = True,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the motion since the newest node and its covariance."""
        motion = stream.timeline.motion(self._base_ns, stamp_ns)
        return self._bridged(motion.increment, stream.covariance(motion, floor=floor))

    def _bridged(self, mean: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Put the motion up to where the leading source began to lead before its own."""
        if self._bridge is None:
            return mean, noise
        carry = se2.adjoint(se2.inverse(mean))
        return (se2.compose(self._bridge[0], mean), carry @ self._bridge[1] @ carry.T + noise)

    def _tie(self) -> None:
        """Add the edges of the sources that do not lead."""
        if len(self.streams) == 1 or not self._leads:
            return
        stamps, lead = self.stamps_ns, self.lead
        for source, stream in self.streams.items():
            if source == lead:
                continue
            last, node = self._tied[source]
            while node < len(stamps) and stamps[node] <= stream.settled_ns:
                if stream.timeline.covers(int(stamps[node]), closely=True):
                    if last >= 0 and not stamps[last] < stream.restarted_ns <= stamps[node]:
                        motion = stream.timeline.motion(int(stamps[last]), int(stamps[node]))
                        self.edges.append((source, Edges(
                            [self.rows[last]], [self.rows[node]], [motion.increment],
                            [covariance.information(stream.covariance(motion))],
                            [EdgeKind.ODOMETRY])))
                    last = node
                node += 1
            self._tied[source] = last, node

    def lead_at(self, stamp_ns: int) -> str:
        """Return the source that led at an instant, whatever has come since."""
        return next(name for after_ns, name in reversed(self._leads) if after_ns < stamp_ns)

    def anchor(self, stamp_ns: int) -> Anchor | None:
        """
        Return a stamp as seen from the last hidden node before it; None if no odometry tells.

        The stamp is not before the first node and not after `covered_ns`. The source that led at
        that instant tells, whatever has come since.
        """
        node = int(np.searchsorted(self.stamps_ns, stamp_ns, side='right')) - 1
        node_ns, row = int(self.stamps_ns[node]), int(self.rows[node])
        stream = self.streams[self.lead_at(stamp_ns)]
        if not (stream.timeline.covers(node_ns) and stream.timeline.covers(stamp_ns)):
            return None
        motion = stream.timeline.motion(node_ns, stamp_ns)
        return Anchor(row, motion.increment, stream.covariance(motion, floor=False))

    def newest(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return motion since the newest node, its covariance, and odometry as it came."""
        stream = self.streams[self.lead]
        motion, raw = stream.newest(self._base_ns)
        return *self._bridged(motion.increment, stream.covariance(motion, floor=False)), raw


    def saved(self) -> SavedNodes:
        """Return everything but the samples away from the nodes; there is at least one node."""
        bridge = None if self._bridge is None else SavedBridge(
            as_pose(self._bridge[0]), as_matrix(self._bridge[1]))
        after_ns, leads = zip(*self._leads, strict=True)
        return SavedNodes(
            self.stamps_ns.copy(), self.rows.copy(), self.odometry.copy(),
            leads, np.array(after_ns), self._lead_ns, self._base_ns, self._base, bridge,
            {name: stream.saved(self.stamps_ns, self._tied[name])
             for name, stream in self.streams.items()})

    def restore(self, saved: SavedNodes) -> None:
        """Go on, without any nodes yet, from where saved ones were."""
        self._stamps.append(saved.stamps_ns)
        self._rows.append(saved.rows)
        self._odometry.append(saved.odometry)
        self._leads = list(zip(saved.leads_after_ns.tolist(), saved.leads, strict=True))
        self._lead_ns, self._base_ns, self._base = saved.lead_ns, saved.base_ns, saved.base
        if saved.bridge is not None:
            self._bridge = np.array(saved.bridge.mean), np.array(saved.bridge.covariance)
        for name, stream in saved.streams.items():
            self._make_stream(name).restore(stream)
            self._tied[name] = stream.tied, stream.next_to_tie
