# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter files as groups of parameters with flat names, and whose these are."""

from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
import re
from typing import Any, NamedTuple

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
    System.FILTER: re.compile(r'(odom|imu|pose|twist)\d+_config|two_d_mode|world_frame'),
    System.NAVSAT: re.compile(
        r'magnetic_declination_radians|yaw_offset|zero_altitude|use_odometry_yaw|'
        r'broadcast_(utm|cartesian)_transform|publish_filtered_gps|use_local_cartesian'),
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
    return bool(values.get('world_frame', values.get('odom_frame', 'odom')) == values.get(
        'map_frame', 'map'))


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
        sections += found
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
            yield f'{prefix}{name}', value
