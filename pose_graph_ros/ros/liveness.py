# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rates of the sources, and which have become silent while others have not; imports no rclpy."""

from collections.abc import Collection
from dataclasses import dataclass

# A source is silent after this time [s], or after this many of its own periods if that is longer.
LEAST_SILENCE, PERIODS = 2.0, 5.0
NEWEST = 0.1  # weight of the newest gap between two messages in the mean period


@dataclass(slots=True)
class _Arrivals:
    at: float  # time of the newest message [s]
    period: float = 0.0  # mean gap between messages [s]
    count: int = 1

    @property
    def patience(self) -> float:
        """Longest gap between two messages that is no silence [s]."""
        return max(LEAST_SILENCE, PERIODS * self.period)


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
        source : str
        now : float
            By a monotonic clock, here and below [s].

        """
        arrivals = self._arrivals.get(source)
        if arrivals is None:
            self._arrivals[source] = _Arrivals(now)
            return
        # a silence must not make the period much longer
        gap = min(now - arrivals.at, arrivals.patience)
        arrivals.count += 1
        arrivals.period += max(NEWEST, 1.0 / (arrivals.count - 1)) * (gap - arrivals.period)
        arrivals.at = now

    def silence(self, source: str, now: float) -> float | None:
        """
        Return the time since the last message of a source [s]; None before the first.

        Parameters
        ----------
        source : str
        now : float

        """
        arrivals = self._arrivals.get(source)
        return None if arrivals is None else now - arrivals.at

    def rate(self, source: str) -> float:
        """Return the present rate of a source [Hz]; 0 before its second message."""
        arrivals = self._arrivals.get(source)
        return 1.0 / arrivals.period if arrivals is not None and arrivals.period > 0.0 else 0.0

    def silent(self, now: float) -> list[str]:
        """Return the sources that are silent at a time [s] at which another one is not."""
        active = [arrivals for arrivals in self._arrivals.values()
                  if now - arrivals.at <= arrivals.patience]
        return sorted(
            name for name, arrivals in self._arrivals.items()
            if name not in self._rare
            and any(other.at - arrivals.at > arrivals.patience for other in active))
