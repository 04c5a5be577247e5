# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph migrate`: files of robot_localization, fuse and slam_toolbox become one of ours."""

import argparse
import json
import math
from pathlib import Path
import re
import shlex
from typing import Any

import numpy as np
import pytest
import yaml

from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.adapters.conversions import planar_pose, stamp_ns
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.migration.inputs import STATE
from pose_graph_ros.cli.shared import parameter_values

ROOT = Path(__file__).parents[2]
Tree = dict[str, Any]


def config(*used: str) -> list[bool]:
    return [each in used for each in STATE]


def ekf(world: str, **inputs: Any) -> Tree:
    """Parameters of a filter, with the same ones about frames and noise as in most files."""
    return {'frequency': 30.0, 'two_d_mode': True, 'publish_tf': True, 'map_frame': 'map',
            'odom_frame': 'odom', 'base_link_frame': 'base_footprint', 'world_frame': world,
            **inputs, 'process_noise_covariance': [0.05] * 15}


WHEELS = {'odom0': 'wheels', 'odom0_config': config('vx', 'vy', 'vz', 'vyaw'),
          'odom0_queue_size': 10, 'odom0_differential': False}
COMPASS = {'imu0': 'imu', 'imu0_config': config('yaw'), 'imu0_relative': False}
GNSS = {'odom1': 'odometry/gps', 'odom1_config': config('x', 'y')}
NAVSAT = {'delay': 3.0, 'magnetic_declination_radians': 0.0, 'yaw_offset': 0.0,
          'zero_altitude': True, 'broadcast_utm_transform': True, 'wait_for_datum': False}
# a robot as in tutorials on outdoor navigation: two filters, and fixes in the one of the map
OUTDOOR = {'filter_odom': ekf('odom', **WHEELS, **COMPASS),
           'filter_map': ekf('map', **WHEELS, **GNSS, **COMPASS), 'navsat': NAVSAT}


def written(folder: Path, name: str, tree: Tree, *, ros1: bool = False) -> Path:
    """Return a parameter file."""
    nodes = tree if ros1 else {node: {'ros__parameters': own} for node, own in tree.items()}
    (folder / name).write_text(json.dumps(nodes))  # which is YAML
    return folder / name


def migrated(folder: Path, tree: Tree, *words: str, ros1: bool = False) -> tuple[Tree, str]:
    """Return the parameters that the node reads from what a file became, and the text of it."""
    out = folder / 'out.yaml'
    assert main(['migrate', str(written(folder, 'in.yaml', tree, ros1=ros1)), '-o', str(out),
                 '--force', *words]) == 0
    return parameter_values(argparse.Namespace(params_file=out, param=[])), out.read_text()


def listed(text: str) -> dict[str, set[str]]:
    """Return the parameters in each of the lists below the values, with their nodes."""
    found: dict[str, set[str]] = {}
    joined = re.sub(r'\n#       (?=\S)', ' ', text)  # lines that go on
    for line in joined.splitlines():
        if match := re.fullmatch(r'# (Taken|Not .*|Changes .*|Has .*): \d+', line):
            names = found.setdefault(match[1], set())
        elif match := re.fullmatch(r'#   (in\.yaml.*)', line):
            node = match[1].rpartition(', ')[2]
        elif match := re.match(r'#     - ([^:]+)', line):
            names |= {f'{node}.{each}' for each in match[1].split(', ')}
    return found


def test_each_parameter_is_in_one_list_and_each_value_says_where_it_is_from(tmp_path) -> None:
    tree = {**OUTDOOR, 'camera': {'fps': 30}}
    tree['filter_map'] = {**tree['filter_map'], 'no_such_thing': 1}
    values, text = migrated(tmp_path, tree)
    lists = listed(text)
    every = [f'{node}.{name}' for node, own in tree.items() for name in own]
    assert sorted(name for names in lists.values() for name in names) == sorted(every)
    assert lists['Not known'] == {'camera.fps', 'filter_map.no_such_thing'}
    assert values['base_link_frame'] == 'base_footprint'
    lines = [line for line in text.splitlines() if re.match(r' +\w+: \S', line)]
    assert len(lines) > 8
    assert all(' # ' in line for line in lines)
    assert 'base_footprint       # in.yaml, filter_map, base_link_frame' in text


