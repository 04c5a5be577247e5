# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The ROS parameters: those of the node, and groups of those of sources.

Which groups a source has, its kind says (`sources`). The node declares its parameters from here,
and the parameter file and docs/parameters.md are generated. Defaults come from `core.config`. This
module imports no ROS.
"""

from dataclasses import dataclass
from enum import Enum
from functools import partial

from pose_graph_ros.core import config

Value = bool | float | str | list[float] | list[str]

DEFAULT_SOURCES = ('odom', 'global_pose', 'fix')
OUTPUTS = {
    'path': ('path', 'nav_msgs/msg/Path', 'corrected path'),
    'pose': ('pose', 'geometry_msgs/msg/PoseWithCovarianceStamped', 'newest pose'),
    'filtered_odometry': ('odometry/filtered', 'nav_msgs/msg/Odometry', 'newest pose and twist'),
    'filtered_fix': ('gps/filtered', 'sensor_msgs/msg/NavSatFix', 'newest pose on the Earth'),
    'graph': ('graph', 'visualization_msgs/msg/MarkerArray', 'markers of the graph'),
    'verdicts': ('~/verdicts', 'diagnostic_msgs/msg/DiagnosticArray', 'verdicts'),
    'diagnostics': ('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', 'diagnostics')}
"""Default topic, type and content of the outputs."""
ROBOT_LOCALIZATION = 'robot_localization'


class Change(Enum):
    """When a parameter can be changed."""

    ALWAYS = 'running'  # at any time; it applies to data received afterwards
    UNCONFIGURED = 'unconfigured'  # before the transition `configure`, which reads it
    START = 'read-only'  # never, as it determines other parameters or the startup itself


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the node or of a source."""

    name: str  # for a parameter of a source, without the name of the source
    default: Value  # an empty list means that the parameter is unset
    unit: str
    description: str
    smallest: float | None = None  # bound of a number, or of each one in a list, inclusive
    largest: float | None = None
    choices: tuple[str, ...] = ()  # allowed texts; empty if all are allowed
    sizes: tuple[int, ...] = ()  # allowed sizes of a list; empty if all are allowed
    change: Change = Change.ALWAYS


Early = partial(Parameter, change=Change.UNCONFIGURED)
"""One that the node reads when it is configured."""


def _values(choices: type[Enum]) -> tuple[str, ...]:
    return tuple(str(choice.value) for choice in choices)


_BACKEND, _ODOMETRY = config.BackendConfig(), config.OdometrySource()
_COVARIANCE, _RATES = config.CovariancePolicy(), config.GyroSource()
_NODES, _NOISE = _BACKEND.nodes, _ODOMETRY.noise
_WINDOW, _THINNING = _BACKEND.window, _BACKEND.thinning

PARAMETERS: tuple[Parameter, ...] = (
    Parameter('sources', list(DEFAULT_SOURCES), '', 'Names of the sources of measurements; '
              'the parameters of each source are listed under its name. Of several odometry '
              'sources the first one is preferred. The source `loop_closure` always exists.',
              change=Change.START),
    Parameter('autostart', True, '', 'Whether the node configures and activates itself. If false, '
              'a lifecycle manager must do so.', change=Change.START),
    Early('map_frame', 'map', '', 'Frame of the corrected path.'),
    Early('odom_frame', 'odom', '', 'Frame of the odometry, child of `map_frame` in TF.'),
    Early('base_link_frame', 'base_link', '', 'Frame of the robot base.'),
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
    Parameter('solve_timeout', 10.0, 's', 'Time after which an update, an optimisation or other '
              'work on the graph is interrupted and undone. Measurements of an update are tried '
              'again in smaller groups, for longer. If 0, there is no limit.', 0.0, 3600.0),
    Parameter('graph_file', '', '', 'File that `~/save_graph` writes and `~/load_graph` reads, '
              'such as graph.g2o, in `file_folder`. Files with the suffixes .json and .tum are '
              'stored next to it.'),
    Parameter('file_folder', '', '', 'Folder outside of which `~/save_graph` writes and '
              '`~/load_graph` reads nothing. By default that of `graph_file` at the start, or, if '
              'that is unset, the one in which the node is started.', change=Change.START),
    Early('load_graph_on_start', False, '', 'Whether to continue with the graph in `graph_file`, '
          'once there is one. If it cannot be loaded, the node is not configured.'),
    Parameter('state_file', '', '', 'File in which the node keeps all that it accepts, such as '
              '~/.ros/pose_graph.db, and from which it continues when it is started again, also '
              'after a power failure. If empty, there is none.', change=Change.START),
    Early('state_period', 1.0, 's', 'Time within which what was accepted is in `state_file`.',
          0.01, 60.0),
    Early('datum', [], 'deg, deg, rad', 'Latitude and longitude of the origin of the map and, '
          'optionally, the angle from east to its x axis. If unset, the first fix is the origin '
          'and the x axis points east.', sizes=(0, 2, 3)),
    Early('wait_for_datum', False, '',
          'Whether to refuse fixes until `~/set_datum` is called, if `datum` is unset.'),
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
    Parameter('compatible', 'none', '', 'Whose services the node offers as well: with '
              '`robot_localization` those of its `ekf_node` and `navsat_transform_node`, by their '
              'names and types, such as `fromLL`.', choices=('none', ROBOT_LOCALIZATION),
              change=Change.START),
    *(Early(f'outputs.{name}', topic, '', f'Topic of the {content}.')
      for name, (topic, _, content) in OUTPUTS.items()),
)

