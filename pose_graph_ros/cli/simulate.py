# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Simulate a drive with known ground truth, and write it as a rosbag2 or as a g2o file.

Worlds: `drive`, a car that laps some city blocks twice; `hall`, a robot in the aisles of a hall;
`grid`, a walk at random through the streets of a small Manhattan. Each has the sensors and the
disturbances that are usual there; options change them. Equal options give equal drives, and what
is said of one sensor changes no other.

A bag has the true poses on /ground_truth. What was false, moved or left out is in OUT_truth.json;
of a graph OUT.g2o the truth is in OUT_truth.g2o, with the same ids.
"""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import replace
import json
from pathlib import Path
from typing import Any

from pose_graph_ros.cli.simulation_files import about_graph, graph_texts, write_recording
from pose_graph_ros.cli.simulation_options import (
    add_sensors,
    changed,
    number,
    refuse_what_graphs_lack,
)
from pose_graph_ros.core.exceptions import ConfigError, FileWriteError
from pose_graph_ros.core.io.atomic_files import write_files
from pose_graph_ros.core.io.tum import tum_text
from pose_graph_ros.offline.simulation.graph import graph_of, SimulatedGraph
from pose_graph_ros.offline.simulation.recording import course, record, Recording
from pose_graph_ros.offline.simulation.settings import Gyro, Setup
from pose_graph_ros.offline.simulation.worlds import WORLDS

GRAPH_SUFFIX = '.g2o'
LONGEST_S = 100_000.0  # of a simulation, which takes 100 MB an hour
PICTURES = ('.png', '.pdf', '.svg')
EXAMPLES = """\
examples:
  pose-graph simulate city                                        # as in `pose-graph demo`
  pose-graph simulate hall --world hall --duration 3600 --closures 0.5 --false-rate 0.1
  pose-graph simulate gnss --world grid --closures 0 --fix-sigma 0.5 --fix-correlated 1,30
  pose-graph simulate bad --outage /gps/fix:60:120 --jump /odom:200:3,0 --jump /gps/fix:250:20,5:30
  pose-graph simulate late --delay /gps/fix:2:3 --duplicate /loop_closure:0.2 --gyro
  pose-graph simulate city.g2o --world grid --duration 2300 --false-rate 0.3 --false-groups 9:5
  pose-graph replay hall --odom /odom --truth /ground_truth

exit code: 0 written, 2 wrong input
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this tool."""
    parser.epilog = EXAMPLES
    parser.add_argument('out', metavar='OUT', type=Path,
                        help='folder of the rosbag2, or a graph if the name ends in .g2o')
    parser.add_argument('--world', choices=WORLDS, default='drive',
                        help='(default: %(default)s)')
    parser.add_argument('--duration', metavar='S', type=number(10.0, LONGEST_S),
                        help='length [s] (default: ' + ', '.join(
                            f'{each.duration_s:g} for {name}' for name, each in WORLDS.items())
                        + ')')
    parser.add_argument('--seed', metavar='N', type=number(0, whole=True), default=1,
                        help='(default: %(default)s)')
    add_sensors(parser)
    out = parser.add_argument_group('output')
    out.add_argument('--node-distance', metavar='M', type=number(0.01),
                     help='distance of the nodes of a graph [m] (default: ' + ', '.join(
                         f'{each.node_distance:g} for {name}' for name, each in WORLDS.items())
                     + ')')
    out.add_argument('--tum', action='store_true', help='also write the truth as OUT_truth.tum')
    out.add_argument('--plot', metavar='FILE', type=Path,
                     help=f'draw a map; the name ends in {", ".join(PICTURES)}')
    out.add_argument('--json', action='store_true',
                     help='print what was simulated, the content of OUT_truth.json, as JSON '
                          '(docs/tools.md)')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    world = WORLDS[options.world]
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
    way = course(world, options.seed, options.duration, lambda usual: changed(usual, options))
    about = {'world': options.world, 'seed': options.seed,
             'duration_s': float(way.motion.time[-1])}
    files = dict[Path, bytes]()
    simulated: SimulatedGraph | Recording
    if is_graph:
        simulated = graph_of(way, options.node_distance or world.node_distance)
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