def test_the_filter_that_publishes_odometry_stays_and_is_heard_once(tmp_path) -> None:
    rates = {'imu0': 'imu', 'imu0_config': config('vyaw')}
    tree = {**OUTDOOR, 'filter_odom': ekf('odom', **WHEELS, **rates),
            'filter_map': ekf('map', **WHEELS, **GNSS, **rates)}
    values, text = migrated(tmp_path, tree)
    assert values['sources'] == ['odom', 'fix']
    assert values['odom.topic'] == 'odometry/local'
    assert values['outputs.filtered_odometry'] == 'odometry/global'
    assert 'Keep filter_odom: it publishes odom -> base_footprint' in text
    # what only the replaced one hears is heard beside it
    tree['filter_map'] |= {'odom2': 'visual', 'odom2_config': config('vx', 'vyaw')}
    values, _ = migrated(tmp_path, tree)
    assert values['sources'] == ['odom', 'odom2', 'fix']
    assert (values['odom.topic'], values['odom2.topic']) == ('odometry/local', 'visual')
    # as may be the output itself
    tree['filter_map'] |= {'odom2': 'odometry/filtered'}
    values, _ = migrated(tmp_path, tree)
    assert values['sources'] == ['odom', 'fix']
    assert values['odom.topic'] == 'odometry/filtered'
    del tree['filter_map']['odom2']
    # where the driver publishes the transform, the sensors themselves
    values, text = migrated(tmp_path, tree, '--replace-local')
    assert values['sources'] == ['odom', 'fix', 'gyro']
    assert (values['odom.topic'], values['odom.integrate']) == ('wheels', 'twist')
    assert values['gyro.topic'] == 'imu'


@pytest.mark.parametrize(('inputs', 'expected'), [
    ({'odom0': 'a', 'odom0_config': config('x', 'y', 'yaw', 'vx')},
     {'sources': ['odom'], 'odom.topic': 'a', 'odom.integrate': 'pose'}),
    ({**WHEELS, 'odom1': 'visual', 'odom1_config': config('vx', 'vyaw')},
     {'sources': ['odom', 'odom1'], 'odom1.topic': 'visual', 'odom1.type': 'odometry'}),
    ({**WHEELS, 'imu0': 'imu', 'imu0_config': config('yaw', 'vyaw', 'ax')},
     {'sources': ['odom', 'imu', 'gyro'], 'imu.topic': 'imu', 'gyro.topic': 'imu'}),
    ({**WHEELS, **COMPASS, 'imu0_relative': True}, {'sources': ['odom', 'gyro']}),
    ({**WHEELS, 'pose0': 'amcl_pose', 'pose0_config': config('x', 'y', 'yaw')},
     {'sources': ['odom', 'global_pose'], 'global_pose.topic': 'amcl_pose',
      'global_pose.heading': 'auto'}),
    ({**WHEELS, 'pose0': 'uwb', 'pose0_config': config('x', 'y')},
     {'global_pose.heading': 'never'}),
    ({**WHEELS, 'pose0': 'icp', 'pose0_config': config('x', 'y'), 'pose0_differential': True},
     {'sources': ['odom']}),
    ({'twist0': 'speed', 'twist0_config': config('vx', 'vy', 'vyaw')},
     {'sources': ['twist0'], 'twist0.type': 'twist', 'twist0.topic': 'speed'}),
    ({**WHEELS, **GNSS}, {'sources': ['odom', 'fix'], 'fix.topic': 'gps/fix'}),
    # neither a pose in the map as odometry is odometry, nor a yaw rate
    ({**WHEELS, 'odom1': 'slam', 'odom1_config': config('x', 'y', 'yaw')}, {'sources': ['odom']}),
    ({**WHEELS, 'odom1': 'rate', 'odom1_config': config('vyaw')}, {'sources': ['odom']}),
])
def test_what_is_used_of_an_input_tells_its_type(tmp_path, inputs, expected) -> None:
    values, _ = migrated(tmp_path, {'node': ekf('map', **inputs)})
    assert {name: values[name] for name in expected} == expected


