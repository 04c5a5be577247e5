# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the arguments of the launch file mean for the node."""

from pathlib import Path

import pytest

from pose_graph_ros.adapters.launch_arguments import (
    arguments,
    parameter_file,
    parameters,
    remappings,
    switch,
)
from pose_graph_ros.adapters.parameters import all_parameters
from pose_graph_ros.adapters.sources import KNOWN_SOURCES
from pose_graph_ros.core.exceptions import ConfigError

TREE = Path(__file__).resolve().parents[2]
DEFAULTS = {name: default for name, (default, _) in arguments(TREE).items()}
TF = [('/tf', 'tf'), ('/tf_static', 'tf_static')]


def test_defaults_leave_everything_to_the_parameter_file() -> None:
    assert parameters(DEFAULTS) == {}
    assert all(topic in (new, f'/{new}') for topic, new in remappings(DEFAULTS))
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


def test_tf_is_that_of_the_namespace_unless_refused() -> None:
    assert remappings(DEFAULTS)[-2:] == TF
    without = remappings({**DEFAULTS, 'remap_tf': 'False', 'path': '/p'})
    assert not set(TF) & set(without)
    assert ('path', '/p') in without


def test_a_parameter_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match='argument params_file: expected a file'):
        parameter_file({**DEFAULTS, 'params_file': str(tmp_path / 'no.yaml')})
