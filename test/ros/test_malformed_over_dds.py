# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A short form of the benchmark's flood of malformed messages on all inputs of the real node."""

import importlib
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

COUNT = 3000


def test_after_a_flood_of_malformed_messages_a_drive_is_followed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    benchmark = importlib.import_module('benchmark.malformed')
    found = benchmark.flooded(COUNT)
    assert found.sent.total() == COUNT
    assert len({topic for topic, _ in found.sent}) == len(benchmark.inputs())
    assert int(found.values['received']) > 0, 'some can be read'
    assert found.error < benchmark.ERROR