def test_a_filter_in_the_odometry_frame_with_gnss_is_replaced(tmp_path) -> None:
    values, text = migrated(tmp_path, {'ekf': ekf('odom', **WHEELS, **GNSS)})
    assert values['sources'] == ['odom', 'fix']
    assert values['odom.topic'] == 'wheels'
    assert 'Let the driver of the wheels publish odom -> base_footprint, which ekf did' in text


def test_the_datum_counts_if_it_is_waited_for_and_the_compass_is_turned(tmp_path) -> None:
    navsat = {'yaw_offset': 1.5, 'magnetic_declination_radians': 0.25, 'wait_for_datum': True,
              'datum': [50.7, 7.1, 0.3]}
    tree = {'ekf': ekf('map', **WHEELS, **COMPASS), 'navsat': navsat}
    values, _ = migrated(tmp_path, tree)
    # navsat_transform_node turns its map by the offsets as well, whatever the datum says
    assert values['datum'] == [50.7, 7.1, 2.05]
    assert values['imu.yaw_offset'] == 1.75
    values, _ = migrated(tmp_path, {**tree, 'navsat': {**navsat, 'datum': []}})
    assert values['datum'] == []
    values, text = migrated(tmp_path, {**tree, 'navsat': {**navsat, 'wait_for_datum': False}})
    assert values['datum'] == []
    assert 'navsat.datum' in listed(text)['Not needed']


def test_files_of_ros_1_and_several_files_give_the_same(tmp_path) -> None:
    one, _ = migrated(tmp_path, OUTDOOR)
    assert migrated(tmp_path, OUTDOOR, ros1=True)[0] == one
    files = [str(written(tmp_path, f'{name}.yaml', {name: own})) for name, own in OUTDOOR.items()]
    assert main(['migrate', *files, '-o', str(tmp_path / 'several.yaml')]) == 0
    assert parameter_values(argparse.Namespace(
        params_file=tmp_path / 'several.yaml', param=[])) == one


def test_what_a_section_for_all_nodes_says_is_of_each_filter(tmp_path) -> None:
    one, _ = migrated(tmp_path, OUTDOOR)
    common = {name: value for name, value in OUTDOOR['filter_odom'].items()
              if name.endswith(('_frame', '_mode', 'frequency')) and name != 'world_frame'}
    tree = {'/**': common} | {node: {name: value for name, value in own.items()
                                     if name not in common} for node, own in OUTDOOR.items()}
    values, text = migrated(tmp_path, tree)
    assert values == one
    assert 'Keep filter_odom: it publishes odom -> base_footprint' in text
    # in another namespace it says nothing of them
    values, _ = migrated(tmp_path, {'/r1/**': tree.pop('/**'), **{
        f'/r10/{node}': own for node, own in tree.items()}})
    assert values['base_link_frame'] == 'base_link'


def test_a_node_with_a_world_frame_alone_is_no_filter(tmp_path) -> None:
    tree = {'camera': {'world_frame': 'odom'},
            'navsat': {**NAVSAT, 'world_frame': 'map', 'map_frame': 'map'},
            'filter_map': OUTDOOR['filter_map']}
    values, text = migrated(tmp_path, tree)
    assert values['odom.topic'] == 'wheels'
    assert 'Stop navsat and filter_map: this node does the work' in text
    assert listed(text)['Not known'] == {'camera.world_frame'}


