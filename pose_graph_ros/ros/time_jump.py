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


class TimeJumpDetector:
    """
    Watches the stamps of the primary odometry for jumps back in time.

    A stamp that is behind the newest one by less than the threshold [ns] is late, and no jump.
    """

    def __init__(self, threshold_ns: int) -> None:
        self.guard = StampGuard(threshold_ns, behind=False)
        """Follows the newest stamp of the primary odometry."""
        self._primary = ''
        self._held: list[ReceivedMessage] = []
        self._behind: list[int] = []
        self._drained: set[str] | None = None
        """Sources that have sent messages of the new time; None if no old ones are expected."""
        self._old_above_ns = self._n_new = 0

    def receive(self, received: ReceivedMessage) -> Decision:
        """Return which messages can be used, now that this one has come."""
        if self._is_old(received):
            return Decision([], is_old=True)
        if received.is_primary and received.source != self._primary:
            # another odometry may have another clock
            self._primary = received.source
            self.forget()
        if not received.is_primary or received.stamp_ns <= 0:
            return self._release_unless_in_doubt(received)
        newest_ns = self.guard.newest_ns
        if newest_ns == 0 or received.stamp_ns > newest_ns - self.guard.limit_ns:
            self.guard.accepts(received.stamp_ns)
            self._behind.clear()
            return Decision(self.release([received]))
        if self._behind and received.stamp_ns <= self._behind[-1]:
            self._behind.clear()
        self._behind.append(received.stamp_ns)
        if len(self._behind) < EVIDENCE:
            return self._release_unless_in_doubt(received)
        jump_ns = newest_ns - self._behind[0]
        self.forget()
        self.guard.reset(received.stamp_ns)
        return Decision(self.release([received]), jump_ns)

    def release(self, more: list[ReceivedMessage] | None = None) -> list[ReceivedMessage]:
        """Remove and return the messages that are held back, with more appended."""
        held, self._held = self._held, []
        return held + (more or [])

    def forget(self) -> None:
        """Forget all stamps; messages that are held back stay so."""
        self.guard.reset()
        self._behind.clear()
        self._drained = None

    def clock_jumped(self, back_ns: int) -> None:
        """
        Start again because the clock was set back by an amount [ns].

        Messages of the old time may still be in the queues: those less than half of the jump
        behind the newest one, of sources that have sent none of the new time before.
        """
        newest_ns = self.guard.newest_ns
        self.forget()
        if newest_ns > 0:
            self._drained, self._n_new = set(), 0
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

    def _release_unless_in_doubt(self, received: ReceivedMessage) -> Decision:
        if not self._behind or len(self._held) >= MOST_HELD:
            self._behind.clear()
            return Decision(self.release([received]))
        self._held.append(received)
        return Decision([])
