# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a received measurement to a constraint in the queue, in any order of stamps."""

from array import array
import bisect
from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Mapping
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.stream import ReorderBuffer
from pose_graph_ros.core.sources.gyro import Gyros
from pose_graph_ros.core.sources.kinds import attach, due_ns, key, KINDS, validate
from pose_graph_ros.core.sources.queued import Beacons, Queued, WaitingRange
from pose_graph_ros.core.sources.settings import SOURCES


class WaitingMeasurement(NamedTuple):
    due_ns: int  # stamp that odometry must reach [ns]
    source: str
    measurement: ms.PoseMeasurement


class SeenStamps:
    """Stamps and references of the measurements seen so far, by source; 16 bytes each."""

    def __init__(self) -> None:
        # sorted stamps [ns], and a reference for each
        self.columns = defaultdict[str, tuple['array[int]', 'array[int]']](
            lambda: (array('q'), array('q')))

    def has(self, source: str, measurement: ms.PoseMeasurement) -> bool:
        """Tell whether a measurement with the same stamp and reference was added."""
        return self._find(source, measurement) >= 0

    def near(self, source: str, stamp_ns: int, period_ns: int) -> int:
        """Return how many stamps of the source are closer than a period to a given one."""
        stamps, _ = self.columns[source]
        return bisect.bisect_left(stamps, stamp_ns + period_ns) - bisect.bisect_right(
            stamps, stamp_ns - period_ns)

    def add(self, source: str, measurement: ms.PoseMeasurement) -> None:
        stamps, references = self.columns[source]
        at = bisect.bisect_right(stamps, measurement.stamp_ns)
        stamps.insert(at, measurement.stamp_ns)
        references.insert(at, key(measurement))

    def remove(self, source: str, measurement: ms.PoseMeasurement) -> None:
        at = self._find(source, measurement)
        for column in self.columns[source] if at >= 0 else ():
            del column[at]

    def forget(self, before_ns: int) -> None:
        """Forget all stamps before one [ns]: such measurements are refused for another reason."""
        for stamps, references in self.columns.values():
            n = bisect.bisect_left(stamps, before_ns)
            del stamps[:n], references[:n]

    def saved(
        self, without: list[tuple[str, ms.PoseMeasurement]],
    ) -> dict[str, tuple[IntArray, IntArray]]:
        """Return stamps and references, by source, without some measurements."""
        rest = deepcopy(self)
        for source, measurement in without:
            rest.remove(source, measurement)
        return {source: (np.array(stamps_ns, np.int64), np.array(references, np.int64))
                for source, (stamps_ns, references) in rest.columns.items()}

    def restore(self, saved: Mapping[str, tuple[IntArray, IntArray]]) -> None:
        for source, (stamps_ns, references) in saved.items():
            self.columns[source] = array('q', stamps_ns.tolist()), array('q', references.tolist())

    def _find(self, source: str, measurement: ms.PoseMeasurement) -> int:
        stamps, references = self.columns[source]
        same = range(bisect.bisect_left(stamps, measurement.stamp_ns),
                     bisect.bisect_right(stamps, measurement.stamp_ns))
        own = key(measurement)
        return next((at for at in same if references[at] == own), -1)


