# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory of `pose-graph replay` over a very long bag, which is made for it and removed again."""

from collections.abc import Iterator
import json
from pathlib import Path
import sys
import tempfile
import time

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from benchmark.course import Course
from benchmark.drives import Event
from benchmark.parts import child
from benchmark.section import about, Options, say, Section
from pose_graph_ros.adapters.bag_writer import BAG_VERSION
from pose_graph_ros.adapters.output_cdr import odometry_cdr
from pose_graph_ros.cli.simulate import fix_messages, loop_closure_messages, odometry_messages
from pose_graph_ros.core.estimate import Prediction
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import LoopClosure, Position

PLANE = TangentPlane(50.7271, 7.0866, 61.0)
RATE = 50.0
"""Of odometry [Hz]."""
FIX_PERIOD, CLOSURE_PERIOD = 1.0, 10.0
LIMIT = 400.0
"""Resident memory that is asked for [MB]."""
WINDOW = 600
"""[s]"""
ODOMETRY, FIX = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/NavSatFix'
POSE_TYPE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


def write_bag(folder: Path, samples: int, seed: int = 0) -> None:
    """
    Write a compressed bag piece by piece.

    Parameters
    ----------
    folder : Path, which must not exist
    samples : int, number of messages of odometry
    seed : int

    """
    course = Course(samples / RATE, seed, odometry_rate=RATE, fix_period=FIX_PERIOD,
                    closure_period=CLOSURE_PERIOD)
    types = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(folder, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        topics = {topic: writer.add_connection(topic, kind, typestore=types) for topic, kind in (
            ('/odom', ODOMETRY), ('/gps/fix', FIX), ('/loop_closure', POSE_TYPE))}
        for times, poses, others in course.pieces():
            stamps = course.stamps(times)
            messages = [(stamp, '/odom', data) for stamp, data in zip(
                stamps.tolist(), _odometry(stamps, poses), strict=True)]
            messages += [(stamp, topic, bytes(types.serialize_cdr(message, kind)))
                         for topic, kind, stamp, message in _others(others, course)]
            # a closure or a fix after the odometry with its stamp
            messages.sort(key=lambda message: message[:2] != '/odom' and message[0])
            for stamp, topic, data in messages:
                writer.write(topics[topic], stamp, data)


def _odometry(stamps: np.ndarray, poses: FloatArray) -> Iterator[bytes]:
    """Yield serialised messages, all with the twist of the first."""
    first = next(iter(odometry_messages(
        '/odom', 'odom', Trajectory(stamps[:2], poses[:2]), (0.01,) * 6)))[3]
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        yield odometry_cdr(stamp, Prediction(pose, 0.01 * np.eye(3)), first, 'odom', 'base_link')


def _others(others: list[Event], course: Course) -> Iterator[tuple]:
    """Yield the messages of fixes and of closures."""
    fixes = [each for _, each in others if isinstance(each, Position)]
    closures = [each for _, each in others if isinstance(each, LoopClosure)]
    if len(fixes) > 0:
        yield from fix_messages(
            '/gps/fix', np.array([each.stamp_ns for each in fixes]),
            PLANE.to_geodetic(np.array([each.position for each in fixes])), course.fix_sigma)
    if len(closures) > 0:
        yield from loop_closure_messages(
            '/loop_closure', np.array([(each.reference_ns, each.stamp_ns) for each in closures]),
            np.array([each.pose for each in closures]), closures[0].covariance)


def replay(bag: Path, out: Path, *arguments: str) -> tuple[float, float]:
    """Return the time of a replay [s], and the largest resident memory of the process [MB]."""
    command = [str(Path(sys.executable).with_name('pose-graph')), 'replay', str(bag), '-o',
               str(out), *arguments]
    begin = time.monotonic()
    # by a small process, as the largest size of the one that starts a process counts as well
    said = child('import resource, subprocess\n'
                 f'assert subprocess.call({command!r}, stdout=subprocess.DEVNULL) in (0, 1)\n'
                 'print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)')
    return time.monotonic() - begin, int(said) * 1024e-6


def section(options: Options) -> Section:
    """
    Replay bags of several lengths.

    `pose-graph replay` of a bag with odometry at {RATE:.0f} Hz, fixes at 1 Hz and a loop closure
    every {CLOSURE_PERIOD:.0f} s, with a window of {WINDOW} s. Largest resident memory of the
    process. Asked for: below {LIMIT:.0f} MB with 10 million samples.
    """
    found = Section('A replay of very many samples', about(section))
    table = found.table('', 'samples', 'hours', 'bag MB', 'time s', 'us a sample', 'hidden nodes',
                        'largest memory MB')
    for n in options.sizes or ((100_000,) if options.quick else (1_000_000, 10_000_000)):
        with tempfile.TemporaryDirectory() as scratch:
            bag, out = Path(scratch, 'bag'), Path(scratch, 'out')
            write_bag(bag, n)
            size = sum(file.stat().st_size for file in bag.iterdir()) * 1e-6
            say('  replaying')
            seconds, memory = replay(bag, out, '-p', f'window.seconds:={float(WINDOW)}')
            summary = json.loads((out / 'summary.json').read_text(encoding='utf-8'))
        table.add(str(n), f'{n / RATE / 3600.0:.1f}', f'{size:.0f}', f'{seconds:.0f}',
                  f'{1e6 * seconds / n:.0f}', str(summary['hidden_nodes']), f'{memory:.0f}')
        found.ask(f'replay of {n} samples: memory', memory, ' MB', most=LIMIT)
    return found
