# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The ROS parameters in two tables: those of the node, and those of each source.

The node declares its parameters from the tables, and the parameter file and docs/parameters.md are
generated from them. Defaults come from `core.config`. This module imports no ROS.
"""

from dataclasses import dataclass
from enum import Enum

from pose_graph_ros.adapters.sources import DEFAULT_SOURCES, Kind, ODOMETRY_KINDS, OUTPUTS
from pose_graph_ros.core import config
from pose_graph_ros.core.config import GyroSource, Integrate, RateNoise

Value = bool | float | str | list[float] | list[str]


class Change(Enum):
    """When a parameter can be changed."""

    ALWAYS = 'running'  # at any time; it applies to data received afterwards
    UNCONFIGURED = 'unconfigured'  # before the transition `configure`, which reads it
    START = 'read-only'  # never, as it determines other parameters or the startup itself


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the node, or of its sources if `kinds` is not empty."""

    name: str  # for a parameter of a source, without the name of the source
    default: Value  # an empty list of numbers means that the parameter is unset
    unit: str
    description: str
    smallest: float | None = None  # bound of a number, or of each one in a list, inclusive
    largest: float | None = None
    choices: tuple[str, ...] = ()  # allowed texts; empty if all are allowed
    sizes: tuple[int, ...] = ()  # allowed sizes of a list; empty if all are allowed
    kinds: tuple[Kind, ...] = ()  # kinds of sources with this parameter
    change: Change = Change.ALWAYS


def _values(choices: type[Enum]) -> tuple[str, ...]:
    return tuple(str(choice.value) for choice in choices)


_BACKEND, _ODOMETRY = config.BackendConfig(), config.OdometrySource()
_MEASUREMENT, _COVARIANCE = config.MeasurementSource(), config.CovariancePolicy()
_RATES = GyroSource()
_NODES, _NOISE = _BACKEND.nodes, _ODOMETRY.noise
_WINDOW, _THINNING = _BACKEND.window, _BACKEND.thinning

PARAMETERS: tuple[Parameter, ...] = (
    Parameter('sources', list(DEFAULT_SOURCES), '', 'Names of the sources of measurements; the '
              'parameters of each source are listed under its name. Of several odometry sources '
              'the first one is preferred. The source `loop_closure` always exists.',
              change=Change.START),
    Parameter('autostart', True, '', 'Whether the node configures and activates itself. If false, '
              'a lifecycle manager must do so.', change=Change.START),
    Parameter('map_frame', 'map', '', 'Frame of the corrected path.', change=Change.UNCONFIGURED),
    Parameter('odom_frame', 'odom', '', 'Frame of the odometry, child of `map_frame` in TF.',
              change=Change.UNCONFIGURED),
    Parameter('base_link_frame', 'base_link', '', 'Frame of the robot base.',
              change=Change.UNCONFIGURED),
    Parameter('publish_tf', True, '', 'Whether to publish the transform from `map_frame` to '
              '`odom_frame` on /tf.'),
    Parameter('wait_for_map', False, '', 'Whether pose, odometry, path and transform are held '
              'back until it is known where the odometry frame lies in the map, if `sources` '
              'lists one that tells: fixes or global poses.'),
    Parameter('transform_time_offset', 0.0, 's', 'Time added to the stamp of the published '
              'transform.', 0.0, 10.0),
    Parameter('transform_slew', [0.0, 0.0], 'm/s, rad/s', 'Maximum linear and angular speed at '
              'which corrections move the robot in the published transform. If 0, corrections '
              'are applied at once.', 0.0, 1000.0, sizes=(2,)),
    Parameter('frequency', 10.0, 'Hz', 'Frequency of the incremental optimisation of the graph.',
              0.01, 100.0),
    Parameter('path_period', 1.0, 's', 'Minimum time between two published paths; markers of the '
              'graph and verdicts come half as often.', 0.0, 3600.0),
    Parameter('diagnostics_period', 1.0, 's', 'Time between two messages on /diagnostics.',
              0.01, 60.0),
    Parameter('closing_silence', 2.0, 's', 'Time without any message after which the whole graph '
              'is optimised until convergence. If 0, it never is.', 0.0, 3600.0),
    Parameter('graph_file', '', '', 'File that `~/save_graph` writes and `~/load_graph` reads, '
              'such as graph.g2o. Files with the suffixes .json and .tum are stored next to it.'),
    Parameter('load_graph_on_start', False, '', 'Whether to continue with the graph in '
              '`graph_file`, once there is one. If it cannot be loaded, the node is not '
              'configured.',
              change=Change.UNCONFIGURED),
    Parameter('datum', [], 'deg, deg, rad', 'Latitude and longitude of the origin of the map and, '
              'optionally, the angle from east to its x axis. If unset, the first fix is the '
              'origin and the x axis points east.', sizes=(0, 2, 3), change=Change.UNCONFIGURED),
    Parameter('wait_for_datum', False, '', 'Whether to refuse fixes until `~/set_datum` is '
              'called, if `datum` is unset.', change=Change.UNCONFIGURED),
    Parameter('minimum_travel_distance', _NODES.minimum_travel_distance, 'm',
              'Distance from the last hidden node at which a new one is added.', 0.0, 1000.0),
    Parameter('minimum_travel_heading', _NODES.minimum_travel_heading, 'rad',
              'Rotation since the last hidden node at which a new one is added.', 0.0, 3.2),
    Parameter('window.seconds', _WINDOW.seconds, 's', 'Time that the graph looks back. What is '
              'older leaves it: its path stays as it is, and what its measurements told is kept '
              'as a prior. If 0, there is no limit; the smallest of the three limits applies.',
              0.0, 1e9),
    Parameter('window.metres', _WINDOW.metres, 'm', 'Length of the path that the graph looks '
              'back. If 0, there is no limit.', 0.0, 1e9),
    Parameter('window.nodes', float(_WINDOW.nodes), '', 'Number of hidden nodes that the graph '
              'keeps. If 0, there is no limit.', 0.0, 1e9),
    Parameter('window.prior', _WINDOW.prior.value, '', 'What replaces the hidden nodes that '
              'leave: `dense`, one constraint on all their neighbours, or `sparse`, a few '
              'constraints between pairs of these, which is cheaper and less certain.',
              choices=_values(config.WindowPrior)),
    Parameter('thinning.cell', _THINNING.cell, 'm', 'Where a place is driven again and again, few '
              'hidden nodes stay in the graph: one leaves it if an older one stays within this '
              'distance and its position relative to that is certain. If 0, all stay. Twice the '
              'distance between hidden nodes is a good value.', 0.0, 1000.0),
    *(Parameter(f'outputs.{name}', topic, '', f'Topic of the {content}.',
                change=Change.UNCONFIGURED) for name, (topic, _, content) in OUTPUTS.items()),
)

