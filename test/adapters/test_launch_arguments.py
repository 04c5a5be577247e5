# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the arguments of the launch file mean for the node."""

from pathlib import Path

import pytest

from pose_graph_ros.adapters.launch_arguments import (
    arguments,
    display_remappings,
    parameter_file,
    parameters,
    remappings,
    switch,
    unknown,
)
from pose_graph_ros.adapters.parameter_table import OUTPUTS
from pose_graph_ros.adapters.parameters import all_parameters, checked
from pose_graph_ros.adapters.sources import KNOWN_SOURCES
from pose_graph_ros.core.exceptions import ConfigError

TREE = Path(__file__).resolve().parents[2]
DEFAULTS = {name: default for name, (default, _) in arguments(TREE).items()}
TF = [('/tf', 'tf'), ('/tf_static', 'tf_static')]


def test_defaults_leave_everything_to_the_parameter_file() -> None:
    assert parameters(DEFAULTS) == {}
    assert remappings(DEFAULTS) == display_remappings(DEFAULTS) == TF
    assert remappings({**DEFAULTS, 'remap_tf': 'False'}) == []
    assert parameter_file(DEFAULTS) == str(TREE / 'config' / 'pose_graph.yaml')
    assert Path(DEFAULTS['rviz_config']).is_file()
    assert not switch(DEFAULTS, 'rviz')


@pytest.mark.parametrize('source', KNOWN_SOURCES)
def test_a_topic_that_is_given_is_a_parameter(source: str) -> None:
    known = {parameter.name for parameter in all_parameters({'sources': list(KNOWN_SOURCES)})}
    assert parameters({**DEFAULTS, source: '/x'}) == {f'{source}.topic': '/x'}
    assert f'{source}.topic' in known
    assert parameters({**DEFAULTS, source: ''}) == {}


@pytest.mark.parametrize(('text', 'value'), [
    ('true', True), ('True', True), ('TRUE', True), ('1', True), ('false', False),
    ('False', False), ('0', False), (' true ', True)])
@pytest.mark.parametrize('name', ['use_sim_time', 'autostart'])
def test_true_and_false_as_people_write_them(name: str, text: str, value: bool) -> None:
    assert parameters({**DEFAULTS, name: text}) == {name: value}


@pytest.mark.parametrize('name', ['use_sim_time', 'autostart', 'rviz', 'remap_tf'])
@pytest.mark.parametrize('text', ['yes', '2', 'truee'])
def test_anything_else_is_refused(name: str, text: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}: expected true or false, got '{text}'"):
        switch({**DEFAULTS, name: text}, name)


@pytest.mark.parametrize('output', OUTPUTS)
def test_an_output_is_moved_without_moving_an_input_of_the_same_name(output: str) -> None:
    given = {**DEFAULTS, output: '/new', 'odom': f'/{OUTPUTS[output][0]}'}
    assert parameters(given) == {f'outputs.{output}': '/new', 'odom.topic': given['odom']}
    assert remappings(given) == TF, 'a remap would move both'
    assert (OUTPUTS[output][0], '/new') in display_remappings(given), 'RViz has no such parameter'
    assert f'outputs.{output}' in {parameter.name for parameter in all_parameters({})}


def test_services_of_robot_localization_are_asked_for_by_name() -> None:
    given = parameters({**DEFAULTS, 'compatible': 'robot_localization'})
    assert given == {'compatible': 'robot_localization'}
    assert checked(given)['compatible'] == 'robot_localization'
    with pytest.raises(ConfigError, match='compatible: expected one of none, robot_localization'):
        checked(parameters({**DEFAULTS, 'compatible': 'fuse'}))


@pytest.mark.parametrize('text', ['[odom, fix]', 'odom,fix', "['odom', \"fix\"]", ' odom fix '])
def test_sources_are_an_argument(text: str) -> None:
    assert parameters({**DEFAULTS, 'sources': text}) == {'sources': ['odom', 'fix']}
    with pytest.raises(ConfigError, match=r"argument sources: expected names, got '\[\]'"):
        parameters({**DEFAULTS, 'sources': '[]'})


def test_an_argument_that_launch_would_pass_over_is_told() -> None:
    assert unknown(['odom:=/o', 'fix:=/f', 'file.launch.py'], DEFAULTS, included=False) == []
    assert unknown(['odmo:=/o', 'speed:=3'], DEFAULTS, included=False) == [
        'argument odmo is not known and has no effect: did you mean odom?',
        'argument speed is not known and has no effect: --show-args lists all']
    # another launch file may have a `speed` of its own
    assert len(unknown(['odmo:=/o', 'speed:=3'], DEFAULTS, included=True)) == 1


def test_a_parameter_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match='argument params_file: expected a file'):
        parameter_file({**DEFAULTS, 'params_file': str(tmp_path / 'no.yaml')})