class MeasurementPipeline:
    """Measurements between their arrival and the update that adds them to the graph."""

    def __init__(self, nodes: HiddenNodes, config: BackendConfig) -> None:
        self.nodes, self.config = nodes, config
        # measurements that wait for odometry to reach their stamps, in the order of these, then of
        # their arrival
        self.waiting: list[WaitingMeasurement] = []
        # those that odometry has passed, as constraints at the last estimate, and if each is gated
        self.ahead: dict[object, tuple[Factors, bool]] = {}
        self.seen = SeenStamps()  # stamps of the measurements that were accepted or wait
        self.queue: list[Queued] = []  # constraints for the next update
        # how often each source got each answer: (source, 'accepted' or the reason)
        self.counts: Counter[tuple[str, str]] = Counter()
        # yaw rates, from which rotations between the hidden nodes are made
        self.gyros = Gyros(nodes, config, self.counts)
        self.beacons = Beacons(self.counts)  # and the ranges that wait for them
        # detail of the newest refusal by source and reason
        self.refusals: dict[tuple[str, str], str] = {}
        # source and stamps [ns] of the newest loop closures that could not be attached
        self.refused_closures = deque[tuple[str, int, int | None]](maxlen=SOURCES.most_refused)

    def add(self, measurement: ms.Measurement, source: str) -> ms.Answer:
        if isinstance(measurement, ms.YawRate):
            answer = self.count(source, self.gyros.stream(source).add(measurement))
            self._take_turns()
            return answer
        return self.count(source, self._add(measurement, source))

    def finish(self) -> None:
        """Settle all odometry and yaw rates, without waiting for older ones."""
        self.nodes.finish()
        self.gyros.finish()

    def _take_turns(self) -> None:
        """Make the rotations that are due, and count what happened to the rates."""
        self.queue += self.gyros.extend()
        self.count_sorted(self.gyros.streams)

    def _add(self, measurement: ms.PoseMeasurement, source: str) -> ms.Answer:
        settings = self.config.measurement_source(source, type(measurement))
        validated = validate(measurement, settings.covariance)
        if isinstance(validated, ms.Answer):
            return validated
        checked = validated.measurement
        if self.seen.has(source, checked):
            return ms.rejected('duplicate_stamp', f'{source} at {1e-9 * checked.stamp_ns:.3f} s '
                                                  'was received before')
        if settings.minimum_period > 0.0 and self.seen.near(
                source, checked.stamp_ns, round(settings.minimum_period * 1e9)) > 0:
            return ms.rejected('thinned', f'less than {settings.minimum_period} s from another')
        if self.seen.near(source, checked.stamp_ns, 500_000_000) >= SOURCES.most_in_second:
            return ms.rejected('too_dense', f'{source} has {SOURCES.most_in_second} measurements '
                                            f'in the second around {1e-9 * checked.stamp_ns:.3f}')
        answer = self.take(checked, source)
        if answer.status is not ms.AnswerStatus.REJECTED:
            for repair in validated.repairs:
                self.counts[source, repair] += 1
        return answer

    def take(self, checked: ms.PoseMeasurement, source: str) -> ms.Answer:
        """Attach a measurement that is good, or let it wait."""
        answer = (self._attach(checked, source) if due_ns(checked) <= self.nodes.covered_ns
                  else self._wait(checked, source))
        if answer.status is not ms.AnswerStatus.REJECTED:
            self.seen.add(source, checked)
        return answer

    @property
    def pending(self) -> list[tuple[str, ms.PoseMeasurement]]:
        """The measurements that `take` has let wait, with their sources."""
        return [*(each[1:] for each in self.waiting), *self.beacons.measurements]

    def _wait(self, measurement: ms.PoseMeasurement, source: str) -> ms.Answer:
        """Let a measurement wait for odometry; if too many wait, drop the one due last."""
        bisect.insort(self.waiting, WaitingMeasurement(due_ns(measurement), source, measurement),
                      key=lambda each: each.due_ns)
        if len(self.waiting) > SOURCES.most_waiting:
            excess = self.waiting.pop()
            answer = ms.rejected(
                'too_many_pending', f'{SOURCES.most_waiting} measurements wait for odometry')
            if excess.measurement is measurement:
                return answer
            self.count(excess.source, answer)
            self.seen.remove(excess.source, excess.measurement)
        return ms.Answer(
            ms.AnswerStatus.PENDING, 'pending', 'waits for odometry to reach its stamp')

    def attach_due(self) -> None:
        """Attach the measurements whose stamps odometry has reached, and make rotations."""
        if len(self.gyros.streams) > 0:
            self._take_turns()
        if len(self.waiting) == 0 or self.waiting[0].due_ns > self.nodes.covered_ns:
            return
        due = self.waiting_until(self.nodes.covered_ns)
        del self.waiting[:len(due)]
        for waiting in due:
            self.count(waiting.source, self._attach(waiting.measurement, waiting.source))

    def waiting_until(self, stamp_ns: int) -> list[WaitingMeasurement]:
        """Return the measurements that wait for odometry up to a stamp [ns]."""
        return self.waiting[:bisect.bisect_right(
            self.waiting, stamp_ns, key=lambda each: each.due_ns)]

    def _attach(self, measurement: ms.PoseMeasurement, source: str) -> ms.Answer:
        attachment = attach(self.nodes, measurement.stamp_ns)
        made = attachment if isinstance(attachment, ms.Answer) else KINDS[
            type(measurement)].constraint(measurement, source, attachment, self.nodes)
        if isinstance(made, ms.Answer):
            if isinstance(measurement, ms.LoopClosure):
                self.refused_closures.append(
                    (source, measurement.stamp_ns, measurement.reference_ns))
            return made
        if isinstance(measurement, ms.Range):
            self.beacons.add(WaitingRange(made, measurement))
        else:
            self.queue.append(made)
        return ms.ACCEPTED

    def take_ready(self, *, aligned: bool) -> list[Queued]:
        """
        Take the constraints out of the queue that can be added to the graph.

        If the graph is not aligned with the map, measurements in it stay in the queue; the oldest
        ones beyond `most_unaligned` are dropped and counted.
        """
        waiting = [] if aligned else [each for each in self.queue if each.is_in_map]
        ready = [each for each in self.queue if aligned or not each.is_in_map]
        # bounds the memory of a robot that is not aligned for days
        self.queue = waiting[-SOURCES.most_unaligned:]
        excess = waiting[:len(waiting) - len(self.queue)]
        self.counts.update((dropped.source, 'dropped_unaligned') for dropped in excess)
        return ready

    @property
    def needed_ns(self) -> int | None:
        """Earliest stamp that something is attached at, or may align [ns]; None without one."""
        needed = [stamp_ns for each in self.waiting
                  for stamp_ns in self._stamps_of(each.measurement)]
        needed += [stamp_ns for each in self.queue if each.factor.kind[0] != FactorKind.HEADING
                   for stamp_ns in (each.stamp_ns, each.reference_ns)]
        begin_ns = max(self.nodes.last_frozen_ns, 0)
        return min((stamp_ns for stamp_ns in needed if stamp_ns >= begin_ns), default=None)

    def _stamps_of(self, measurement: ms.PoseMeasurement) -> Iterator[int]:
        """Yield the stamps that a measurement is attached at, as far as they are known [ns]."""
        yield measurement.stamp_ns
        other = key(measurement)
        if 0 <= -2 - other < len(self.nodes):
            yield int(self.nodes.stamps_ns[-2 - other])
        elif other > 0:
            yield other

    def count_sorted(self, streams: Mapping[str, ReorderBuffer[Any]]) -> None:
        """Count what was sorted in late or dropped of some streams, by source."""
        for source, stream in streams.items():
            for reason, count in (('sorted', stream.n_sorted), ('stamp_ahead', stream.n_dropped)):
                if count > 0:
                    self.counts[source, reason] = count

    def count(self, source: str, answer: ms.Answer) -> ms.Answer:
        if answer.status is ms.AnswerStatus.ACCEPTED:
            self.counts[source, 'accepted'] += 1
        elif answer.status is ms.AnswerStatus.REJECTED:
            self.counts[source, answer.reason] += 1
            self.refusals[source, answer.reason] = answer.detail
        return answer
