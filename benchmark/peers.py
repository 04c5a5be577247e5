# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a peer can cost.

Bursts of messages and calls that nobody asked for, beside a drive with the node over DDS.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np

from benchmark.feeder import Feeder
from benchmark.load import NODE, PARAMETERS, Process
from benchmark.section import about, Options, Section
from benchmark.stranger import KINDS
from pose_graph_ros.cli.demo import isolated_environment

TITLE = 'What a peer can cost'
COUNT, BURST, SECONDS = 10_000, 5.0, 10.0
OWN = 'sources:=["odom", "global_pose", "fix", "imu", "range"]', 'range.type:=range'
RATE, NODES = 20.0, 1000
"""Of odometry [Hz]; hidden nodes before."""
MOST_LATENCY, MOST_MEMORY = 2.0, 20.0
"""What is asked for: times the p99 without a stranger, and MB."""


@contextmanager
def stranger(environment: dict[str, str]) -> Iterator['subprocess.Popen[str]']:
    """Start the other process, once it is matched."""
    with subprocess.Popen([sys.executable, '-m', 'benchmark.stranger'], env=environment, text=True,
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        # Fast DDS may print before, such as on ports of processes that were killed
        assert 'ready\n' in iter(process.stdout.readline, '')
        try:
            yield process
        finally:
            process.kill()


def bursts(options: Options) -> Section:
    """
    Send a burst of each kind.

    For each kind a node is started, which drives until it has {NODES} hidden nodes; then odometry
    comes at {RATE:.0f} Hz, fixes at 10 Hz, for {SECONDS:.0f} s and {SECONDS:.0f} s more. At the
    begin of these a stranger, another process, sends {COUNT} messages or calls of one kind in
    {BURST:.0f} s, each with texts of its own. Latency is from before the publication of odometry
    to the arrival of `pose` with its stamp; memory is what the node has more at the end than
    before the burst. A start of another graph (`~/reset`, `~/load_graph`) leaves odometry without
    a pose until the next estimate. `answered` are calls that had an answer when the last one was
    sent: of those that wait, DDS keeps the newest ten.
    """
    section = Section('Bursts of each kind', about(bursts))
    table = section.table('', 'kind', 'sent', 'answered', 'no output', 'p99 before [ms]',
                          'p99 [ms]', 'most [ms]', 'more memory [MB]', 'lines of log')
    count = 1000 if options.quick else COUNT
    for kind in filter(options.wants, KINDS):
        with tempfile.TemporaryDirectory(prefix='pose_graph_') as folder, \
                isolated_environment(Path(folder)) as environment, \
                Feeder(environment, (PoseWithCovarianceStamped, 'pose')) as feeder:
            process = Process(NODE, environment, (
                *PARAMETERS, *OWN, f'graph_file:={folder}/graph'))
            try:
                feeder.wait_until_ready()
                feeder.listen(time.monotonic() + 0.5)
                feeder.fill(NODES)
                with stranger(environment) as peer:
                    assert peer.stdin is not None
                    assert peer.stdout is not None
                    usual = feeder.run(RATE, SECONDS, process.cpu_seconds)
                    before, n_lines = process.memory()['VmRSS'], process.n_lines()
                    print(kind, count, BURST, 1e-9 * feeder.stamp_ns, file=peer.stdin, flush=True)
                    phase = feeder.run(RATE, SECONDS, process.cpu_seconds)
                    answered = peer.stdout.readline().strip()
                    more = process.memory()['VmRSS'] - before
                    n_lines = process.n_lines() - n_lines
            finally:
                process.stop()
        p99 = [float(np.percentile(each.latency, 99)) for each in (usual, phase)]
        table.add(kind, str(count), answered, str(phase.missing), f'{p99[0]:.2f}', f'{p99[1]:.2f}',
                  f'{np.max(phase.latency):.1f}', f'{more:.1f}',
                  str(n_lines))
        section.ask(f'{kind}: latency, p99, beside that before', p99[1] / p99[0], ' times',
                    most=MOST_LATENCY)
        section.ask(f'{kind}: more memory', more, ' MB', most=MOST_MEMORY)
    return section


SECTIONS = {'bursts': bursts}
