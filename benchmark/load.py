# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure the real node over DDS: rates, latencies, processor and memory, with graphs of some size.

The node is a process of its own, with default parameters but for a fixed datum and no closing
optimisation in the pauses. The graph is filled by a drive with a hidden node at each sample of
odometry; then a robot drives at 2 m/s, with fixes at 10 Hz. Latency is the time from before the
publication of odometry to the arrival of `odometry/filtered` with its stamp, both by the steady
clock of the sender, and holds the way there and back. The echo is a process that sends back what
it gets: what DDS and rclpy cost alone. Pacing is how late the sender itself was.
"""

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

import numpy as np

from benchmark.feeder import DATUM, Feeder, Phase
from benchmark.section import about, Options, Section
from pose_graph_ros.cli.demo import isolated_environment
from pose_graph_ros.ros.spinning import EventsExecutor

TITLE = 'The node under load'
NODE = 'pose_graph_ros.ros.main'
PARAMETERS = (f'datum:=[{DATUM[0]}, {DATUM[1]}]', 'closing_silence:=0.0')
# What is asked for, with a graph of the largest size.
LARGE = 100_000
LATENCY_RATE, LATENCY = 500.0, 10.0
"""[Hz], and p99 [ms]."""
CPU_RATE, CPU = 200.0, 0.6
"""[Hz], and parts of one core."""
CPU_BESIDE, LATENCY_BESIDE = 1.5, 3.0
"""Times those of the echo by rclpy.spin, at 200 and 500 Hz, with a graph of any size."""
MEMORY = 400.0
"""[MB], of which a third are pages of libraries that the system can take back."""
START_TIME = 3.0
"""[s]"""
LADDER = (1000.0, 1500.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
STARTS = 5
READY = 'ready, listening', 'kernels ready'
"""What the log then says."""
MB = 1e6


class Process:
    """A process under test, and what the system says of it."""

    def __init__(
        self, module: str, environment: dict[str, str], parameters: tuple[str, ...] = (),
    ) -> None:
        arguments = [part for parameter in parameters for part in ('-p', parameter)]
        if len(arguments) > 0:
            arguments.insert(0, '--ros-args')
        self.log = Path(environment['ROS_LOG_DIR']) / 'stderr'
        with self.log.open('w', encoding='utf-8') as log:
            self.process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments], env=environment, stderr=log)

    def has_said(self, *parts: str) -> bool:
        """Tell whether all of these stand in its log."""
        log = self.log.read_text(encoding='utf-8')
        return all(part in log for part in parts)

    def n_lines(self) -> int:
        """Return how many lines its log has."""
        return self.log.read_bytes().count(b'\n')

    def cpu_seconds(self) -> float:
        """Return the time of the processor that it has taken so far [s]."""
        stat = Path(f'/proc/{self.process.pid}/stat').read_text(encoding='ascii')
        user, system = stat.rpartition(')')[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf('SC_CLK_TCK')

    def memory(self) -> dict[str, float]:
        """Return the resident set and its parts [MB]."""
        status = Path(f'/proc/{self.process.pid}/status').read_text(encoding='ascii')
        values = dict(line.split(':', 1) for line in status.splitlines() if ':' in line)
        return {name: int(values[name].split()[0]) * 1024 / MB
                for name in ('VmRSS', 'RssAnon', 'RssFile', 'RssShmem', 'VmHWM')}

    def stop(self) -> None:
        """End it as Ctrl-C does."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(15.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()


@contextmanager
def started(
    module: str, parameters: tuple[str, ...] = (),
) -> Iterator[tuple[Process, Feeder]]:
    """Start a process and a feeder that talk to each other alone."""
    with tempfile.TemporaryDirectory(prefix='pose_graph_') as log, \
            isolated_environment(Path(log)) as environment, Feeder(environment) as feeder:
        process = Process(module, environment, parameters)
        try:
            yield process, feeder
        finally:
            process.stop()


def measured(process: Process, feeder: Feeder, rate: float, seconds: float) -> Phase:
    """Run one rate, and count what the node has lost."""
    before = feeder.count('odom.accepted')
    phase = feeder.run(rate, seconds, process.cpu_seconds)
    feeder.settle()
    phase.lost = len(phase.sent_ns) - (feeder.count('odom.accepted') - before)
    return phase


def cells(phase: Phase) -> tuple[str, ...]:
    """Return the figures of one rate."""
    latency = phase.latency
    p50, p99, most = (np.percentile(latency, (50, 99, 100)) if len(latency) > 0
                      else (np.nan, np.nan, np.nan))
    pacing = 1e-6 * np.percentile(phase.late_ns, (50, 99))
    return (f'{phase.rate:.0f}', str(len(phase.sent_ns)), str(phase.lost), str(phase.missing),
            f'{p50:.2f}', f'{p99:.2f}', f'{most:.1f}', f'{100 * phase.cpu:.0f}',
            f'{pacing[0]:.2f} / {pacing[1]:.2f}')


HEADER = ('odometry [Hz]', 'sent', 'lost', 'no output', 'p50 [ms]', 'p99 [ms]', 'most [ms]',
          'CPU [% of a core]', 'pacing p50 / p99 [ms]')


FLOOR: dict[float, Phase] = {}
"""Phases of the echo by rate, where it has been measured."""


def echo(options: Options) -> Section:
    """
    Measure a process that does nothing but send back.

    A node of rclpy that republishes the bytes of each odometry message. No lost messages are
    counted: it has no diagnostics.
    """
    section = Section('The floor: an echo', about(echo))
    for title, parameters, higher in (
            ('as rclpy.spin runs it', (), LADDER[1:3]),
            ('by the EventsExecutor, as the node', ('events:=true',), ())):
        if parameters and EventsExecutor is None:
            continue
        table = section.table(title, *HEADER)
        with started('benchmark.echo', parameters) as (process, feeder):
            feeder.wait_for_listener()
            feeder.listen(time.monotonic() + 1.0)
            for rate in (*options.rates, *higher):
                phase = feeder.run(rate, _seconds(options), process.cpu_seconds)
                FLOOR.setdefault(rate, phase)
                table.add(*cells(phase))
    return section