def test_names_with_a_slash_in_front_are_those_without(tmp_path) -> None:
    tree = {**OUTDOOR, 'filter_map': {**OUTDOOR['filter_map'], 'world_frame': '/map',
                                      'odom0': '/wheels'}}
    values, _ = migrated(tmp_path, tree)
    assert values['sources'] == ['odom', 'fix', 'imu'], 'the wheels do not count twice'


def test_a_number_without_a_point_is_one_as_rcl_reads_it(tmp_path) -> None:
    file = tmp_path / 'in.yaml'
    file.write_text(f'ekf: {{world_frame: map, imu0: imu, imu0_config: {config("yaw")}}}\n'
                    'navsat: {yaw_offset: 1e-1, wait_for_datum: true}')
    out = tmp_path / 'out.yaml'
    assert main(['migrate', str(file), '-o', str(out)]) == 0
    assert yaml.safe_load(out.read_text())['/**']['ros__parameters']['imu']['yaw_offset'] == 0.1


def test_a_yaw_in_the_odometry_frame_without_fixes_is_no_compass(tmp_path) -> None:
    local = ekf('odom', **WHEELS, **COMPASS)
    values, _ = migrated(tmp_path, {'ekf': local}, '--replace-local')
    assert values['sources'] == ['odom', 'gyro']
    values, _ = migrated(tmp_path, {'ekf': local, 'navsat': NAVSAT}, '--replace-local')
    assert values['sources'] == ['odom', 'imu', 'fix']


def test_the_output_has_another_name_than_an_input(tmp_path) -> None:
    values, text = migrated(tmp_path, {'ekf': ekf('map', **WHEELS, **GNSS) | {
        'odom0': '/odometry/filtered'}})
    assert values['outputs.filtered_odometry'] == 'odometry/global'
    assert 'filtered_odometry:=odometry/global' in text


FUSE = {
    'optimization_frequency': 20.0, 'lag_duration': 0.5,
    'motion_models': {'model': {'type': 'fuse_models::Unicycle2D'}},
    'model': {'process_noise_diagonal': [0.1] * 8},
    'sensor_models': {'start': {'type': 'fuse_models::Unicycle2DIgnition', 'ignition': True},
                      'wheels': {'type': 'fuse_models::Odometry2D', 'motion_models': ['model']},
                      'inertial': {'type': 'fuse_models::Imu2D', 'motion_models': ['model']},
                      'markers': {'type': 'fuse_models::Pose2D'},
                      'sonar': {'type': 'my_models::Sonar'}},
    'start': {'initial_sigma': [0.1] * 8},
    'wheels': {'topic': 'wheel_odom', 'linear_velocity_dimensions': ['x', 'y'],
               'angular_velocity_dimensions': ['yaw']},
    'inertial': {'topic': 'imu', 'angular_velocity_dimensions': ['yaw'],
                 'linear_acceleration_dimensions': ['x']},
    'markers': {'topic': 'marker_pose', 'position_dimensions': ['x', 'y'],
                'loss': {'type': 'fuse_loss::CauchyLoss', 'a': 1.0}},
    'publishers': {'filtered': {'type': 'fuse_models::Odometry2DPublisher'}},
    'filtered': {'topic': 'fused', 'base_link_frame_id': 'base_footprint',
                 'world_frame_id': 'map', 'publish_tf': False}}


@pytest.mark.parametrize('ros1', [False, True])
def test_plugins_of_fuse_become_sources_and_outputs(tmp_path, ros1) -> None:
    tree = FUSE
    if ros1:  # parameters without a node, and plugins in lists
        tree = {name: [{'name': key, **own} for key, own in value.items()]
                if name in ('sensor_models', 'motion_models', 'publishers') else value
                for name, value in FUSE.items()}
    values, text = migrated(tmp_path, tree if ros1 else {'smoother': tree}, ros1=ros1)
    expected = {'sources': ['odom', 'gyro', 'global_pose'], 'odom.topic': 'wheel_odom',
                'odom.integrate': 'twist', 'gyro.topic': 'imu', 'global_pose.topic': 'marker_pose',
                'global_pose.heading': 'never', 'global_pose.robust_loss': 'cauchy',
                'outputs.filtered_odometry': 'fused', 'base_link_frame': 'base_footprint',
                'publish_tf': False, 'frequency': 20.0, 'window.seconds': 0.0}
    assert {name: values[name] for name in expected} == expected
    lists = {fate: {name.partition('.')[2] if not ros1 else name.removeprefix('in.yaml.')
                    for name in names} for fate, names in listed(text).items()}
    assert 'lag_duration' in lists['Changes its meaning']
    assert 'sensor_models.sonar.type' in lists['Not known']
    assert 'sensor_models.start.type' in lists['Not needed']


