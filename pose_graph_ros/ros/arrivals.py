# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is noticed as messages arrive: rates, silence, delays and refusals of sources; no rclpy."""

from collections import Counter, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
import math

from pose_graph_ros.core.odometry.time_keeper import EVIDENCE, EVIDENCE_NS, LATEST_NS
from pose_graph_ros.core.quantities import Seconds, StampNs


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


INTENDED = ('paused', 'thinned')  # reasons that the user has asked for


@dataclass(slots=True)
class Arrivals:
    """What is noticed of one source as its messages come."""

    source: str
    is_rare: bool = False  # whether its silence means nothing
    count: int = 0  # number of messages
    # frame_id and child_frame_id of the newest message that could be read; None before
    frames: tuple[str, str] | None = None
    at: Seconds = -math.inf  # time of the newest message
    since: Seconds = -math.inf  # the same, or later if the node was inactive meanwhile
    gaps: deque[float] = field(default_factory=lambda: deque(maxlen=EXPECTED.gaps))
    # how late the newest message was by odometry, less than 0 for ahead; None if not compared
    delay: Seconds | None = None
    wrong: str = ''  # what to say of its stamps if they are wrong
    n_apart: int = 0  # number of the last messages that are too far ahead or behind
    apart_since_ns: StampNs = 0  # stamp of odometry at the first of them
    # when its newest message was accepted: how many were, the time, and how many were refused by
    # reason
    accepted: int = 0
    accepted_at: Seconds = 0.0
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def patience(self) -> Seconds:
        """Longest gap that is no silence; infinite before there is a rhythm."""
        if len(self.gaps) < EXPECTED.rhythm:
            return math.inf
        gaps = sorted(self.gaps)
        return max(EXPECTED.least_silence, EXPECTED.medians * gaps[len(gaps) // 2],
                   EXPECTED.longest * gaps[-2])

    @property
    def rate(self) -> float:
        """Present rate [Hz]; 0 before the second message."""
        gaps = [*self.gaps][-EXPECTED.present:]
        return len(gaps) / sum(gaps) if sum(gaps) > 0.0 else 0.0

    def receive(self, now: Seconds) -> None:
        """Record that a message came."""
        if self.since == self.at > -math.inf:
            self.gaps.append(now - self.at)
        self.count += 1
        self.at = self.since = now

    def resume(self, now: Seconds) -> None:
        """Let its silence begin now, since nothing could be received before."""
        if self.at > -math.inf:
            self.since = now

    def is_active(self, now: Seconds) -> bool:
        """Tell whether its newest message is not long ago."""
        return now - self.since <= (
            self.patience if math.isfinite(self.patience) else EXPECTED.quiet)

    def compare(self, stamp_ns: StampNs, clock: tuple[str, StampNs], *, may_be_late: bool) -> None:
        """Compare a stamp with the newest one of an odometry."""
        odometry, clock_ns = clock
        if odometry in ('', self.source):
            return
        late_ns = clock_ns - stamp_ns
        self.delay = 1e-9 * late_ns
        if late_ns >= -LATEST_NS and (may_be_late or late_ns <= LATEST_NS):
            self.n_apart, self.wrong = 0, ''
            return
        if self.n_apart == 0:
            self.apart_since_ns = clock_ns
        self.n_apart += 1
        # odometry that is silent has fallen behind itself
        if self.n_apart >= EVIDENCE and clock_ns - self.apart_since_ns >= EVIDENCE_NS:
            way = 'ahead of' if late_ns < 0 else 'behind'
            waits = ', for which its measurements wait' if may_be_late else ''
            self.wrong = (
                f'the stamps of {self.source} are {abs(self.delay):.1f} s {way} those of '
                f'{odometry}{waits}: mend the clock of its driver (GPS time is 18 s ahead of '
                f'UTC), or set {self.source}.time_offset')

    def refusal(
        self, counts: Counter[tuple[str, str]], details: Mapping[tuple[str, str], str],
        now: Seconds,
    ) -> str:
        """Return what to say if its newest messages were all refused, else an empty text."""
        refused = Counter({reason: counts[name, reason] for name, reason in details
                           if name == self.source and reason not in INTENDED})
        accepted = counts[self.source, 'accepted']
        if accepted > self.accepted:
            self.accepted, self.accepted_at, self.refused = accepted, now, refused
        newest = refused - self.refused
        count = newest.total()
        if count < EXPECTED.refusals or (
                accepted > 0 and now - self.accepted_at <= EXPECTED.refused_for):
            return ''
        begin = f'{count} of {self.count}' if accepted == 0 else f'the newest {count}'
        # all reasons with the newest detail of each, the most frequent first
        reasons = '; '.join(
            (f'{n} times ' if len(newest) > 1 else '') + f'{reason} '
            f'({details[self.source, reason]})' for reason, n in newest.most_common())
        return f'{begin} messages of {self.source} were refused: {reasons}'


def silent(sources: Collection[Arrivals], now: Seconds) -> list[str]:
    """Return the sources that are silent at a time at which another one is not."""
    newest = max((each.at for each in sources if each.is_active(now)), default=-math.inf)
    return sorted(each.source for each in sources
                  if not each.is_rare and newest - each.since > each.patience)


def quiet(sources: Collection[Arrivals], now: Seconds) -> Seconds:
    """Return for how long no source has sent anything; 0 if that is not long, or never."""
    if any(each.is_active(now) for each in sources):
        return 0.0
    silence = now - max((each.since for each in sources), default=-math.inf)
    return silence if EXPECTED.quiet < silence < math.inf else 0.0
