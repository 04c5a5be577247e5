# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run a bag or a g2o file through the engine of the node, without ROS and as fast as possible.

Messages are read and added as in the node, but without threads, and the same full optimisation
follows at the end. The path is the one of a node that receives the same messages. Of a g2o file,
edges to the next vertex are odometry, with the noise of the file (odom.noise:=model takes that of
the parameters); all others are loop closures, which come when their later end is reached.
"""

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
import time
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.bag_inputs import (
    choose_inputs,
    Inputs,
    read_inputs,
    read_static_frames,
)
from pose_graph_ros.adapters.bags import BagError, BagReader, MessageError, open_bag
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.sources import backend_config, CLOSURES, ODOMETRY_KINDS, source_list
from pose_graph_ros.cli import options as shared
from pose_graph_ros.cli.evaluation import Drive
from pose_graph_ros.cli.g2o_inputs import read_measurements
from pose_graph_ros.cli.judgement import judgement, judgement_lines
from pose_graph_ros.cli.results import collect_drive, write_results
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.g2o import EDGE2_ORDERS
from pose_graph_ros.core.io.g2o_writing import write_g2o
from pose_graph_ros.core.judgement.texts import Key, states_by_stamps
from pose_graph_ros.core.judgement.verdicts import State, Verdict
from pose_graph_ros.core.measurements import Answer, LoopClosure, Measurement, OdometrySample

UPDATE_EVERY = 10  # new hidden nodes after which the graph is updated, to stay near the optimum


class Replayed(NamedTuple):
    """Result of running a bag through the engine."""

    backend: PoseGraphBackend
    report: UpdateReport  # report of the final optimisation
    refused: Counter[tuple[str, str]]  # messages without a valid measurement, by source and reason
    origin: MapOrigin | None = None  # datum of the graph

    def states(self, verdicts: Sequence[Verdict]) -> dict[Key, State]:
        """Return what is believed, by source and stamps; refused loop closures are not."""
        refused = dict.fromkeys(self.backend.refused_closures, State.DOUBTED)
        return states_by_stamps(verdicts) | refused


def run(bag: BagReader, inputs: Inputs, values: Mapping[str, Any]) -> Replayed:
    """
    Return a new engine after adding all messages of a bag and a full optimisation.

    Parameters
    ----------
    values : mapping, all parameters of the node

    """
    reader = MessageReader(values)
    for message in read_static_frames(bag):
        reader.frames.receive(message.decode())
    refused: Counter[tuple[str, str]] = Counter()
    backend, report = run_measurements(_read(bag, inputs, reader, refused), values)
    plane = reader.datum.plane
    return Replayed(backend, report, refused, None if plane is None else plane.origin)


def _read(
    bag: BagReader, inputs: Inputs, reader: MessageReader, refused: Counter[tuple[str, str]],
) -> Iterator[tuple[str, OdometrySample | Measurement]]:
    """Yield the valid measurements of a bag that are not held out; count the others."""
    for source, message, held_out in read_inputs(bag, inputs):
        if held_out:
            continue
        try:
            measurement = reader.read(source, message.decode())
        except MessageError:
            refused[source, 'malformed'] += 1
            continue
        if isinstance(measurement, Answer):
            refused[source, measurement.reason] += 1
        else:
            yield source, measurement


def run_measurements(
    measurements: Iterable[tuple[str, OdometrySample | Measurement]], values: Mapping[str, Any],
) -> tuple[PoseGraphBackend, UpdateReport]:
    """
    Return a new engine after adding measurements, and the report of the full optimisation.

    Parameters
    ----------
    measurements : iterable, sources and measurements, in the order of their arrival
    values : mapping, all parameters of the node

    """
    backend = PoseGraphBackend(backend_config(values))
    next_update = UPDATE_EVERY
    for source, measurement in measurements:
        if isinstance(measurement, OdometrySample):
            backend.add_odometry(measurement, source)
        else:
            backend.add_measurement(measurement, source)
        if backend.graph.n_nodes >= next_update:
            backend.update()
            next_update = backend.graph.n_nodes + UPDATE_EVERY
    return backend, backend.optimize()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this tool."""
    parser.add_argument('bag', type=Path, help='rosbag2 folder, .mcap, .db3, or a .g2o file')
    parser.add_argument('-o', '--out', metavar='DIR', type=Path, default=Path('replay'),
                        help='folder for the results (default: %(default)s)')
    parser.add_argument('--stamps', metavar='FILE', type=Path,
                        help='text file with the stamps [s] of the vertices of a .g2o file '
                             '(default: a second apart)')
    parser.add_argument('--edge2', choices=EDGE2_ORDERS,
                        help='format of the tag EDGE2 in a .g2o file')
    shared.add_inputs(parser)
    shared.add_parameters(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.bag.suffix == '.g2o':
        return _execute_g2o(options)
    values = shared.parameter_values(options)
    wanted = shared.wanted_topics(options)
    with open_bag(options.bag) as bag:
        inputs = choose_inputs(bag, source_list(values), wanted, options.hold_out)
        for source, topic in inputs.topics.items():
            print(f'{source}: {topic}')
        start = time.monotonic()
        result = run(bag, inputs, values)
        seconds = time.monotonic() - start
        estimate = result.backend.estimate()
        if estimate is None:
            topics = ' or '.join(inputs.topics[name] for name in inputs.of(*ODOMETRY_KINDS))
            raise BagError(f'{options.bag}: no usable odometry on {topics}')
        verdicts = result.backend.verdicts()
        drive = collect_drive(
            bag, inputs, values, estimate.path, options.truth, origin=result.origin,
            states=result.states(verdicts))
    return _report(options, drive, result, verdicts, seconds)


def _execute_g2o(options: argparse.Namespace) -> int:
    """Replay a g2o file."""
    values = shared.parameter_values(options, {'odom.noise': 'twist'})
    measurements = read_measurements(options.bag, options.stamps, options.edge2)
    odometry_source = next(
        source.name for source in source_list(values) if source.kind.is_odometry)
    start = time.monotonic()
    backend, report = run_measurements((
        (odometry_source if isinstance(each, OdometrySample) else CLOSURES, each)
        for each in measurements), values)
    result = Replayed(backend, report, Counter())
    seconds = time.monotonic() - start
    estimate = backend.estimate()
    assert estimate is not None, 'a graph has vertices'
    verdicts = backend.verdicts()
    states = result.states(verdicts)
    samples = [each for each in measurements if isinstance(each, OdometrySample)]
    loops = [(each.reference_ns or 0, each.stamp_ns) for each in measurements
             if isinstance(each, LoopClosure)]
    drive = Drive(
        Trajectory(np.array([each.stamp_ns for each in samples]),
                   np.array([each.pose for each in samples])),
        np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty(0, dtype=bool), estimate.path,
        None, np.array(loops, dtype=np.int64).reshape(-1, 2),
        loop_states=[states.get((CLOSURES, stamp, reference), State.BELIEVED)
                     for reference, stamp in loops])
    return _report(options, drive, result, verdicts, seconds)


def _report(
    options: argparse.Namespace, drive: Drive, result: Replayed, verdicts: Sequence[Verdict],
    seconds: float,
) -> int:
    """Write the results and print a summary; return the exit code."""
    backend, report = result.backend, result.report
    estimate, totals = backend.estimate(), backend.verdict_totals()
    assert estimate is not None
    counts = {f'{source}.{answer}': count for (source, answer), count
              in sorted((backend.counts + result.refused).items())}
    table = write_results(drive, options.out, options.bag.stem, {
        'seconds': seconds, 'alignment': estimate.alignment.value,
        'hidden_nodes': estimate.n_hidden, 'frozen_nodes': estimate.n_frozen,
        'thinned_nodes': estimate.n_thinned, 'edges': estimate.n_edges,
        'observed_nodes': estimate.n_observed, 'biases': estimate.n_biases,
        'chi2': estimate.chi2, 'odometry_scale': estimate.odometry_scale,
        'status': report.status.value, 'counts': counts,
        'judged': judgement(totals, verdicts)})
    write_g2o(backend.graph, options.out / 'graph.g2o')
    print(f'{estimate.n_hidden} hidden nodes, {estimate.n_edges} edges, {estimate.n_observed} '
          f'observed nodes in {seconds:.2f} s; {report.status.value}, chi2 {report.chi2:.6g}; '
          f'{estimate.alignment.value}')
    if estimate.odometry_scale != 1.0:
        print(f'{estimate.primary}: weighed with {estimate.odometry_scale:.3g} times the sigmas '
              'that it claims')
    for source, fit in sorted(backend.reports().items()):
        text = f'{source}: squared residual {fit.energy:.3g} sigma^2'
        if fit.errors.significant:
            text += (f'; errors of {fit.errors.sigma_correlated:.3g} m with a time constant of '
                     f'{fit.errors.tau:.3g} s')
        if fit.in_use is not None:
            text += f'; treated as correlated over {fit.in_use.tau:.3g} s'
        if fit.wrongly_white:
            text += f', but are treated as white: see {source}.correlation_time'
        print(text)
    for line in judgement_lines(totals, verdicts):
        print(line)
    print('counts: ' + ', '.join(f'{name} {count}' for name, count in counts.items()))
    print(f'\n{table}\n\nwritten: {options.out}/path.tum, drive.png, summary.json, graph.g2o')
    return 0 if report.status is Status.CONVERGED else 1
