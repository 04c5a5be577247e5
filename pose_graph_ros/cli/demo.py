# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Play a bag to the node over DDS; write the same results as a replay, and what the node published.

The results are those of the graph that the node saved, whose engine is restored. Times of updates
are in the recorded diagnostics: each message has the number of updates and their mean and longest
time since the start. The stamp of an update is that of the newest odometry that the node had
published before.
"""

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, ExitStack
import fcntl
import importlib
from importlib.util import find_spec
import json
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
import time

from pose_graph_ros.adapters.bags import BagError, choose_inputs, Inputs, open_bag
from pose_graph_ros.adapters.conversions import stamp_ns
from pose_graph_ros.adapters.damaged_bags import ROS1_SUFFIXES
from pose_graph_ros.adapters.sources import backend_config, source_list, Values
from pose_graph_ros.cli import shared, simulate
from pose_graph_ros.cli.drive import drive_in
from pose_graph_ros.cli.run import document, Recorder, Run, Update
from pose_graph_ros.cli.truth import truth_of
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.io.graph_files import read_graph
from pose_graph_ros.offline.simulation import recording, settings, worlds

SIMULATED_TOPICS = {'odom': '/odom', 'fix': '/gps/fix', 'loop_closure': '/loop_closure'}
GRAPH, RECORDED = 'graph.g2o', 'corrected'  # saved graph and rosbag2 of the node
DIAGNOSTICS, ODOMETRY = '/diagnostics', '/odometry/filtered'
NO_ANSWERS = ('believed', 'believed_weakly', 'doubted', 'waiting', 'forgotten', 'left',
              'left_unused', 'without_lever_arm', 'rate_hz', 'silence_s', 'bias')
"""Ends of keys of the diagnostics that are not counts of messages by what was answered."""


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    values = shared.parameter_values(options)
    options.out.mkdir(parents=True, exist_ok=True)
    bag_path, wanted = options.bag, shared.wanted_topics(options)
    title = 'Simulated drive' if bag_path is None else bag_path.stem
    if bag_path is None:
        bag_path = options.out / 'simulated_drive'
        options.truth = options.truth or '/ground_truth'
        print('simulating a drive')
        way = recording.course(worlds.WORLDS['drive'], 1, settings.DURATIONS_S['drive'])
        simulate.write_drive(recording.record(way), bag_path, overwrite=True)
        wanted = {source: topic or SIMULATED_TOPICS.get(source)
                  for source, topic in wanted.items()}
    truth = truth_of(options)
    with open_bag(bag_path) as bag:
        inputs = choose_inputs(
            bag, source_list(values), wanted, options.hold_out, truth=truth.topic)
    if bag_path.suffix in ROS1_SUFFIXES:
        raise BagError(f'{bag_path}: a ROS 1 bag cannot be played to a ROS 2 node; '
                       'pose-graph replay reads it')
    print(f'bag: {bag_path}')
    for source, topic in inputs.topics.items():
        print(f'  {source:<13} {topic}')
    start = time.monotonic()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # also stop the node on SIGTERM
    converged = _run(bag_path, inputs, values, options)
    seconds = time.monotonic() - start
    saved, recorder = read_graph(options.out / GRAPH), Recorder()
    backend = PoseGraphBackend.restored(backend_config(values), saved)
    report = backend.optimize()
    diagnostics = _updates(options.out / RECORDED, recorder, int(backend.node_stamps_ns[-1]))
    counts: dict[tuple[str, str], int] = {}  # of messages by source and answer
    for key, value in diagnostics.items():
        source, _, answer = key.rpartition('.')
        if source in inputs.topics and answer not in NO_ANSWERS and value.isdecimal():
            counts[source, answer] = int(value)
    with open_bag(bag_path) as bag:
        drive = drive_in(bag, inputs, values, backend, truth, origin=saved.datum)
    run = Run(title, 'the node over DDS', drive, backend, recorder, values, inputs.kinds, counts,
              report, seconds)
    print('\n'.join([
        *document.write_results(run, options.out, {
            'bag': bag_path.name, 'topics': dict(inputs.topics), 'rate': options.rate,
            'seconds': seconds, 'node': diagnostics}),
        f'written to {options.out}/: path.tum, corrected/ (rosbag2), drive.png, summary.json, '
        f'{GRAPH}, run.json', f'a page of it: pose-graph report {options.out}']))
    return 0 if converged and report.status is Status.CONVERGED else 1


def _updates(recorded: Path, recorder: Recorder, last_ns: int) -> Mapping[str, str]:
    """Record the updates before the last stamp; return the newest values of the diagnostics."""
    newest_ns, before, values = 0, (0, 0.0, 0.0), dict[str, str]()
    with open_bag(recorded) as bag:
        topics = [topic for topic in (DIAGNOSTICS, ODOMETRY) if topic in bag.topics]
        for message in bag.messages(topics):
            content = message.decode()
            if message.topic == ODOMETRY:
                newest_ns = stamp_ns(content)
                continue
            values = {item.key: item.value for item in content.status[0].values}
            count = int(values.get('updates', 0))
            total = count * float(values.get('solve_mean_ms', 0.0))
            longest = float(values.get('solve_max_ms', 0.0))
            # of the last one, the final optimisation has a part
            if before[0] < count and 0 < newest_ns < last_ns and 'chi2' in values:
                recorder.add_update(Update(
                    newest_ns, int(values['hidden_nodes']), longest if longest > before[2] else
                    max((total - before[1]) / (count - before[0]), 0.0), float(values['chi2'])),
                    count - before[0])
                before = count, total, longest
    return values


def _run(bag: Path, inputs: Inputs, values: Values, options: argparse.Namespace) -> bool:
    """Tell whether the optimisation converged after playing the bag to the node."""
    node_command = [sys.executable, '-m', 'pose_graph_ros.ros.main',
                    *shared.ros_arguments(options),
                    # the player reads from the diagnostics which messages the node has processed
                    '-p', 'diagnostics_period:=0.05', '-p', 'path_period:=0.5',
                    # in quotes, as it is read as YAML
                    '-p', f'graph_file:={json.dumps(str((options.out / GRAPH).resolve()))}']
    if find_spec('tf2_msgs') is None:  # make demo does not build it for the simulated drive
        node_command += ['-p', 'publish_tf:=false']
    with tempfile.TemporaryDirectory(prefix='pose_graph_') as log, \
            isolated_environment(Path(log)) as env:
        before = dict(os.environ)
        os.environ.update(env)
        try:
            try:
                player = importlib.import_module('pose_graph_ros.ros.player')
            except ImportError as error:  # all other tools work without ROS
                raise PoseGraphError(f'ROS 2 is not there: {error}') from error
            node = subprocess.Popen(node_command)
            try:
                converged = player.play(bag, options.out / RECORDED, inputs,
                                        {name: values[f'{name}.topic'] for name in inputs.topics},
                                        rate=options.rate, is_running=lambda: node.poll() is None)
            finally:
                node.send_signal(signal.SIGINT)  # nothing happens if it has ended
                try:
                    code = node.wait(15.0)
                except subprocess.TimeoutExpired:
                    node.kill()
                    code = node.wait()
        finally:
            os.environ.clear()
            os.environ.update(before)
        if code != 0:
            raise PoseGraphError(f'the node ended with code {code}')
        print('the node stopped cleanly')
        return bool(converged)


@contextmanager
def isolated_environment(log: Path) -> Iterator[dict[str, str]]:
    """
    Yield environment variables for ROS processes that only communicate with each other.

    No other program of this package uses their domain until the context is left.
    """
    with ExitStack() as locks:
        for domain in random.SystemRandom().sample(range(1, 101), 100):
            try:
                fcntl.flock(locks.enter_context(open(
                    f'{tempfile.gettempdir()}/pose_graph_ros_domain_{domain}', 'a')),
                    fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                continue  # it is used; if all are, the last one is used twice
        env = dict(os.environ)
        # set by a sourced ROS, but not by the wheels from PyPI
        env.setdefault('AMENT_PREFIX_PATH', sys.prefix)
        env.pop('ROS_LOCALHOST_ONLY', None)
        yield env | {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_DOMAIN_ID': str(domain),
                     'ROS_LOG_DIR': str(log)}
