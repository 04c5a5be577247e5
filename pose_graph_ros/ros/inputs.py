# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The inputs of the node as a bag holds them: which topic feeds which, and what is held out.

Player and offline replay read bags through here, so both feed the same messages. No rclpy.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from pose_graph_ros.ros.bags import BagError, BagMessage, BagReader, choose_topic

POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
TYPES = {
    'odom': 'nav_msgs/msg/Odometry',
    'fix': 'sensor_msgs/msg/NavSatFix',
    'global_pose': POSE,
    'loop_closure': POSE,
}
"""Message type of each input of the node."""
TOPICS = {
    'odom': 'odom', 'fix': 'gps/fix', 'global_pose': 'global_pose',
    'loop_closure': 'loop_closure'}
"""Topic of the node for each input."""
CLOSURES = '/loop_closure'
"""Topic of a bag that is taken for loop closures without being asked for."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Topics of a bag that feed the node, and how much of them is kept back."""

    topics: Mapping[str, str]
    """Input, such as `fix`, to the topic in the bag."""
    hold_out: int = 0
    """Every so many-th fix (global pose, if there are no fixes) is held out; 0 for none."""

    def __post_init__(self) -> None:
        if self.hold_out < 0 or self.hold_out == 1:
            raise BagError(f'hold out: expected 0 or at least 2, got {self.hold_out}')


class InputMessage(NamedTuple):
    """One message of a bag for the node."""

    source: str
    message: BagMessage
    held_out: bool


def choose_inputs(
    reader: BagReader, wanted: Mapping[str, str | None], hold_out: int = 0,
) -> Inputs:
    """
    Settle which topics feed which input: those asked for, else what the bag leaves no doubt about.

    Odometry and fixes are then the only topic of their type, loop closures are `/loop_closure`,
    and where there are no fixes a global pose is the only other pose. Who asks for global poses
    gets no fixes unasked, and the other way around.

    Raises
    ------
    BagError
        If there is no odometry, or the choice is not clear; names the candidates.

    """
    topics: dict[str, str] = {}

    def take(source: str, name: str | None) -> None:
        option = f'--{source.replace("_", "-")}'
        chosen = choose_topic(reader, name, TYPES[source], option)
        if chosen is not None:
            topics[source] = chosen

    odom, fix, global_pose, closure = (wanted.get(source) for source in TYPES)
    poses = [name for name, info in reader.topics.items() if info.type == POSE]
    if closure is None and CLOSURES in poses:
        closure = CLOSURES
    take('odom', odom)
    if fix is not None or global_pose is None:
        take('fix', fix)
    others = [name for name in poses if name != closure]
    if global_pose is None and 'fix' not in topics and len(others) == 1:
        global_pose = others[0]
    if global_pose is not None:
        take('global_pose', global_pose)
    if closure is not None:
        take('loop_closure', closure)
    if 'odom' not in topics:
        raise BagError(f'{reader.path}: no topic of type {TYPES["odom"]} for the odometry; '
                       f'the bag has {reader.describe()}')
    return Inputs(topics, hold_out)


def read_inputs(reader: BagReader, inputs: Inputs) -> Iterator[InputMessage]:
    """Iterate over the messages of the inputs in the order in which they were recorded."""
    sources: dict[str, list[str]] = {}
    for source, topic in inputs.topics.items():
        sources.setdefault(topic, []).append(source)
    held_source = 'fix' if 'fix' in inputs.topics else 'global_pose'
    count = 0
    for message in reader.messages(list(sources)):
        for source in sources[message.topic]:
            held_out = False
            if source == held_source and inputs.hold_out > 0:
                count += 1
                held_out = count % inputs.hold_out == 0
            yield InputMessage(source, message, held_out)
