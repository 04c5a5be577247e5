# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From messages to measurements, with a count for everything; imports no rclpy.

What is noticed as messages arrive, rates, silence, delays and refusals of sources, are `Arrivals`.

Time begins again if the clock was set back, or if `TimeKeeper` finds it in the stamps and the
publishers are others than before. While that is in doubt all messages are held back,
so that no measurement of the new time reaches the old graph, and afterwards those of the old time
that are still in the queues are recognised.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
import logging
import math
import time
from typing import Any, NamedTuple

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.adapters.sources import Measured, MessageReader
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry.se2 import between_one
from pose_graph_ros.core.measurements import Answer, OdometrySample, rejected
from pose_graph_ros.core.odometry.motion import is_jump, SpeedWindow, UNKNOWN
from pose_graph_ros.core.odometry.time_keeper import EVIDENCE, EVIDENCE_NS, LATEST_NS, TimeKeeper
from pose_graph_ros.core.quantities import Seconds, StampNs

logger = logging.getLogger(__name__)


class Expectations(NamedTuple):
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
Counts = Counter[tuple[str, str]]
Details = Mapping[tuple[str, str], str]
"""Of messages by source and 'accepted' or a reason, and details of the newest refusals."""
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
            self.wrong = (f'the stamps of {self.source} are {abs(self.delay):.1f} s {way} those '
                          f'of {odometry}{waits}: mend the clock of its driver (GPS time is 18 s '
                          f'ahead of UTC), or set {self.source}.time_offset')

    def refusal(self, counts: Counts, details: Details, now: Seconds) -> str:
        """Return what to say if its newest messages were all refused, else an empty text."""
        refused = Counter({reason: counts[name, reason] for name, reason in details
                           if name == self.source and reason not in INTENDED})
        if (accepted := counts[self.source, 'accepted']) > self.accepted:
            self.accepted, self.accepted_at, self.refused = accepted, now, refused
        newest = refused - self.refused
        count = newest.total()
        if count < EXPECTED.refusals or (
                accepted > 0 and now - self.accepted_at <= EXPECTED.refused_for):
            return ''
        begin = f'{count} of {self.count}' if accepted == 0 else f'the newest {count}'
        # all reasons with the newest detail of each, the most frequent first
        return f'{begin} messages of {self.source} were refused: ' + '; '.join(
            (f'{n} times ' if len(newest) > 1 else '')
            + f'{reason} ({details[self.source, reason]})' for reason, n in newest.most_common())


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


# --- messages

PAUSED = rejected('paused', 'call ~/pause with false to resume')
BEFORE_JUMP = rejected('before_clock_jump', 'a message from before the clock was set back')
LONGEST_DOUBT = 1.0  # messages that are held back are released without odometry for so long [s]


class ReceivedMessage(NamedTuple):
    """A usable message as it came."""

    source: str
    message: Message
    measurement: Measured
    refusal: Answer | None = None  # why it is not used, by its stamp


class Decision(NamedTuple):
    """What is to be done after a message has come."""

    released: list[ReceivedMessage]
    """Messages that can be used now, in the order in which they came."""
    jump_ns: int = 0  # length of the jump back in time before these messages [ns]; 0 for none
    is_old: bool = False  # whether the message is from before time began again


class Senders:
    """Knows which publishers, by their ids, odometry of the present comes from."""

    def __init__(self, find: Callable[[str], Collection[bytes]]) -> None:
        self._find = find   # returns those that a source has now; takes 30 us
        self._known: dict[str, set[bytes]] = {}
        self._noted_at: dict[str, Seconds] = {}
        self.strangers_may = True  # whether time may begin again with a source that is not known

    def note(self, source: str) -> None:
        """Note, at most once a second, who sends a source now if none that is known is left."""
        now = time.monotonic()
        if now - self._noted_at.get(source, -math.inf) >= 1.0:
            self._noted_at[source], found = now, set(self._find(source))
            # another beside those that go on need not have sent anything
            if self._known.setdefault(source, found).isdisjoint(found) and len(found) > 0:
                self._known[source] = found

    def forget(self) -> None:
        """Let the next who are noted be those that are known."""
        self._known.clear()
        self._noted_at.clear()

    def have_changed(self, source: str, is_new: bool) -> bool:
        """Tell whether all that are known have gone, and there are others; or have hardly come."""
        if (known := self._known.get(source)) is None or (is_new and self.strangers_may):
            return self.strangers_may
        found = self._find(source)
        return len(known) > 0 and len(found) > 0 and known.isdisjoint(found)


