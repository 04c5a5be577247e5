# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Parameter files as groups of parameters with flat names, whose these are, and the inputs in them.

Of inputs of filters and smoothers: what is used of them, and which kinds of sources they are.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
import re
from typing import Any, NamedTuple

from pose_graph_ros.adapters.conversions import frame
from pose_graph_ros.adapters.parameters import yaml_value
from pose_graph_ros.core.exceptions import ConfigError


class System(Enum):
    """A kind of node whose parameters are known."""

    FILTER = "robot_localization's filter"
    NAVSAT = "robot_localization's navsat_transform_node"
    FUSE = "fuse's smoother"
    SLAM_TOOLBOX = 'slam_toolbox'


# A parameter that no other node has. Names of nodes are free, so these do not tell anything.
SIGNATURES = {
    System.FILTER: re.compile(r'(odom|imu|pose|twist)\d+_config|two_d_mode'),
    System.NAVSAT: re.compile(
        r'magnetic_declination_radians|yaw_offset|zero_altitude|use_odometry_yaw|'
        r'broadcast_(utm|cartesian)_transform|publish_filtered_gps|use_local_cartesian|'
        r'wait_for_datum'),
    System.FUSE: re.compile(r'(sensor_models|motion_models|publishers)\..+\.type|lag_duration'),
    System.SLAM_TOOLBOX: re.compile(r'solver_plugin|loop_search_maximum_distance|map_file_name|'
                                    r'ceres_linear_solver'),
}


class Section(NamedTuple):
    """The parameters of one node in one file."""

    file: Path
    node: str  # with its namespace, as the file names it, or else the name of the file
    values: Mapping[str, Any]  # by names in which dots stand for nested groups
    system: System | None  # None if the node is another one


def in_map(section: Section) -> bool:
    """Tell whether a filter estimates in the map frame, by the defaults of robot_localization."""
    values = section.values
    world = values.get('world_frame', values.get('odom_frame', 'odom'))
    return frame(str(world)) == frame(str(values.get('map_frame', 'map')))


def place(section: Section, *names: str) -> str:
    """Return where a value is from: file, node and parameters."""
    return ', '.join(dict.fromkeys(filter(None, (
        section.file.name, section.node, ' and '.join(names)))))


def read(paths: Sequence[Path]) -> list[Section]:
    """Return the groups of parameters in some files; each file must have one that is known."""
    sections = []
    for path in paths:
        try:
            content = yaml_value(path.read_text(encoding='utf-8'))
        except OSError as error:
            raise ConfigError(f'{path}: {error.strerror}') from error
        except ValueError as error:
            raise ConfigError(f'{path}: cannot be read as yaml: {error}') from error
        if not isinstance(content, Mapping):
            raise ConfigError(f'{path}: expected a parameter file')
        found = [Section(path, node.removeprefix('/**/') or path.name, values, _system(values))
                 for node, values in _nodes(content)]
        if any('sources' in each.values for each in found):
            raise ConfigError(f'{path}: is a parameter file of this node already')
        if all(each.system is None for each in found):
            raise ConfigError(f'{path}: has no parameters of robot_localization, fuse or '
                              'slam_toolbox')
        sections += _shared_out(found)
    return sections


def _shared_out(sections: list[Section]) -> list[Section]:
    """Return the nodes of a file, each with what a section for several, as `/**`, says of it."""
    for shared in [each for each in sections if each.node.endswith('*')]:
        # of a kind, as what tells the kind may be in it; alone it is that of a node
        users = [each for each in sections if each is not shared and each.system is not None
                 and shared.system in (None, each.system)
                 and Path('/', each.node).is_relative_to(Path('/', shared.node.rstrip('*')))]
        if len(users) > 0:
            sections = [each._replace(values={**shared.values, **each.values})
                        if each in users else each for each in sections if each is not shared]
    return sections


def _nodes(tree: Mapping[Any, Any], name: str = '') -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and parameters of each node; those of ROS 1 have no `ros__parameters`."""
    if isinstance(inner := tree.get('ros__parameters'), Mapping):
        yield name, dict(_flat(inner))
    elif _system(flat := dict(_flat(tree))) is not None:
        yield name, flat
    else:
        for key, value in tree.items():
            if isinstance(value, Mapping):
                # ROS 2 writes the slash of a namespace, ROS 1 nests
                yield from _nodes(value, f'{name}/{key}'.replace('//', '/') if name else str(key))
        others = {str(key): value for key, value in tree.items() if not isinstance(value, Mapping)}
        if len(others) > 0:
            yield name, others


def _system(values: Mapping[str, Any]) -> System | None:
    return next((system for system, pattern in SIGNATURES.items()
                 if any(pattern.fullmatch(name) for name in values)), None)


def _flat(tree: Mapping[Any, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        named = {str(each['name']): {key: own for key, own in each.items() if key != 'name'}
                 for each in value if isinstance(each, Mapping) and 'name' in each
                 } if isinstance(value, list) else {}  # plugins of fuse in ROS 1
        if isinstance(value, Mapping) or len(named) > 0:
            yield from _flat(named or value, f'{prefix}{name}.')
        else:
            # rcl reads 1e-3 as a number, and the parser of Python as text
            yield f'{prefix}{name}', float(value) if isinstance(value, str) and re.fullmatch(
                r'[-+]?\d+(\.\d*)?[eE][-+]?\d+', value) else value


# --- inputs

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
    # in the odometry frame 0 is anywhere, unless fixes have to fit it
    knows_east = in_map or with_fixes or any(each.is_gnss for each in every)
    kinds = ['imu'] if 'yaw' in uses and knows_east and not one.moves else []
    return [*kinds, 'gyro'] if 'vyaw' in uses or ('yaw' in uses and len(kinds) == 0) else kinds


def free_name(one: Input, kind: str, kinds: Sequence[str], named: Sequence[str],
              usual: str) -> str:
    """Return the usual name of a kind of source, or that of the input if it is taken."""
    if usual not in ('', *named):
        return usual
    name = re.sub(r'\W', '_', one.name)
    return f'{name}_{kind}' if len(kinds) > 1 or name in named else name