def test_of_slam_toolbox_what_concerns_the_graph_is_taken(tmp_path) -> None:
    values, text = migrated(tmp_path, {'slam_toolbox': {
        'solver_plugin': 'solver_plugins::CeresSolver', 'ceres_loss_function': 'HuberLoss',
        'base_frame': 'base_footprint', 'minimum_travel_distance': 0.5,
        'minimum_travel_heading': 0.4, 'map_file_name': 'hall', 'scan_topic': '/scan',
        'transform_publish_period': 0.0, 'loop_search_maximum_distance': 3.0}})
    expected = {'base_link_frame': 'base_footprint', 'minimum_travel_distance': 0.5,
                'minimum_travel_heading': 0.4, 'publish_tf': False,
                'loop_closure.robust_loss': 'huber'}
    assert {name: values[name] for name in expected} == expected
    lists = listed(text)
    assert 'slam_toolbox.map_file_name' in lists['Changes its meaning']
    assert 'slam_toolbox.scan_topic' in lists['Has no counterpart']


@pytest.mark.parametrize(('text', 'said'), [
    (None, 'No such file'), ('a: [1', 'cannot be read as yaml'), ('words', 'expected a param'),
    ('driver: {ros__parameters: {port: 5000}}', 'has no parameters of robot_localization'),
    ('/**: {ros__parameters: {sources: [odom], minimum_travel_heading: 1.0}}', 'already'),
    ('ekf: {ros__parameters: {world_frame: map, odom0: $(var robot)/odom, odom0_config: '
     f'{config("vx")}}}}}', "odom0: '$(var robot)/odom' is filled in by a launch file"),
    ('navsat: {ros__parameters: {wait_for_datum: true, datum: $(var site), yaw_offset: 1.5}}',
     "datum: '$(var site)' is filled in by a launch file"),
    ('navsat: {ros__parameters: {wait_for_datum: true, datum: [1, 2], yaw_offset: .nan}}',
     'yaw_offset and magnetic_declination_radians: expected angles [rad], got [nan, 0.0]'),
    ('ekf: {ros__parameters: {world_frame: odom, map_frame: odom, odom0: o, odom0_config: '
     f'{config("vx")}}}}}', 'expected three different names')])
def test_what_cannot_be_migrated_is_said_in_one_line(tmp_path, capsys, text, said) -> None:
    if text is not None:
        (tmp_path / 'in.yaml').write_text(text)
    assert main(['migrate', str(tmp_path / 'in.yaml'), '-o', str(tmp_path / 'out.yaml')]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / 'out.yaml').exists()


def test_the_launch_call_has_namespace_and_clock_of_the_nodes(tmp_path) -> None:
    _, text = migrated(tmp_path, {'/robot_1/ekf': {'use_sim_time': True, **ekf('map', **WHEELS)}})
    assert 'compatible:=robot_localization namespace:=robot_1 use_sim_time:=true' in text
    # robot_localization itself publishes to /tf everywhere
    assert 'where the other nodes use /tf, add remap_tf:=false' in re.sub(r'\n# +', ' ', text)