class TimeJumps:
    """Holds messages back while the keeper of time is in doubt."""

    def __init__(self, keeper: TimeKeeper, senders: Senders) -> None:
        self._keeper, self.senders = keeper, senders
        keeper.may_begin_again = senders.have_changed
        self._held: list[ReceivedMessage] = []
        self._drained: set[str] | None = None
        """Sources that have sent messages of the new time; None if no old ones are expected."""
        self._old_above_ns = self._n_new = 0

    def receive(self, received: ReceivedMessage) -> Decision:
        """Return which messages can be used, now that this one has come."""
        if self._drained is not None and self._is_old(received):
            return Decision([], is_old=True)
        judged = self._keeper.judge(received.source, received.measurement)
        if judged.refusal is not None:
            received = received._replace(refusal=judged.refusal)
        if judged.jump_ns > 0:
            self.senders.forget()
            self._expect_old(judged.before_ns, judged.jump_ns, {received.source})
            return Decision(self.release(received), judged.jump_ns)
        if self._keeper.in_doubt and len(self._held) < 10_000:
            self._held.append(received)
            return Decision([])
        if judged.refusal is None and isinstance(received.measurement, OdometrySample):
            self.senders.note(received.source)
        return Decision(self.release(received))

    def release(self, *more: ReceivedMessage) -> list[ReceivedMessage]:
        """Remove and return the messages that are held back, with more appended."""
        held, self._held = [*self._held, *more], []
        return held

    def forget(self) -> None:
        """Forget all stamps; messages that are held back stay so."""
        self._keeper.forget()
        self.senders.forget()
        self._drained = None

    def clock_jumped(self, back_ns: int, clock_ns: int) -> None:
        """Start again because the clock was set back by an amount, to a time [ns]."""
        newest_ns = self._keeper.now_ns
        self.forget()
        if newest_ns > clock_ns:
            # the clock may have run on for long without a message
            back_ns = min(back_ns, newest_ns - clock_ns)
        if newest_ns > 0:
            self._expect_old(newest_ns, back_ns, set())

    def _expect_old(self, newest_ns: int, back_ns: int, drained: set[str]) -> None:
        """
        Expect messages of the old time that may still be in the queues.

        They are those less than half of the jump behind the newest one, of sources that have sent
        none of the new time before; such messages that are held back are dropped.
        """
        self._drained, self._n_new = drained, 0
        self._old_above_ns = newest_ns - back_ns // 2
        self._held = [received for received in self._held if not self._is_old(received)]

    def _is_old(self, received: ReceivedMessage) -> bool:
        if self._drained is None:
            return False
        if received.source not in self._drained and (
                received.measurement.stamp_ns > self._old_above_ns):
            return True
        self._drained.add(received.source)
        self._n_new += isinstance(received.measurement, OdometrySample)
        if self._n_new > 20:     # so many of odometry that the queues are empty
            self._drained = None
        return False


