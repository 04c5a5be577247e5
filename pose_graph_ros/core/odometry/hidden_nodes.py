# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Hidden nodes, which are made from odometry alone.

Of several sources the primary one makes the nodes; the others add edges. The preferred source
becomes the primary one unless it begins later than another by more than the patience. A primary
source that is silent for longer than the patience is replaced by the most preferred source that
has samples then. The choice depends on the stamps alone if all sources deliver samples in the
order of stamps, up to the reorder window: when one source settles a stamp, the earlier samples of
all sources are known.
"""

from collections.abc import Callable, Iterable
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Pose, Poses, wrap_one
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.measurements import Answer, OdometrySample
from pose_graph_ros.core.odometry.motion import Attachment, Motion, OdometryErrors, Span
from pose_graph_ros.core.odometry.node_table import NodeTable, SavedNodes
from pose_graph_ros.core.odometry.stream import find_silence, NEVER, OdometryStream
from pose_graph_ros.core.odometry.timeline import next_row, OdometryTimeline
from pose_graph_ros.core.saved_columns import as_pose


class NewNode(NamedTuple):
    """A hidden node that odometry makes, as the motion from the one before."""

    mean: FloatArray  # the motion, or the pose of the first node, shape (3,)
    information: FloatArray | None  # shape (3, 3); None for the first one
    source: str
    stamp_ns: int = -1  # of the node [ns]
    moving: float = 0.0  # for how long the calibration of the source acts on it [s]; 0 without


class HiddenNodes(NodeTable):
    """
    The hidden nodes by stamp, and the odometry that makes them.

    A settled sample of the primary source (see `stream`) makes a node if one is due by the node
    policy, with an edge from the node before. The other sources add edges between them.

    `make_node` returns the id of a new node in the graph, or -1 if there is none: it is then tried
    again at the next sample.
    """

    def __init__(self, config: BackendConfig, make_node: Callable[[NewNode], int]) -> None:
        super().__init__()
        self._make_node = make_node
        self.streams: dict[str, OdometryStream] = {}  # by the name of the source
        # stamp after which a source is the primary one [ns], and its name, by stamp
        self._primaries: list[tuple[int, str]] = []
        self.n_primaries = 0  # number of times that a source became the primary one
        # stamp of the newest sample of the primary source that was checked for a node [ns]: up to
        # there everything is settled; -1 before the first odometry
        self.covered_ns = -1
        # stamp and odometry pose from which the motion to the next node is measured
        self._base_ns, self._base = -1, (0.0, 0.0, 0.0)
        # motion from the newest node to `_base_ns`, where the primary source has no sample as old
        # as that node; else None
        self._span: Span | None = None
        self._secondary: list[tuple[str, Factors]] = []  # edges not yet taken, with their sources
        # stamp before which samples may have been dropped as nodes were thinned out [ns]
        self._samples_since_ns = -1
        # of the primary odometry, which the edges to new nodes know of
        self.errors = OdometryErrors()
        self.relocated: set[int] = set()  # numbers of the nodes at which the robot was put by hand
        self.configure(config)

    @property
    def relocated_ids(self) -> IntArray:
        """Ids of the nodes at which the robot was put by hand; no odometry leads to them."""
        return self.ids[np.array(sorted(self.relocated), dtype=np.int64)]

    def poses(self, graph: Graph) -> Poses:
        """Return the poses of all hidden nodes: frozen ones, then the graph's."""
        return np.concatenate((self.frozen, self.recent_poses(graph)))

    def recent_poses(self, graph: Graph) -> Poses:
        """Return the poses of the hidden nodes that are not frozen."""
        return self.placed(graph.poses[graph.node_rows(self.ids[self.n_frozen:])])

    @property
    def primary(self) -> str:
        """Source that makes the nodes; empty before the first one."""
        return self._primaries[-1][1] if self._primaries else ''

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample of the primary source [ns]; -1 before the first."""
        return self.streams[self.primary].newest_ns if self._primaries else -1

    def configure(self, config: BackendConfig) -> None:
        """Set the settings for nodes and edges from now on; the next one has the new noise."""
        self._config, self._patience_ns = config, round(config.odometry_patience * 1e9)
        for name, stream in self.streams.items():
            stream.configure(config.odometry_source(name))

    @property
    def _names(self) -> list[str]:
        """Names of all sources: those that are configured in their order, then the others."""
        named = [name for name in self._config.odometry if name in self.streams]
        return named + [name for name in self.streams if name not in named]

    def add_sample(self, sample: OdometrySample, source: str) -> Answer:
        """Return the answer to a sample of a source, after making what is due."""
        if source not in self.streams:
            self.streams[source] = OdometryStream(self._config.odometry_source(source))
        stream = self.streams[source]
        answer = stream.add(sample)
        self._process(source, stream.settle())
        return answer

    def finish(self) -> None:
        """Settle all samples, and make the nodes and edges that are due."""
        for source, stream in list(self.streams.items()):
            self._process(source, stream.settle(stream.newest_ns))
        ready = [name for name in self._names if self.streams[name].first_after(-1) < NEVER]
        if not self._primaries and len(ready) > 0:
            self._make_first_node(ready[0])

    def take_secondary_edges(self) -> list[tuple[str, Factors]]:
        """Return the new edges of the other sources with their sources' names; forget them."""
        self._add_secondary_edges()
        edges, self._secondary = self._secondary, []
        return edges

    def _process(self, source: str, settled: Iterable[tuple[int, Pose]]) -> None:
        """Make the nodes and edges that are due after settling samples of a source."""
        for stamp_ns, pose in settled:
            if not self._primaries:
                self._choose_first(stamp_ns)
            elif stamp_ns - self.covered_ns > self._patience_ns:
                self._replace_silent_primary(source, stamp_ns)
            if self._primaries and source == self.primary and stamp_ns > self.covered_ns:
                self._extend(stamp_ns, pose)

    def _choose_first(self, settled_ns: int) -> None:
        """Choose the first primary source, and make the first node, unless it is too early."""
        names, ready_ns = self._names, NEVER
        preferred = next(iter(self._config.odometry), names[0])
        for name in names:
            begin_ns = self.streams[name].first_after(-1)
            if name != preferred:
                begin_ns = self.streams[name].first_after(begin_ns + self._patience_ns - 1)
            ready_ns = min(ready_ns, begin_ns)
        if ready_ns <= settled_ns:
            self._make_first_node(self._first_with_sample(names, -1, ready_ns))

    def _first_with_sample(self, names: list[str], after_ns: int, until_ns: int) -> str:
        """Return the first source with a sample in (after_ns, until_ns]; one at least has one."""
        return next(name for name in names if self.streams[name].first_after(after_ns) <= until_ns)

    def _make_first_node(self, source: str) -> None:
        """Make a source the primary one, and the first node at its first sample."""
        stream = self.streams[source]
        first_ns = stream.first_after(-1)
        list(stream.settle(first_ns))
        pose = stream.timeline.poses[0]
        self._set_primary(-1, source)
        self.covered_ns = self._base_ns = first_ns
        self._append(first_ns, self._make_node(NewNode(pose.copy(), None, source)),
                     as_pose(pose), pose.copy())
        self._catch_up()

    def _set_primary(self, after_ns: int, source: str) -> None:
        self._primaries.append((after_ns, source))
        self.n_primaries += 1

    def _replace_silent_primary(self, source: str, settled_ns: int) -> None:
        """Replace the primary source if it was silent before a settled sample of a source."""
        others = [name for name in self._names if name != self.primary]
        silence = find_silence(self.streams, [self.primary, *others],
                               self.covered_ns, (source, settled_ns), self._patience_ns)
        if silence is None:
            return
        # another source makes the nodes after the last sample before the silence
        old, (last_ns, known_ns) = self.streams[self.primary], silence
        for stamp_ns, pose in old.settle(last_ns):
            self._extend(stamp_ns, pose)
        source = self._first_with_sample(others, last_ns, known_ns)
        stream = self.streams[source]
        list(stream.settle(known_ns))
        self._add_secondary_edges()
        timeline, node_ns = stream.timeline, int(self.stamps_ns[-1])
        self._set_primary(last_ns, source)
        if self._span is None and timeline.covers(node_ns):
            self._base_ns = node_ns
        else:
            # the new primary source has no sample at the newest node
            begin_ns = int(timeline.stamps_ns[0])
            self._span = self._since_node(
                old, old.timeline.motion(self._base_ns, min(begin_ns, last_ns)))
            self._base_ns = begin_ns
            if begin_ns > last_ns:
                self._span = self._span.continued(
                    *old.timeline.gap_motion(last_ns, begin_ns, old.saved_ns))
        self._base, self.covered_ns = as_pose(timeline.pose(self._base_ns)), last_ns
        self._catch_up()

    def relocate(self, mean: FloatArray, noise: FloatArray) -> int:
        """
        Make a node 1 ns after the newest odometry, for a robot that was moved by hand.

        All odometry must be settled. The motion by odometry since the newest node is not used, but
        the pose of the robot in it, with its covariance in the frame at the end. Returns the id of
        the new node in the graph, or -1 if it could not be made.
        """
        stream = self.streams[self.primary]
        timeline = stream.timeline
        moved = self._since_node(stream, timeline.motion(self._base_ns, self.covered_ns))[0]
        node = self._make_node(NewNode(mean, covariance.information(noise), self.primary))
        if node < 0:
            return node
        stamp_ns = max(self.covered_ns, int(self.stamps_ns[-1])) + 1
        self.relocated.add(len(self))
        self._append(
            stamp_ns, node, as_pose(timeline.poses[-1]), se2.compose(self.odometry[-1], moved))
        self._base_ns = self.covered_ns
        # no secondary edge spans the step to the new pose
        for source, other in self.streams.items():
            if source != self.primary:
                other.tie_from(len(self) - 1, reached=False)
        return node

    def _catch_up(self) -> None:
        """Make the nodes that are due at the settled samples of a new primary source."""
        timeline = self.streams[self.primary].timeline
        begin = int(np.searchsorted(timeline.stamps_ns, self.covered_ns, side='right'))
        self._process(self.primary, list(zip(timeline.stamps_ns[begin:].tolist(),
                                             map(as_pose, timeline.poses[begin:]), strict=True)))

    def _append(self, stamp_ns: int, node: int, base: Pose, odometry: FloatArray) -> None:
        self.append(stamp_ns, node, odometry)
        self._base_ns, self._base, self._span = stamp_ns, base, None
        self.streams[self.primary].tie_from(len(self) - 1, reached=True)

    def _extend(self, stamp_ns: int, pose: Pose) -> None:
        """Make a node at a settled sample of the primary source, if one is due."""
        self.covered_ns, base = stamp_ns, self._base
        if self._span is None and not self._config.nodes.due(
                math.hypot(pose[0] - base[0], pose[1] - base[1]),
                abs(wrap_one(pose[2] - base[2])), (stamp_ns - self._base_ns) * 1e-9):
            return
        stream = self.streams[self.primary]
        motion = stream.timeline.motion(self._base_ns, stamp_ns)
        by_odometry = self._since_node(stream, motion)
        mean, noise = self._corrected(by_odometry, stamp_ns)
        node = self._make_node(NewNode(mean, covariance.information(noise),
                                       self.primary, stamp_ns, self._moving(motion, stamp_ns)))
        if node >= 0:
            self._append(stamp_ns, node, pose, se2.compose(self.odometry[-1], by_odometry.mean))

    def _moving(self, motion: Motion, stamp_ns: int) -> float:
        """
        Return for how long its calibration acts on the motion from `_base_ns` to a stamp [s].

        It does not while the robot stands, nor where the motion since the newest node is not that
        of the primary source alone; 0 without one.
        """
        if (self._span is not None or motion.distance == motion.turn == 0.0
                or not self._config.odometry_source(self.primary).calibrate):
            return 0.0
        return self.streams[self.primary].timeline.moving(self._base_ns, stamp_ns)

    def _corrected(self, motion: Span, stamp_ns: int) -> Span:
        """Return a motion from the newest node to a stamp [ns] that knows of its errors."""
        if self.errors == OdometryErrors():
            return motion
        seconds = np.array([(stamp_ns - int(self.stamps_ns[-1])) * 1e-9])
        return Span(self.errors.motions(motion.mean[None], seconds)[0],
                    self.errors.covariances(motion.covariance[None])[0])

    def _since_node(self, stream: OdometryStream, motion: Motion, *, floor: bool = True) -> Span:
        """Return a motion from `_base_ns` on as one from the newest node, and its covariance."""
        then = Span(motion.increment, stream.covariance(motion, floor=floor))
        return then if self._span is None else self._span.continued(*then)

    def _add_secondary_edges(self) -> None:
        if len(self.streams) == 1 or not self._primaries:
            return
        for source, stream in self.streams.items():
            if source != self.primary:
                self._secondary += [
                    (source, edge) for edge in stream.secondary_edges(self.stamps_ns, self.ids)]

    def primary_at(self, stamp_ns: int) -> str:
        """Return the source that was the primary one at a stamp [ns]."""
        return next((name for after_ns, name in reversed(self._primaries) if after_ns < stamp_ns),
                    self._primaries[0][1])

    def attach(self, stamp_ns: int) -> Attachment | None:
        """
        Return the last hidden node before a stamp and the motion from there to the stamp.

        If that node has left the graph, it is its anchor, or the next node, from which the motion
        leads back. The motion is that of the source that was the primary one then, so the result
        does not depend on later samples; None if that source does not cover the node and the
        stamp. The stamp is not before the first node or `last_frozen_ns`, and not after
        `covered_ns` [ns].
        """
        node = int(np.searchsorted(self.stamps_ns, stamp_ns, side='right')) - 1
        node = max(node, self.n_frozen)
        node_ns = int(self.stamps_ns[node])
        stream = self.streams[self.primary_at(max(stamp_ns, node_ns))]
        if node_ns <= stamp_ns < self._samples_since_ns:
            # to before the next node, without the samples there
            first = next_row(None, node_ns, as_pose(self.odometry[node - self.n_frozen]))
            after = next_row(first, int(self.stamps_ns[node + 1]),
                             as_pose(self.odometry[node + 1 - self.n_frozen]))
            motion = OdometryTimeline((first, after)).motion(node_ns, stamp_ns)
            return self.attachment(node, motion.increment, stream.covariance(motion, floor=False))
        if not (stream.timeline.covers(node_ns) and stream.timeline.covers(stamp_ns)):
            return None
        motion = stream.timeline.motion(min(node_ns, stamp_ns), max(node_ns, stamp_ns))
        mean, noise = motion.increment, stream.covariance(motion, floor=False)
        if stamp_ns < node_ns:
            adjoint = se2.adjoint(mean)
            mean, noise = se2.inverse(mean), adjoint @ noise @ adjoint.T
        return self.attachment(node, mean, noise)

    def attach_ahead(self, stamp_ns: int) -> Attachment | None:
        """Return the newest node and the motion to a later stamp [ns], settled or not."""
        stream = self.streams[self.primary]
        motion = stream.motion_ahead(self._base_ns, stamp_ns)
        return None if motion is None else Attachment(
            int(self.ids[-1]), *self._since_node(stream, motion, floor=False))

    def drop_samples(self, newest: int) -> None:
        """
        Drop the samples before the newest nodes; `newest` is the number of these.

        The motion from an older node is interpolated between that node and the next one.
        """
        if self.n_thinned == 0 or len(self) - newest <= self.n_frozen:
            return
        since_ns = int(self.stamps_ns[-newest])
        for stream in self.streams.values():
            # the next edge of the source begins there
            stream.forget(since_ns if stream.tied < 0
                          else min(since_ns, int(self.stamps_ns[stream.tied])))
        self._samples_since_ns = since_ns

    def forget(self, poses: FloatArray) -> None:
        """Freeze the oldest nodes at poses, shape (M, 3), as they have left; drop their past."""
        self.freeze(poses)
        first, last_ns = self.n_frozen, self.last_frozen_ns
        for stream in self.streams.values():
            stream.forget(last_ns)
            if stream.tied < first:   # no edge begins at a node that has left
                stream.tie_from(max(stream.next_to_tie, first), reached=False)
        n_old = sum(after_ns < last_ns for after_ns, _ in self._primaries) - 1
        del self._primaries[:max(n_old, 0)]

    def newest(self, calibration: OdometryErrors) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Return the motion from the newest node to the newest sample, and its covariance at its end.

        Third comes the newest pose of the primary source as received, shape (3,) [m, m, rad].
        `calibration` has the constant errors that the graph knows of beside `errors`.
        """
        stream = self.streams[self.primary]
        newest_ns = max(self.newest_ns, int(self.stamps_ns[-1]))
        motion, raw = stream.newest(self._base_ns)
        mean, noise = self._corrected(self._since_node(stream, motion, floor=False), newest_ns)
        moving = self._moving(motion, newest_ns)
        if moving > 0.0:
            mean = calibration.motions(mean[None], np.array([moving]))[0]
        return mean, noise, raw

    def saved(self) -> SavedNodes:
        """Return the state, with the odometry samples that are needed; there must be a node."""
        needed_ns = self.stamps_ns[max(self.n_frozen - 1, 0):]
        return SavedNodes(
            self.stamps_ns.copy(), self.ids.copy(), self.odometry.copy(),
            tuple(self._primaries), self.covered_ns, self._base_ns, self._base, self._span,
            {name: stream.saved(needed_ns) for name, stream in self.streams.items()},
            self.frozen.copy(), float(self.travelled[0]), self.places(),
            self.errors, np.array(sorted(self.relocated), dtype=np.int64))

    def restore(self, saved: SavedNodes) -> None:
        """Set the state of this empty object to a saved one."""
        self.fill(saved)
        for lead in saved.leads:
            self._set_primary(*lead)
        self.covered_ns, self._base_ns, self._base = saved.lead_ns, saved.base_ns, saved.base
        self._span = saved.bridge
        for name, stream in saved.streams.items():
            self.streams[name] = OdometryStream(self._config.odometry_source(name))
            self.streams[name].restore(stream)
        self.relocated = {*saved.relocated.tolist()}
        self.errors = saved.errors
        if self.n_thinned > 0:
            self._samples_since_ns = int(self.streams[self.primary].timeline.stamps_ns[0])
