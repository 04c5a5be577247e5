# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is said of a parameter that is not known."""

import pytest

from pose_graph_ros.adapters.parameter_names import explanation, is_own
from pose_graph_ros.adapters.parameters import all_parameters, OF_SOURCES

KNOWN = {parameter.name for parameter in all_parameters({})}


@pytest.mark.parametrize(('name', 'said'), [
    ('frequncy', 'did you mean frequency?'), ('Frequency', 'did you mean frequency?'),
    ('odom.sigma_distnce', 'did you mean odom.sigma_distance?'),
    ('window.second', 'did you mean window.seconds?'),
    ('odm.sigma_distance', 'odm is not in sources; did you mean odom.sigma_distance?'),
    ('imu.topic', 'imu is not in sources'), ('wheels.type', 'wheels is not in sources'),
    ('odom.lever_arm', 'a source of the type of odom has none'),
    ('robust_loss', 'did you mean fix.robust_loss?'),
    ('gain', ''), ('odom.gain', ''), ('', ''), ('.', '')])
def test_the_nearest_name_is_offered(name: str, said: str) -> None:
    assert explanation(name, KNOWN, OF_SOURCES) == said


@pytest.mark.parametrize(('name', 'own'), [
    ('gain', True), ('odom.gain', True), ('odm.topic', True), ('planner.gain', False),
    ('local_costmap.robot.radius', False), ('window.gain', True),
    ('alignment.sigma_heading', True), ('alignment.gain', False)])
def test_groups_that_the_node_does_not_have_are_for_other_nodes(name: str, own: bool) -> None:
    assert is_own(name, KNOWN, OF_SOURCES) is own
