# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure the real node over DDS: rates, latencies, processor and memory, with graphs of some size.

    .venv/bin/python -m benchmark.load --out docs/benchmarks/load

The node is a process of its own, with default parameters but for a fixed datum and no closing
optimisation in the pauses. The graph is filled by a drive with a hidden node at each sample of
odometry; then a robot drives at 2 m/s, with fixes at 10 Hz. Latency is the time from before the
publication of odometry to the arrival of `odometry/filtered` with its stamp, both by the steady
clock of the sender, and holds the way there and back. The echo is a process that sends back what
it gets: what DDS and rclpy cost alone. Pacing is how late the sender itself was.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
import shlex
import signal
import subprocess
import sys
import tempfile
import time

import numpy as np

from benchmark import report
from benchmark.feeder import DATUM, Feeder, Phase
from benchmark.metrics import Metric
from benchmark.section import say, Section, Table
from pose_graph_ros.adapters.output_cdr import path_cdr
from pose_graph_ros.cli.demo import isolated_environment
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.ros.spinning import EventsExecutor

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
PATH_TIME, START_TIME = 10.0, 3.0
"""[ms] and [s]."""
LADDER = (1000.0, 1500.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
STARTS = 5
READY = 'ready, listening', 'kernels ready'
"""What the log then says."""
MB = 1e6


class Process:
    """A process under test, and what the system says of it."""

    def __init__(
        self, module: str, environment: dict[str, str], parameters: Sequence[str] = (),
    ) -> None:
        arguments = [part for parameter in parameters for part in ('-p', parameter)]
        if len(arguments) > 0:
            arguments.insert(0, '--ros-args')
        self._log = Path(environment['ROS_LOG_DIR']) / 'stderr'
        with self._log.open('w', encoding='utf-8') as log:
            self.process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments], env=environment, stderr=log)

    def has_said(self, *parts: str) -> bool:
        """Tell whether all of these stand in its log."""
        log = self._log.read_text(encoding='utf-8')
        return all(part in log for part in parts)

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
    module: str, parameters: Sequence[str] = (), *, path: bool = False,
    feeder_type: type[Feeder] = Feeder,
) -> Iterator[tuple[Process, Feeder]]:
    """Start a process and a feeder that talk to each other alone."""
    with tempfile.TemporaryDirectory(prefix='pose_graph_') as log, \
            isolated_environment(Path(log)) as environment, \
            feeder_type(environment, listens_to_path=path) as feeder:
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


def echo(rates: Sequence[float], seconds: float) -> tuple[Section, dict[float, Phase]]:
    """Measure a process that does nothing but send back; return also its phases by rate."""
    section = Section(
        'The floor: an echo', 'A node of rclpy that republishes the bytes of each odometry '
        'message. No lost messages are counted: it has no diagnostics.')
    floor: dict[float, Phase] = {}
    for title, parameters, higher in (
            ('as rclpy.spin runs it', (), LADDER[1:3]),
            ('by the EventsExecutor, as the node', ('events:=true',), ())):
        table = Table(title, HEADER)
        if parameters and EventsExecutor is None:
            continue
        with started('benchmark.echo', parameters) as (process, feeder):
            feeder.wait_for_listener()
            feeder.rest(1.0)
            for rate in (*rates, *higher):
                phase = feeder.run(rate, seconds, process.cpu_seconds)
                floor.setdefault(rate, phase)
                table.add(*cells(phase))
                say(f'echo {title}: {" ".join(cells(phase))}')
        section.tables.append(table)
    return section, floor


def beside(nodes: int, phase: Phase, floor: Phase | None) -> list[Metric]:
    """Return what the node takes beside the echo, where something is asked of it."""
    if floor is None or phase.rate not in (CPU_RATE, LATENCY_RATE):
        return []
    key = f'{nodes} nodes, {phase.rate:.0f} Hz'
    metrics = [Metric(f'{key}: CPU beside the echo', phase.cpu / floor.cpu, ' times',
                      target=CPU_BESIDE)]
    if phase.rate == LATENCY_RATE and len(phase.latency) > 0 and len(floor.latency) > 0:
        metrics.append(Metric(
            f'{key}: latency, p99, beside the echo',
            float(np.percentile(phase.latency, 99) / np.percentile(floor.latency, 99)), ' times',
            target=LATENCY_BESIDE))
    return metrics


