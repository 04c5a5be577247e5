# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Detection of time that starts again: a bag that is played in a loop, a simulation that is reset.

Messages come late, and drivers make mistakes, so that time has started again only if several
consecutive odometry stamps increase behind the newest one. Messages that come in the meantime are
held back, so that no measurement of the new time reaches the old graph. Imports no rclpy.
"""

from typing import NamedTuple

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.core.odometry.stamp_guard import EVIDENCE, StampGuard

MOST_HELD = 200  # greatest number of messages that are held back at a time
MOST_OLD = 20  # after this many odometry messages of the new time the old ones have drained


class ReceivedMessage(NamedTuple):
    """A message as it came."""

    source: str
    message: Message
    stamp_ns: int
    is_primary: bool  # whether it is of the primary odometry; before there is one, of any odometry


class Decision(NamedTuple):
    """What is to be done after a message has come."""

    released: list[ReceivedMessage]
    """Messages that can be used now, in the order in which they came."""
    jump_ns: int = 0  # length of the jump back in time before these messages [ns]; 0 for none
    is_old: bool = False  # whether the message is from before the clock was set back


class _Watch:
    """The stamps of one odometry."""

    def __init__(self) -> None:
        self.guard = StampGuard(0, behind=False)
        """Follows the newest stamp."""
        self.behind: list[int] = []
        """Increasing stamps behind the newest one [ns], if the last ones were."""

    def jump_ns(self, stamp_ns: int, limit_ns: int) -> int:
        """Return the length of the jump back that this stamp is the last evidence of, else 0."""
        newest_ns, self.guard.limit_ns = self.guard.newest_ns, limit_ns
        if newest_ns == 0 or stamp_ns > newest_ns - limit_ns:
            self.guard.accepts(stamp_ns)
            self.behind.clear()
            return 0
        if self.behind and stamp_ns <= self.behind[-1]:
            self.behind.clear()
        self.behind.append(stamp_ns)
        return newest_ns - self.behind[0] if len(self.behind) >= EVIDENCE else 0


class TimeJumpDetector:
    """
    Watches the stamps of the primary odometry, or of each odometry before there is a primary one.

    A stamp that is behind the newest one by less than the threshold [ns] is late, and no jump.
    Each odometry is compared with itself alone, as another one may have another clock.
    """

    def __init__(self, threshold_ns: int) -> None:
        self.threshold_ns = threshold_ns
        self._watches: dict[str, _Watch] = {}
        self._held: list[ReceivedMessage] = []
        self._drained: set[str] | None = None
        """Sources that have sent messages of the new time; None if no old ones are expected."""
        self._old_above_ns = self._n_new = 0

    def receive(self, received: ReceivedMessage) -> Decision:
        """Return which messages can be used, now that this one has come."""
        if self._is_old(received):
            return Decision([], is_old=True)
        if not received.is_primary:
            # if it becomes primary, its stamps are judged by those from then on
            self._watches.pop(received.source, None)
        elif received.stamp_ns > 0:
            watch = self._watches.setdefault(received.source, _Watch())
            jump_ns = watch.jump_ns(received.stamp_ns, self.threshold_ns)
            if jump_ns > 0:
                gone_back = {name for name, each in self._watches.items() if each.behind}
                self._expect_old(watch.guard.newest_ns, jump_ns, gone_back)
                self._watches[received.source] = renewed = _Watch()
                renewed.guard.reset(received.stamp_ns)
                return Decision(self.release([received]), jump_ns)
        if len(self._held) < MOST_HELD and any(watch.behind for watch in self._watches.values()):
            self._held.append(received)
            return Decision([])
        for watch in self._watches.values():
            watch.behind.clear()
        return Decision(self.release([received]))

    def release(self, more: list[ReceivedMessage] | None = None) -> list[ReceivedMessage]:
        """Remove and return the messages that are held back, with more appended."""
        held, self._held = self._held, []
        return held + (more or [])

    def forget(self) -> None:
        """Forget all stamps; messages that are held back stay so."""
        self._watches.clear()
        self._drained = None

    def clock_jumped(self, back_ns: int) -> None:
        """Start again because the clock was set back by an amount [ns]."""
        newest_ns = max((watch.guard.newest_ns for watch in self._watches.values()), default=0)
        self.forget()
        if newest_ns > 0:
            self._expect_old(newest_ns, back_ns, set())

    def _expect_old(self, newest_ns: int, back_ns: int, drained: set[str]) -> None:
        """
        Forget all stamps, and expect messages of the old time that may still be in the queues.

        They are those less than half of the jump behind the newest one, of sources that have sent
        none of the new time before; such messages that are held back are dropped.
        """
        self._watches.clear()
        self._drained, self._n_new = drained, 0
        self._old_above_ns = newest_ns - back_ns // 2
        self._held = [received for received in self._held if not self._is_old(received)]

    def _is_old(self, received: ReceivedMessage) -> bool:
        if self._drained is None:
            return False
        if received.source not in self._drained and received.stamp_ns > self._old_above_ns:
            return True
        self._drained.add(received.source)
        self._n_new += received.is_primary
        if self._n_new > MOST_OLD:
            self._drained = None
        return False
