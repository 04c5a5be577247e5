# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Starts and ends: while kernels are compiled nothing is lost, and any moment can be the last."""

from collections.abc import Callable
import os
from pathlib import Path
import signal
import time

from circle import fix_at, odometry_at, path_error
from harness import AS_A_USER, Client, copy_kernels, NodeProcess, PATIENCE, PREPARE_PATIENCE
import pytest


@pytest.mark.timeout(PREPARE_PATIENCE)
def test_nothing_is_lost_while_kernels_are_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    # what batch optimisation needs is compiled: some four seconds
    copy_kernels(tmp_path / 'kernels', without='batch')
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'kernels'))
    with NodeProcess(tmp_path, program=AS_A_USER) as node:
        client = Client(int(node.env['ROS_DOMAIN_ID']))
        client.spin_until(lambda: len(client.diagnostics) > 0
                          and client.odom.get_subscription_count() > 0
                          and client.fix.get_subscription_count() > 0, 'it listens')
        client.spin_for(0.3)
        assert client.values['prepared'] == '0'
        for step in range(100):
            client.odom.publish(odometry_at(step / 10.0))
            if step % 5 == 0:
                client.fix.publish(fix_at(step / 10.0))
            client.spin_for(0.005)
        client.spin_until(lambda: client.values['received'] == '120', 'all are heard')
        assert client.values['prepared'] == '0'
        assert client.values['processed'] == '0'
        client.spin_until(lambda: client.diagnostics[-1].status[0].message == (
            'Compiling kernels, as at every first start: 120 measurements wait until then.'),
            'it says what it waits for')
        client.spin_until(lambda: client.values['prepared'] == '1', 'it has compiled',
                          PREPARE_PATIENCE)
        client.wait_processed(120)
        assert client.values['odom.accepted'] == '100'
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
    with NodeProcess(tmp_path, program=AS_A_USER) as node:
        client = Client(int(node.env['ROS_DOMAIN_ID']))
        client.spin_until(lambda: len(client.diagnostics) > 0, 'it runs', PREPARE_PATIENCE)
        assert client.values['prepared'] == '0'
        client.close()
        assert node.signal_and_wait(signal.SIGINT, signal.SIGINT) == 0
        assert 'Traceback' not in node.stderr()


def catches(pid: int, number: signal.Signals) -> bool:
    """Tell whether a process has a handler for a signal, else Python itself takes it."""
    [line] = [line for line in Path(f'/proc/{pid}/status').read_text().splitlines()
              if line.startswith('SigCgt')]
    return bool(int(line.split()[1], 16) >> (number - 1) & 1)


def processor_time(pid: int) -> float:
    """Return the time of the processor that a process has used [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def wait_until(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_a_signal_at_any_moment_of_the_start_ends_the_node(tmp_path: Path) -> None:
    for used in (0.0, 0.7, 1.4):
        folder = tmp_path / str(used)
        folder.mkdir()
        with NodeProcess(folder, program=AS_A_USER) as node:
            wait_until(lambda: catches(node.process.pid, signal.SIGTERM))
            wait_until(lambda used=used: processor_time(node.process.pid) > used)
            assert node.signal_and_wait(signal.SIGINT, signal.SIGTERM) == 0
            assert 'Traceback' not in node.stderr()