# --- groups of parameters of sources

OF_ALL = (
    Early('topic', '', '', 'Topic of the messages. By default the name of the source, unless the '
          'source is predefined.'),
    Parameter('time_offset', 0.0, 's', 'Time added to the stamps of the messages.', -3.6e3, 3.6e3),
    Parameter('covariance_scale', 1.0, '', 'Factor applied to all covariances.', 1e-6, 1e6))

OF_WHEELS = (
    Early('noise', _ODOMETRY.noise_from.value, '', 'Origin of the odometry noise: `model` uses '
          'distance and rotation, `twist` the twist covariance times the time step.',
          choices=_values(config.NoiseFrom)),
    Parameter('sigma_distance', _NOISE.sigma_distance, 'm/sqrt(m)', 'Odometry noise along the '
              'path, per square root of the distance.', 0.0, 10.0),
    Parameter('sigma_lateral', _NOISE.sigma_lateral, 'm/sqrt(m)', 'Odometry noise across the '
              'path, per square root of the distance.', 0.0, 10.0),
    Parameter('sigma_heading_distance', _NOISE.sigma_heading_distance, 'rad/sqrt(m)', 'Odometry '
              'noise of the heading, per square root of the distance.', 0.0, 10.0),
    Parameter('sigma_heading_turn', _NOISE.sigma_heading_turn, 'rad/sqrt(rad)', 'Odometry noise '
              'of the heading, per square root of the rotation.', 0.0, 10.0),
    Parameter('maximum_speed', _ODOMETRY.maximum_speed, 'm/s', 'Faster motion is treated as a '
              'jump of the odometry.', 0.01, 1e4),
    Parameter('sigma_scale', _ODOMETRY.sigma_scale, '', 'Factor on the standard deviations of the '
              'primary odometry. If 0, it is 1, but more or less where global poses or fixes '
              'with a `correlation_time` of -1 show that odometry drifts more or less than it '
              'claims.', 0.0, 1e3),
    Early('calibrate', _ODOMETRY.calibrate, '', 'Whether a bias of the yaw rate and an error of '
          'the scale of the distance are estimated all the time, while this is the primary '
          'odometry. Fixes or global poses show them; they matter where these are missing.'),
    Early('calibration_sigma', [*_ODOMETRY.calibration_sigma], 'rad/s, 1', 'Standard deviations '
          'of the bias and of the error of the scale, before anything shows them.', 1e-9, 10.0,
          sizes=(2,)),
    Early('calibration_walk', [*_ODOMETRY.calibration_walk], 'rad/s/sqrt(h), 1/sqrt(h)',
          'Random walk of both, per square root of an hour.', 1e-9, 10.0, sizes=(2,)))

INTEGRATE = Early('integrate', _ODOMETRY.integrate.value, '', 'Origin of the motion: the `pose` '
                  'in the messages, or their `twist`, integrated between messages.',
                  choices=_values(config.Integrate))

