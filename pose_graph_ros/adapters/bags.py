# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Read bags without a ROS installation.

A bag is a rosbag2 folder, one of its .mcap or .db3 files, or a ROS 1 .bag file. A bag that cannot
be read raises `BagError`, whose message begins with the path. The caller decodes each message, so
that one that cannot be decoded (`MessageError`) does not end the iteration. A bag that was cut
short or damaged is read as far as it goes, with a warning (`damaged_bags`). Player and replay
choose the topics that feed the sources alike.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
import glob
import heapq
import logging
from pathlib import Path
import re
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, Self

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from pose_graph_ros.adapters.conversions import StaticFrames
from pose_graph_ros.adapters.damaged_bags import repair, ROS1_SUFFIXES
from pose_graph_ros.adapters.sources import CLOSURES, Kind, KNOWN_SOURCES, MessageReader, Source
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.quantities import Seconds

logger = logging.getLogger(__name__)

BAG_FILE_SUFFIXES = ('.mcap', '.db3', *ROS1_SUFFIXES)
JOURNALS = ('.db3-wal', '.db3-journal')


class BagError(PoseGraphError, ValueError):
    """A bag cannot be read or written; the error message names its path."""


class MessageError(BagError):
    """One message of a bag cannot be decoded; the others may be valid."""


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """Type and number of messages of one topic of a bag; several types are joined with ` | `."""

    type: str
    count: int


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One message of a bag, which is decoded on demand."""

    topic: str
    type: str
    recorded_ns: int  # when the recorder received the message [ns]; not the stamp in its header
    raw: bytes  # the message as stored: in CDR in a rosbag2, in the ROS 1 format in a .bag file
    connection: Connection = field(repr=False, compare=False)  # definition, quality of service
    _decode: Callable[[bytes], Any] = field(repr=False, compare=False)

    def decode(self) -> Any:
        """Return an object with the fields of the type, else raise a `MessageError`."""
        try:
            return self._decode(self.raw)
        except Exception as error:  # generated code can raise anything on invalid bytes
            raise MessageError(f'{self.topic}: message recorded at {self.recorded_ns} ns is no '
                               f'{self.type}: {one_line(error)}') from error


class Span(NamedTuple):
    """Time in which messages were recorded."""

    begin_ns: int | None = None  # stamp of the first; None from the begin on [ns]
    end_ns: int | None = None  # stamp before which they were recorded; None to the end [ns]


WHOLE = Span()


Reader = Rosbag1Reader | Rosbag2Reader
Watch = Callable[[Iterable[BagMessage], int], Iterable[BagMessage]]
"""What passes messages on, given about how many there are."""


def _absolute(connection: Connection) -> str:
    """Return the topic of a connection with a slash, which recorders of ROS 1 may leave out."""
    return '/' + connection.topic.removeprefix('/')


class Bag:
    """
    Bags that follow each other, or one, read as one; a context manager.

    `path` names them, `topics` are those in them by name. The first message was recorded at
    `start_ns`, the last one 1 ns before `end_ns`, which is not later if there are no messages.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.damage = dict[Path, str]()  # a sentence for each of the bags that is not whole
        with ExitStack() as stack:
            parts = [(path, _reader(path, stack, self.damage)) for path in paths]
            self._stack = stack.pop_all()
        self._parts = sorted(parts, key=lambda part: part[1].start_time)
        self._decoders: dict[tuple[Path, str], Callable[[bytes], Any]] = {}
        self.watch: Watch = lambda messages, _: messages    # all messages pass it
        self.path = ', '.join(str(path) for path, _ in self._parts)
        found: dict[str, list[Connection]] = {}
        for connection in (each for _, reader in parts for each in reader.connections):
            found.setdefault(_absolute(connection), []).append(connection)
        self.topics = {name: TopicInfo(
            ' | '.join(sorted({each.msgtype for each in own})), sum(
                each.msgcount for each in own)) for name, own in sorted(found.items())}
        self.start_ns = min(reader.start_time for _, reader in parts)   # an empty one begins late
        self.end_ns = max(reader.end_time for _, reader in parts)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the files; messages that were read before can still be decoded."""
        self._stack.close()

    def messages(self, topics: Collection[str], span: Span = WHOLE) -> Iterator[BagMessage]:
        """
        Iterate over the messages of some topics in the order in which they were recorded.

        Raises `BagError`: at the call for an unknown topic, on iteration for a damaged file.
        """
        unknown = sorted(set(topics) - set(self.topics))
        if unknown:
            raise BagError(
                f'{self.path}: no topic {", ".join(unknown)}; the bag has {self.describe()}')
        parts = [self._read(*part, topics, span) for part in self._parts]
        length_ns = min(span.end_ns or self.end_ns, self.end_ns) - (span.begin_ns or self.start_ns)
        return iter(self.watch(heapq.merge(*parts, key=lambda message: message.recorded_ns), round(
            length_ns / max(self.end_ns - self.start_ns, 1)
            * sum(self.topics[topic].count for topic in topics))))

    def describe(self) -> str:
        """Return the topics with their types on one line, for error messages."""
        return ', '.join(
            f'{name} ({info.type})' for name, info in self.topics.items()) or 'no topics'

    def _read(self, path: Path, reader: Reader, topics: Collection[str],
              span: Span) -> Iterator[BagMessage]:
        """Iterate over the messages of a reader; where it fails, over what can be repaired."""
        connections = [c for c in reader.connections if _absolute(c) in topics]
        if len(connections) == 0:  # rosbags reads all topics if it is given none
            return
        seen: Counter[str] = Counter()
        last_ns: int | None = None
        try:
            for connection, recorded_ns, raw in reader.messages(connections, *span):
                topic, last_ns, kind = _absolute(connection), recorded_ns, connection.msgtype
                seen[topic] += 1
                if (path, kind) not in self._decoders:
                    # by the definition in the bag, else by the standard one
                    is_ros1 = isinstance(reader, Rosbag1Reader)
                    types = own_types(connection) or get_typestore(
                        Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
                    self._decoders[path, kind] = partial(types.deserialize_ros1 if is_ros1
                                                         else types.deserialize_cdr, typename=kind)
                yield BagMessage(topic, kind, recorded_ns, bytes(raw), connection,
                                 self._decoders[path, kind])
        except Exception as error:  # the parsers can raise anything on a damaged file
            text = f'damaged after {seen.total()} messages: {one_line(error)}'
            with ExitStack() as stack:
                if (rest := _repaired(path, text, stack, self.damage)) is None:
                    raise BagError(f'{path}: {text}') from error
                yield from self._read(path, rest, topics, span if last_ns is None else Span(
                    last_ns + 1, span.end_ns))
            return
        for topic in sorted({*map(_absolute, connections)} if span == WHOLE else ()):
            count = sum(each.msgcount for each in connections if _absolute(each) == topic)
            if seen[topic] != count:
                logger.warning('%s: %s should have %d messages, %d were found',
                               path, topic, count, seen[topic])


def open_bag(*paths: str | Path) -> Bag:
    """
    Open a rosbag2 folder (sqlite3 or mcap, also compressed), or one of `BAG_FILE_SUFFIXES`.

    Several follow each other, in any order. Raises `BagError` for a path that is no bag, or a bag
    that is damaged or not supported.
    """
    return Bag([Path(path) for path in paths])


def _reader(path: Path, stack: ExitStack, damage: dict[Path, str]) -> Reader:
    """Return an open reader, which the stack closes."""
    if not path.exists():
        raise BagError(f'{path}: does not exist')
    if path.is_file() and path.suffix not in BAG_FILE_SUFFIXES:
        raise BagError(f'{path}: no bag, expected a rosbag2 folder or a file ending in '
                       f'{", ".join(BAG_FILE_SUFFIXES)}')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        rest = _repaired(path, 'the recording was not ended, it has no metadata.yaml', stack,
                         damage)
        if rest is None:
            inside = sorted(p.name for p in path.iterdir() if p.suffix in BAG_FILE_SUFFIXES)
            hint = f'; name a file in it: {", ".join(inside)}' if inside else ''
            raise BagError(f'{path}: no rosbag2 folder, it has no metadata.yaml{hint}')
        return rest
    files = path.iterdir() if path.is_dir() else path.parent.glob(f'{glob.escape(path.name)}-*')
    if any(each.name.endswith(JOURNALS) and each.stat().st_size > 0 for each in files) and (
            rest := _repaired(
                path, 'the recording was not ended, it has a journal', stack, damage)):
        return rest
    try:
        return _opened(path, path, stack)
    except Exception as error:  # the parsers can raise anything on a damaged file
        if (rest := _repaired(path, f'damaged or cut short: {one_line(error)}', stack, damage)):
            return rest
        raise BagError(
            f'{path}: damaged, cut short or not supported: {one_line(error)}') from error


def _opened(path: Path, copy: Path, stack: ExitStack) -> Reader:
    """Return an open reader of a copy of what is at a path."""
    reader = (Rosbag1Reader if path.suffix in ROS1_SUFFIXES else Rosbag2Reader)(copy)
    reader.open()
    stack.callback(reader.close)
    return reader


def _repaired(
    path: Path, reason: str, stack: ExitStack, damage: dict[Path, str],
) -> Reader | None:
    """Return a reader of a copy of what can be read of a bag; None if nothing can."""
    folder = stack.enter_context(TemporaryDirectory(prefix='pose_graph_'))
    copy = Path(folder, 'bag')
    try:
        if not (sentence := repair(path, reason, copy)):
            return None
        reader = _opened(path, copy, stack)
        logger.warning(sentence)
        damage.setdefault(path, sentence)   # it may be read more than once
        return reader
    except OSError as error:
        raise BagError(f'{path}: {reason}; what can be read of it cannot be copied to '
                       f'{folder}: {one_line(error)}') from error
    except Exception as error:  # what can be read need not be what a bag may have
        logger.info('%s cannot be repaired: %s', path, one_line(error))
        return None


def own_types(connection: Connection) -> Typestore | None:
    """Return the types by the definition in the bag; None if it has none that is usable."""
    text, kind = connection.msgdef.data, connection.msgdef.format
    if kind == MessageDefinitionFormat.NONE or text.strip() == '':
        return None
    types = get_typestore(Stores.EMPTY)
    try:
        if kind == MessageDefinitionFormat.MSG:
            types.register(get_types_from_msg(text, connection.msgtype))
        else:
            # several definitions, each after a separator and a line 'IDL: <name>'
            for part in text.split('=' * 80 + '\n'):
                idl = part.partition('\n')[2] if part.startswith('IDL: ') else part
                if idl.strip():
                    types.register(get_types_from_idl(idl))
        types.get_msgdef(connection.msgtype)
    except Exception as error:  # the parser can raise anything on an invalid definition
        logger.warning('%s: the definition of %s in the bag is not usable, using the standard '
                       'one: %s', connection.topic, connection.msgtype, one_line(error))
        return None
    return types


def one_line(error: Exception) -> str:
    """Return the text of an error on one line."""
    return ' '.join(str(error).split()) or type(error).__name__


# --- the topics of a bag that feed the sources, for player and replay alike

OPTIONS = tuple(KNOWN_SOURCES)  # have an option for their topic; without it that is guessed
# What names of topics with the truth have in them: these are no inputs unless they are named.
TRUTH = re.compile(r'(?:/|_|\b)(?:ground_?truth|truth|gt)(?:/|_|\b)', re.IGNORECASE)
STATIC_FRAMES = '/tf_static', 'tf2_msgs/msg/TFMessage'  # topic and type of static transforms


@dataclass(frozen=True, slots=True)
class Inputs:
    """Topics of a bag that feed the sources of the node, and how many fixes are held out."""

    topics: Mapping[str, str]  # topic in the bag by name of the source, such as `fix`
    kinds: Mapping[str, Kind] = field(default_factory=dict)  # kind by name of the source
    hold_out: int = 0  # every n-th fix, or global pose if there are none, is held out; 0: none
    span: Span = WHOLE  # when the messages that are read were recorded
    stretch: Seconds | None = None  # every n-th stretch of the drive is held out, not every fix

    def __post_init__(self) -> None:
        if self.hold_out < 0 or self.hold_out == 1:
            raise BagError(f'--hold-out: expected 0 or at least 2, got {self.hold_out}')

    def of(self, is_wanted: Callable[[Kind], bool]) -> list[str]:
        """Return the names of the sources of some kinds."""
        return [source for source in self.topics if is_wanted(self.kinds[source])]

    @property
    def odometry(self) -> list[str]:
        """Names of the sources of odometry, in the order of preference."""
        return self.of(lambda kind: kind.is_odometry)

    @property
    def fixes(self) -> list[str]:
        """Names of the sources of fixes."""
        return self.of(lambda kind: kind.on_earth)


def choose_inputs(reader: Bag, sources: Sequence[Source], wanted: Mapping[str, str | None],
                  hold_out: int = 0, span: Span = WHOLE, *, truth: str | None = None) -> Inputs:
    """
    Return the topics that feed the sources: wanted ones, else by parameter, else guessed.

    Guesses are made for `odom`, `fix`, `imu` and `gyro`, if the bag has one of their type, for
    `loop_closure`, if its usual topic is in the bag, and for `global_pose`, if one topic of poses
    is left and no source of fixes has a topic. Fixes are not guessed if global poses are wanted,
    and topics that are named as the truth, such as `/ground_truth` or `/gt/pose`, never.

    Neither is the topic of the truth that the result is compared with. Raises `BagError` if there
    is no odometry, a wanted topic is missing or of another type, a source is not among the
    parameters, or there are several candidates, which the message names.
    """
    kinds = {source.name: source.kind for source in sources}
    chosen = {name: topic for name, topic in wanted.items() if topic is not None}
    asked = 'global_pose' in chosen
    options = {name: f'--{name.replace("_", "-")}' for name in OPTIONS}
    for name in sorted(set(chosen) - set(kinds)):
        raise BagError(f'{options[name]} {chosen[name]}: the parameter sources has no {name}')
    named = {source.name: '/' + source.topic.removeprefix('/') for source in sources
             if source.topic != KNOWN_SOURCES.get(source.name, (None, None))[1]}
    for name, topic in named.items():
        if name not in chosen and topic in reader.topics:
            chosen[name] = topic
        elif name not in chosen:
            logger.warning('%s: no topic %s for %s', reader.path, topic, name)
    topics = dict(chosen)
    for name, topic in chosen.items():
        option = options.get(name, f'{name}.topic')
        info, wanted_type = reader.topics.get(topic), kinds[name].message_type
        if info is None:
            raise BagError(
                f'{reader.path}: no topic {topic} ({option}); the bag has {reader.describe()}')
        if info.type != wanted_type:
            raise BagError(f'{reader.path}: {option} {topic} is of type {info.type}, '
                           f'expected {wanted_type}')
    for name in ('odom', 'fix', CLOSURES, 'global_pose', 'imu', 'gyro'):
        if name not in topics and name in kinds and name not in named and (guess := _guess(
                reader, name, kinds, topics, asked=asked, truth=truth)) is not None:
            topics[name] = guess
    ordered = {name: topics[name] for name in kinds if name in topics}
    inputs = Inputs(ordered, {name: kinds[name] for name in ordered}, hold_out, span)
    if len(inputs.odometry) == 0:
        other = '' if truth is None else f' but that of the truth, {truth}'
        raise BagError(f'{reader.path}: no topic of type {KNOWN_SOURCES["odom"][0].message_type} '
                       f'for the odometry{other}; the bag has {reader.describe()}')
    return inputs


def _guess(reader: Bag, name: str, kinds: Mapping[str, Kind], topics: Mapping[str, str], *,
           asked: bool, truth: str | None) -> str | None:
    """Return the topic of a source for which none was given; None if there is no candidate."""
    kind, option = kinds[name], f'--{name.replace("_", "-")}'
    free = [topic for topic, info in reader.topics.items()
            if info.type == kind.message_type and topic != truth and not TRUTH.search(topic)
            and not any(used == topic and (kind.part == '' or kinds[source].part == kind.part)
                        for source, used in topics.items())]
    if kind.is_rare:
        usual = '/' + KNOWN_SOURCES[CLOSURES][1]
        return usual if usual in free else None
    if kind.in_map and not kind.on_earth:
        fixes = any(kinds[source].on_earth for source in topics)
        return free[0] if len(free) == 1 and not fixes else None
    if len(free) == 0 or (kind.on_earth and asked):
        return None
    if len(free) > 1:
        raise BagError(f'{reader.path}: {len(free)} topics of type {kind.message_type}, choose '
                       + ' or '.join(f'{option} {topic}' for topic in free))
    return free[0]


def read_inputs(reader: Bag, inputs: Inputs) -> Iterator[tuple[str, BagMessage, bool]]:
    """
    Yield source, message, and whether it is kept out of the graph, of the messages of the inputs.

    They come in the order in which they were recorded.
    """
    held, count = inputs.fixes or inputs.of(lambda kind: kind.in_map), 0
    for message in reader.messages({*inputs.topics.values()}, inputs.span):
        for source in (name for name, topic in inputs.topics.items() if topic == message.topic):
            count += source in held
            yield source, message, (
                source in held and inputs.stretch is None and inputs.hold_out > 0
                and count % inputs.hold_out == 0)


def read_static_frames(reader: Bag) -> list[BagMessage]:
    """Return the valid messages of a bag on /tf_static, to be received before all others."""
    topic, type_name = STATIC_FRAMES
    if topic not in reader.topics or reader.topics[topic].type != type_name:
        return []
    good = []
    for message in reader.messages([topic]):
        with suppress(Exception):   # it may have other fields, by a definition in the bag
            StaticFrames().receive(message.decode())
            good.append(message)
    return good


def reader_of(bag: Bag, values: Mapping[str, Any]) -> MessageReader:
    """Return a new reader for the messages of a bag, which knows its static transforms."""
    reader = MessageReader(values)
    for message in read_static_frames(bag):
        reader.frames.receive(message.decode())
    return reader
