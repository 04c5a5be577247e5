# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The one judge of stamps: the time of the robot is that of its odometry.

A stamp is of the present if it is near the newest one, and stamps of another time are believed
only if several consecutive ones agree with one another for a second, while no other odometry goes
on. Time has moved on then (a silence has ended), or begins again (a bag that is played again, a
robot that is started again): that is believed only if who knows the senders finds it possible, as
a graph ends with it. Only messages that are usable otherwise are shown to it.
"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample, rejected, YawRate
from pose_graph_ros.core.quantities import StampNs

# Stamps that are farther apart are not of one time [ns]. The poses of odometry are accumulated, so
# the motion of the few messages that are refused is not lost.
APART_NS = 60_000_000_000
# No odometry is so late that another one, of the same time, is ahead of it by more than this [ns].
LATEST_NS = 5_000_000_000
# Number of consecutive stamps, and the time that they span [ns], that show another time.
EVIDENCE, EVIDENCE_NS = 5, 1_000_000_000


class Judgement(NamedTuple):
    """What a stamp says."""

    refusal: Answer | None = None  # why its message is not used, unless time begins again
    # length of the jump back with which time begins again with this stamp [ns], else 0
    jump_ns: int = 0
    before_ns: StampNs = 0  # newest stamp of odometry before that


PRESENT = Judgement()
TELL_TIME = OdometrySample, YawRate


@dataclass(slots=True)
class _Watch:
    """The stamps of one source; 0 stands for none [ns]."""

    newest_ns: int = 0  # newest one of the present; 0 as well if they are of another time
    passed_ns: int = 0  # newest one that was not refused
    was_present: bool = False
    n_apart: int = 0  # number of the last stamps that are of another time and agree
    first_ns: int = 0  # first and last of these
    last_ns: int = 0
    others_ns: int = 0  # newest stamp of the other odometry at the first
    in_doubt: bool = False  # whether time begins again with them if they go on
    clock_ns: int = 0  # newest stamp of the odometry that is preferred to it
    since_ns: int = 0  # its own stamp when that one came

    def set_present(self, newest_ns: int) -> None:
        self.newest_ns = self.passed_ns = newest_ns
        self.n_apart, self.in_doubt, self.was_present = 0, False, True


