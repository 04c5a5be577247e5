# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the topics of a bag that feed the sources, and read them, for player and replay alike."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import logging
import re
from typing import Any

from pose_graph_ros.adapters.bags import Bag, BagError, BagMessage, MessageError, Span, WHOLE
from pose_graph_ros.adapters.sources import CLOSURES, Kind, KNOWN_SOURCES, MessageReader, Source

logger = logging.getLogger(__name__)

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

    def __post_init__(self) -> None:
        if self.hold_out < 0 or self.hold_out == 1:
            raise BagError(f'hold out: expected 0 or at least 2, got {self.hold_out}')

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


def choose_inputs(
    reader: Bag, sources: Sequence[Source], wanted: Mapping[str, str | None],
    hold_out: int = 0, span: Span = WHOLE, *, truth: str | None = None,
) -> Inputs:
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
    for name in sorted(set(chosen) - set(kinds)):
        raise BagError(f'--{_option(name)} {chosen[name]}: the parameter sources has no {name}')
    named = {source.name: '/' + source.topic.removeprefix('/') for source in sources
             if source.topic != KNOWN_SOURCES.get(source.name, (None, None))[1]}
    for name, topic in named.items():
        if name not in chosen and topic in reader.topics:
            chosen[name] = topic
        elif name not in chosen:
            logger.warning('%s: no topic %s for %s', reader.path, topic, name)
    topics = dict(chosen)
    for name, topic in chosen.items():
        option = f'--{_option(name)}' if name in OPTIONS else f'{name}.topic'
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


def _option(name: str) -> str:
    return name.replace('_', '-')


def _guess(
    reader: Bag, name: str, kinds: Mapping[str, Kind], topics: Mapping[str, str],
    *, asked: bool, truth: str | None,
) -> str | None:
    """Return the topic of a source for which none was given; None if there is no candidate."""
    kind, option = kinds[name], f'--{_option(name)}'
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
        choices = ' or '.join(f'{option} {topic}' for topic in free)
        raise BagError(
            f'{reader.path}: {len(free)} topics of type {kind.message_type}, choose {choices}')
    return free[0]


def read_inputs(reader: Bag, inputs: Inputs) -> Iterator[tuple[str, BagMessage, bool]]:
    """
    Yield source, message, and whether it is kept out of the graph, of the messages of the inputs.

    They come in the order in which they were recorded.
    """
    sources: dict[str, list[str]] = {}
    for source, topic in inputs.topics.items():
        sources.setdefault(topic, []).append(source)
    held, count = inputs.fixes or inputs.of(lambda kind: kind.in_map), 0
    for message in reader.messages(list(sources), inputs.span):
        for source in sources[message.topic]:
            count += source in held
            yield source, message, (
                source in held and inputs.hold_out > 0 and count % inputs.hold_out == 0)


def read_static_frames(reader: Bag) -> list[BagMessage]:
    """Return the valid messages of a bag on /tf_static, to be received before all others."""
    topic, type_name = STATIC_FRAMES
    if topic not in reader.topics or reader.topics[topic].type != type_name:
        return []
    good = []
    for message in reader.messages([topic]):
        with suppress(MessageError):
            message.decode()
            good.append(message)
    return good


def reader_of(bag: Bag, values: Mapping[str, Any]) -> MessageReader:
    """Return a new reader for the messages of a bag, which knows its static transforms."""
    reader = MessageReader(values)
    for message in read_static_frames(bag):
        reader.frames.receive(message.decode())
    return reader
