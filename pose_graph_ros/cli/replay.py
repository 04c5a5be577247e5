# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run a bag through the engine of the node, without ROS and as fast as possible.

Messages are read and added as in the node, but without threads, and the same full optimisation
follows at the end. The path is the one of a node that receives the same messages.
"""

import argparse
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
import time
from typing import Any, NamedTuple

from pose_graph_ros.adapters.bag_inputs import (
    choose_inputs,
    Inputs,
    read_inputs,
    read_static_frames,
)
from pose_graph_ros.adapters.bags import BagError, BagReader, MessageError, open_bag
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.sources import backend_config, Kind, source_list
from pose_graph_ros.cli import options as shared
from pose_graph_ros.cli.judgement import judgement, judgement_lines
from pose_graph_ros.cli.results import collect_drive, write_results
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.io.g2o import write_g2o
from pose_graph_ros.core.judgement.texts import states_by_stamps
from pose_graph_ros.core.measurements import Answer, OdometrySample

UPDATE_EVERY = 10  # new hidden nodes after which the graph is updated, to stay near the optimum


class Replayed(NamedTuple):
    """Result of running a bag through the engine."""

    backend: PoseGraphBackend
    report: UpdateReport  # report of the final optimisation
    refused: Counter[tuple[str, str]]  # messages without a valid measurement, by source and reason
    origin: MapOrigin | None = None  # datum of the graph


def run(bag: BagReader, inputs: Inputs, values: Mapping[str, Any]) -> Replayed:
    """
    Return a new engine after adding all messages of a bag and a full optimisation.

    Parameters
    ----------
    bag : BagReader
    inputs : Inputs
    values : mapping
        All parameters of the node.

    """
    backend = PoseGraphBackend(backend_config(values))
    reader = MessageReader(values)
    for message in read_static_frames(bag):
        reader.frames.receive(message.decode())
    refused: Counter[tuple[str, str]] = Counter()
    next_update = UPDATE_EVERY
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
        elif isinstance(measurement, OdometrySample):
            backend.add_odometry(measurement, source)
        else:
            backend.add_measurement(measurement, source)
        if backend.graph.n_nodes >= next_update:
            backend.update()
            next_update = backend.graph.n_nodes + UPDATE_EVERY
    report, plane = backend.optimize(), reader.datum.plane
    return Replayed(backend, report, refused, None if plane is None else plane.origin)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this tool."""
    parser.add_argument('bag', type=Path, help='rosbag2 folder, .mcap or .db3')
    parser.add_argument('-o', '--out', metavar='DIR', type=Path, default=Path('replay'),
                        help='folder for the results (default: %(default)s)')
    shared.add_inputs(parser)
    shared.add_parameters(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    values, wanted = shared.parameter_values(options), shared.wanted_topics(options)
    with open_bag(options.bag) as bag:
        inputs = choose_inputs(bag, source_list(values), wanted, options.hold_out)
        for source, topic in inputs.topics.items():
            print(f'{source}: {topic}')
        start = time.monotonic()
        backend, report, refused, origin = run(bag, inputs, values)
        seconds = time.monotonic() - start
        estimate = backend.estimate()
        if estimate is None:
            topics = ' or '.join(inputs.topics[name] for name in inputs.of(Kind.ODOMETRY))
            raise BagError(f'{options.bag}: no usable odometry on {topics}')
        verdicts, totals = backend.verdicts(), backend.verdict_totals()
        drive = collect_drive(
            bag, inputs, values, estimate.path, options.truth, origin=origin,
            states=states_by_stamps(verdicts))
    counts = {f'{source}.{answer}': count for (source, answer), count
              in sorted((backend.counts + refused).items())}
    table = write_results(drive, options.out, options.bag.stem, {
        'seconds': seconds, 'alignment': estimate.alignment.value,
        'hidden_nodes': estimate.n_hidden, 'edges': estimate.n_edges,
        'observed_nodes': estimate.n_observed, 'biases': estimate.n_biases,
        'chi2': estimate.chi2, 'status': report.status.value, 'counts': counts,
        'judged': judgement(totals, verdicts)})
    write_g2o(backend.graph, options.out / 'graph.g2o')
    print(f'{estimate.n_hidden} hidden nodes, {estimate.n_edges} edges, {estimate.n_observed} '
          f'observed nodes in {seconds:.2f} s; {report.status.value}, chi2 {report.chi2:.6g}; '
          f'{estimate.alignment.value}')
    for source, fit in sorted(backend.reports().items()):
        text = f'{source}: squared residual {fit.energy:.3g} sigma^2'
        if fit.errors.significant:
            text += (f'; errors of {fit.errors.sigma_correlated:.3g} m with a time constant of '
                     f'{fit.errors.tau:.3g} s')
        if fit.wrongly_white:
            text += f', but are treated as white: see {source}.correlation_time'
        print(text)
    for line in judgement_lines(totals, verdicts):
        print(line)
    print('counts: ' + ', '.join(f'{name} {count}' for name, count in counts.items()))
    print(f'\n{table}\n\nwritten: {options.out}/path.tum, drive.png, summary.json, graph.g2o')
    return 0 if report.status is Status.CONVERGED else 1
