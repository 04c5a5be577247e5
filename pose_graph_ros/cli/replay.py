# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run bags or a g2o file through the engine of the node, without ROS."""

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
import time
from typing import Any, NamedTuple

from pose_graph_ros.adapters import sources
from pose_graph_ros.adapters.bag_inputs import Inputs, reader_of
from pose_graph_ros.adapters.bag_writer import BagWriter
from pose_graph_ros.adapters.bags import Bag, BagError, open_bag
from pose_graph_ros.adapters.sources import CLOSURES, Kind, MessageReader
from pose_graph_ros.adapters.surroundings import Datum
from pose_graph_ros.cli import exports, shared
from pose_graph_ros.cli.drive import collect_drive, Drive, drive_in, measured_in
from pose_graph_ros.cli.exports import LivePoses, require_datum
from pose_graph_ros.cli.graph_input import GRAPH_SUFFIXES, read_measurements
from pose_graph_ros.cli.run import Recorder, Run, Update
from pose_graph_ros.cli.run.document import write_results
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.io.g2o import write_g2o
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.measurements import Measurement, OdometrySample

UPDATE_EVERY = 10  # new hidden nodes after which the graph is updated, to stay near the optimum


class Replayed(NamedTuple):
    """Result of running a bag through the engine."""

    backend: PoseGraphBackend
    report: UpdateReport  # of the final optimisation
    counts: Counter[tuple[str, str]]  # messages by source and answer
    recorder: Recorder
    datum: Datum | None = None  # of the map; None for a g2o file

    @property
    def refused(self) -> set[Key]:
        """Loop closures that are not in the graph."""
        return {*self.recorder.refused, *self.backend.refused_closures}


def run(
    bag: Bag, inputs: Inputs, values: Mapping[str, Any], live: LivePoses | None = None,
) -> Replayed:
    """Return a new engine after adding all messages of a bag and a full optimisation."""
    reader, recorder = reader_of(bag, values), Recorder()
    refused: Counter[tuple[str, str]] = Counter()
    backend, report = run_measurements(
        measurements_of(bag, inputs, reader, refused), values, recorder, live)
    return Replayed(backend, report, backend.counts + refused, recorder, reader.datum)


def measurements_of(
    bag: Bag, inputs: Inputs, reader: MessageReader, refused: Counter[tuple[str, str]],
) -> Iterator[tuple[str, OdometrySample | Measurement]]:
    """Yield the valid measurements of a bag that are not held out, and their sources."""
    for source, measurement, _ in measured_in(bag, inputs, reader, refused, held_out=False):
        yield source, measurement


def run_measurements(
    measurements: Iterable[tuple[str, OdometrySample | Measurement]], values: Mapping[str, Any],
    recorder: Recorder | None = None, live: LivePoses | None = None,
) -> tuple[PoseGraphBackend, UpdateReport]:
    """Return a new engine after adding measurements, and the report of the full optimisation."""
    backend = PoseGraphBackend(sources.backend_config(values))
    recorder = Recorder() if recorder is None else recorder
    next_update = UPDATE_EVERY
    for source, measurement in measurements:
        if isinstance(measurement, OdometrySample):
            backend.add_odometry(measurement, source)
        else:
            recorder.add_answer(source, measurement, backend.add_measurement(measurement, source))
        if backend.graph.n_nodes >= next_update if live is None else live.is_due(
                measurement, backend.graph.n_nodes):
            begin = time.thread_time()  # of this process, however busy the machine is
            report = backend.update()
            recorder.add_update(Update(
                int(backend.node_stamps_ns[-1]), len(backend.node_stamps_ns),
                1e3 * (time.thread_time() - begin), report.chi2))
            next_update = backend.graph.n_nodes + UPDATE_EVERY
            if live is not None:
                live.updated(backend)
        if live is not None:
            live.add(measurement, source)
    return backend, backend.optimize()


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    is_graph = any(path.suffix in GRAPH_SUFFIXES for path in options.bags)
    return _execute_g2o(options) if is_graph else _execute_bags(options)


