# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A stranger sends hundreds of messages and calls of each kind; the node goes on, over DDS."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import subprocess
import sys

from circle import drive, START
from harness import Client, NodeProcess, TFMessage
import pytest

ROOT = Path(__file__).parents[2]
SOURCES = ('-p', 'sources:=["odom", "global_pose", "fix", "imu", "range"]', '-p',
           'range.type:=range', '-p', 'graph_file:=map')
pytestmark = pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not there')


@contextmanager
def stranger(node: NodeProcess) -> Iterator['subprocess.Popen[str]']:
    with subprocess.Popen([sys.executable, '-m', 'benchmark.stranger'], env=node.env, text=True,
                          cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        # Fast DDS may print before, such as on ports of processes that were killed
        assert 'ready\n' in iter(process.stdout.readline, '')
        try:
            yield process
        finally:
            process.kill()


def memory(node: NodeProcess) -> float:
    """Return the resident set [MB]."""
    status = Path(f'/proc/{node.process.pid}/status').read_text()
    return int(status.partition('VmRSS:')[2].split()[0]) / 1e3


@pytest.mark.parametrize('node', [SOURCES], indirect=True)
def test_after_hundreds_of_each_kind_the_node_answers_and_has_not_grown(
    node: NodeProcess, client: Client,
) -> None:
    drive(client, 8.0)
    assert client.optimize().success
    with stranger(node) as peer:
        before, n_lines = memory(node), len(node.stderr().splitlines())
        for kind in ('odom', 'global_pose', 'fix', 'imu', 'range', 'loop_closure', 'initialpose',
                     'set_pose', 'judge', 'tf_static', 'set_parameters', 'pause', 'save_graph',
                     'optimize', 'set_datum'):
            print(kind, 300, 0.3, START + 4.0, file=peer.stdin, flush=True)
            peer.stdout.readline()
        client.wait_current()
        assert client.trigger('optimize').success
        values = client.values
        assert int(values['odom.not_finite']) > 200
        assert int(values['range.dropped_unlocated']) > 100
        assert int(values['set_pose.wrong_frame']) > 0  # of the newest that waits alone
        assert memory(node) - before < 20.0
        new = node.stderr().splitlines()[n_lines:]
        assert len(new) < 150, '\n'.join(new)
        # resets of a graph in which nothing is cost nothing, and a drive goes on
        resets = int(values['resets'])
        print('reset', 300, 0.3, 0.0, file=peer.stdin, flush=True)
        peer.stdout.readline()
    client.spin_until(lambda: int(client.values['resets']) > resets, 'it is reset')
    client.start_new_graph()
    drive(client, 4.0)
    assert len(client.poses) > 0
    assert memory(node) - before < 20.0