def test_what_no_file_can_say_stands_under_what_to_do(tmp_path) -> None:
    _, text = migrated(tmp_path, {'ekf': ekf('map', **COMPASS, twist0='speed',
                                             twist0_config=config('vx'))})
    said = re.sub(r'\n# +', ' ', text)
    # as robot_localization takes the mounting of an IMU off its yaw
    assert 'counterclockwise by some angle, take that off imu.yaw_offset' in said
    assert 'A twist has no odometry frame, so map -> odom is not published' in said
    _, text = migrated(tmp_path, {'ekf': ekf('odom', **WHEELS, pose0='amcl_pose',
                                             pose0_config=config('x', 'y', 'yaw'))})
    assert 'If amcl_pose is a pose in the map, such as that of AMCL, take it out of ekf' in (
        re.sub(r'\n# +', ' ', text))


def test_a_file_is_overwritten_only_by_force(tmp_path, capsys) -> None:
    one, out = str(written(tmp_path, 'in.yaml', OUTDOOR)), tmp_path / 'out.yaml'
    assert main(['migrate', one]) == 0
    shown = capsys.readouterr().out
    out.write_text('mine')
    assert main(['migrate', one, '-o', str(out)]) == 2
    assert out.read_text() == 'mine'
    assert main(['migrate', one, '-o', str(out), '--force']) == 0
    said = capsys.readouterr().out
    launch = ('ros2 launch pose_graph_ros pose_graph.launch.py params_file:={} '
              'compatible:=robot_localization filtered_odometry:=odometry/global')
    assert launch.format('pose_graph.yaml') in shown
    assert launch.format(shlex.quote(str(out))) in said
    assert 'Changes its meaning: ' in said
    assert yaml.safe_load(shown) == yaml.safe_load(out.read_text())


def renamed(drive: Path, folder: Path) -> None:
    """Write a drive as the outdoor robot records it, with a compass that is 6 degrees off."""
    quaternion = message_types()['geometry_msgs/msg/Quaternion']
    topics = {'/odom': ['/odometry/local', '/wheels'], '/imu/data': ['/imu']}
    with open_bag(drive) as bag, BagWriter(folder) as new:
        truth = np.array([(stamp_ns(each.decode()), planar_pose(each.decode().pose.pose)[2])
                          for each in bag.messages(['/ground_truth'])])
        yaw, generator = np.unwrap(truth[:, 1]), np.random.default_rng(5)
        for each in bag.messages(list(bag.topics)):
            message = each.decode()
            if each.topic == '/imu/data':
                half = 0.5 * (np.interp(stamp_ns(message), truth[:, 0], yaw)
                              + generator.normal(0.1, 0.03))
                message.orientation = quaternion(0.0, 0.0, math.sin(half), math.cos(half))
                message.orientation_covariance = np.diag([1.0, 1.0, 0.03**2]).ravel()
            for topic in topics.get(each.topic, [each.topic]):
                new.write(topic, each.type, each.recorded_ns, message)


def error(capsys, bag: Path, *words: str) -> float:
    """Return the error of a replay [m], rms."""
    assert main(['replay', str(bag), '-o', f'{bag}_replay', '--truth', '/ground_truth', '--json',
                 *words]) == 0
    errors = json.loads(capsys.readouterr().out)['errors']
    return next(each['rms'] for each in errors if each['name'] == 'corrected path to truth')


@pytest.mark.slow
def test_a_drive_with_a_migrated_file_is_as_near_the_truth_as_with_the_defaults(
        tmp_path, capsys) -> None:
    drive, outdoor = tmp_path / 'drive', tmp_path / 'outdoor'
    assert main(['simulate', str(drive), '--duration', '120', '--gyro', '--fix-correlated', '0,1',
                 '--jump', '/gps/fix:none', '--outage', '/gps/fix:none']) == 0
    renamed(drive, outdoor)
    migrated(tmp_path, OUTDOOR)
    capsys.readouterr()
    usual = error(capsys, drive)
    assert 0.05 < error(
        capsys, outdoor, '--params-file', str(tmp_path / 'out.yaml')) < 1.1 * usual