_ALL = tuple(Kind)
_WHEELS, _GYRO = ODOMETRY_KINDS, (Kind.GYRO,)
_OTHERS = tuple(kind for kind in Kind if kind is not Kind.GYRO and not kind.is_odometry)
_POSITIONS = (Kind.GLOBAL_POSE, Kind.FIX)
_JUDGED = (*_POSITIONS, Kind.LOOP_CLOSURE)
_NOT_CLOSURES = tuple(kind for kind in _OTHERS if kind is not Kind.LOOP_CLOSURE)

SOURCE_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('type', '', '', 'Type of the source.', choices=_values(Kind), kinds=_ALL,
              change=Change.START),
    Parameter('topic', '', '', 'Topic of the messages. By default the name of the source, unless '
              'the source is predefined.', kinds=_ALL, change=Change.UNCONFIGURED),
    Parameter('time_offset', 0.0, 's', 'Time added to the stamps of the messages.', -3600.0,
              3600.0, kinds=_ALL),
    Parameter('noise', _ODOMETRY.noise_from.value, '', 'Origin of the odometry noise: `model` '
              'uses distance and rotation, `twist` the twist covariance times the time step.',
              choices=_values(config.NoiseFrom), kinds=_WHEELS, change=Change.UNCONFIGURED),
    Parameter('integrate', _ODOMETRY.integrate.value, '', 'Origin of the motion: the `pose` in '
              'the messages, or their `twist`, integrated between messages.',
              choices=_values(Integrate), kinds=(Kind.ODOMETRY,),
              change=Change.UNCONFIGURED),
    Parameter('sigma_distance', _NOISE.sigma_distance, 'm/sqrt(m)', 'Odometry noise along the '
              'path, per square root of the distance.', 0.0, 10.0, kinds=_WHEELS),
    Parameter('sigma_lateral', _NOISE.sigma_lateral, 'm/sqrt(m)', 'Odometry noise across the '
              'path, per square root of the distance.', 0.0, 10.0, kinds=_WHEELS),
    Parameter('sigma_heading_distance', _NOISE.sigma_heading_distance, 'rad/sqrt(m)', 'Odometry '
              'noise of the heading, per square root of the distance.', 0.0, 10.0, kinds=_WHEELS),
    Parameter('sigma_heading_turn', _NOISE.sigma_heading_turn, 'rad/sqrt(rad)', 'Odometry noise '
              'of the heading, per square root of the rotation.', 0.0, 10.0, kinds=_WHEELS),
    Parameter('maximum_speed', _ODOMETRY.maximum_speed, 'm/s', 'Faster motion is treated as a '
              'jump of the odometry.', 0.01, 1e4, kinds=_WHEELS),
    Parameter('mounting', 'tf', '', 'Whether the z axis of the gyroscope points `up` or `down`. '
              'With `tf` the rotation from its frame to the robot base frame is taken from '
              '/tf_static; messages are refused until it is there.',
              choices=('tf', 'up', 'down'), kinds=_GYRO),
    Parameter('noise', _RATES.noise_from.value, '', 'Origin of the noise of the rate: `message` '
              'uses the variance in the messages, if it is positive, `model` uses `sigma_rate`.',
              choices=_values(RateNoise), kinds=_GYRO),
    Parameter('sigma_rate', _RATES.sigma_rate, 'rad/sqrt(s)', 'Noise density of the rate (angle '
              'random walk).', 1e-9, 10.0, kinds=_GYRO),
    Parameter('sigma_turn', _RATES.sigma_turn, 'rad/sqrt(rad)', 'Noise of the rotation, per '
              'square root of the rotation; stands for the error of the scale.', 0.0, 10.0,
              kinds=_GYRO),
    Parameter('sigma_bias', _RATES.sigma_bias, 'rad/s', 'Standard deviation of the bias when the '
              'sensor is switched on. At rest by the wheels, a mean rate of up to five of these '
              'is a measurement of the bias.', 1e-9, 10.0, kinds=_GYRO,
              change=Change.UNCONFIGURED),
    Parameter('sigma_bias_walk', _RATES.sigma_bias_walk, 'rad/s/sqrt(s)', 'Random walk of the '
              'bias.', 1e-12, 1.0, kinds=_GYRO, change=Change.UNCONFIGURED),
    Parameter('bias_period', _RATES.bias_period, 's', 'Time between two states of the bias.', 0.1,
              3600.0, kinds=_GYRO, change=Change.UNCONFIGURED),
    Parameter('maximum_gap', _RATES.maximum_gap, 's', 'Longest time between two messages over '
              'which the rate is integrated. A longer one leaves the rotation between two hidden '
              'nodes out.', 1e-3, 10.0, kinds=_GYRO),
    Parameter('covariance_override', [], 'm, rad', 'Standard deviation of the position and, '
              'optionally, of the heading, used instead of the covariance in the messages.', 1e-6,
              1e6, sizes=(0, 1, 2), kinds=_OTHERS),
    Parameter('covariance_scale', 1.0, '', 'Factor applied to all covariances.', 1e-6, 1e6,
              kinds=_ALL),
    Parameter('sigma_floor', [_COVARIANCE.position_floor, _COVARIANCE.heading_floor], 'm, rad',
              'Minimum standard deviation of position and heading.', 1e-6, 100.0, sizes=(2,),
              kinds=_NOT_CLOSURES),
    Parameter('heading', _COVARIANCE.heading.value, '', 'Whether to use the heading of the pose. '
              'With `auto` it is used if its variance is positive and less than that of a uniform '
              'distribution on the circle.', choices=_values(config.Heading),
              kinds=(Kind.GLOBAL_POSE,)),
    Parameter('lever_arm', [0.0, 0.0], 'm', 'Position of the antenna in the robot base frame, x '
              'and y. If zero, it is taken from /tf_static if available.', -1e3, 1e3, sizes=(2,),
              kinds=(Kind.FIX,)),
    Parameter('yaw_offset', 0.0, 'rad', 'Angle added to the yaw, such that zero is east.', -6.3,
              6.3, kinds=(Kind.IMU,)),
    *(Parameter('robust', robust.value, '', text, choices=choices, kinds=kinds)
      for kinds, robust, choices, text in (
        (_JUDGED, config.POSITIONS.robust, _values(config.Robust), 'Protection from wrong '
         'measurements: `judged` uses only those that the others do not contradict, with the '
         '`robust_loss`; `loss` uses all, with the `robust_loss`; `none` uses all, without it.'),
        ((Kind.IMU,), config.HEADINGS.robust, _values(config.Robust)[1:], 'Whether the '
         '`robust_loss` is used.'))),
    Parameter('sigma_scale', _ODOMETRY.sigma_scale, '', 'Factor on the standard deviations of the '
              'primary odometry. If 0, it is 1, but more or less where global poses or fixes '
              'with a `correlation_time` of -1 show that odometry drifts more or less than it '
              'claims.',
              0.0, 1e3, kinds=_WHEELS),
    *(Parameter('robust_loss', loss.value, '', 'Robust loss applied to the errors. The last four '
                'are bounded: very wrong measurements have no influence, and the start matters. '
                'The weight of a measurement falls above an error of 3 standard deviations, for '
                '`tukey` of 5.', choices=_values(config.Loss), kinds=kinds) for kinds, loss in (
        (_POSITIONS, config.POSITIONS.loss),
        ((Kind.IMU, Kind.LOOP_CLOSURE), _MEASUREMENT.loss))),
    *(Parameter('correlation_time', time, 's', 'Time constant of time-correlated errors. If 0, '
                'errors are white noise. If -1, the errors themselves show whether they are '
                'correlated and for how long.', config.FOUND, 1e5, kinds=kinds,
                change=Change.UNCONFIGURED) for kinds, time in (
        (_POSITIONS, config.POSITIONS.correlation_time),
        ((Kind.IMU,), _MEASUREMENT.correlation_time))),
)

OF_SOURCES = frozenset(parameter.name for parameter in SOURCE_PARAMETERS)
