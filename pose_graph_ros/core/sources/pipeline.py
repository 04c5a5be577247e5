# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a received measurement to a constraint in the queue, in any order of stamps."""

from collections import Counter, deque
from collections.abc import Iterator

import numpy as np

from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.measurements import (
    Absolute,
    ACCEPTED,
    Answer,
    AnswerStatus,
    Fix,
    HeadingOnly,
    LoopClosure,
    Measurement,
    PoseMeasurement,
    rejected,
    value_defect,
    YawRate,
)
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.odometry.turns import Gyros
from pose_graph_ros.core.sources.constraint_queue import AttachedMeasurement, Queue, QueuedEdge
from pose_graph_ros.core.sources.measurement_constraints import (
    absolute_constraint,
    attach,
    attach_reference,
    loop_closure_constraint,
)
from pose_graph_ros.core.sources.validation import validate
from pose_graph_ros.core.sources.waiting import (
    due_ns,
    MAX_WAITING,
    SeenStamps,
    WaitingMeasurements,
)

# Maximum number of measurements that wait for the alignment; the oldest are dropped.
MOST_UNALIGNED = 5000
# Number of refused loop closures that are remembered.
MOST_REFUSED = 1000


class MeasurementPipeline:
    """
    Measurements between their arrival and the update that adds them to the graph.

    A measurement is validated by the policy of its source, waits until odometry has reached its
    stamp, and is attached to the hidden node before that stamp. Its outcome is counted.

    Parameters
    ----------
    nodes : HiddenNodes, what measurements are attached to

    """

    def __init__(self, nodes: HiddenNodes, config: BackendConfig) -> None:
        self._nodes, self._config = nodes, config
        self.gyros = Gyros(nodes, config)
        """Yaw rates, from which rotations between the hidden nodes are made."""
        self.waiting = WaitingMeasurements()
        """Measurements that wait for odometry to reach their stamps."""
        self.seen = SeenStamps()
        """Stamps of the measurements that were accepted or wait."""
        self.queue = Queue()
        """Constraints for the next update."""
        self.counts: Counter[tuple[str, str]] = Counter()
        """How often each source got each answer: (source, 'accepted' or the reason)."""
        self.refusals: dict[tuple[str, str], str] = {}
        """Detail of the newest refusal by source and reason."""
        self.refused_closures = deque[tuple[str, int, int | None]](
            maxlen=MOST_REFUSED)
        """Source and stamps [ns] of the newest loop closures that could not be attached."""

    def configure(self, config: BackendConfig) -> None:
        """Set the settings for later measurements."""
        self._config = config
        self.gyros.configure(config)

    def add(self, measurement: Measurement, source: str) -> Answer:
        """Return the answer to a measurement that is added, after counting it."""
        if isinstance(measurement, YawRate):
            answer = self.count(source, self.gyros.add(measurement, source))
            self._take_turns()
            return answer
        return self.count(source, self._add(measurement, source))

    def finish(self) -> None:
        """Settle all odometry and yaw rates, without waiting for older ones."""
        self._nodes.finish()
        self.gyros.finish()

    def _take_turns(self) -> None:
        """Make the rotations that are due, and count what happened to the rates."""
        gyros = self.gyros
        gyros.extend()
        self.queue.turns += gyros.new
        gyros.new.clear()
        self.counts.update(gyros.counts)
        gyros.counts.clear()
        for source, stream in gyros.streams.items():
            for reason, count in (('sorted', stream.n_sorted),
                                  ('stamp_ahead', stream.n_dropped)):
                if count > 0:
                    self.counts[source, reason] = count

    def _add(self, measurement: PoseMeasurement, source: str) -> Answer:
        settings = self._config.measurement_source(source, type(measurement))
        validated = validate(measurement, settings.covariance)
        if isinstance(validated, Answer):
            return validated
        checked = validated.measurement
        if self.seen.has(source, checked):
            return rejected('duplicate_stamp', f'{source} at {1e-9 * checked.stamp_ns:.3f} s was '
                                               'received before')
        if settings.minimum_period > 0.0 and self.seen.near(
                source, checked.stamp_ns, round(settings.minimum_period * 1e9)):
            return rejected('thinned', f'less than {settings.minimum_period} s from another')
        answer = (self._attach(checked, source) if due_ns(checked) <= self._nodes.covered_ns
                  else self._wait(checked, source))
        if answer.status is not AnswerStatus.REJECTED:
            self.seen.add(source, checked)
            for repair in validated.repairs:
                self.counts[source, repair] += 1
        return answer

    def _wait(self, measurement: PoseMeasurement, source: str) -> Answer:
        """Let a measurement wait for odometry; if too many wait, drop the one due last."""
        excess = self.waiting.push(source, measurement)
        if excess is not None:
            answer = rejected('too_many_pending', f'{MAX_WAITING} measurements wait for odometry')
            if excess.measurement is measurement:
                return answer
            self.count(excess.source, answer)
            self.seen.remove(excess.source, excess.measurement)
        return Answer(AnswerStatus.PENDING, 'pending', 'waits for odometry to reach its stamp')

    def attach_due(self) -> None:
        """Attach the measurements whose stamps odometry has reached, and make rotations."""
        if len(self.gyros.streams) > 0:
            self._take_turns()
        if len(self.waiting) > 0:
            for waiting in self.waiting.pop_due(self._nodes.covered_ns):
                self.count(waiting.source, self._attach(waiting.measurement, waiting.source))

    def _attach(self, measurement: PoseMeasurement, source: str) -> Answer:
        """Queue the constraint of a measurement whose stamp odometry has reached."""
        answer = self._try_to_attach(measurement, source)
        if answer.status is AnswerStatus.REJECTED and isinstance(measurement, LoopClosure):
            self.refused_closures.append((source, measurement.stamp_ns, measurement.reference_ns))
        return answer

    def _try_to_attach(self, measurement: PoseMeasurement, source: str) -> Answer:
        attachment = attach(self._nodes, measurement.stamp_ns)
        if isinstance(attachment, Answer):
            return attachment
        if isinstance(measurement, Fix):
            # the last step: only a fix that nothing else is wrong with may become the datum
            measurement = measurement.placed()
            if (defect := value_defect(measurement.position)) is not None:
                return rejected(defect, f'Fix: {measurement.position.tolist()} m from the datum')
        if not isinstance(measurement, LoopClosure):
            self._enqueue(measurement, source, attachment)
            return ACCEPTED
        reference = attach_reference(self._nodes, measurement)
        if isinstance(reference, Answer):
            return reference
        if reference.node == attachment.node:
            return rejected(
                'same_node', f'both ends are attached to hidden node {attachment.node}')
        reference_ns = measurement.reference_ns
        if reference_ns is None:
            reference_ns = int(self._nodes.stamps_ns[measurement.reference_node])
        self.queue.edges.append(QueuedEdge(
            source, loop_closure_constraint(measurement, reference, attachment),
            measurement.stamp_ns, reference_ns))
        return ACCEPTED

    def attach_to_node(self, measurement: Absolute, source: str, node: int) -> None:
        """
        Attach a measurement to a hidden node, with no motion in between.

        Parameters
        ----------
        node : int, id of the node in the graph

        """
        self._enqueue(measurement, source, Attachment(node, np.zeros(3), np.zeros((3, 3))))

    def _enqueue(self, measurement: Absolute, source: str, attachment: Attachment) -> None:
        self.queue.observed.append(AttachedMeasurement(
            source, absolute_constraint(measurement, attachment), measurement, attachment))

    def take_ready(self, *, aligned: bool) -> Queue:
        """
        Take the constraints out of the queue that can be added to the graph.

        If the graph is not aligned with the map, observed nodes stay in the queue; the oldest ones
        beyond `MOST_UNALIGNED` are dropped and counted.
        """
        ready = Queue(edges=self.queue.edges, turns=self.queue.turns)
        self.queue.edges, self.queue.turns = [], []
        if aligned:
            ready.observed, self.queue.observed = self.queue.observed, []
        else:
            # bounds the memory of a robot that is not aligned for days
            excess = self.queue.observed[:-MOST_UNALIGNED]
            del self.queue.observed[:len(excess)]
            self.counts.update((dropped.source, 'dropped_unaligned') for dropped in excess)
        return ready

    def needed_ns(self, *, aligned: bool) -> int | None:
        """
        Return the earliest stamp at which something is to be attached to the graph [ns], or None.

        Before the graph is aligned with the map, that includes positions that may align it.
        """
        needed = [stamp_ns for _, measurement in self.waiting.measurements
                  for stamp_ns in self._stamps_of(measurement)]
        for edge in self.queue.edges:
            needed += [stamp_ns for stamp_ns in edge[2:] if stamp_ns >= 0]
        if not aligned:
            needed += [each.measurement.stamp_ns for each in self.queue.observed
                       if not isinstance(each.measurement, HeadingOnly)]
        begin_ns = self._nodes.last_frozen_ns
        return min((stamp_ns for stamp_ns in needed if stamp_ns >= begin_ns), default=None)

    def _stamps_of(self, measurement: Measurement) -> Iterator[int]:
        """Yield the stamps that a measurement is attached at, as far as they are known [ns]."""
        yield measurement.stamp_ns
        if isinstance(measurement, LoopClosure):
            node = measurement.reference_node
            if measurement.reference_ns is not None:
                yield measurement.reference_ns
            elif node is not None and 0 <= node < len(self._nodes):
                yield int(self._nodes.stamps_ns[node])

    def count(self, source: str, answer: Answer) -> Answer:
        """
        Return an answer after counting it.

        Parameters
        ----------
        answer : Answer, one that is pending is not counted

        """
        if answer.status is AnswerStatus.ACCEPTED:
            self.counts[source, 'accepted'] += 1
        elif answer.status is AnswerStatus.REJECTED:
            self.counts[source, answer.reason] += 1
            self.refusals[source, answer.reason] = answer.detail
        return answer
