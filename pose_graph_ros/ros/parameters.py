# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The tables of all parameters: the node declares them from here, yaml file and README show them.

One table holds those of the node, the other those that every source has under its name. Defaults
come from `core`, so that the offline tools have the same. This module imports no ROS.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
import re
import sys
from typing import Any

from pose_graph_ros.core.config import AlignmentPolicy, BackendConfig, NodePolicy
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.sources import (
    Correlation,
    CovariancePolicy,
    Heading,
    HEADINGS,
    LOOP_CLOSURES,
    Loss,
    MeasurementSource,
    NoiseFrom,
    OdometrySource,
    POSITIONS,
)
from pose_graph_ros.ros.sources import DEFAULT_SOURCES, Kind, KNOWN_SOURCES, source_names

Value = bool | float | str | list[float] | list[str]


class Change(Enum):
    """When a parameter can be changed."""

    ALWAYS = 'running'
    """At any time, for what comes from then on."""
    UNCONFIGURED = 'unconfigured'
    """While the node is not configured: it is taken when that is done."""
    START = 'read-only'
    """Only at the start: it decides which parameters there are, or what happens then."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter; of a source if it has kinds."""

    name: str
    """That of a source stands without the name of the source."""
    default: Value
    """An empty list of numbers stands for "not set"."""
    unit: str
    description: str
    smallest: float | None = None
    """Bound of a number, or of each in a list, inclusive."""
    largest: float | None = None
    choices: tuple[str, ...] = ()
    """What a text may be; empty for anything."""
    sizes: tuple[int, ...] = ()
    """How many numbers a list may have; empty for any."""
    kinds: tuple[Kind, ...] = ()
    """Kinds of sources that have the parameter."""
    change: Change = Change.ALWAYS


def _values(choices: type[Enum]) -> tuple[str, ...]:
    return tuple(str(choice.value) for choice in choices)


_NODES, _ALIGNMENT, _BACKEND = NodePolicy(), AlignmentPolicy(), BackendConfig()
_ODOMETRY, _MEASUREMENT, _COVARIANCE = OdometrySource(), MeasurementSource(), CovariancePolicy()
_NOISE = _ODOMETRY.noise
_POLICY = {True: 'repair', False: 'refuse'}

PARAMETERS: tuple[Parameter, ...] = (
    Parameter('sources', list(DEFAULT_SOURCES), '', 'Names of the sources, each with parameters '
              'as below; of odometry the first one is preferred. `loop_closure` is always there.',
              change=Change.START),
    Parameter('autostart', True, '', 'Configure and activate by itself; else a lifecycle manager '
              'does.', change=Change.START),
    Parameter('map_frame', 'map', '', 'Frame of the corrected path.',
              change=Change.UNCONFIGURED),
    Parameter('odom_frame', 'odom', '', 'Frame of the odometry, child of `map_frame` in TF.',
              change=Change.UNCONFIGURED),
    Parameter('base_link_frame', 'base_link', '', 'Frame of the robot.',
              change=Change.UNCONFIGURED),
    Parameter('publish_tf', True, '', 'Publish `map_frame` to `odom_frame` on /tf.'),
    Parameter('transform_time_offset', 0.0, 's', 'Added to the stamp of the transform.',
              0.0, 10.0),
    Parameter('transform_slew_linear', 0.0, 'm/s', 'What is corrected moves the robot in the '
              'published transform no faster than this; 0: at once.', 0.0, 1000.0),
    Parameter('transform_slew_angular', 0.0, 'rad/s', 'What is corrected turns the robot in the '
              'published transform no faster than this; 0: at once.', 0.0, 1000.0),
    Parameter('frequency', 10.0, 'Hz', 'How often the graph is optimised.', 0.01, 100.0),
    Parameter('path_period', 1.0, 's', 'The path is published at most this often.', 0.0, 3600.0),
    Parameter('graph_period', 2.0, 's', 'The markers of the graph are published at most this '
              'often.', 0.1, 3600.0),
    Parameter('diagnostics_period', 1.0, 's', 'How often /diagnostics is published.', 0.01, 60.0),
    Parameter('closing_silence', 2.0, 's', 'After so long without any message the graph is '
              'optimised to the end; 0 never does.', 0.0, 3600.0),
    Parameter('clock_jump_threshold', 1.0, 's', 'When time, the clock of the node or the stamps '
              'of odometry, jumps back by more than this the graph begins anew.', 0.01, 3600.0),
    Parameter('graph_file', '', '', 'File that `~/save_graph` writes and `~/load_graph` reads: '
              'graph.g2o, with .json and .tum beside it.'),
    Parameter('datum', [], 'deg, deg, rad', 'Latitude and longitude of the origin of the map and, '
              'as a third number, the angle of its x axis from east; unset: the first fix, '
              'x east.', sizes=(0, 2, 3), change=Change.UNCONFIGURED),
    Parameter('wait_for_datum', False, '', 'Without `datum`, refuse fixes until `~/set_datum` is '
              'called.', change=Change.UNCONFIGURED),
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
    Parameter('odometry_patience', _BACKEND.odometry_patience, 's', 'Another odometry makes the '
              'hidden nodes when the one that did is so much behind.', 0.05, 3600.0),
    Parameter('alignment.sigma_heading', _ALIGNMENT.sigma_heading, 'rad',
              'From positions alone the map is aligned once the angle is this certain.',
              1e-3, 1.0),
    Parameter('alignment.minimum_baseline', _ALIGNMENT.minimum_baseline, 'm',
              '... and the positions span this length,', 0.1, 1000.0),
    Parameter('alignment.baseline_in_sigmas', _ALIGNMENT.baseline_in_sigmas, '',
              '... and this many of their sigmas.', 1.0, 100.0),
)

