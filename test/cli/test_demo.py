# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The environment of the processes of the demo, which itself runs in test_replay_is_node."""


import pytest

from pose_graph_ros.cli.demo import isolated_environment


def test_domains_are_free_again_after_an_error(tmp_path) -> None:
    """There are a hundred, and programs that share one receive each other's messages."""
    for _ in range(120):
        with pytest.raises(OSError, match='of the body'), isolated_environment(tmp_path):
            raise OSError('of the body')
    with isolated_environment(tmp_path) as first, isolated_environment(tmp_path) as second:
        assert first['ROS_DOMAIN_ID'] != second['ROS_DOMAIN_ID']


def test_nothing_is_heard_from_other_machines(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv('ROS_LOCALHOST_ONLY', '0')
    with isolated_environment(tmp_path) as env:
        assert env['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
        assert 'ROS_LOCALHOST_ONLY' not in env
        assert env['ROS_LOG_DIR'] == str(tmp_path)
