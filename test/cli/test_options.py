# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command line options that several tools share: topics, and the parameters of the node."""

import argparse

import pytest
import yaml

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.cli import shared
from pose_graph_ros.cli.arguments import demo
from pose_graph_ros.core.exceptions import ConfigError

FILE = """
/**:
  ros__parameters:
    use_sim_time: true
    frequency: 5.0
    sources: [odom, fix, rear]
    rear: {type: fix, lever_arm: [-0.5, 0.25]}
    window: {seconds: 2.0}
    qos_overrides: {/path: {publisher: {depth: 1}}}
/robot/pose_graph:
  ros__parameters: {path_period: 3.0}
/robot/other:
  ros__parameters: {no_such_parameter: 1.0}
other:
  nothing: true
"""


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    demo(parser)
    return parser.parse_args(words)


def test_parameters_come_from_the_file_and_from_the_command_line(tmp_path) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text(FILE, encoding='utf-8')
    in_file = {
        'frequency': 5.0, 'sources': ['odom', 'fix', 'rear'], 'rear.type': 'fix',
        'rear.lever_arm': [-0.5, 0.25], 'window.seconds': 2.0, 'path_period': 3.0}
    assert shared.parameter_values(parsed('--params-file', str(path))) == checked(in_file)
    # the command line wins, and its values are read as yaml
    given = parsed('--params-file', str(path), '-p', 'frequency:=20', '--param',
                   'rear.lever_arm:=[1, 2]', '-p', 'publish_tf:=false')
    assert shared.parameter_values(given) == checked({
        **in_file, 'frequency': 20.0, 'rear.lever_arm': [1.0, 2.0], 'publish_tf': False})
    assert shared.ros_arguments(given) == [
        '--ros-args', '--params-file', str(path), '-p', 'frequency:=20', '-p',
        'rear.lever_arm:=[1, 2]', '-p', 'publish_tf:=false']


def test_a_file_of_ros2_param_dump_is_taken(tmp_path) -> None:
    path = tmp_path / 'dump.yaml'
    path.write_text(yaml.safe_dump({'/pose_graph': {'ros__parameters': {
        'datum': None, 'fix': {'covariance_override': None, 'covariance_scale': 9.0},
        'use_sim_time': False, 'start_type_description_service': True,
        'qos_overrides': {'/odom': {'subscription': {'depth': 7}}}}}}), encoding='utf-8')
    assert shared.parameter_values(parsed('--params-file', str(path))) == checked(
        {'fix.covariance_scale': 9.0})


@pytest.mark.parametrize(('text', 'said'), [
    ('/**: {ros__parameters: {frequency: 0.0}}', r'frequency: expected a number in'),
    ('/**: {ros__parameters: {no_such: 0.0}}', 'no_such is not known'),
    ('/**: {frequency: 1.0}', r'params\.yaml: /\*\*: expected ros__parameters'),
    ('pose_graph: 5', r'params\.yaml: pose_graph: expected ros__parameters'),
    ('/**: [', r'params\.yaml: cannot be read as yaml'),
    (b'\xff\xfe\xfa', r'params\.yaml: cannot be read as yaml'),
    (None, r'params\.yaml: cannot be read as yaml')])
def test_a_wrong_file_is_refused(text, said, tmp_path) -> None:
    path = tmp_path / 'params.yaml'
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=said) as caught:
        shared.parameter_values(parsed('--params-file', str(path)))
    assert '\n' not in str(caught.value)


def test_a_parameter_without_a_value_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"expected NAME:=VALUE, got 'frequency=1\.0'"):
        shared.parameter_values(parsed('-p', 'frequency=1.0'))