_ALL = tuple(Kind)
_WHEELS = (Kind.ODOMETRY,)
_OTHERS = tuple(kind for kind in Kind if kind is not Kind.ODOMETRY)
_POSITIONS = (Kind.GLOBAL_POSE, Kind.FIX)
_NOT_CLOSURES = tuple(kind for kind in _OTHERS if kind is not Kind.LOOP_CLOSURE)

SOURCE_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('type', '', '', 'What the source is.', choices=_values(Kind), kinds=_ALL,
              change=Change.START),
    Parameter('topic', '', '', 'Topic; if it is not given, the name of the source.', kinds=_ALL,
              change=Change.UNCONFIGURED),
    Parameter('time_offset', 0.0, 's', 'Added to the stamps.', -3600.0, 3600.0, kinds=_ALL),
    Parameter('noise', _ODOMETRY.noise_from.value, '', 'Noise by a model of distance and turns, '
              'or by the covariance of the twist times dt.', choices=_values(NoiseFrom),
              kinds=_WHEELS, change=Change.UNCONFIGURED),
    Parameter('sigma_distance', _NOISE.sigma_distance, 'm/sqrt(m)',
              'Odometry noise along the path, per root of its length.', 0.0, 10.0, kinds=_WHEELS),
    Parameter('sigma_lateral', _NOISE.sigma_lateral, 'm/sqrt(m)',
              'Odometry noise across the path, per root of its length.', 0.0, 10.0,
              kinds=_WHEELS),
    Parameter('sigma_heading_distance', _NOISE.sigma_heading_distance, 'rad/sqrt(m)',
              'Heading noise per root of the path length.', 0.0, 10.0, kinds=_WHEELS),
    Parameter('sigma_heading_turn', _NOISE.sigma_heading_turn, 'rad/sqrt(rad)',
              'Heading noise per root of the turn.', 0.0, 10.0, kinds=_WHEELS),
    Parameter('sigma_floor', [_NOISE.sigma_floor_position, _NOISE.sigma_floor_heading], 'm, rad',
              'Least noise of position and heading between two hidden nodes.', 1e-6, 100.0,
              sizes=(2,), kinds=_WHEELS),
    Parameter('reorder_window', _ODOMETRY.reorder_window, 's', 'What is older than the newest '
              'message by less than this is sorted in.', 0.0, 60.0, kinds=_WHEELS),
    Parameter('maximum_speed', _ODOMETRY.maximum_speed, 'm/s', 'A faster motion is a jump of the '
              'odometry, not of the robot.', 0.01, 1e4, kinds=_WHEELS),
    Parameter('covariance_policy', _POLICY[_COVARIANCE.repair], '',
              'What becomes of a broken covariance.', choices=('repair', 'refuse'),
              kinds=_NOT_CLOSURES),
    Parameter('covariance_policy', _POLICY[LOOP_CLOSURES.covariance.repair], '',
              'What becomes of a broken covariance.', choices=('repair', 'refuse'),
              kinds=(Kind.LOOP_CLOSURE,)),
    Parameter('covariance_override', list(_COVARIANCE.override), 'm, rad', 'Sigma of the position '
              'and, if there are two numbers, of the heading, taken instead of the covariances.',
              1e-6, 1e6, sizes=(0, 1, 2), kinds=_OTHERS),
    Parameter('covariance_scale', _COVARIANCE.scale, '', 'Factor on every covariance.', 1e-6, 1e6,
              kinds=_ALL),
    Parameter('sigma_floor', [_COVARIANCE.position_floor, _COVARIANCE.heading_floor], 'm, rad',
              'No position and no heading is believed to be better.', 1e-6, 100.0, sizes=(2,),
              kinds=_OTHERS),
    Parameter('sigma_ceiling', _COVARIANCE.position_ceiling, 'm',
              'No position counts as worse.', 1e-3, 1e6, kinds=_OTHERS),
    Parameter('default_sigma', [_COVARIANCE.default_position, _COVARIANCE.default_heading],
              'm, rad', 'Taken where a covariance is unknown (all zero) and repaired.', 1e-5, 1e4,
              sizes=(2,), kinds=_OTHERS),
    Parameter('heading', _COVARIANCE.heading.value, '', 'Whether the heading is used; auto: if '
              'its variance is positive and less than that of a flat guess.',
              choices=_values(Heading), kinds=(Kind.GLOBAL_POSE,)),
    Parameter('lever_arm', [0.0, 0.0], 'm', 'Antenna in the frame of the robot, x and y; zero: '
              'from /tf_static if it is there.', -1e3, 1e3, sizes=(2,), kinds=(Kind.FIX,)),
    Parameter('yaw_offset', 0.0, 'rad', 'Added to the yaw; its zero is east.', -6.3, 6.3,
              kinds=(Kind.IMU,)),
    Parameter('robust_loss', POSITIONS.loss.value, '', 'How large errors count.',
              choices=_values(Loss), kinds=_POSITIONS),
    Parameter('robust_loss', _MEASUREMENT.loss.value, '', 'How large errors count.',
              choices=_values(Loss), kinds=tuple(kind for kind in Kind if kind not in _POSITIONS)),
    Parameter('rejection_threshold', _MEASUREMENT.rejection_threshold, '', 'From so many sigmas '
              'on the loss holds back.', 0.1, 1e3, kinds=_ALL),
    Parameter('minimum_period', _MEASUREMENT.minimum_period, 's', 'Of messages whose stamps lie '
              'closer the first to come is used; 0: all.', 0.0, 3600.0, kinds=_POSITIONS),
    Parameter('minimum_period', HEADINGS.minimum_period, 's', 'Of messages whose stamps lie '
              'closer the first to come is used; 0: all.', 0.0, 3600.0, kinds=(Kind.IMU,)),
    Parameter('correlation_time', _MEASUREMENT.correlation_time, 's',
              'How long an error lives, its time constant; 0: it is white.', 0.0, 1e5,
              kinds=_NOT_CLOSURES, change=Change.UNCONFIGURED),
    Parameter('correlation_model', _MEASUREMENT.correlation.value, '', 'Errors that live on are '
              'estimated as a bias, or make the covariances larger.',
              choices=_values(Correlation), kinds=_NOT_CLOSURES, change=Change.UNCONFIGURED),
    Parameter('white_share', _MEASUREMENT.white_share, '', 'Variance of what is white beside an '
              'error that lives on, in parts of the variance.', 0.0, 1.0, kinds=_NOT_CLOSURES,
              change=Change.UNCONFIGURED),
)

