# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rates of the sources, and which have fallen silent, each by its own rhythm; no rclpy."""

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
import math

# A source is silent after the longest of this time [s], this many of its median gaps between two
# messages, and this many times the second longest of its gaps and of its pauses.
LEAST_SILENCE, MEDIANS, LONGEST = 2.0, 5.0, 3.0
GAPS, ENOUGH = 50, 5  # number of gaps that are kept, and that make a rhythm
# A pause, which is a much longer gap, is remembered for this many times its length. One may be a
# failure of the driver; two show a source that comes and goes.
MEMORY = 20.0
QUIET = 10.0  # longest time without a message from any source that is not said [s]


@dataclass(slots=True)
class _Arrivals:
    at: float  # time of the newest message [s]
    since: float  # the same, or later if the node was inactive meanwhile [s]
    gaps: deque[float] = field(default_factory=lambda: deque(maxlen=GAPS))
    pauses: list[tuple[float, float]] = field(default_factory=list)  # ends and lengths [s]

    @property
    def usual(self) -> float:
        """Longest gap that is no pause [s]; infinite before there is a rhythm."""
        if len(self.gaps) < ENOUGH:
            return math.inf
        gaps = sorted(self.gaps)
        return max(LEAST_SILENCE, MEDIANS * gaps[len(gaps) // 2], LONGEST * gaps[-2])

    def patience(self, now: float) -> float:
        """Return the longest gap that is no silence [s]."""
        self.pauses = [pause for pause in self.pauses if now - pause[0] < MEMORY * pause[1]]
        second = sorted((0.0, 0.0, *(length for _, length in self.pauses)))[-2]
        return max(self.usual, LONGEST * second)

    def receive(self, now: float) -> None:
        gap = now - self.at
        if self.since == self.at:
            # the least is compared first, as this is called at the rate of the messages
            if gap > LEAST_SILENCE and gap > self.usual:
                self.pauses.append((now, gap))
            else:
                self.gaps.append(gap)
        self.at = self.since = now

    def is_active(self, now: float) -> bool:
        patience = self.patience(now)
        return now - self.since <= (patience if math.isfinite(patience) else QUIET)


class Liveness:
    """Times of the messages of each source; the silence of those that are rare means nothing."""

    def __init__(self, rare: Collection[str] = ()) -> None:
        self._rare = frozenset(rare)
        self._arrivals: dict[str, _Arrivals] = {}

    def receive(self, source: str, now: float) -> None:
        """
        Record that a message came.

        Parameters
        ----------
        now : float, by a monotonic clock, here and below [s]

        """
        arrivals = self._arrivals.get(source)
        if arrivals is None:
            self._arrivals[source] = _Arrivals(now, now)
        else:
            arrivals.receive(now)

    def resume(self, now: float) -> None:
        """Let all silences begin at a time [s], since nothing could be received before."""
        for arrivals in self._arrivals.values():
            arrivals.since = now

    def silence(self, source: str, now: float) -> float | None:
        """
        Return the time since the last message of a source [s]; None before the first.

        Parameters
        ----------
        now : float

        """
        arrivals = self._arrivals.get(source)
        return None if arrivals is None else now - arrivals.at

    def rate(self, source: str) -> float:
        """Return the present rate of a source [Hz]; 0 before its second message."""
        arrivals = self._arrivals.get(source)
        total = 0.0 if arrivals is None else sum(arrivals.gaps)
        return 0.0 if arrivals is None or total <= 0.0 else len(arrivals.gaps) / total

    def silent(self, now: float) -> list[str]:
        """Return the sources that are silent at a time [s] at which another one is not."""
        newest = max((arrivals.at for arrivals in self._arrivals.values()
                      if arrivals.is_active(now)), default=-math.inf)
        return sorted(name for name, arrivals in self._arrivals.items()
                      if name not in self._rare
                      and newest - arrivals.since > arrivals.patience(now))

    def quiet(self, now: float) -> float:
        """Return for how long no source has sent anything [s]; 0 if that is not long, or never."""
        if len(self._arrivals) == 0 or any(
                arrivals.is_active(now) for arrivals in self._arrivals.values()):
            return 0.0
        silence = now - max(arrivals.since for arrivals in self._arrivals.values())
        return silence if silence > QUIET else 0.0
