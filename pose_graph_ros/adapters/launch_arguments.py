# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The arguments of the launch file, and what they mean for the node; no ROS, and no launch."""

from collections.abc import Mapping
from pathlib import Path

from pose_graph_ros.adapters.sources import Kind, KNOWN_SOURCES
from pose_graph_ros.core.exceptions import ConfigError

AS_IN_FILE = 'as in params_file'
"""Default of arguments that set a parameter only if they are given."""
SWITCHES = {'true': True, '1': True, 'false': False, '0': False}

# Topic of the node and type of the messages by argument.
OUTPUTS = {
    'path': ('path', 'nav_msgs/Path'),
    'pose': ('pose', 'geometry_msgs/PoseWithCovarianceStamped'),
    'filtered_odometry': ('odometry/filtered', 'nav_msgs/Odometry'),
}


def arguments(share: Path) -> dict[str, tuple[str, str]]:
    """Return default and description by name, given the folder of the installed package."""
    config = share / 'config'
    inputs = {
        source: (AS_IN_FILE, f'topic of {kind.message_type.replace("/msg/", "/")}; sets '
                 f'{source}.topic' + (
                     f', if sources lists {source}' if kind in (Kind.IMU, Kind.GYRO) else ''))
        for source, (kind, _) in KNOWN_SOURCES.items()}
    return {
        'params_file': (str(config / 'pose_graph.yaml'), 'yaml file of parameters'),
        'name': ('pose_graph', 'name of the node'),
        'namespace': ('', 'namespace of the node and its topics'),
        'remap_tf': ('true', 'true or false: in a namespace, use its tf and tf_static instead of '
                     '/tf and /tf_static, as Nav2 does'),
        'use_sim_time': (AS_IN_FILE, 'true or false: take the time from /clock (simulation, '
                         'ros2 bag play --clock)'),
        'log_level': ('info', 'debug, info, warn, error or fatal'),
        'autostart': (AS_IN_FILE, 'true or false: configure and activate the node; otherwise a '
                      'lifecycle manager does'),
        'rviz': ('false', 'true or false: start RViz as well, if it is installed'),
        'rviz_config': (str(config / 'pose_graph.rviz'), 'configuration of RViz'),
        **inputs,
        **{name: (topic, f'topic of {type_name}') for name, (topic, type_name) in OUTPUTS.items()},
    }


def switch(given: Mapping[str, str], name: str) -> bool:
    """
    Return an argument that is true or false, as people write it.

    Parameters
    ----------
    given : mapping, arguments by name

    Raises
    ------
    ConfigError
        If it is neither true, false, 1 nor 0, in any case of letters.

    """
    text = given[name].strip().lower()
    if text not in SWITCHES:
        raise ConfigError(f'argument {name}: expected true or false, got {given[name]!r}')
    return SWITCHES[text]


def parameter_file(given: Mapping[str, str]) -> str:
    """Return the path of the parameter file; raises `ConfigError` if there is none."""
    path = Path(given['params_file']).expanduser()
    if not path.is_file():
        raise ConfigError(f'argument params_file: expected a file, got {str(path)!r}')
    return str(path)


def parameters(given: Mapping[str, str]) -> dict[str, bool | str]:
    """Return the parameters that arguments set; they take precedence over the parameter file."""
    own = {name for name, text in given.items() if text not in ('', AS_IN_FILE)}
    values: dict[str, bool | str] = {
        name: switch(given, name) for name in ('use_sim_time', 'autostart') if name in own}
    return values | {f'{name}.topic': given[name] for name in KNOWN_SOURCES if name in own}


def remappings(given: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the remaps of topics by the arguments, for the node and for RViz."""
    outputs = [(topic, given[name]) for name, (topic, _) in OUTPUTS.items()]
    return outputs + [(f'/{topic}', topic) for topic in ('tf', 'tf_static')
                      if switch(given, 'remap_tf')]
