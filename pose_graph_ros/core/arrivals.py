# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From a measurement at the door to a constraint in the queue, in any order of stamps.

It is admitted by the policy of its source, waits until odometry has reached its stamp, and is
bound to the hidden nodes before it. Whatever becomes of it is counted.
"""

from collections import Counter

import numpy as np

from pose_graph_ros.core import binding
from pose_graph_ros.core.admission import admit
from pose_graph_ros.core.anchoring import anchor_at, reference_of
from pose_graph_ros.core.hidden_nodes import HiddenNodes
from pose_graph_ros.core.joining import Bound, Joining, Queue
from pose_graph_ros.core.measurements import (
    Absolute,
    ACCEPTED,
    Answer,
    LoopClosure,
    Measurement,
    rejected,
    Verdict,
)
from pose_graph_ros.core.pending import due_ns, MAX_PENDING, Pending, Seen

# Measurements that wait for the angle between odometry and map; the oldest make way.
MOST_UNALIGNED = 5000


class Arrivals:
    """
    What has come in and has not joined the graph yet.

    Parameters
    ----------
    nodes : HiddenNodes
    joins : Joining
        Knows the settings of each source.

    """

    def __init__(self, nodes: HiddenNodes, joins: Joining) -> None:
        self._nodes, self._joins = nodes, joins
        self.pending = Pending()
        """Measurements that wait for odometry to reach their stamps."""
        self.seen = Seen()
        self.queue = Queue()
        """Constraints that join the graph at the next update."""
        self.counts: Counter[tuple[str, str]] = Counter()
        """How often each source got each answer: (source, 'accepted' or the reason)."""

    def take(self, measurement: Measurement, source: str) -> Answer:
        """Take a measurement; count and return what becomes of it."""
        return self.count(source, self._take(measurement, source))

    def _take(self, measurement: Measurement, source: str) -> Answer:
        settings = self._joins.settings(source, type(measurement))
        admitted = admit(measurement, settings.covariance)
        if isinstance(admitted, Answer):
            return admitted
        checked = admitted.measurement
        if self.seen.has(source, checked):
            return rejected('duplicate_stamp', f'{source} at {checked.stamp_ns} came before')
        if settings.minimum_period > 0.0 and self.seen.near(
                source, checked.stamp_ns, round(settings.minimum_period * 1e9)):
            return rejected('thinned', f'less than {settings.minimum_period} s from another one')
        if due_ns(checked) <= self._nodes.covered_ns:
            answer = self._bind(checked, source)
        else:
            answer = self._let_wait(checked, source)
        if answer.verdict is not Verdict.REJECTED:
            self.seen.add(source, checked)
            for repair in admitted.repairs:
                self.counts[source, repair] += 1
        return answer

    def _let_wait(self, measurement: Measurement, source: str) -> Answer:
        """Let a measurement wait for odometry, in the place of the one that waits longest."""
        excess = self.pending.push(source, measurement)
        if excess is not None:
            answer = rejected('too_many_pending', f'{MAX_PENDING} measurements wait for odometry')
            if excess.measurement is measurement:
                return answer
            self.count(excess.source, answer)
            self.seen.remove(excess.source, excess.measurement)
        return Answer(Verdict.PENDING, 'pending', 'waits for odometry to reach its stamp')

    def bind_due(self) -> None:
        """Bind the measurements whose stamps odometry has reached."""
        if len(self.pending) > 0:
            for waiting in self.pending.pop_due(self._nodes.covered_ns):
                self.count(waiting.source, self._bind(waiting.measurement, waiting.source))

    def _bind(self, measurement: Measurement, source: str) -> Answer:
        """Turn a measurement that odometry has reached into a constraint for the next update."""
        anchor = anchor_at(self._nodes, measurement.stamp_ns)
        if isinstance(anchor, Answer):
            return anchor
        if not isinstance(measurement, LoopClosure):
            self.queue.observed.append(Bound(
                source, binding.absolute_constraint(measurement, anchor), measurement, anchor))
            return ACCEPTED
        reference = reference_of(self._nodes, measurement)
        if isinstance(reference, Answer):
            return reference
        if reference.node == anchor.node:
            return rejected('same_node', f'both ends fall to hidden node {anchor.node}')
        self.queue.edges.append(
            (source, binding.loop_closure_constraint(measurement, reference, anchor)))
        return ACCEPTED

    def put(self, measurement: Absolute, source: str, node: int) -> None:
        """Bind a measurement to a hidden node, by its row, with no motion in between."""
        anchor = binding.Anchor(node, np.zeros(3), np.zeros((3, 3)))
        self.queue.observed.append(Bound(
            source, binding.absolute_constraint(measurement, anchor), measurement, anchor))

    def thin_unaligned(self) -> None:
        """Drop the oldest of what waits for the angle between odometry and map, if it is much."""
        # where a robot stands for days, unaligned, memory must not run full
        excess = self.queue.observed[:-MOST_UNALIGNED]
        del self.queue.observed[:len(excess)]
        self.counts.update((bound.source, 'dropped_unaligned') for bound in excess)

    def count(self, source: str, answer: Answer) -> Answer:
        """Count an answer and return it."""
        if answer.verdict is Verdict.ACCEPTED:
            self.counts[source, 'accepted'] += 1
        elif answer.verdict is Verdict.REJECTED:
            self.counts[source, answer.reason] += 1
        return answer
