# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The table of all parameters: the node declares them from it, the yaml file and the README show it.

Defaults come from `core.config`, so that the offline tools have the same. This module imports no
ROS.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pose_graph_ros.core.config import AlignmentPolicy, BackendConfig, NodePolicy, OdometryNoise
from pose_graph_ros.core.exceptions import ConfigError

Value = bool | float | str | list[float]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the node."""

    name: str
    default: Value
    """An empty list of numbers stands for "not set"."""
    unit: str
    description: str
    smallest: float | None = None
    """Bound of a number, inclusive."""
    largest: float | None = None


_NODES, _NOISE, _ALIGNMENT, _BACKEND = (
    NodePolicy(), OdometryNoise(), AlignmentPolicy(), BackendConfig())

PARAMETERS: tuple[Parameter, ...] = (
    Parameter('map_frame', 'map', '', 'Frame of the corrected path.'),
    Parameter('odom_frame', 'odom', '', 'Frame of the odometry, child of `map_frame` in TF.'),
    Parameter('base_link_frame', 'base_link', '', 'Frame of the robot.'),
    Parameter('publish_tf', True, '', 'Publish `map_frame` to `odom_frame` on /tf.'),
    Parameter('transform_time_offset', 0.0, 's', 'Added to the stamp of the transform.',
              0.0, 10.0),
    Parameter('frequency', 2.0, 'Hz', 'How often the graph is optimised.', 0.01, 100.0),
    Parameter('path_period', 1.0, 's', 'The path is published at most this often.', 0.0, 3600.0),
    Parameter('diagnostics_period', 1.0, 's', 'How often /diagnostics is published.', 0.01, 60.0),
    Parameter('closing_silence', 2.0, 's', 'After so long without any message the graph is '
              'optimised to the end; 0 never does.', 0.0, 3600.0),
    Parameter('datum', [], 'deg, deg, rad', 'Latitude and longitude of the origin of the map and, '
              'as a third number, the angle of its x axis from east; unset: the first fix, '
              'x east.'),
    Parameter('fix.lever_arm', [0.0, 0.0], 'm', 'Antenna in the frame of the robot, x and y.'),
    Parameter('minimum_travel_distance', _NODES.minimum_travel_distance, 'm',
              'Distance from the last hidden node that makes a new one.', 0.0, 1000.0),
    Parameter('minimum_travel_heading', _NODES.minimum_travel_heading, 'rad',
              'Turn since the last hidden node that makes a new one.', 0.0, 3.2),
    Parameter('minimum_node_interval', _NODES.minimum_interval, 's',
              'Never more hidden nodes than one in this time.', 0.0, 60.0),
    Parameter('moving_node_interval', _NODES.moving_interval, 's',
              'A hidden node at the latest after this time, unless the robot stands still.',
              0.05, 3600.0),
    Parameter('node_heartbeat', _NODES.heartbeat, 's',
              'A hidden node at the latest after this time, even at rest.', 0.1, 86400.0),
    Parameter('odom.sigma_distance', _NOISE.sigma_distance, 'm/sqrt(m)',
              'Odometry noise along the path, per root of its length.', 0.0, 10.0),
    Parameter('odom.sigma_lateral', _NOISE.sigma_lateral, 'm/sqrt(m)',
              'Odometry noise across the path, per root of its length.', 0.0, 10.0),
    Parameter('odom.sigma_heading_distance', _NOISE.sigma_heading_distance, 'rad/sqrt(m)',
              'Heading noise per root of the path length.', 0.0, 10.0),
    Parameter('odom.sigma_heading_turn', _NOISE.sigma_heading_turn, 'rad/sqrt(rad)',
              'Heading noise per root of the turn.', 0.0, 10.0),
    Parameter('default_position_sigma', _BACKEND.default_position_sigma, 'm',
              'Taken where a fix or a global pose says that its covariance is unknown (all '
              'zero).', 1e-3, 1e4),
    Parameter('position_sigma_floor', _BACKEND.position_sigma_floor, 'm',
              'No measured position is believed to be better.', 1e-4, 100.0),
    Parameter('heading_sigma_floor', _BACKEND.heading_sigma_floor, 'rad',
              'No measured heading is believed to be better.', 1e-5, 1.0),
    Parameter('alignment.sigma_heading', _ALIGNMENT.sigma_heading, 'rad',
              'From positions alone the map is aligned once the angle is this certain.',
              1e-3, 1.0),
    Parameter('alignment.minimum_baseline', _ALIGNMENT.minimum_baseline, 'm',
              '... and the positions span this length,', 0.1, 1000.0),
    Parameter('alignment.baseline_in_sigmas', _ALIGNMENT.baseline_in_sigmas, '',
              '... and this many of their sigmas.', 1.0, 100.0),
)


def defaults() -> dict[str, Value]:
    """Return every parameter's default."""
    return {parameter.name: parameter.default for parameter in PARAMETERS}