def _seconds(options: Options) -> float:
    return 3.0 if options.quick else options.seconds


def _sizes(options: Options) -> tuple[int, ...]:
    return (1000,) if options.quick else options.sizes or (1000, 10_000, LARGE)


def graphs(options: Options) -> Section:
    """
    Measure the node with graphs of some sizes.

    {seconds:.0f} s at each rate, fixes at 10 Hz; `path` has no subscriber. Memory of the node
    after the graph was filled, and at the end.
    """
    section = Section(
        'Rates, latencies and memory', about(graphs, seconds=_seconds(options)))
    for count in _sizes(options):
        with started(NODE, PARAMETERS) as (process, feeder):
            feeder.wait_until_ready()
            feeder.listen(time.monotonic() + 0.5)
            filled = feeder.fill(count)
            memory = process.memory()
            table = section.table(f'{feeder.values["hidden_nodes"]} hidden nodes', *HEADER)
            error = 0.0
            for rate in options.rates:
                phase = measured(process, feeder, rate, _seconds(options))
                table.add(*cells(phase))
                error = float(np.fmax(error, phase.error))
                _ask(section, count, phase)
            solves = f'{feeder.values["solve_mean_ms"]} / {feeder.values["solve_max_ms"]}'
            best = 0.0
            for rate in LADDER:
                phase = measured(process, feeder, rate, 5.0)
                table.add(*cells(phase))
                if phase.lost > 0 or phase.missing > 0:
                    break
                best = rate
            end = process.memory()
        sizes = section.table(
            '', 'hidden nodes', 'filled in [s]', 'samples a second', 'resident [MB]',
            'anonymous [MB]', 'files [MB]', 'at the end [MB]', 'peak [MB]',
            'highest rate without loss [Hz]', 'update mean / most [ms]', 'error of the output [m]')
        sizes.add(str(count), f'{filled:.1f}', f'{count / filled:.0f}',
                  *(f'{memory[name]:.0f}' for name in ('VmRSS', 'RssAnon', 'RssFile')),
                  f'{end["VmRSS"]:.0f}', f'{end["VmHWM"]:.0f}', f'{best:.0f}', solves,
                  f'{error:.2f}')
        section.ask(f'{count} nodes: resident set', max(memory['VmRSS'], end['VmRSS']), ' MB',
                    most=MEMORY if count == LARGE else None)
        section.ask(f'{count} nodes: highest rate without loss', best, ' Hz')
    return section


def _ask(section: Section, nodes: int, phase: Phase) -> None:
    """Add the figures that something is asked of, also beside the echo."""
    key, floor = f'{nodes} nodes, {phase.rate:.0f} Hz', FLOOR.get(phase.rate)

    def ask(what: str, value: float, unit: str, most: float) -> None:
        section.ask(f'{key}: {what}', value, unit, most=most if nodes == LARGE else None)

    if phase.rate == CPU_RATE:
        ask('CPU', 100.0 * phase.cpu, ' %', 100.0 * CPU)
    if floor is not None and phase.rate in (CPU_RATE, LATENCY_RATE):
        section.ask(f'{key}: CPU beside the echo', phase.cpu / floor.cpu, ' times',
                    most=CPU_BESIDE)
    if phase.rate == LATENCY_RATE:
        latency, least = (np.percentile(each.latency, 99) if each is not None and len(
            each.latency) > 0 else np.inf for each in (phase, floor))
        ask('messages lost', phase.lost, '', 0.0)
        ask('outputs missing', phase.missing, '', 0.0)
        ask('latency, p99', latency, ' ms', LATENCY)
        if floor is not None:
            section.ask(f'{key}: latency, p99, beside the echo', latency / least, ' times',
                        most=LATENCY_BESIDE)


def starting(_options: Options) -> Section:
    """
    Time the start of the node up to its being ready, from compiled kernels.

    From the start of the process until its log says that it listens and has its kernels, compiled
    before, and until a peer has heard the same in diagnostics. In between lies the discovery of
    DDS, which takes 3 s more when an announcement is lost.
    """
    section = Section('The start', about(starting))
    said, heard = [], []
    for _ in range(STARTS + 1):
        begin = time.monotonic()
        with started(NODE, ('diagnostics_period:=0.1',)) as (process, feeder):
            feeder.wait_until(lambda process=process: process.has_said(*READY), 'it says so')
            said.append(time.monotonic() - begin)
            feeder.wait_until_ready()
            heard.append(time.monotonic() - begin)
            memory = process.memory()
    table = section.table(
        '', 'start', 'ready by its log [s]', 'heard by a peer [s]', 'resident [MB]')
    table.add('first, may compile', f'{said[0]:.2f}', f'{heard[0]:.2f}', '')
    for k in range(1, STARTS + 1):
        table.add(str(k), f'{said[k]:.2f}', f'{heard[k]:.2f}', '')
    table.add('median', f'{np.median(said[1:]):.2f}', f'{np.median(heard[1:]):.2f}',
              f'{memory["VmRSS"]:.0f}')
    section.ask('start, by its log', float(np.median(said[1:])), ' s', most=START_TIME)
    section.ask('start, heard by a peer', float(np.median(heard[1:])), ' s', most=START_TIME)
    return section


SECTIONS = {'start': starting, 'echo': echo, 'graphs': graphs}
