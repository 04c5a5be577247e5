# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which sources are heard, and which have fallen silent while others have not; no rclpy."""

from collections.abc import Collection
from dataclasses import dataclass

# A source is silent after this time, or so many of its own periods [s].
LEAST_SILENCE = 2.0
PERIODS = 5.0
# Weight of the newest gap between two messages in the period.
NEWEST = 0.1


@dataclass(slots=True)
class _Heard:
    at: float
    period: float = 0.0
    """Mean gap between messages [s]."""
    count: int = 1

    @property
    def patience(self) -> float:
        """How long a gap between two messages may be [s]."""
        return max(LEAST_SILENCE, PERIODS * self.period)


class Hearing:
    """
    When each source was last heard, by a clock that is never set.

    Parameters
    ----------
    rare : collection of str
        Sources that come when they come: their silence means nothing.

    """

    def __init__(self, rare: Collection[str] = ()) -> None:
        self._rare = frozenset(rare)
        self._heard: dict[str, _Heard] = {}

    def hear(self, source: str, now: float) -> None:
        """Note a message at a time [s]."""
        heard = self._heard.get(source)
        if heard is None:
            self._heard[source] = _Heard(now)
            return
        # a gap that was a silence says little of the period
        gap = min(now - heard.at, heard.patience)
        heard.count += 1
        heard.period += max(NEWEST, 1.0 / (heard.count - 1)) * (gap - heard.period)
        heard.at = now

    def silence(self, source: str, now: float) -> float | None:
        """Return the time since the last message of a source [s]; None before the first."""
        heard = self._heard.get(source)
        return None if heard is None else now - heard.at

    def rate(self, source: str) -> float:
        """Return how often a source is heard of late [Hz]; 0 before its second message."""
        heard = self._heard.get(source)
        return 1.0 / heard.period if heard is not None and heard.period > 0.0 else 0.0

    def silent(self, now: float) -> list[str]:
        """Return the sources that have ended while another one goes on."""
        going = [heard for heard in self._heard.values() if now - heard.at <= heard.patience]
        return sorted(
            name for name, heard in self._heard.items()
            if name not in self._rare
            and any(other.at - heard.at > heard.patience for other in going))
