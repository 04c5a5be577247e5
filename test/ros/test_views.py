# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
RViz configuration and Foxglove layout: all that they name is there.

Neither program can be asked here, so the names are read from the files, and compared
with the tables of the node and with the strings in its source.
"""

import ast
from collections.abc import Iterator
import json
from pathlib import Path
import re
from typing import Any

import yaml

import pose_graph_ros
from pose_graph_ros.adapters.output_cdr import NAMESPACES

TREE = Path(__file__).resolve().parents[2]
RVIZ = TREE / 'config' / 'pose_graph.rviz'
FOXGLOVE = TREE / 'config' / 'foxglove_layout.json'
PARAMETER_FILE = TREE / 'config' / 'pose_graph.yaml'


def strings(path: Path) -> set[str]:
    """Return all strings in a module."""
    return {node.value for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def publications() -> dict[str, str]:
    """Return the topics that the node publishes, each with the name of its quality of service."""
    tree = ast.parse((SOURCES / 'publishers.py').read_text(encoding='utf-8'))
    (table,) = (node.value for node in ast.walk(tree) if isinstance(node, ast.Assign)
                and ast.unparse(node.targets[0]) == 'OUTPUTS')
    return {key.value: ast.unparse(value.elts[1])
            for key, value in zip(table.keys, table.values, strict=True)}


SOURCES = Path(pose_graph_ros.__file__).parent / 'ros'
PUBLISHED = publications()
SUBSCRIBED = strings(SOURCES / 'topics.py') & {'initialpose', 'set_pose'}
TOPICS = PUBLISHED.keys() | SUBSCRIBED
LATCHED = {topic for topic, quality in PUBLISHED.items() if quality == 'LATCHED_QOS'}
"""Topics whose newest message everyone gets who joins late."""


# --- RViz ------------------------------------------------------------------------------------

CONFIGURATION = yaml.safe_load(RVIZ.read_text(encoding='utf-8'))
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
    assert sorted(LATCHED) == ['graph', 'path', '~/verdicts']
    for topic in rviz_topics():
        latched = topic['Value'] in LATCHED
        assert topic['Durability Policy'] == ('Transient Local' if latched else 'Volatile')
        assert topic['Reliability Policy'] == 'Reliable'
        assert topic['History Policy'] == 'Keep Last'
        assert topic['Depth'] == 1 or not latched


def test_rviz_knows_the_namespaces_of_the_markers() -> None:
    markers = next(display for display in MANAGER['Displays'] if display['Name'] == 'Graph')
    assert set(markers['Namespaces']) == set(NAMESPACES)


# --- Foxglove --------------------------------------------------------------------------------

LAYOUT = json.loads(FOXGLOVE.read_text(encoding='utf-8'))
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
    assert keys <= strings(SOURCES / 'diagnostics.py')
    hardware = {name for panel in PANELS.values() for path in panel.get('paths', [])
                for name in re.findall(r'hardware_id=="(\w+)"', path['value'])}
    hardware |= {panel['selectedHardwareId'] for panel in PANELS.values()
                 if 'selectedHardwareId' in panel}
    assert hardware == {'pose_graph'}
    assert hardware <= strings(SOURCES / 'publishers.py')