def graphs(
    nodes: Sequence[int], rates: Sequence[float], seconds: float, floor: Mapping[float, Phase], *,
    path: bool,
) -> list[Section]:
    """Measure the node with graphs of some sizes."""
    rate_section = Section(
        'Rates and latencies', f'{seconds:.0f} s at each rate, fixes at 10 Hz; '
        + ('`path` has a subscriber.' if path else '`path` has no subscriber.'))
    memory_section = Section(
        'Memory and filling', 'Of the node, after the graph was filled, and at the end.')
    sizes = Table('', ('hidden nodes', 'filled in [s]', 'samples a second', 'resident [MB]',
                       'anonymous [MB]', 'files [MB]', 'at the end [MB]', 'peak [MB]',
                       'highest rate without loss [Hz]', 'update mean / most [ms]',
                       'error of the output [m]'))
    for count in nodes:
        with started(NODE, PARAMETERS, path=path) as (process, feeder):
            feeder.wait_until_ready()
            feeder.rest(0.5)
            seconds_filled = feeder.fill(count)
            memory = process.memory()
            say(f'{count} nodes in {seconds_filled:.1f} s: {memory}, {feeder.values}')
            table = Table(f'{feeder.values["hidden_nodes"]} hidden nodes',
                          HEADER + (('paths',) if path else ()))
            error = 0.0
            for rate in rates:
                phase = measured(process, feeder, rate, seconds)
                table.add(*cells(phase), *((str(phase.paths),) if path else ()))
                say(f'  {" ".join(cells(phase))}, {phase.error:.2f} m')
                error = float(np.fmax(error, phase.error))
                rate_section.metrics += asked(count, phase)
                rate_section.metrics += beside(count, phase, floor.get(rate))
            solves = f'{feeder.values["solve_mean_ms"]} / {feeder.values["solve_max_ms"]}'
            best, ladder = highest_rate(process, feeder)
            for phase in ladder:
                table.add(*cells(phase), *((str(phase.paths),) if path else ()))
            rate_section.tables.append(table)
            end = process.memory()
        sizes.add(str(count), f'{seconds_filled:.1f}', f'{count / seconds_filled:.0f}',
                  *(f'{memory[name]:.0f}' for name in ('VmRSS', 'RssAnon', 'RssFile')),
                  f'{end["VmRSS"]:.0f}', f'{end["VmHWM"]:.0f}', f'{best:.0f}', solves,
                  f'{error:.2f}')
        target = MEMORY if count == LARGE else None
        memory_section.metrics += [
            Metric(f'{count} nodes: resident set', max(memory['VmRSS'], end['VmRSS']), ' MB',
                   target=target),
            Metric(f'{count} nodes: highest rate without loss', best, ' Hz')]
    memory_section.tables.append(sizes)
    return [rate_section, memory_section]


def asked(nodes: int, phase: Phase) -> list[Metric]:
    """Return the figures that something is asked of."""
    key = f'{nodes} nodes, {phase.rate:.0f} Hz'
    large = nodes == LARGE
    metrics = []
    if phase.rate == LATENCY_RATE:
        latency = float(np.percentile(phase.latency, 99)) if len(phase.latency) > 0 else np.inf
        metrics += [
            Metric(f'{key}: messages lost', float(phase.lost), target=0.0 if large else None),
            Metric(f'{key}: outputs missing', float(phase.missing), target=0.0 if large else None),
            Metric(f'{key}: latency, p99', latency, ' ms', target=LATENCY if large else None)]
    if phase.rate == CPU_RATE:
        metrics.append(Metric(
            f'{key}: CPU', 100.0 * phase.cpu, ' %', target=100.0 * CPU if large else None))
    return metrics


def highest_rate(process: Process, feeder: Feeder) -> tuple[float, list[Phase]]:
    """Go up in rate until something is lost; return the highest rate before that, and all."""
    best, phases = 0.0, []
    for rate in LADDER:
        phase = measured(process, feeder, rate, 5.0)
        phases.append(phase)
        say(f'  {" ".join(cells(phase))}')
        if phase.lost > 0 or phase.missing > 0:
            break
        best = rate
    return best, phases