# A source's name begins names of parameters, and of counts in the diagnostics.
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')
_TOPIC = re.compile(r'(~?/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')
_TAKEN = {'solver', 'worker', 'received', 'alignment', 'qos_overrides', 'use_sim_time',
          'start_type_description_service'} | {parameter.name for parameter in PARAMETERS}


def type_parameter(source: str) -> Parameter:
    """Return the parameter that tells what a source is; it comes before its others."""
    return _of_source(SOURCE_PARAMETERS[0], source)


def source_parameters(source: str, kind: str) -> tuple[Parameter, ...]:
    """
    Return all parameters of a source with their full names.

    Raises
    ------
    ConfigError
        If there is no such kind of source.

    """
    checked_value(type_parameter(source), kind)
    return tuple(_of_source(parameter, source) for parameter in SOURCE_PARAMETERS
                 if Kind(kind) in parameter.kinds)


def _of_source(parameter: Parameter, source: str) -> Parameter:
    kind, topic = KNOWN_SOURCES.get(source, (None, source))
    default = parameter.default
    if parameter.name == 'type' and kind is not None:
        default = kind.value
    elif parameter.name == 'topic':
        default = topic
    return replace(parameter, name=f'{source}.{parameter.name}', default=default)


def listed_sources(given: Mapping[str, Any]) -> list[str]:
    """
    Return the names of all sources by the given parameters.

    Raises
    ------
    ConfigError
        If `sources` is no list of names, or a name cannot be one.

    """
    names = given.get('sources', list(DEFAULT_SOURCES))
    names = checked_value(PARAMETERS[0], names)
    for name in names:
        if _NAME.fullmatch(name) is None or name in _TAKEN:
            raise ConfigError(f'parameter sources: {name!r} cannot be the name of a source; '
                              'expected letters, digits and _, and no name of something else')
    if len(set(names)) < len(names):
        raise ConfigError(f'parameter sources: expected different names, got {list(names)}')
    return source_names(names)


