# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The real node with a window of a few hidden nodes, over DDS."""

from circle import drive, fix_at, path_error, START
from harness import Client, pose, stamp_ns
import numpy as np
import pytest

WINDOW = 24


@pytest.mark.parametrize('node', [('-p', f'window.nodes:={WINDOW}.0')], indirect=True)
def test_the_path_is_whole_and_what_comes_for_nodes_that_have_left_is_refused(
    node: object, client: Client,
) -> None:
    drive(client, 40.0)
    client.wait_current()
    client.spin_until(lambda: int(client.values['frozen_nodes']) > WINDOW, 'nodes have left')
    values = client.values
    hidden, frozen = int(values['hidden_nodes']), int(values['frozen_nodes'])
    assert hidden > 60
    assert hidden - frozen <= 1.125 * WINDOW + 12
    assert values['priors'] == '1'
    # the newest fixes are as new as odometry that had not come
    assert int(values['fix.accepted']) >= 79
    client.fix.publish(fix_at(3.05))
    client.loop_closure.publish(pose(START + 39.0, 0.0, 0.0, 0.0, frame=f'@{START + 3.0:.9f}'))
    for source in ('fix', 'loop_closure'):
        client.spin_until(lambda source=source: client.values.get(
            f'{source}.before_window') == '1', f'a late {source} is refused')
    answer = client.optimize()
    assert answer.success, answer.message
    path = client.paths[-1]
    assert len(path.poses) >= int(client.values['hidden_nodes'])
    stamps = np.array([stamp_ns(item) for item in path.poses])
    assert stamps[0] == round(START * 1e9)
    assert np.all(np.diff(stamps) > 0)
    assert np.max(np.diff(stamps)) < 1.5e9
    # exact measurements, of which those before the alignment have left at its first guess
    assert path_error(client) < 0.3