class TimeKeeper:
    """Keeps the time of the robot."""

    def __init__(self, odometry: list[str], threshold_ns: StampNs) -> None:
        self.threshold_ns = threshold_ns
        # tells whether time may begin again with a source, and if the present has hardly begun;
        # a recording cannot tell
        self.may_begin_again: Callable[[str, bool], bool] = lambda *_: True
        self._odometry = list(odometry)
        self._watches = defaultdict[str, _Watch](_Watch)
        self._since_ns = 0

    @property
    def now_ns(self) -> int:
        """Newest stamp of odometry [ns]; 0 before the first."""
        return self._newest_but('')

    @property
    def clock(self) -> tuple[str, int]:
        """The odometry that others are compared with, and its newest stamp [ns]; 0 for none."""
        for name in self._odometry:
            if (newest_ns := self._watches[name].newest_ns) > 0:
                return name, newest_ns
        return '', 0

    @property
    def in_doubt(self) -> bool:
        """Whether time may have begun again, so that messages are to be held back."""
        for name, watch in self._watches.items():
            if watch.in_doubt and self._newest_but(name) - watch.others_ns < EVIDENCE_NS:
                return True
        return False

    def forget(self) -> None:
        """Forget all stamps: the next one may be any."""
        self._watches.clear()

    def shift(self, source: str, by_ns: int) -> None:
        """Add an offset [ns] to the stamps of a source, as all from now on have it."""
        watch = self._watches[source]
        if watch.newest_ns > 0:
            watch.set_present(max(watch.newest_ns + by_ns, 1))

    def judge(self, source: str, measurement: OdometrySample | Measurement) -> Judgement:
        """Return what a usable measurement says of the time, and whether it is of that time."""
        stamp_ns = measurement.stamp_ns
        if stamp_ns <= 0 or not isinstance(measurement, TELL_TIME):
            return PRESENT  # the engine refuses stamps of zero, and waits for odometry
        watch, now_ns = self._watches[source], self.now_ns
        if source not in self._odometry:
            # it tells no time, and is judged by odometry and by what it sent before
            known = [each for each in (now_ns, watch.newest_ns) if each > 0]
            if known and all(abs(stamp_ns - each) > APART_NS for each in known):
                return Judgement(self._refusal(source, stamp_ns))
            watch.newest_ns = stamp_ns
            return PRESENT
        if self._is_ahead(source, stamp_ns):
            return Judgement(self._refusal(source, stamp_ns))
        own_ns = watch.newest_ns
        earliest_ns = own_ns - self.threshold_ns if own_ns > 0 else now_ns - LATEST_NS
        latest_ns = now_ns + min(self.threshold_ns, APART_NS)
        if now_ns == 0 or earliest_ns <= stamp_ns <= latest_ns:
            self._since_ns = stamp_ns if now_ns == 0 else self._since_ns
            watch.set_present(max(own_ns, stamp_ns))
            return PRESENT
        return self._judge_other_time(source, stamp_ns, earliest_ns)

    def _judge_other_time(self, source: str, stamp_ns: int, earliest_ns: int) -> Judgement:
        """Judge a stamp of odometry that is before the earliest one of the present, or ahead."""
        watch, now_ns, others_ns = self._watches[source], self.now_ns, self._newest_but(source)
        if watch.n_apart == 0 or not 0 < stamp_ns - watch.last_ns <= APART_NS:
            watch.n_apart, watch.first_ns, watch.others_ns = 0, stamp_ns, others_ns
        watch.n_apart, watch.last_ns = watch.n_apart + 1, stamp_ns
        lasts_ns = stamp_ns - watch.first_ns
        # for ten seconds preferred odometry need not have the time of the one that came before it
        decides = (not watch.was_present and source == self._odometry[0]
                   and now_ns - self._since_ns < 10_000_000_000)
        is_evidence = watch.n_apart >= EVIDENCE and lasts_ns >= EVIDENCE_NS
        # time does not move with the source if it went on elsewhere meanwhile
        if is_evidence and not decides and 2 * (others_ns - watch.others_ns) > lasts_ns:
            watch.newest_ns = 0
        begins_again, can_decide = stamp_ns < earliest_ns, decides or watch.newest_ns > 0
        watch.in_doubt = begins_again and can_decide and self.may_begin_again(
            source, now_ns - self._since_ns < EVIDENCE_NS)
        if begins_again and can_decide and not watch.in_doubt:
            return Judgement(self._refusal(source, stamp_ns))
        if is_evidence and can_decide:
            if decides or begins_again:
                self._watches.clear()
                self._watches[source], self._since_ns = watch, watch.first_ns
            watch.set_present(stamp_ns)
            return (Judgement(jump_ns=now_ns - watch.first_ns, before_ns=now_ns)
                    if begins_again else PRESENT)
        if abs(stamp_ns - max(now_ns, watch.passed_ns)) > APART_NS:
            return Judgement(self._refusal(source, stamp_ns))
        watch.passed_ns = max(watch.passed_ns, stamp_ns)
        return PRESENT

    def _is_ahead(self, source: str, stamp_ns: int) -> bool:
        """Tell whether a stamp is ahead of preferred odometry while that is not silent."""
        watch, (clock, clock_ns) = self._watches[source], self.clock
        if clock == '' or self._odometry.index(clock) >= self._odometry.index(source):
            return False
        if clock_ns != watch.clock_ns:
            watch.clock_ns, watch.since_ns = clock_ns, stamp_ns
        return stamp_ns - clock_ns > LATEST_NS >= stamp_ns - watch.since_ns

    def _newest_but(self, source: str) -> int:
        newest_ns = 0   # in a loop, which takes a third of the time of a generator
        for name in self._odometry:
            if name != source:
                newest_ns = max(newest_ns, self._watches[name].newest_ns)
        return newest_ns

    def _refusal(self, source: str, stamp_ns: int) -> Answer:
        other, clock_ns = self.clock
        apart = 1e-9 * (stamp_ns - (clock_ns or self._watches[source].newest_ns))
        is_own = other in ('', source)
        return rejected('stamp_leap', (
            f'{1e-9 * stamp_ns:.3f} s is {abs(apart):.1f} s '
            f'{"ahead of" if apart > 0 else "behind"} '
            f'{"those before" if is_own else f"the stamps of {other}"}: ' + (
                'if a new drive or loop of a bag is meant, call ~/reset, or play with --clock and '
                'use_sim_time; else ' if is_own and apart < 0 else '')
            + f'mend the clock of its driver, or set {source}.time_offset'))