OF_GYROS = (
    Parameter('mounting', 'tf', '', 'Whether the z axis of the gyroscope points `up` or `down`. '
              'With `tf` the rotation from its frame to the robot base frame is taken from '
              '/tf_static; messages are refused until it is there.', choices=('tf', 'up', 'down')),
    Parameter('noise', _RATES.noise_from.value, '', 'Origin of the noise of the rate: `message` '
              'uses the variance in the messages, if it is positive, `model` uses `sigma_rate`.',
              choices=_values(config.RateNoise)),
    Parameter('sigma_rate', _RATES.sigma_rate, 'rad/sqrt(s)', 'Noise density of the rate (angle '
              'random walk).', 1e-9, 10.0),
    Parameter('sigma_turn', _RATES.sigma_turn, 'rad/sqrt(rad)', 'Noise of the rotation, per '
              'square root of the rotation; stands for the error of the scale.', 0.0, 10.0),
    Early('sigma_bias', _RATES.sigma_bias, 'rad/s',
          'Standard deviation of the bias when the sensor is switched on. At rest by the wheels, '
          'a mean rate of up to five of these is a measurement of the bias.', 1e-9, 10.0),
    Early('sigma_bias_walk', _RATES.sigma_bias_walk, 'rad/s/sqrt(s)', 'Random walk of the bias.',
          1e-12, 1.0),
    Early('bias_period', _RATES.bias_period, 's', 'Time between two states of the bias.', 0.1,
          3600.0),
    Parameter('maximum_gap', _RATES.maximum_gap, 's', 'Longest time between two messages over '
              'which the rate is integrated. A longer one leaves the rotation between two hidden '
              'nodes out.', 1e-3, 10.0))

HEADING = Parameter('heading', _COVARIANCE.heading.value, '', 'Whether to use the heading of the '
                    'pose. With `auto` it is used if its variance is positive and less than that '
                    'of a uniform distribution on the circle.', choices=_values(config.Heading))
LEVER_ARM = Parameter('lever_arm', [0.0, 0.0], 'm', 'Position of the antenna in the robot base '
                      'frame, x and y. If zero, it is taken from /tf_static if available.', -1e3,
                      1e3, sizes=(2,))
BEACONS = Early('beacons', [], '', 'Beacons at known places: name, x and y in the map [m] of '
                'each, such as "anchor_1 12.5 -3.0". Others are located by their ranges.')
YAW_OFFSET = Parameter(
    'yaw_offset', 0.0, 'rad', 'Angle added to the yaw, such that zero is east.', -6.3, 6.3)


def of_measurements(defaults: config.MeasurementSource) -> tuple[Parameter, ...]:
    """Return the parameters of sources whose measurements have a covariance."""
    judged = defaults.robust is config.Robust.JUDGED
    return (
        Parameter('covariance_override', [], 'm, rad', 'Standard deviation of the position and, '
                  'optionally, of the heading, used instead of the covariance in the messages.',
                  1e-6, 1e6, sizes=(0, 1, 2)),
        Parameter('robust', defaults.robust.value, '', (
            'Protection from wrong measurements: `judged` uses only those that the others do not '
            'contradict, with the `robust_loss`; `loss` uses all, with the `robust_loss`; `none` '
            'uses all, without it.' if judged else 'Whether the `robust_loss` is used.'),
            choices=_values(config.Robust)[not judged:]),
        Parameter('robust_loss', defaults.loss.value, '', 'Robust loss applied to the errors. The '
                  'last four are bounded: very wrong measurements have no influence, and the '
                  'start matters. The weight of a measurement falls above an error of 3 standard '
                  'deviations, for `tukey` of 5.', choices=_values(config.Loss)))


def in_the_map(defaults: config.MeasurementSource) -> tuple[Parameter, ...]:
    """Return the parameters of sources of measurements relative to the map."""
    return (
        *of_measurements(defaults),
        Parameter('sigma_floor', [_COVARIANCE.position_floor, _COVARIANCE.heading_floor], 'm, rad',
                  'Minimum standard deviation of position and heading.', 1e-6, 100.0, sizes=(2,)),
        Early('correlation_time', defaults.correlation_time, 's', 'Time constant of '
              'time-correlated errors. If 0, errors are white noise. If -1, the errors '
              'themselves show whether they are correlated and for how long.', config.FOUND, 1e5))
