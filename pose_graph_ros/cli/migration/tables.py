# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What becomes of each parameter of other systems: one table for each kind of node.

The first row whose pattern is the whole name, and whose value is that of the parameter if it has
one, tells. Names of parameters of an input or a plugin stand without its name and behind what it
became here and a colon, such as `fix:differential` for `odom1_differential`.
"""

from collections.abc import Callable
from enum import Enum
import re
from typing import Any, NamedTuple


class Fate(Enum):
    """What becomes of a parameter."""

    TAKEN = 'Taken'
    NOT_NEEDED = 'Not needed'
    CHANGED = 'Changes its meaning'
    NONE = 'Has no counterpart'
    UNKNOWN = 'Not known'


class Rule(NamedTuple):
    """What becomes of the parameters with some names."""

    pattern: str  # of the whole name, as a regular expression
    fate: Fate
    sentence: str = ''  # why, and what to do
    target: str = ''  # our parameter that gets the value; `*.` stands for the source of an input
    convert: Callable[[Any], Any] = lambda value: value
    value: Any = None  # the row is only for this value; None for all


TAKEN, NOT_NEEDED, CHANGED, NONE, UNKNOWN = Fate
GRAVITY = 'accelerations are not used: motion comes from odometry alone'
COMMANDS = 'commands of velocity are not used: odometry tells what was driven'
BY_MOTION = 'odometry always counts by its motion from message to message'
AT_ODOMETRY = 'a pose comes with every message of odometry, at its rate'
JUDGED = ('nothing is refused for its distance from the newest state alone: all measurements '
          'together decide which ones are believed (parameter robust, topic ~/verdicts)')
NOISE = ('there is no motion model: odometry has noise by distance and turn (odom.sigma_*), whose '
         'defaults suit most wheels; `pose-graph tune` finds it from a recorded drive')
SET_POSE = 'send the pose to the topic initialpose or set_pose'
START = 'nothing is assumed of the start: the first fixes and poses tell where it is'
ROTATIONS = ('a yaw that counts from its start tells rotations, as the rates in the same messages '
             'do: so it became a gyroscope')
QUEUES = 'queues are 1000 messages deep; qos_overrides changes that'
DELAYS = 'a measurement is put where its own stamp is, however late it comes'
EVERYWHERE = (
    Rule('use_sim_time', TAKEN, 'in the launch call', value=True),
    Rule(r'qos_overrides\..*', CHANGED, 'write it again for the topics of this node'))

FILTER = (
    Rule('map_frame', TAKEN, target='map_frame'),
    Rule('odom_frame', TAKEN, target='odom_frame'),
    Rule('base_link_frame', TAKEN, target='base_link_frame'),
    Rule('base_link_(frame_output|output_frame)', NONE, 'the pose is that of base_link_frame'),
    Rule('world_frame', TAKEN, 'tells which filter is replaced; here the world is map_frame'),
    Rule('publish_tf', TAKEN, 'map_frame -> odom_frame', 'publish_tf'),
    Rule('transform_time_offset', TAKEN, target='transform_time_offset'),
    Rule('two_d_mode', NOT_NEEDED, 'this node always is in the plane', value=True),
    Rule('two_d_mode', NONE, 'false asks for height, roll and pitch, which this node has not: '
         'who needs them keeps a filter in odom_frame beside it'),
    Rule('frequency', CHANGED, AT_ODOMETRY + '; frequency here is how often the graph is '
         'optimised, for which 10 Hz is enough'),
    Rule('sensor_timeout|predict_to_current_time', NOT_NEEDED,
         'nothing is predicted without odometry; silent inputs are reported in /diagnostics'),
    Rule('transform_timeout|tf_timeout|silent_tf_failure', NOT_NEEDED,
         'only /tf_static is read, and nothing waits for it'),
    Rule('tf_prefix', CHANGED, 'write the prefix into the names of the frames'),
    Rule('print_diagnostics|debug|debug_out_file|permit_corrected_publication', NOT_NEEDED,
         '/diagnostics and the corrected path are always published, and `pose-graph report` shows '
         'a whole run'),
    Rule('publish_acceleration', NONE, 'there is no accel/filtered: ' + GRAVITY, value=True),
    Rule('smooth_lagged_data|history_length', NOT_NEEDED, DELAYS),
    Rule('reset_on_time_jump', NOT_NEEDED, 'a clock that is set back begins a new graph'),
    Rule('disabled_at_startup', CHANGED, 'the node is a lifecycle node: set autostart to false',
         'autostart', lambda value: False, value=True),
    Rule('use_control', NONE, COMMANDS, value=True),
    Rule('stamped_control|control_timeout|control_config|(ac|de)celeration_(limits|gains)',
         NOT_NEEDED, COMMANDS),
    Rule('gravitational_acceleration', NOT_NEEDED, GRAVITY),
    Rule('(dynamic_)?process_noise_covariance', CHANGED, NOISE),
    Rule('initial_estimate_covariance', CHANGED, START),
    Rule('initial_state', NOT_NEEDED, 'it is the origin, as by default', value=[0.0] * 15),
    Rule('initial_state', CHANGED, SET_POSE),
    Rule('alpha|kappa|beta', NOT_NEEDED, 'there are no sigma points: the whole graph is '
         'linearised again wherever it moves'),
)

OF_UNUSED = Rule('none:.*', NOT_NEEDED, 'goes with its input')
INPUT = (
    OF_UNUSED,
    Rule('.*:(queue_size|nodelay)', NOT_NEEDED, QUEUES),
    Rule('odometry:(differential|relative)', CHANGED, BY_MOTION + ', as with differential: true'),
    Rule('fix:(differential|relative)', NOT_NEEDED,
         'fixes are positions on the Earth; the first one is the origin if datum is not set'),
    Rule('(global_pose|imu.*):(differential|relative)', NOT_NEEDED, 'it is absolute here, too',
         value=False),
    Rule('gyro:(differential|relative)', CHANGED, ROTATIONS, value=True),
    Rule('.*:(differential|relative)', NOT_NEEDED, 'only its rate is used'),
    Rule('(odometry|twist):.*rejection_threshold', CHANGED, 'a motion that the robot cannot have '
         'made is a jump of odometry, behind which the path goes on (maximum_speed)'),
    Rule('.*:(remove_gravitational_acceleration|linear_acceleration_rejection_threshold)',
         NOT_NEEDED, GRAVITY),
    Rule('(imu|gyro).*:.*rejection_threshold', CHANGED, 'imu.robust_loss: huber gives less '
         'weight to headings that are far off; rates of a gyroscope are all used'),
    Rule('.*:.*rejection_threshold', CHANGED, JUDGED),
    Rule('.*:pose_use_child_frame', NONE, 'the pose of odometry is that of base_link_frame',
         value=True),
)

NAVSAT = (
    Rule('datum', TAKEN, 'its angle is that of the x axis, too', 'datum', lambda value: [
        float(each) for each in (value.split(',') if isinstance(value, str) else value)[:3]]),
    Rule('wait_for_datum', TAKEN, 'by the service datum, if datum is not set', 'wait_for_datum',
         value=True),
    Rule('yaw_offset|magnetic_declination_radians', NOT_NEEDED, 'it is 0', value=0),
    Rule('yaw_offset|magnetic_declination_radians', CHANGED, 'no compass is needed: fixes tell '
         'how odometry lies in the map, whose x axis points east, not to where an IMU reads 0; '
         'the third number of datum turns it'),
    Rule('frequency|delay|use_odometry_yaw', NOT_NEEDED, 'each fix is used when it comes, and all '
         'together tell how odometry lies in the map'),
    Rule('zero_altitude|use_local_cartesian', NOT_NEEDED,
         'the map is a plane that touches the Earth, without UTM zones'),
    Rule('publish_filtered_gps', NOT_NEEDED, 'gps/filtered is always published'),
    Rule('broadcast_(utm|cartesian)_transform(_as_parent_frame_?)?', NONE, 'there is no frame '
         'utm: gps/filtered, toLL and fromLL tell positions on the Earth', value=True),
    Rule('transform_timeout|tf_prefix|world_frame|base_link_frame', NOT_NEEDED,
         'only /tf_static is read: of the antenna'),
)

STAYS = 'belongs to matching scans, and stays in the front end'
SLAM_TOOLBOX = (
    Rule('map_frame', TAKEN, target='map_frame'),
    Rule('odom_frame', TAKEN, target='odom_frame'),
    Rule('base_frame', TAKEN, target='base_link_frame'),
    Rule('minimum_travel_distance', TAKEN, target='minimum_travel_distance'),
    Rule('minimum_travel_heading', TAKEN, target='minimum_travel_heading'),
    Rule('transform_publish_period', TAKEN, '0 is publish_tf: false', 'publish_tf',
         lambda value: False, value=0),
    Rule('transform_publish_period', CHANGED, 'map -> odom is published with every message of '
         'odometry. Set this to 0 where slam_toolbox runs on as front end'),
    Rule('map_file_name', CHANGED, 'its .posegraph is not read; graph_file with '
         'load_graph_on_start, or state_file, keep the graph of this node'),
    Rule('map_start_pose|map_start_at_dock', CHANGED, SET_POSE),
    Rule('mode|localization_on_configure|lifelong_.*', CHANGED, 'there is one mode, in which a '
         'loaded graph goes on; thinning.cell holds its size where places are driven often'),
    Rule('ceres_loss_function', TAKEN, 'odometry needs none',
         'loop_closure.robust_loss', lambda value: {'HuberLoss': 'huber', 'CauchyLoss': 'cauchy'}
         .get(value, 'none')),
    Rule('solver_plugin|ceres_.*', NOT_NEEDED, 'the solver is incremental and has no settings'),
    Rule('do_loop_closing|loop_.*', CHANGED, 'the front end finds loop closures and sends them '
         'to the topic loop_closure; which are believed is decided here'),
    Rule('(position|yaw)_covariance_scale', CHANGED, 'global_pose.covariance_scale is for poses '
         'of slam_toolbox as source global_pose'),
    Rule('debug_logging|transform_timeout|tf_buffer_duration|stack_size_to_use|use_lifecycle_'
         'manager', NOT_NEEDED, 'only /tf_static is read; log_level:=debug in the launch call'),
    Rule('enable_interactive_mode|interactive_mode|paused_.*', CHANGED, 'what a person decides '
         'goes to the topic ~/judge; ~/pause holds the node'),
    Rule('use_map_saver|map_name|map_update_interval|resolution|max_laser_range', NONE,
         'this node makes no grid map'),
    Rule('(scan|throttle|correlation|distance_variance|angle_variance|fine|coarse|minimum|link|'
         'use_scan|use_response)_.*', NONE, STAYS),
)

LOSSES = {'HuberLoss': 'huber', 'CauchyLoss': 'cauchy', 'GemanMcClureLoss': 'geman_mcclure',
          'DCSLoss': 'dcs', 'TukeyLoss': 'tukey', 'TrivialLoss': 'none'}
FUSE = (
    Rule('optimization_frequency', TAKEN, target='frequency'),
    Rule('optimization_period', TAKEN, 'as a frequency', 'frequency', lambda value: 1.0 / value),
    Rule('lag_duration', CHANGED, 'the whole drive stays in the graph, so that a loop closure or '
         'a late fix corrects all of it; window.seconds, of minutes, bounds the memory'),
    Rule('transaction_timeout', NOT_NEEDED, DELAYS),
    Rule('solver_options.*', NOT_NEEDED, 'the solver is incremental and has no settings'),
    Rule('reset_service', CHANGED, 'the service is ~/reset'),
    Rule(r'motion_models.*', NOT_NEEDED, 'odometry stands for a motion model'),
    Rule(r'sensor_models\..*\.(motion_models|ignition)', NOT_NEEDED,
         'there is no motion model, and a graph begins by itself'),
)
INPUT_OF_FUSE = (
    OF_UNUSED,
    Rule('.*:(queue_size|throttle_use_wall_time|tf_timeout|disable_checks)', NOT_NEEDED, QUEUES),
    Rule('.*:throttle_period', NONE, 'all messages are used, as their number does not change the '
         'size of the graph'),
    Rule('odometry:differential', CHANGED, BY_MOTION + ', as with differential: true'),
    Rule('gyro:differential', CHANGED, ROTATIONS, value=True),
    Rule('.*:differential', NOT_NEEDED, 'it is absolute here, too'),
    Rule(r'.*:.*target_frame', NOT_NEEDED, 'base_link_frame, or map_frame of poses'),
    Rule(r'global_pose:(pose_)?loss\.type', TAKEN, '', '*.robust_loss',
         lambda value: LOSSES[str(value).rpartition('::')[2]]),
    Rule(r'.*:.*loss\..*', CHANGED, 'losses are set by robust_loss of fix, global_pose, imu and '
         'loop_closure, and act above 3 standard deviations; odometry needs none'),
    Rule('.*:(independent|use_twist_covariance|.*_covariance.*_diagonal)', CHANGED, NOISE + '; '
         'with odom.noise: twist it is the covariance of the twist'),
    Rule('.*:(remove_gravitational_acceleration|gravitational_acceleration|'
         'linear_acceleration_.*|acceleration_.*)', NONE, GRAVITY),
)
OUTPUT = Rule('type', TAKEN, 'an output of this node')
PLUGINS = {
    'Unicycle2D': (
        Rule('process_noise_diagonal|scale_process_noise|velocity_norm_min', CHANGED, NOISE),
        Rule('disable_checks|buffer_length', NOT_NEEDED, 'there is no motion model')),
    'Unicycle2DIgnition': (
        Rule('initial_state', NOT_NEEDED, 'it is the origin, as by default', value=[0.0] * 8),
        Rule('initial_state', CHANGED, SET_POSE),
        Rule('initial_sigma', CHANGED, START),
        Rule('topic|set_pose.*|reset_service', CHANGED, SET_POSE + '; the path so far stays'),
        Rule('.*', NOT_NEEDED, 'a graph begins by itself')),
    'GraphIgnition': (
        Rule('.*', CHANGED, 'a graph is loaded by ~/load_graph, or at the start with graph_file '
             'and load_graph_on_start, from g2o'),),
    'Transaction': (Rule('.*', NONE, 'constraints of others come as loop closures'),),
    'Acceleration2D': (Rule('.*', NONE, GRAVITY),),
    'Odometry2DPublisher': (
        OUTPUT,
        Rule('topic', TAKEN, target='outputs.filtered_odometry'),
        Rule('map_frame_id', TAKEN, target='map_frame'),
        Rule('odom_frame_id', TAKEN, target='odom_frame'),
        Rule('base_link_frame_id', TAKEN, target='base_link_frame'),
        Rule('base_link_output_frame_id', NONE, 'the pose is that of base_link_frame'),
        Rule('world_frame_id', CHANGED, 'the world always is map_frame here'),
        Rule('publish_tf', TAKEN, 'map_frame -> odom_frame', 'publish_tf'),
        Rule('publish_frequency|predict_to_current_time', CHANGED, AT_ODOMETRY),
        Rule('predict_with_acceleration|acceleration_topic', NONE, GRAVITY),
        Rule('invert_tf', NONE, 'the transform is map_frame -> odom_frame', value=True),
        Rule('.*', NOT_NEEDED, 'a covariance comes with every pose, without a setting')),
    'Path2DPublisher': (
        OUTPUT,
        Rule('topic', TAKEN, target='outputs.path'),
        Rule('frame_id', TAKEN, target='map_frame'),
        Rule('.*', NOT_NEEDED, 'path_period bounds how often')),
    'Pose2DPublisher': (
        OUTPUT,
        Rule('topic', TAKEN, target='outputs.pose'),
        Rule('.*', CHANGED, 'see the other publisher: frames are the same for all outputs')),
    'SerializedPublisher': (Rule('.*', NONE, '~/save_graph writes the graph as g2o'),),
}
"""Of plugins of fuse that are no inputs, by the last part of their type."""
UNKNOWN_PLUGIN = (Rule('type', UNKNOWN, 'no plugin that this tool knows; ranges to beacons are a '
                       'source of type range'),)


def rule_of(rules: tuple[Rule, ...], name: str, value: Any) -> Rule:
    """Return the row for a parameter, or one that says that there is none."""
    same = [rule for rule in (*rules, *EVERYWHERE) if re.fullmatch(rule.pattern, name)]
    return next((rule for rule in same if rule.value is None or rule.value == value),
                Rule('', UNKNOWN, 'no parameter that this tool knows') if len(same) == 0 else
                Rule('', NOT_NEEDED, f'{str(value).lower()} asks for nothing'))