class Input:
    """Counts all messages, holds them back while time may have jumped back, and reads them."""

    def __init__(self, values: Mapping[str, Any],
                 publishers: Callable[[str], Collection[bytes]]) -> None:
        self.reader = MessageReader(values)
        self.time_jumps = TimeJumps(self.reader.keeper, Senders(publishers))
        self._told: set[tuple[str, str]] = set()
        self._odometry_at = 0.0
        self.paused = False  # whether all measurements are rejected
        self._clear()

    def _clear(self) -> None:
        self.arrivals = {name: Arrivals(name, is_rare=source.kind.is_rare)
                         for name, source in self.reader.sources.items()}
        self.rejected: Counts = Counter()  # number by source and reason
        self._details: dict[tuple[str, str], str] = {}  # of the newest by source and reason
        self.posted = 0  # number of measurements that were handed to the engine
        self.silent: list[str] = []  # sources that are silent while others are not
        self.quiet = 0.0  # for how long nothing at all has come, if that is long [s]
        self.refused: dict[str, str] = {}  # what to say of sources that all is refused from
        self.posted_at = time.monotonic()  # time of the last of them, by a monotonic clock [s]
        self.is_streaming = False  # whether any were posted since the final optimisation

    def start_new_graph(self, values: Mapping[str, Any],
                        reader: MessageReader | None = None) -> None:
        """
        Forget all messages but those of /tf_static; those that are held back stay so.

        They are read on by the reader of an earlier graph, if it is given, with its datum.
        """
        if reader is None:
            reader = MessageReader(values, self.reader.frames, self.reader.keeper)
        else:
            reader.configure(values)
        self.reader = reader
        self._clear()

    def receive(self, source: str, message: Message) -> Decision:
        """Return which messages can be used now, after counting a new one."""
        now, arrivals = time.monotonic(), self.arrivals[source]
        arrivals.receive(now)
        if (measurement := self.read(source, message)) is None:
            return Decision([])
        if isinstance(measurement, OdometrySample):
            self._odometry_at = now
        decision = self.time_jumps.receive(ReceivedMessage(source, message, measurement))
        if decision.is_old:
            self.reject(source, BEFORE_JUMP)
        elif decision.jump_ns == 0 and not arrivals.is_rare:
            arrivals.compare(measurement.stamp_ns, self.reader.keeper.clock,
                             may_be_late=not self.reader.sources[source].kind.is_motion)
        return decision

    def release_overdue(self) -> list[ReceivedMessage]:
        """Remove and return the messages that were held back if no odometry has come for long."""
        return self.time_jumps.release() if (
            time.monotonic() - self._odometry_at > LONGEST_DOUBT) else []

    def read(self, source: str, message: Message) -> Measured | None:
        """Return the measurement of a message; None if it cannot be used, whatever its stamp."""
        if isinstance(measurement := self.reader.convert(source, message), Answer):
            self.reject(source, measurement)
            return None
        self.arrivals[source].frames = (
            message.header.frame_id, getattr(message, 'child_frame_id', ''))
        return measurement

    def post(self, received: ReceivedMessage, post: Callable[[str, Measured], bool]) -> None:
        """Hand a measurement to the engine, unless its stamp is refused or the input is paused."""
        source, _, measurement, refusal = received
        if refusal is not None or self.paused:
            self.reject(source, refusal or PAUSED)
        elif not post(source, measurement):
            self.reject(source, rejected('inbox_full', 'the solver does not keep up'))
        else:
            self.posted += 1
            self.posted_at, self.is_streaming = time.monotonic(), True

    def watch(self, counts: Counts, details: Details, *, active: bool) -> None:
        """
        Find the sources that are silent or refused, and log each reason once.

        The engine has counted measurements by source and 'accepted' or a reason, and kept the
        details of the newest refusals.
        """
        now, details = time.monotonic(), {**details, **self._details}
        arrivals, counts = self.arrivals.values(), counts + self.rejected
        self.silent = silent(arrivals, now) if active else []
        self.quiet = quiet(arrivals, now) if active else 0.0
        self.refused = {each.source: sentence for each in arrivals
                        if (sentence := each.refusal(counts, details, now)) != ''}
        for (source, reason), detail in details.items():
            if source in self.reader.sources and (source, reason) not in self._told:
                self._told.add((source, reason))
                logger.log(logging.INFO if reason in INTENDED else logging.WARNING,
                           '%s: %s: %s (logged once, counted in diagnostics)',
                           source, reason, detail)

    def reject(self, source: str, answer: Answer) -> None:
        """Count a message that cannot be used."""
        self.rejected[source, answer.reason] += 1
        self._details[source, answer.reason] = answer.detail


# A step in the stamps by more than this may be a mistake: it is treated as a jump [ns].
FAR_NS = 10_000_000_000


class PoseContinuity:
    """
    Watches the raw poses of the primary odometry for jumps, as the engine does.

    Its next estimate accounts for a jump; until then the old one must not be propagated over it.
    Where there is an estimate from before the first sample, the engine decides whether the
    odometry continues from there.
    """

    def __init__(self, maximum_speed: float, *, resumes: bool = False) -> None:
        self.maximum_speed = maximum_speed  # may be changed at any time
        self._resumes, self._stamp_ns = resumes, 0
        self._pose = (0.0, 0.0, 0.0)
        self._window = SpeedWindow(UNKNOWN, 0, self._pose)
        self._jump_ns = 0

    def covers(self, estimate: Estimate | None, sample: OdometrySample) -> bool:
        """Tell whether an estimate can be propagated to the newest sample."""
        elapsed_ns = sample.stamp_ns - self._stamp_ns
        # far behind, the stamp before was wrong: it lay in the future
        if elapsed_ns > 0 or elapsed_ns < -FAR_NS:
            x, y, theta = sample.pose.tolist()
            motion = between_one(self._pose, (x, y, theta))
            step = math.hypot(motion[0], motion[1]), abs(motion[2])
            begins = self._stamp_ns == 0 or elapsed_ns < 0
            jumped = (self._stamp_ns == 0 and self._resumes) if begins else (
                elapsed_ns > FAR_NS or is_jump(self._window.speeds, step, elapsed_ns * 1e-9,
                                               sample.speed, self.maximum_speed))
            self._stamp_ns, self._pose = sample.stamp_ns, (x, y, theta)
            if begins or jumped:
                self._window = SpeedWindow(self._window.speeds, sample.stamp_ns, self._pose)
                self._jump_ns = sample.stamp_ns if jumped else 0
            else:
                self._window = self._window.moved(sample.stamp_ns, self._pose, step)
        # a map that was loaded may end hours after odometry that the engine refuses
        return estimate is not None and estimate.stamp_ns >= self._jump_ns and not (
            self._resumes and sample.stamp_ns < estimate.stamp_ns - FAR_NS)
