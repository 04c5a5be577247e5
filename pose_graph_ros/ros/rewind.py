# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether time has begun again: a bag that is played in a loop, a simulation that was reset.

A single stamp of the past means nothing; messages come late and drivers err. Where the odometry
goes on from a time that lies behind, time has begun again. What comes while that is in doubt is
held back, so that nothing of the new time ends in the old graph. No rclpy.
"""

from typing import NamedTuple

from pose_graph_ros.ros.conversions import Message

# So many odometry messages, each newer than the one before, and all of them behind the newest.
EVIDENCE = 5
# More than this is not held back for the sake of a doubt.
MOST_HELD = 200
# After so much odometry of the new time nothing of the old one is on its way any more.
MOST_OLD = 20


class Heard(NamedTuple):
    """A message as it came."""

    source: str
    message: Message
    stamp_ns: int
    tells_time: bool
    """Whether it is of the odometry by whose stamps time is told."""


class Taken(NamedTuple):
    """What became of a message."""

    released: list[Heard]
    """What can be used now, in the order in which it came."""
    jump_ns: int = 0
    """By how much time has jumped back before these [ns], if it has."""
    is_old: bool = False
    """Whether the message is of the time before the clock was set back."""


class Rewind:
    """
    Watches the stamps of odometry for a new beginning of time.

    Parameters
    ----------
    threshold_ns : int
        What is behind by less than this is late [ns].

    """

    def __init__(self, threshold_ns: int) -> None:
        self.threshold_ns = threshold_ns
        self.newest_ns = 0
        """Newest stamp of odometry that does not stand alone, or the first [ns]; 0 for none."""
        self._teller = ''
        self._n_ahead = 0
        self._held: list[Heard] = []
        self._behind: list[int] = []
        self._old: set[str] | None = None
        """Sources of which nothing of the old time is on its way any more."""
        self._old_above_ns = self._n_new = 0

    def take(self, heard: Heard) -> Taken:
        """Take a message; say what can be used now."""
        if self._is_old(heard):
            return Taken([], is_old=True)
        if heard.tells_time and heard.source != self._teller:
            # another odometry may have another clock
            self._teller = heard.source
            self.forget()
        if not heard.tells_time or heard.stamp_ns <= 0:
            return self._release_unless_in_doubt(heard)
        if self.newest_ns == 0 or heard.stamp_ns > self.newest_ns - self.threshold_ns:
            self._advance(heard.stamp_ns)
            self._behind.clear()
            return Taken(self.release([heard]))
        if self._behind and heard.stamp_ns <= self._behind[-1]:
            self._behind.clear()
        self._behind.append(heard.stamp_ns)
        if len(self._behind) < EVIDENCE:
            return self._release_unless_in_doubt(heard)
        jump_ns = self.newest_ns - self._behind[0]
        self.forget()
        self.newest_ns = heard.stamp_ns
        return Taken(self.release([heard]), jump_ns)

    def release(self, more: list[Heard] | None = None) -> list[Heard]:
        """Hand out what was held back, and more behind it."""
        held, self._held = self._held, []
        return held + (more or [])

    def forget(self) -> None:
        """Begin anew with the next message; what is held back stays so."""
        self.newest_ns = self._n_ahead = 0
        self._behind.clear()
        self._old = None

    def clock_jumped(self, back_ns: int) -> None:
        """
        Begin anew because the clock was set back.

        What was still on its way then is of the old time: its stamps are nearer to the newest of
        that than to as much before. Of each source that ends with the first that is not.
        """
        newest_ns = self.newest_ns
        self.forget()
        if newest_ns > 0:
            self._old, self._n_new = set(), 0
            self._old_above_ns = newest_ns - back_ns // 2
            self._held = [heard for heard in self._held if not self._is_old(heard)]

    def _is_old(self, heard: Heard) -> bool:
        if self._old is None:
            return False
        if heard.source not in self._old and heard.stamp_ns > self._old_above_ns:
            return True
        self._old.add(heard.source)
        self._n_new += heard.tells_time
        if self._n_new > MOST_OLD:
            self._old = None
        return False

    def _advance(self, stamp_ns: int) -> None:
        """Let a stamp count as the newest unless it is far ahead and stands alone."""
        self._n_ahead += 1
        if (self.newest_ns == 0 or stamp_ns <= self.newest_ns + self.threshold_ns
                or self._n_ahead > EVIDENCE):
            self.newest_ns, self._n_ahead = max(self.newest_ns, stamp_ns), 0

    def _release_unless_in_doubt(self, heard: Heard) -> Taken:
        if not self._behind or len(self._held) >= MOST_HELD:
            self._behind.clear()
            return Taken(self.release([heard]))
        self._held.append(heard)
        return Taken([])
