# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
RViz configuration and Foxglove layout: all that they name is there.

Neither program can be asked here: the names in the files are compared with the tables of the node.
"""

from collections.abc import Iterator
import json
from pathlib import Path
import re
from typing import Any

import pytest
import yaml

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from pose_graph_ros.adapters.output_cdr import NAMESPACES
from pose_graph_ros.adapters.parameter_table import OUTPUTS
from pose_graph_ros.ros import diagnostics, publishers
from pose_graph_ros.ros.topics import INPUTS

CONFIG = Path(__file__).resolve().parents[2] / 'config'
TOPICS = {topic for topic, *_ in OUTPUTS.values()} | INPUTS.keys()


# --- RViz ------------------------------------------------------------------------------------

CONFIGURATION = yaml.safe_load((CONFIG / 'pose_graph.rviz').read_text(encoding='utf-8'))
MANAGER = CONFIGURATION['Visualization Manager']


def rviz_topics() -> list[dict[str, Any]]:
    return [item['Topic'] for item in MANAGER['Displays'] + MANAGER['Tools'] if 'Topic' in item]


def test_rviz_shows_what_the_node_publishes() -> None:
    shown = {display['Class'].removeprefix('rviz_default_plugins/'):
             display.get('Topic', {}).get('Value') for display in MANAGER['Displays']}
    assert shown == {
        'Grid': None, 'Path': 'path', 'MarkerArray': 'graph', 'PoseWithCovariance': 'pose',
        'Odometry': 'odometry/filtered', 'TF': None}
    assert {topic['Value'] for topic in rviz_topics()} <= TOPICS


def test_rviz_asks_for_what_is_latched_and_for_nothing_that_is_not_offered() -> None:
    latched_outputs = {OUTPUTS[name][0] for name in publishers.LATCHED}
    assert latched_outputs == {'graph', 'path', '~/verdicts'}
    for topic in rviz_topics():
        latched = topic['Value'] in latched_outputs
        assert topic['Durability Policy'] == ('Transient Local' if latched else 'Volatile')
        assert topic['Reliability Policy'] == 'Reliable'
        assert topic['History Policy'] == 'Keep Last'
        assert topic['Depth'] == 1 or not latched


def test_rviz_knows_the_namespaces_of_the_markers() -> None:
    markers = next(display for display in MANAGER['Displays'] if display['Name'] == 'Graph')
    assert set(markers['Namespaces']) == set(NAMESPACES)


# --- Foxglove --------------------------------------------------------------------------------

LAYOUT = json.loads((CONFIG / 'foxglove_layout.json').read_text(encoding='utf-8'))
PANELS = LAYOUT['configById']


def named_topics(value: Any) -> Iterator[str]:
    """Walk over all that begins with a slash: topics, and paths into their messages."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from named_topics(key)
            yield from named_topics(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from named_topics(inner)
    elif isinstance(value, str) and value.startswith('/'):
        yield re.match(r'[\w/]+', value)[0]


def test_foxglove_names_topics_of_the_node() -> None:
    # of other tools of the 3D panel, which the format wants to be there
    named = set(named_topics(PANELS)) - {'/move_base_simple/goal', '/clicked_point'}
    assert {'/graph', '/path', '/pose', '/gps/filtered', '/odometry/filtered',
            '/initialpose', '/diagnostics'} == named
    # /diagnostics is absolute in the node, too
    assert {topic if topic in TOPICS else topic.removeprefix('/') for topic in named} <= TOPICS


def test_foxglove_plots_what_is_in_the_diagnostics() -> None:
    keys = {key for panel in PANELS.values() for path in panel.get('paths', [])
            for key in re.findall(r'key=="(\w+)"', path['value'])}
    assert len(keys) > 0
    source = Path(diagnostics.__file__).read_text(encoding='utf-8')
    assert all(f"'{key}'" in source for key in keys)
    hardware = {name for panel in PANELS.values() for path in panel.get('paths', [])
                for name in re.findall(r'hardware_id=="(\w+)"', path['value'])}
    hardware |= {panel['selectedHardwareId'] for panel in PANELS.values()
                 if 'selectedHardwareId' in panel}
    assert hardware == {'pose_graph'}
    assert "hardware_id='pose_graph'" in Path(publishers.__file__).read_text(encoding='utf-8')
