# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How late the stamps of each source are against those of odometry; imports no rclpy."""

from dataclasses import dataclass

from pose_graph_ros.core.odometry.time_keeper import EVIDENCE, EVIDENCE_NS, LATEST_NS


@dataclass(slots=True)
class _Delay:
    seconds: float = 0.0  # of the newest message
    n: int = 0  # number of the last messages that are too far ahead or behind
    since_ns: int = 0  # stamp of odometry at the first of them


class Delays:
    """Compares stamps with the newest one of odometry, when they come."""

    def __init__(self) -> None:
        self._delays: dict[str, _Delay] = {}
        self.wrong: dict[str, str] = {}
        """What is to be said of sources whose stamps are wrong, in sentences."""

    @property
    def seconds(self) -> dict[str, float]:
        """How late the newest message of each source was; less than 0 for ahead [s]."""
        return {source: each.seconds for source, each in self._delays.items()}

    def receive(
        self, source: str, stamp_ns: int, clock: tuple[str, int], *, may_be_late: bool,
    ) -> None:
        """
        Compare a stamp.

        Parameters
        ----------
        clock : tuple, the odometry that is compared with, and its newest stamp [ns]
        may_be_late : bool, whether the source may take any time to measure

        """
        odometry, clock_ns = clock
        if odometry in ('', source):
            return
        delay, late_ns = self._delays.setdefault(source, _Delay()), clock_ns - stamp_ns
        delay.seconds = 1e-9 * late_ns
        if late_ns >= -LATEST_NS and (may_be_late or late_ns <= LATEST_NS):
            delay.n = 0
            self.wrong.pop(source, None)
            return
        if delay.n == 0:
            delay.since_ns = clock_ns
        delay.n += 1
        # odometry that is silent has fallen behind itself
        if delay.n >= EVIDENCE and clock_ns - delay.since_ns >= EVIDENCE_NS:
            way = 'ahead of' if late_ns < 0 else 'behind'
            waits = ', for which its measurements wait' if may_be_late else ''
            self.wrong[source] = (
                f'The stamps of {source} are {abs(delay.seconds):.1f} s {way} those of {odometry}'
                f'{waits}: mend the clock of its driver (GPS time is 18 s ahead of UTC), or set '
                f'{source}.time_offset')
