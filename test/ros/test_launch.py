# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The launch file; launch itself need not be there."""

import ast
import importlib.util
from pathlib import Path

import pytest

from pose_graph_ros.adapters import launch_arguments
from pose_graph_ros.adapters.sources import KNOWN_SOURCES

TREE = Path(__file__).resolve().parents[2]
LAUNCH = TREE / 'launch' / 'pose_graph.launch.py'
TEXT = ast.parse(LAUNCH.read_text(encoding='utf-8'))
ARGUMENTS = launch_arguments.arguments(TREE)

# of launch_ros.actions.Node in Jazzy, and those of launch.actions.ExecuteProcess that are used
NODE_KEYWORDS = {
    'executable', 'package', 'name', 'namespace', 'exec_name', 'parameters', 'remappings',
    'ros_arguments', 'arguments', 'output', 'condition'}


def calls(name: str) -> list[dict[str, str]]:
    """Return the keyword arguments of all calls of a function in the launch file, as texts."""
    return [{str(keyword.arg): ast.unparse(keyword.value) for keyword in node.keywords}
            for node in ast.walk(TEXT) if isinstance(node, ast.Call)
            and ast.unparse(node.func) == name]


def test_nodes_are_called_with_what_they_take() -> None:
    node, rviz = calls('Node')
    assert {*node, *rviz} <= NODE_KEYWORDS
    executable = ast.literal_eval(node['executable'])
    assert f"'{executable} = " in (TREE / 'setup.py').read_text(encoding='utf-8')
    # the displays have to find the topics wherever the node has them
    for keyword in ('namespace', 'parameters'):
        assert node[keyword] == rviz[keyword]
    assert rviz['remappings'] == 'launch_arguments.display_remappings(given)'


def test_every_argument_is_used() -> None:
    used = {node.value for node in ast.walk(TEXT) if isinstance(node, ast.Constant)}
    assert set(ARGUMENTS) - used == {
        'params_file', 'remap_tf', 'use_sim_time', 'autostart', 'sources', 'state_file',
        'compatible', *KNOWN_SOURCES, *launch_arguments.OUTPUTS}, 'and these by launch_arguments'


def test_launch_makes_the_node_and_rviz_only_if_it_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    launch = pytest.importorskip('launch')
    pytest.importorskip('launch_ros')
    specification = importlib.util.spec_from_file_location('pose_graph_launch', LAUNCH)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    monkeypatch.setattr(module.packages, 'get_package_share_directory', lambda _: str(TREE))
    *declared, started = module.generate_launch_description().entities
    assert [entity.name for entity in declared] == list(ARGUMENTS)
    context = launch.LaunchContext()
    for entity in declared:
        entity.execute(context)
    (node,) = started.execute(context)
    context.launch_configurations['rviz'] = 'True'
    with_rviz = started.execute(context)
    assert len(with_rviz) == 2
    assert type(with_rviz[0]) is type(node)
