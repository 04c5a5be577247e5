# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The real node where hidden nodes are thinned out, over DDS."""

from circle import drive, fix_at, path_error, START
from harness import Client, stamp_ns
import numpy as np
import pytest


@pytest.mark.parametrize(
    'node', [('-p', 'thinning.cell:=6.0', '-p', 'thinning.newest:=10.0')], indirect=True)
def test_the_path_stays_whole_and_late_measurements_are_taken(
    node: object, client: Client,
) -> None:
    end = 40.0
    drive(client, end)
    client.wait_current()
    # a few nodes leave with each update, of which a busy machine makes fewer
    while int(client.values['thinned_nodes']) <= 10:
        assert end < 100.0, 'no nodes have left'
        drive(client, end + 2.0, begin=end)
        client.wait_current()
        end += 2.0
    assert client.values['frozen_nodes'] == '0'
    accepted = int(client.values['fix.accepted'])
    client.fix.publish(fix_at(3.05))
    client.spin_until(lambda: int(client.values['fix.accepted']) == accepted + 1, 'a late fix')
    answer = client.optimize()
    assert answer.success, answer.message
    path = client.paths[-1]
    assert len(path.poses) >= int(client.values['hidden_nodes']) > 60
    stamps = np.array([stamp_ns(item) for item in path.poses])
    assert stamps[0] == round(START * 1e9)
    assert np.all(np.diff(stamps) > 0)
    assert np.max(np.diff(stamps)) < 1.5e9
    assert path_error(client) < 0.3