def _execute_bags(options: argparse.Namespace) -> int:
    """Replay bags."""
    values = shared.parameter_values(options)
    with ExitStack() as stack:
        bag = stack.enter_context(open_bag(*options.bags))
        inputs = shared.inputs_of(bag, options, values, options.hold_out)
        require_datum(options.export, known=len(values['datum']) > 0 or len(inputs.fixes) > 0)
        writer = None if options.new_bag is None else stack.enter_context(
            BagWriter(options.new_bag, latched=exports.LATCHED))
        if not options.json:
            print('\n'.join(f'{source}: {topic}' for source, topic in inputs.topics.items()))
        start = time.monotonic()
        live = LivePoses(values['frequency']) if options.live else None
        result = run(shared.watched_bag(bag, 'optimising'), inputs, values, live)
        seconds = time.monotonic() - start
        if len(result.backend.node_stamps_ns) == 0:
            names = inputs.odometry
            topics = ' or '.join(inputs.topics[name] for name in names)
            why = ', '.join(f'{answer} {count}' for (source, answer), count
                            in sorted(result.counts.items()) if source in names)
            raise BagError(f'{bag.path}: no usable odometry on {topics}: {why or "no messages"}')
        plane = None if result.datum is None else result.datum.plane
        done = _run_of(options, result, drive_in(
            shared.watched_bag(bag, 'comparing'), inputs, values, result.backend, options.truth,
            origin=None if plane is None else plane.origin, refused=result.refused),
            values=values, kinds=inputs.kinds, seconds=seconds)
        facts: dict[str, Any] = {'bags': [str(path) for path in options.bags], 'seconds': seconds}
        if writer is not None:
            facts['new_bag'] = exports.write_corrected(
                writer, shared.watched_bag(bag, 'writing the bag'), inputs, done)
    return _report(options, done, facts, result.datum, live)


def _execute_g2o(options: argparse.Namespace) -> int:
    """Replay a g2o file."""
    if len(options.bags) > 1 or options.new_bag or options.live or options.begin or options.until:
        raise BagError(f'{options.bags[0]}: expected one .g2o file alone, without --bag, --live, '
                       '--from and --until')
    require_datum(options.export, known=False)
    values = shared.parameter_values(options, {'odom.noise': 'twist'})
    odometry = next(each.name for each in sources.source_list(values) if each.kind.is_odometry)
    measurements = [
        (odometry if isinstance(each, OdometrySample) else CLOSURES, each)
        for each in read_measurements(options.bags[0], options.stamps, options.edge2)]
    start, recorder = time.monotonic(), Recorder()
    backend, report = run_measurements(measurements, values, recorder)
    result, seconds = Replayed(backend, report, backend.counts, recorder), time.monotonic() - start
    drive = collect_drive(
        ((*each, False) for each in measurements), backend, odometry, result.refused)
    return _report(options, _run_of(
        options, result, drive, values=values,
        kinds={odometry: sources.ODOMETRY, CLOSURES: sources.LOOP_CLOSURE}, seconds=seconds),
        {'seconds': seconds})


def _run_of(
    options: argparse.Namespace, result: Replayed, drive: Drive, *, values: Mapping[str, Any],
    kinds: Mapping[str, Kind], seconds: float,
) -> Run:
    return Run(
        options.bags[0].stem, f'replay of {", ".join(path.name for path in options.bags)}', drive,
        result.backend, result.recorder, values, kinds, result.counts, result.report, seconds)


def _report(
    options: argparse.Namespace, done: Run, facts: Mapping[str, Any], datum: Datum | None = None,
    live: LivePoses | None = None,
) -> int:
    """Write the results and print a summary; return the exit code."""
    lines = write_results(done, options.out, facts)
    write_g2o(done.backend.graph, options.out / 'graph.g2o')
    exported = exports.write_exports(options.export, options.out, done, datum)
    if live is not None:
        exported.append(options.out / 'live.csv')
        exports.write_lines(exported[-1], live.lines())
    names = ['drive.png', 'summary.json', 'run.json', 'graph.g2o',
             *(path.name for path in exported)]
    if options.json:
        print((options.out / 'summary.json').read_text(encoding='utf-8'), end='')
    else:
        print('\n'.join([*lines, f'written: {options.out}/path.tum, {", ".join(names)}']))
    return 0 if done.report.status is Status.CONVERGED else 1