def path_time(nodes: int) -> Section:
    """Time the serialisation of a long path."""
    section = Section('The path', f'nav_msgs/Path of {nodes} poses to bytes.')
    rng = np.random.default_rng(0)
    path = Trajectory(np.arange(1, nodes + 1) * 200_000_000 + 1_700_000_000_000_000_000,
                      rng.normal(0.0, 1.0, (nodes, 3)))
    times = []
    for _ in range(20):
        begin = time.perf_counter()
        data = path_cdr(path, 1, 'map')
        times.append(1e3 * (time.perf_counter() - begin))
    table = Table('', ('poses', 'bytes', 'p50 [ms]', 'most [ms]'))
    table.add(str(nodes), str(len(data)), f'{np.median(times):.2f}', f'{max(times):.2f}')
    section.tables.append(table)
    section.metrics.append(Metric(f'path of {nodes} poses serialised', float(np.median(times)),
                                  ' ms', target=PATH_TIME if nodes == LARGE else None))
    return section


def starting() -> Section:
    """Time the start of the node up to its being ready, from compiled kernels."""
    section = Section(
        'The start', 'From the start of the process until its log says that it listens and has '
        'its kernels, compiled before, and until a peer has heard the same in diagnostics. In '
        'between lies the discovery of DDS, which takes 3 s more when an announcement is lost.')
    said, heard = [], []
    for _ in range(STARTS + 1):
        begin = time.monotonic()
        with started(NODE, ('diagnostics_period:=0.1',)) as (process, feeder):
            feeder.wait_until(lambda process=process: process.has_said(*READY), 'it says so')
            said.append(time.monotonic() - begin)
            feeder.wait_until_ready()
            heard.append(time.monotonic() - begin)
            memory = process.memory()
    table = Table('', ('start', 'ready by its log [s]', 'heard by a peer [s]', 'resident [MB]'))
    table.add('first, may compile', f'{said[0]:.2f}', f'{heard[0]:.2f}', '')
    for k in range(1, STARTS + 1):
        table.add(str(k), f'{said[k]:.2f}', f'{heard[k]:.2f}', '')
    table.add('median', f'{np.median(said[1:]):.2f}', f'{np.median(heard[1:]):.2f}',
              f'{memory["VmRSS"]:.0f}')
    say(f'start: {said}, {heard}')
    section.tables.append(table)
    section.metrics += [
        Metric('start, by its log', float(np.median(said[1:])), ' s', target=START_TIME),
        Metric('start, heard by a peer', float(np.median(heard[1:])), ' s', target=START_TIME)]
    return section


def main(arguments: list[str]) -> int:
    """Measure and write the page; return 1 if a figure is not what is asked for."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.load', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--nodes', type=int, nargs='+', default=[1000, 10_000, LARGE],
                        metavar='N', help='sizes of the graph (default %(default)s)')
    parser.add_argument('--rates', type=float, nargs='+', default=[50.0, 200.0, 500.0, 1000.0],
                        metavar='HZ', help='of odometry (default %(default)s)')
    parser.add_argument('--seconds', type=float, default=20.0, metavar='S',
                        help='at each rate (default %(default)s)')
    parser.add_argument('--path', action='store_true', help='listen to the path, too')
    parser.add_argument('--quick', action='store_true', help='1000 nodes, 3 s at each rate')
    parser.add_argument('--out', type=Path, default=Path('build/benchmark/load'), metavar='DIR')
    options = parser.parse_args(arguments)
    nodes, seconds = ([1000], 3.0) if options.quick else (options.nodes, options.seconds)
    start = starting()
    echoes, floor = echo(options.rates, seconds)
    sections = [start, echoes, *graphs(nodes, options.rates, seconds, floor, path=options.path),
                path_time(LARGE)]
    command = shlex.join(['python', '-m', 'benchmark.load', *arguments])
    about = (__doc__ or '').strip().split('\n\n')[-1].replace('\n', ' ')
    page = report.write(sections, options.out, command, title='The node under load',
                        remarks=about)
    metrics = [metric for section in sections for metric in section.metrics]
    say(f'{report.summary(metrics)}; see {page}')
    return 0 if all(metric.reached for metric in metrics) else 1


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
