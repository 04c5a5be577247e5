# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs of filters and smoothers: what is used of them, and which kinds of sources they are."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
import re

from pose_graph_ros.cli.migration.files import Section

STATE = ('x', 'y', 'z', 'roll', 'pitch', 'yaw', 'vx', 'vy', 'vz', 'vroll', 'vpitch', 'vyaw',
         'ax', 'ay', 'az')
"""What the places of a configuration of robot_localization stand for."""
PLANAR = {'x', 'y', 'yaw', 'vx', 'vy', 'vyaw'}
VELOCITIES = {'vx', 'vy', 'vyaw'}
WAY = {'x', 'y', 'vx', 'vy'}
OF_FUSE = {'Odometry2D': 'odom', 'Imu2D': 'imu', 'Pose2D': 'pose', 'Twist2D': 'twist'}
DIMENSIONS = {'position_dimensions': '', 'orientation_dimensions': '', 'dimensions': 'a',
              'linear_velocity_dimensions': 'v', 'angular_velocity_dimensions': 'v',
              'linear_dimensions': 'v', 'angular_dimensions': 'v',
              'linear_acceleration_dimensions': 'a'}
"""Parameters of plugins of fuse, and what precedes a coordinate in `STATE`."""
_GNSS = re.compile(r'gps|gnss|navsat|fix', re.IGNORECASE)

UNUSED = {
    'odom': 'is a pose in the map as nav_msgs/Odometry: publish it as geometry_msgs/'
            'PoseWithCovarianceStamped, and add a source of type global_pose',
    'pose': 'tells differences of poses, or headings alone: publish it as nav_msgs/Odometry and '
            'add a source of type odometry, or as sensor_msgs/Imu and add one of type imu',
    'twist': 'tells no speed along the robot: rates alone are a source of type gyro, by '
             'sensor_msgs/Imu',
    'imu': 'tells nothing that this node uses: neither a yaw nor its rate'}
"""Why an input became no source, and what to do, by its message."""


@dataclass(frozen=True, eq=False)
class Input:
    """One input of a filter or smoother."""

    section: Section
    name: str  # such as odom0, or that of a plugin
    message: str  # odom, imu, pose or twist
    topic: str
    topic_key: str  # the parameters that tell topic and use
    use_keys: tuple[str, ...]
    uses: frozenset[str]  # of `STATE`
    moves: bool  # whether only differences count

    @property
    def why_unused(self) -> str:
        """Why it became no source, and what to do."""
        return UNUSED[self.message if self.message != 'odom' or self.uses & WAY else 'twist']

    @property
    def positions_only(self) -> bool:
        """Whether it is a position without a heading, from messages of odometry."""
        return self.message == 'odom' and self.uses & PLANAR == {'x', 'y'}

    @property
    def is_gnss(self) -> bool:
        """Whether it is what navsat_transform_node makes of fixes, by its name."""
        return self.positions_only and _GNSS.search(self.topic) is not None


def of_filter(section: Section) -> Iterator[Input]:
    """Yield the inputs of a filter of robot_localization."""
    values = section.values
    for name, topic in values.items():
        if (match := re.fullmatch(r'(odom|imu|pose|twist)\d+', name)) and isinstance(topic, str):
            config = values.get(key := f'{name}_config')
            flags = config if isinstance(config, list) else []
            yield Input(section, name, match[1], topic, name, (key,) if key in values else (),
                        frozenset(each for each, is_used in zip(STATE, flags, strict=False)
                                  if is_used in (True, 1)),
                        any(values.get(f'{name}_{how}') is True
                            for how in ('differential', 'relative')))


def of_smoother(section: Section) -> Iterator[Input]:
    """Yield the inputs of fuse's smoother."""
    for name, kind in plugins(section).items():
        if kind in OF_FUSE:
            own = {leaf: section.values[f'{name}.{leaf}'] for leaf in ('topic', *DIMENSIONS)
                   if isinstance(section.values.get(f'{name}.{leaf}'), str | list)}
            yield Input(section, name, OF_FUSE[kind], str(own.get('topic', name)),
                        f'{name}.topic', tuple(f'{name}.{leaf}' for leaf in DIMENSIONS
                                               if leaf in own),
                        frozenset(DIMENSIONS[leaf] + str(each).lower() for leaf in DIMENSIONS
                                  for each in own.get(leaf, ()) if isinstance(each, str)),
                        section.values.get(f'{name}.differential') is True)


def plugins(section: Section) -> dict[str, str]:
    """Return the plugins of fuse by name: the last part of their type."""
    found = {}
    for name, value in section.values.items():
        if match := re.fullmatch(r'(sensor_models|motion_models|publishers)\.(.+)\.type', name):
            found[match[2]] = str(value).rpartition('::')[2]
    return found


def kinds_of(one: Input, every: Collection[Input], *, in_map: bool, with_fixes: bool) -> list[str]:
    """Return the kinds of sources that an input becomes: none, one, or two of an IMU."""
    uses = one.uses & PLANAR
    match one.message:
        case 'odom' if one.is_gnss or (with_fixes and one.positions_only and not any(
                each.is_gnss for each in every)):
            return ['fix']
        case 'odom':
            # beside other odometry, a pose that counts as it is is one in the map
            is_absolute = in_map and not one.moves and not uses & VELOCITIES and any(
                each.uses & VELOCITIES or each.moves for each in every
                if each.message in ('odom', 'twist') and each is not one)
            return ['odometry'] if uses & WAY and not is_absolute else []
        case 'twist':
            return ['twist'] if 'vx' in uses else []
        case 'pose':
            return ['global_pose'] if {'x', 'y'} <= uses and not one.moves else []
    kinds = ['imu'] if 'yaw' in uses and not one.moves else []
    return [*kinds, 'gyro'] if 'vyaw' in uses or ('yaw' in uses and one.moves) else kinds


def free_name(one: Input, kind: str, kinds: Sequence[str], named: Sequence[str],
              usual: str) -> str:
    """Return the usual name of a kind of source, or that of the input if it is taken."""
    if usual not in ('', *named):
        return usual
    name = re.sub(r'\W', '_', one.name)
    return f'{name}_{kind}' if len(kinds) > 1 or name in named else name
