# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements that wait for odometry to reach their stamps, and which ones have come before."""

from array import array
import bisect
from collections.abc import Iterator
import heapq
import itertools

from pose_graph_ros.core.measurements import Measurement

# A sender whose clock is ahead must not fill the memory.
MAX_PENDING = 10_000


class Pending:
    """Measurements by the stamp at which they are due."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, str, Measurement]] = []
        self._arrival = itertools.count()

    def __len__(self) -> int:
        return len(self._heap)

    @property
    def full(self) -> bool:
        """Whether no more can wait."""
        return len(self) >= MAX_PENDING

    def push(self, due_ns: int, source: str, measurement: Measurement) -> None:
        """Let a measurement wait."""
        heapq.heappush(self._heap, (due_ns, next(self._arrival), source, measurement))

    def pop_due(self, covered_ns: int) -> Iterator[tuple[str, Measurement]]:
        """Hand out what is due, the oldest first."""
        while self._heap and self._heap[0][0] <= covered_ns:
            _, _, source, measurement = heapq.heappop(self._heap)
            yield source, measurement


class Seen:
    """Stamps that have come before, by source: 8 bytes each."""

    def __init__(self) -> None:
        self._stamps: dict[str, array[int]] = {}

    def has(self, key: str, stamp_ns: int) -> bool:
        """Tell whether a stamp has been added under a key."""
        stamps = self._stamps.get(key)
        if stamps is None:
            return False
        at = bisect.bisect_left(stamps, stamp_ns)
        return at < len(stamps) and stamps[at] == stamp_ns

    def add(self, key: str, stamp_ns: int) -> None:
        """Add a stamp; in order it costs nothing."""
        bisect.insort(self._stamps.setdefault(key, array('q')), stamp_ns)