def all_parameters(given: Mapping[str, Any]) -> tuple[Parameter, ...]:
    """
    Return the parameters of the node and of the sources that the given ones list.

    Raises
    ------
    ConfigError
        If a source is none; says which, and what was expected.

    """
    parameters = list(PARAMETERS)
    for source in listed_sources(given):
        kind = type_parameter(source)
        parameters += source_parameters(source, given.get(kind.name, kind.default))
    return tuple(parameters)


def defaults() -> dict[str, Value]:
    """Return the default of every parameter that is there if nothing is given."""
    return {parameter.name: parameter.default for parameter in all_parameters({})}


def checked(given: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return all parameters: the given ones, with types and ranges checked, and other defaults.

    Raises
    ------
    ConfigError
        For a name that is not known, a wrong type or a number out of range: what was expected,
        what came.

    """
    parameters = all_parameters(given)
    known = {parameter.name for parameter in parameters}
    for name in sorted(set(given) - known):
        source, dot, own = name.partition('.')
        hint = ''
        if dot and own in {parameter.name for parameter in SOURCE_PARAMETERS}:
            hint = (f': a source of type {given.get(f"{source}.type", "") or "its kind"} has none'
                    if f'{source}.type' in known else f': {source} is not in sources')
        raise ConfigError(f'parameter {name!r} is not known{hint}')
    return {parameter.name: checked_value(parameter, given[parameter.name])
            if parameter.name in given else parameter.default for parameter in parameters}


def checked_value(parameter: Parameter, value: Any) -> Any:
    """
    Return the value of a parameter as the tables have it: a float for 5, a list for a tuple.

    Raises
    ------
    ConfigError
        If it has a wrong type or is out of range: what was expected, what came.

    """
    name, default = parameter.name, parameter.default
    if isinstance(default, bool | str):
        if type(value) is not type(default):
            raise ConfigError(f'parameter {name}: expected {type(default).__name__}, '
                              f'got {value!r}')
        if len(parameter.choices) > 0 and value not in parameter.choices:
            raise ConfigError(f'parameter {name}: expected one of '
                              f'{", ".join(parameter.choices)}, got {value!r}')
        if name.endswith('.topic') and _TOPIC.fullmatch(str(value)) is None:
            raise ConfigError(f'parameter {name}: expected the name of a topic, got {value!r}')
        return value
    if isinstance(default, list):
        return _checked_list(parameter, value)
    return _number(parameter, value)


def _checked_list(parameter: Parameter, value: Any) -> Value:
    name, sizes = parameter.name, parameter.sizes
    of_names = name == 'sources'
    if not isinstance(value, Sequence) or isinstance(value, str | bytes) or (
            of_names and not all(isinstance(item, str) for item in value)):
        raise ConfigError(f'parameter {name}: expected a list of '
                          f'{"names" if of_names else "numbers"}, got {value!r}')
    if of_names:
        return list(value)
    if len(sizes) > 0 and len(value) not in sizes:
        raise ConfigError(f'parameter {name}: expected {" or ".join(map(str, sizes))} numbers '
                          f'[{parameter.unit}], got {list(value)}')
    return [_number(parameter, item) for item in value]


def _number(parameter: Parameter, value: Any) -> float:
    name = parameter.name
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f'parameter {name}: expected a number, got {value!r}')
    low = -sys.float_info.max if parameter.smallest is None else parameter.smallest
    high = sys.float_info.max if parameter.largest is None else parameter.largest
    if not low <= value <= high:
        expected = ('a finite number' if parameter.smallest is None
                    else f'a number in [{low:g}, {high:g}]')
        raise ConfigError(f'parameter {name}: expected {expected}, got {value!r}')
    return float(value)
