# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulate a drive with known ground truth, and write it as a rosbag2 or as a g2o file."""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import replace
import json
from pathlib import Path
from typing import Any

from pose_graph_ros.cli.simulation_files import about_graph, graph_texts, write_recording
from pose_graph_ros.cli.simulation_options import changed, PICTURES, refuse_what_graphs_lack
from pose_graph_ros.core.exceptions import ConfigError, FileWriteError
from pose_graph_ros.core.io.atomic_files import write_files
from pose_graph_ros.core.io.tum import tum_text
from pose_graph_ros.offline.simulation.graph import graph_of, SimulatedGraph
from pose_graph_ros.offline.simulation.recording import course, record, Recording
from pose_graph_ros.offline.simulation.settings import DURATIONS_S, Gyro, NODE_DISTANCES, Setup
from pose_graph_ros.offline.simulation.worlds import WORLDS

GRAPH_SUFFIX = '.g2o'


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.plot is not None and options.plot.suffix not in PICTURES:
        raise ConfigError(f'--plot {options.plot}: the name must end in {", ".join(PICTURES)}')
    beside = {kind: options.out.with_name(f'{options.out.stem}_truth.{kind}'
                                          if options.out.suffix == GRAPH_SUFFIX else
                                          f'{options.out.name}_truth.{kind}')
              for kind in ('json', 'tum', 'g2o')}
    is_graph = options.out.suffix == GRAPH_SUFFIX
    if is_graph:
        refuse_what_graphs_lack(options)
    elif options.node_distance is not None:
        raise ConfigError(f'--node-distance: only a graph has nodes, but {options.out} is a bag; '
                          f'expected a name that ends in {GRAPH_SUFFIX}')
    written = [options.out, beside['json'], *([beside['tum']] if options.tum else []),
               *([beside['g2o']] if is_graph else [])]
    for path in written:
        if path.exists():
            raise FileWriteError(f'{path}: exists already, not overwritten')
    way = course(WORLDS[options.world], options.seed,
                 options.duration or DURATIONS_S[options.world],
                 lambda usual: changed(usual, options))
    about = {'world': options.world, 'seed': options.seed,
             'duration_s': float(way.motion.time[-1])}
    files = dict[Path, bytes]()
    simulated: SimulatedGraph | Recording
    if is_graph:
        simulated = graph_of(way, options.node_distance or NODE_DISTANCES[options.world])
        about |= about_graph(way, simulated)
        files = {path: text.encode() for path, text in zip(
            (options.out, beside['g2o']), graph_texts(simulated), strict=True)}
    else:
        simulated = record(way)
        about |= write_recording(simulated, options.out)
    text = json.dumps(about, indent=2)
    files[beside['json']] = f'{text}\n'.encode()
    if options.tum:
        files[beside['tum']] = tum_text(simulated.truth).encode()
    write_files(files)
    if options.plot is not None:
        _draw(simulated, options.plot, next(_lines(about)))
        written.append(options.plot)
    if options.json:
        print(text)
        return 0
    for line in _lines(about):
        print(line)
    print('written: ' + ', '.join(map(str, written)))
    return 0


def _draw(simulated: SimulatedGraph | Recording, file: Path, title: str) -> None:
    # matplotlib takes half a second to load
    from pose_graph_ros.cli import simulation_picture as picture  # noqa: PLC0415

    scene = (picture.scene_of_graph(simulated) if isinstance(simulated, SimulatedGraph)
             else picture.scene_of_recording(simulated))
    picture.draw(scene, file, title)


def _lines(about: Mapping[str, Any]) -> Iterator[str]:
    """Yield what people want to know of a simulation."""
    yield (f'{about["world"]}, seed {about["seed"]}: {about["distance_m"]:.0f} m in '
           f'{about["duration_s"]:g} s')
    if 'topics' in about:
        yield from (f'  {topic:<14} {count}' for topic, count in about['topics'].items())
    else:
        yield (f'  {about["nodes"]} nodes, {about["edges"]} edges, {about["observed_nodes"]} '
               f'observed nodes; chi2 of the truth {about["chi2_of_the_truth"]:.6g}, of '
               f'{about["measured_numbers"]} numbers')
    false = len(about['false_closures'])
    yield f'  {about["true_closures"]} true and {false} false loop closures'
    if about['missing_groups'] > 0:
        yield (f'  warning: {about["missing_groups"]} false closures or groups of them found no '
               'places that are apart and driven in the same direction')


def simulate_drive(
    seed: int = 1, duration_s: float = 440.0, *, gyro: bool = False, heading_drift: float = 0.0,
) -> Recording:
    """
    Return a simulated drive; equal arguments give equal drives.

    Parameters
    ----------
    seed : int
        Seed of the sensor errors, the position within the lane and the waits at traffic lights.
    duration_s : float
        Length of the recording, 10 s or more [s]; the second lap begins after about 310 s.
    gyro : bool, whether with a gyroscope; all else is the same without
    heading_drift : float, what the heading by the wheels drifts by, per distance [rad/m]

    """
    def change(usual: Setup) -> Setup:
        return replace(usual, gyro=Gyro() if gyro else None,
                       wheels=replace(usual.wheels, heading_drift=heading_drift))
    return record(course(WORLDS['drive'], seed, duration_s, change))


def write_drive(drive: Recording, folder: str | Path, *, overwrite: bool = False) -> None:
    """
    Write a drive as a rosbag2 with `/odom`, `/gps/fix`, `/loop_closure` and `/ground_truth`.

    With a gyroscope it has `/imu/data` as well.

    Parameters
    ----------
    overwrite : bool, whether to replace an existing bag; otherwise one raises `BagError`

    """
    write_recording(drive, Path(folder), overwrite=overwrite)
