# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The first start, while kernels are compiled: no message is lost meanwhile."""

from pathlib import Path
import signal

from circle import fix_at, odometry_at, path_error
from harness import Client, copy_kernels, NodeProcess, PREPARE_PATIENCE
import pytest


@pytest.mark.timeout(PREPARE_PATIENCE)
def test_nothing_is_lost_while_kernels_are_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    # what the elimination needs is compiled: some eight seconds
    copy_kernels(tmp_path / 'kernels', without='elimination')
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'kernels'))
    with NodeProcess(tmp_path) as node:
        client = Client(int(node.env['ROS_DOMAIN_ID']))
        client.spin_until(lambda: len(client.diagnostics) > 0
                          and client.odom.get_subscription_count() > 0
                          and client.fix.get_subscription_count() > 0, 'it listens')
        client.spin_for(0.3)
        assert client.values['prepared'] == '0'
        assert client.diagnostics[-1].status[0].message.startswith('Compiling')
        for step in range(200):
            client.odom.publish(odometry_at(step / 10.0))
            if step % 5 == 0:
                client.fix.publish(fix_at(step / 10.0))
            client.spin_for(0.005)
        client.spin_until(lambda: client.values['received'] == '240', 'all are heard')
        assert client.values['prepared'] == '0'
        assert client.values['processed'] == '0'
        client.spin_until(lambda: client.values['prepared'] == '1', 'it has compiled',
                          PREPARE_PATIENCE)
        client.wait_processed(240)
        assert client.values['odom.accepted'] == '200'
        assert client.optimize().success
        assert path_error(client) < 1e-3
        client.close()
        assert node.signal_and_wait(signal.SIGINT) == 0
        assert 'compiling kernels' in node.stderr()
        assert 'kernels ready after' in node.stderr()
        assert 'Traceback' not in node.stderr()


@pytest.mark.timeout(PREPARE_PATIENCE)
def test_a_signal_while_kernels_are_compiled_ends_the_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    # all is compiled, as after an installation
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'kernels'))
    with NodeProcess(tmp_path) as node:
        client = Client(int(node.env['ROS_DOMAIN_ID']))
        client.spin_until(lambda: len(client.diagnostics) > 0, 'it runs', PREPARE_PATIENCE)
        assert client.values['prepared'] == '0'
        client.close()
        assert node.signal_and_wait(signal.SIGINT, signal.SIGINT) == 0
        assert 'Traceback' not in node.stderr()
