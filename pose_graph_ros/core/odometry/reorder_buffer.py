# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Samples of one source that wait, in the order of stamps, until no older one can come."""

import bisect
from collections.abc import Callable, Iterator
import operator
from typing import Generic, Protocol, TypeVar

from pose_graph_ros.core.measurements import Answer, LARGEST_STAMP, rejected
from pose_graph_ros.core.quantities import StampNs

# A sample is dropped if its stamp is farther ahead, by this and the reorder window [ns], than the
# stamps of this number of consecutive samples that came after it.
FAR_AHEAD_NS = 10_000_000_000
MANY_BEHIND = 5


class Stamped(Protocol):
    """A sample with a stamp."""

    @property
    def stamp_ns(self) -> StampNs:
        """When it was taken."""


Sample = TypeVar('Sample', bound=Stamped)
stamp_of: Callable[[Stamped], StampNs] = operator.attrgetter('stamp_ns')


class ReorderBuffer(Generic[Sample]):
    """
    The samples that are not settled.

    A sample is settled when it is older than the newest one by the reorder window; older samples
    are rejected then.
    """

    def __init__(self, what: str) -> None:
        self.n_sorted = 0  # samples that were received after newer ones and sorted in before them
        self.n_dropped = 0  # accepted samples that were dropped later, as they were far ahead
        self.settled_ns = -1  # stamp of the newest settled sample; -1 before the first [ns]
        self._waiting: list[Sample] = []
        self._what, self._window_ns = what, 0  # [ns]
        self._n_behind = 0  # consecutive received samples that are far behind the newest one

    @property
    def newest_ns(self) -> StampNs:
        """Stamp of the newest sample, settled or not; -1 before the first."""
        return self._waiting[-1].stamp_ns if self._waiting else self.settled_ns

    def _was_settled(self, stamp_ns: StampNs) -> bool:
        """Tell whether there was a settled sample with a stamp."""
        raise NotImplementedError

    def _settle(self, until_ns: StampNs | None = None) -> Iterator[Sample]:
        """
        Settle samples one by one, and yield each.

        The newest stamp to settle is by default that of the newest sample minus the window.
        """
        if until_ns is None:
            until_ns = self.newest_ns - self._window_ns
        while self._waiting and self._waiting[0].stamp_ns <= until_ns:
            sample = self._waiting.pop(0)
            self.settled_ns = sample.stamp_ns
            yield sample

    def _insert(self, sample: Sample) -> Answer | int:
        """Return the index of a sample that was added, or why it was not."""
        samples, stamp_ns, at = self._waiting, sample.stamp_ns, len(self._waiting)
        if not 0 < stamp_ns <= LARGEST_STAMP:
            return rejected('zero_stamp' if stamp_ns <= 0 else 'no_stamp',
                            f'expected a stamp above 0, got {stamp_ns} ns')
        if stamp_ns <= self.settled_ns:
            return rejected(
                'duplicate_stamp' if self._was_settled(stamp_ns) else 'out_of_order',
                f'{self._what} at {1e-9 * stamp_ns:.3f} s after {1e-9 * self.settled_ns:.3f} s')
        if at > 0 and stamp_ns <= samples[-1].stamp_ns:
            at = bisect.bisect_left(samples, stamp_ns, key=stamp_of)
            if samples[at].stamp_ns == stamp_ns:
                return rejected('duplicate_stamp',
                                f'{self._what} at {1e-9 * stamp_ns:.3f} s came before')
            self.n_sorted += 1
        samples.insert(at, sample)
        latest_ns = stamp_ns + FAR_AHEAD_NS + self._window_ns
        self._n_behind = self._n_behind + 1 if samples[-1].stamp_ns > latest_ns else 0
        if self._n_behind >= MANY_BEHIND:
            kept = bisect.bisect_right(samples, latest_ns, key=stamp_of)
            self.n_dropped += len(samples) - kept
            del samples[kept:]
            self._n_behind = 0
        return at
