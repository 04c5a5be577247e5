# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is noticed as messages arrive: rates, silence, delays and refusals of sources; no rclpy."""

from collections import Counter, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
import math

from pose_graph_ros.core.odometry.time_keeper import EVIDENCE, EVIDENCE_NS, LATEST_NS
from pose_graph_ros.core.quantities import Seconds


@dataclass(frozen=True, slots=True)
class Expectations:
    """When sources are missed [s], and from when on it is said that they are refused."""

    # A source is silent after the longest of this time, this many of its median gaps between two
    # messages, and this many times the second longest: one long gap may be a failure of the
    # driver, two show a source that comes and goes.
    least_silence: float = 2.0
    medians: float = 5.0
    longest: float = 3.0
    gaps: int = 1000            # number of gaps that are kept,
    rhythm: int = 5             # that make a rhythm,
    present: int = 50           # and that tell the present rate
    quiet: float = 10.0         # longest time without a message from any source that is not said
    refusals: int = 3           # number of refused messages from which a source is reported
    refused_for: float = 5.0    # time since its last accepted message from which it is


EXPECTED = Expectations()


@dataclass(slots=True)
class _Arrivals:
    at: float  # time of the newest message [s]
    since: float  # the same, or later if the node was inactive meanwhile [s]
    gaps: deque[float] = field(default_factory=lambda: deque(maxlen=EXPECTED.gaps))

    @property
    def patience(self) -> float:
        """Longest gap that is no silence [s]; infinite before there is a rhythm."""
        if len(self.gaps) < EXPECTED.rhythm:
            return math.inf
        gaps = sorted(self.gaps)
        return max(EXPECTED.least_silence, EXPECTED.medians * gaps[len(gaps) // 2],
                   EXPECTED.longest * gaps[-2])

    def receive(self, now: float) -> None:
        if self.since == self.at:
            self.gaps.append(now - self.at)
        self.at = self.since = now

    def is_active(self, now: float) -> bool:
        return now - self.since <= (
            self.patience if math.isfinite(self.patience) else EXPECTED.quiet)


class Liveness:
    """Times of the messages of each source; the silence of those that are rare means nothing."""

    def __init__(self, rare: Collection[str] = ()) -> None:
        self._rare = frozenset(rare)
        self._arrivals: dict[str, _Arrivals] = {}

    def receive(self, source: str, now: Seconds) -> None:
        """Record that a message came."""
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
        """Return the time since the last message of a source [s]; None before the first."""
        arrivals = self._arrivals.get(source)
        return None if arrivals is None else now - arrivals.at

    def rate(self, source: str) -> float:
        """Return the present rate of a source [Hz]; 0 before its second message."""
        gaps = [*self._arrivals[source].gaps][-EXPECTED.present:] if (
            source in self._arrivals) else []
        return len(gaps) / sum(gaps) if sum(gaps) > 0.0 else 0.0

    def silent(self, now: float) -> list[str]:
        """Return the sources that are silent at a time [s] at which another one is not."""
        newest = max((arrivals.at for arrivals in self._arrivals.values()
                      if arrivals.is_active(now)), default=-math.inf)
        return sorted(name for name, arrivals in self._arrivals.items()
                      if name not in self._rare
                      and newest - arrivals.since > arrivals.patience)

    def quiet(self, now: float) -> float:
        """Return for how long no source has sent anything [s]; 0 if that is not long, or never."""
        if len(self._arrivals) == 0 or any(
                arrivals.is_active(now) for arrivals in self._arrivals.values()):
            return 0.0
        silence = now - max(arrivals.since for arrivals in self._arrivals.values())
        return silence if silence > EXPECTED.quiet else 0.0


@dataclass(slots=True)
class _Delay:
    seconds: float = 0.0  # of the newest message
    n: int = 0  # number of the last messages that are too far ahead or behind
    since_ns: int = 0  # stamp of odometry at the first of them


class Delays:
    """Compares stamps with the newest one of odometry, when they come."""

    def __init__(self) -> None:
        self._delays: dict[str, _Delay] = {}
        self.wrong: dict[str, str] = {}  # sentences on sources whose stamps are wrong

    @property
    def seconds(self) -> dict[str, float]:
        """How late the newest message of each source was; less than 0 for ahead [s]."""
        return {source: each.seconds for source, each in self._delays.items()}

    def receive(
        self, source: str, stamp_ns: int, clock: tuple[str, int], *, may_be_late: bool,
    ) -> None:
        """Compare a stamp with the newest one of an odometry [ns]."""
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
                f'the stamps of {source} are {abs(delay.seconds):.1f} s {way} those of {odometry}'
                f'{waits}: mend the clock of its driver (GPS time is 18 s ahead of UTC), or set '
                f'{source}.time_offset')


INTENDED = ('paused', 'thinned')  # reasons that the user has asked for


class Refusals:
    """Follows the counts of all sources, to tell those that nothing is accepted from any more."""

    def __init__(self) -> None:
        # of each source, when its newest message was accepted: how many were, the time [s], and
        # how many were refused by reason
        self._accepted: dict[str, tuple[int, Seconds, Counter[str]]] = {}

    def update(
        self, received: Mapping[str, int], counts: Counter[tuple[str, str]],
        details: Mapping[tuple[str, str], str], now: Seconds,
    ) -> dict[str, str]:
        """Return what to say of the sources of which the newest messages were all refused."""
        said = {}
        for source, total in received.items():
            refused = Counter({reason: counts[name, reason] for name, reason in details
                               if name == source and reason not in INTENDED})
            accepted = counts[source, 'accepted']
            before, at, until_then = self._accepted.get(source, (0, 0.0, Counter()))
            if accepted > before:
                at, until_then = now, refused
                self._accepted[source] = accepted, at, until_then
            newest = refused - until_then
            count = newest.total()
            if count >= EXPECTED.refusals and (
                    accepted == 0 or now - at > EXPECTED.refused_for):
                begin = f'{count} of {total}' if accepted == 0 else f'the newest {count}'
                said[source] = (f'{begin} messages of {source} were refused: '
                                f'{_reasons(source, newest, details)}')
        return said


def _reasons(source: str, counts: Counter[str], details: Mapping[tuple[str, str], str]) -> str:
    """Return all reasons with the newest detail of each, the most frequent first."""
    return '; '.join(
        (f'{count} times ' if len(counts) > 1 else '') + f'{reason} ({details[source, reason]})'
        for reason, count in counts.most_common())