def checked(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return all parameters: the given ones, with types and ranges checked, and other defaults.

    Raises
    ------
    ConfigError
        For a name that is not known, a wrong type or a number out of range: what was expected,
        what came.

    """
    unknown = sorted(set(values) - {parameter.name for parameter in PARAMETERS})
    if len(unknown) > 0:
        raise ConfigError(f'parameter {unknown[0]!r} is not known')
    return {parameter.name: _checked(parameter, values[parameter.name])
            if parameter.name in values else parameter.default for parameter in PARAMETERS}


def _checked(parameter: Parameter, value: Any) -> Value:
    name, default = parameter.name, parameter.default
    if isinstance(default, bool | str):
        if type(value) is not type(default):
            raise ConfigError(f'parameter {name}: expected {type(default).__name__}, '
                              f'got {value!r}')
        return value
    if isinstance(default, list):
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise ConfigError(f'parameter {name}: expected a list of numbers, got {value!r}')
        return [_number(parameter, item) for item in value]
    number = _number(parameter, value)
    low = -float('inf') if parameter.smallest is None else parameter.smallest
    high = float('inf') if parameter.largest is None else parameter.largest
    if not low <= number <= high:
        raise ConfigError(f'parameter {name}: expected a number in [{low:g}, {high:g}], '
                          f'got {value!r}')
    return number


def _number(parameter: Parameter, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f'parameter {parameter.name}: expected a number, got {value!r}')
    return float(value)


def backend_config(values: Mapping[str, Any]) -> BackendConfig:
    """Return the engine's settings from the parameters."""
    return BackendConfig(
        nodes=NodePolicy(
            minimum_travel_distance=values['minimum_travel_distance'],
            minimum_travel_heading=values['minimum_travel_heading'],
            minimum_interval=values['minimum_node_interval'],
            moving_interval=values['moving_node_interval'],
            heartbeat=values['node_heartbeat']),
        odometry_noise=OdometryNoise(
            sigma_distance=values['odom.sigma_distance'],
            sigma_lateral=values['odom.sigma_lateral'],
            sigma_heading_distance=values['odom.sigma_heading_distance'],
            sigma_heading_turn=values['odom.sigma_heading_turn']),
        alignment=AlignmentPolicy(
            sigma_heading=values['alignment.sigma_heading'],
            minimum_baseline=values['alignment.minimum_baseline'],
            baseline_in_sigmas=values['alignment.baseline_in_sigmas']),
        default_position_sigma=values['default_position_sigma'],
        position_sigma_floor=values['position_sigma_floor'],
        heading_sigma_floor=values['heading_sigma_floor'])


def as_yaml() -> str:
    """Return the content of `config/pose_graph.yaml`: all parameters with their defaults."""
    lines = ['# All parameters with their defaults; the file is made from the table in',
             '# pose_graph_ros/ros/parameters.py (pose-graph parameters --yaml).',
             '/**:', '  ros__parameters:']
    tree: dict[str, Any] = {}
    for parameter in PARAMETERS:
        group, _, leaf = parameter.name.rpartition('.')
        tree.setdefault(group, {})[leaf] = parameter
    for group, leaves in tree.items():
        indent = '    '
        if group != '':
            lines.append(f'{indent}{group}:')
            indent = '      '
        for leaf, parameter in leaves.items():
            unit = f' [{parameter.unit}]' if parameter.unit != '' else ''
            lines.append(f'{indent}# {parameter.description}{unit}')
            if parameter.default == []:
                lines.append(f'{indent}# {leaf}: [0.0, 0.0]')
            else:
                lines.append(f'{indent}{leaf}: {_yaml(parameter.default)}')
    return '\n'.join(lines) + '\n'


def as_markdown() -> str:
    """Return the README's table of parameters."""
    lines = ['| parameter | default | unit | range | what it does |', '|---|---|---|---|---|']
    for parameter in PARAMETERS:
        value = 'unset' if parameter.default == [] else _yaml(parameter.default)
        span = '' if parameter.smallest is None else f'{parameter.smallest:g} to ' \
            f'{parameter.largest:g}'
        lines.append(f'| `{parameter.name}` | {value} | {parameter.unit} | {span} | '
                     f'{parameter.description} |')
    return '\n'.join(lines) + '\n'


def _yaml(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return value if isinstance(value, str) else repr(value)
