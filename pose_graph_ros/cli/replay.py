# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run bags or a g2o file through the engine of the node, without ROS."""

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
import math
import time
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.bag_inputs import Inputs, read_inputs, reader_of
from pose_graph_ros.adapters.bag_writer import BagWriter
from pose_graph_ros.adapters.bags import Bag, BagError, MessageError, open_bags
from pose_graph_ros.adapters.fixes import Datum
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.sources import (
    backend_config,
    CLOSURES,
    Kind,
    ODOMETRY_KINDS,
    source_list,
)
from pose_graph_ros.cli import shared
from pose_graph_ros.cli.drive import (
    collect_drive,
    consistency,
    consistency_lines,
    Drive,
    with_refused,
    write_results,
)
from pose_graph_ros.cli.exports import (
    covariances,
    LATCHED,
    LivePoses,
    require_datum,
    write_corrected,
    write_exports,
    write_lines,
)
from pose_graph_ros.cli.graph_input import GRAPH_SUFFIXES, read_measurements
from pose_graph_ros.cli.run.document import write_document
from pose_graph_ros.cli.run.recorder import Recorder, Run, Update
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.g2o_writing import write_g2o
from pose_graph_ros.core.judgement.texts import (
    as_json,
    is_notable,
    Key,
    ORDER,
    short,
    states_by_stamps,
    totals_text,
)
from pose_graph_ros.core.judgement.verdicts import Judged, SourceVerdicts, State, Verdict
from pose_graph_ros.core.measurements import Answer, LoopClosure, Measurement, OdometrySample
from pose_graph_ros.core.odometry.motion import AS_CLAIMED

UPDATE_EVERY = 10  # new hidden nodes after which the graph is updated, to stay near the optimum


class Replayed(NamedTuple):
    """Result of running a bag through the engine."""

    backend: PoseGraphBackend
    report: UpdateReport  # of the final optimisation
    counts: Counter[tuple[str, str]]  # messages by source and answer
    recorder: Recorder
    datum: Datum | None = None  # of the map; None for a g2o file


def states_of(backend: PoseGraphBackend) -> dict[Key, State]:
    """Return what is believed, by source and stamps; refused loop closures are not."""
    return states_by_stamps(backend.verdicts()) | dict.fromkeys(
        backend.refused_closures, State.DOUBTED)


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
    recorder: Recorder | None = None, live: LivePoses | None = None,
) -> tuple[PoseGraphBackend, UpdateReport]:
    """Return a new engine after adding measurements, and the report of the full optimisation."""
    backend = PoseGraphBackend(backend_config(values))
    recorder = Recorder() if recorder is None else recorder
    next_update = UPDATE_EVERY
    for source, measurement in measurements:
        recorder.add_measurement(source, measurement.stamp_ns)
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
                1e3 * (time.thread_time() - begin), report.chi2, report.iterations))
            next_update = backend.graph.n_nodes + UPDATE_EVERY
            if live is not None:
                live.updated(backend)
        if live is not None:
            live.add(measurement, source)
    return backend, backend.optimize()


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if any(path.suffix in GRAPH_SUFFIXES for path in options.bags):
        return _execute_g2o(options)
    values = shared.parameter_values(options)
    with ExitStack() as stack:
        bag = stack.enter_context(open_bags(options.bags))
        inputs = shared.inputs_of(bag, options, values, options.hold_out)
        require_datum(options.export, known=len(values['datum']) > 0 or len(
            inputs.of(Kind.FIX)) > 0)
        writer = None if options.new_bag is None else stack.enter_context(
            BagWriter(options.new_bag, latched=LATCHED))
        if not options.json:
            print('\n'.join(f'{source}: {topic}' for source, topic in inputs.topics.items()))
        start = time.monotonic()
        live = LivePoses(values['frequency']) if options.live else None
        result = run(shared.WatchedBag(bag, 'optimising'), inputs, values, live)
        seconds = time.monotonic() - start
        estimate = result.backend.estimate()
        if estimate is None:
            names = inputs.of(*ODOMETRY_KINDS)
            topics = ' or '.join(inputs.topics[name] for name in names)
            why = ', '.join(f'{answer} {count}' for (source, answer), count
                            in sorted(result.counts.items()) if source in names)
            raise BagError(f'{bag.path}: no usable odometry on {topics}: {why or "no messages"}')
        plane = None if result.datum is None else result.datum.plane
        drive = with_refused(collect_drive(
            shared.WatchedBag(bag, 'comparing'), inputs, values, estimate.path, options.truth,
            origin=None if plane is None else plane.origin, states=states_of(result.backend)),
            result.backend)
        facts: dict[str, Any] = {'bags': [str(path) for path in options.bags], 'seconds': seconds}
        if writer is not None:
            facts['new_bag'] = write_corrected(
                writer, shared.WatchedBag(bag, 'writing the bag'), inputs, values,
                estimate=estimate, covariances=covariances(result.backend, estimate))
    return _report(options, result, drive, facts, values=values, kinds=inputs.kinds, live=live)


def _execute_g2o(options: argparse.Namespace) -> int:
    """Replay a g2o file."""
    if len(options.bags) > 1 or options.new_bag or options.live or options.begin or options.until:
        raise BagError(f'{options.bags[0]}: expected one .g2o file alone, without --bag, --live, '
                       '--from and --until')
    require_datum(options.export, known=False)
    values = shared.parameter_values(options, {'odom.noise': 'twist'})
    measurements = read_measurements(options.bags[0], options.stamps, options.edge2)
    odometry = next(source.name for source in source_list(values) if source.kind.is_odometry)
    start, recorder = time.monotonic(), Recorder()
    backend, report = run_measurements((
        (odometry if isinstance(each, OdometrySample) else CLOSURES, each)
        for each in measurements), values, recorder)
    seconds, estimate, states = time.monotonic() - start, backend.estimate(), states_of(backend)
    assert estimate is not None, 'a graph has vertices'
    samples = [each for each in measurements if isinstance(each, OdometrySample)]
    loops = [(each.reference_ns, each.stamp_ns) for each in measurements
             if isinstance(each, LoopClosure)]
    drive = Drive(
        Trajectory(np.array([each.stamp_ns for each in samples]),
                   np.array([each.pose for each in samples])),
        np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty(0, dtype=bool), estimate.path,
        None, np.array(loops, dtype=np.int64).reshape(-1, 2),
        loop_states=[states.get((CLOSURES, stamp, reference), State.BELIEVED)
                     for reference, stamp in loops])
    return _report(
        options, Replayed(backend, report, backend.counts, recorder), drive, {'seconds': seconds},
        values=values, kinds={odometry: Kind.ODOMETRY, CLOSURES: Kind.LOOP_CLOSURE})


def _report(
    options: argparse.Namespace, result: Replayed, drive: Drive, facts: Mapping[str, Any], *,
    values: Mapping[str, Any], kinds: Mapping[str, Kind], live: LivePoses | None = None,
) -> int:
    """Write the results and print a summary; return the exit code."""
    backend, report, datum = result.backend, result.report, result.datum
    estimate, title = backend.estimate(), options.bags[0].stem
    assert estimate is not None, 'there is a path'
    verdicts, totals = backend.verdicts(), backend.verdict_totals()
    counts = {'.'.join(key): count for key, count in sorted(result.counts.items())}
    nees = {} if drive.truth is None or report.status is Status.FAILED else consistency(
        drive, covariances(backend, estimate))
    table = write_results(drive, options.out, title, {
        **facts, **{f'nees_{name}': each for name, each in nees.items()},
        'alignment': estimate.alignment.value,
        'hidden_nodes': estimate.n_hidden, 'frozen_nodes': estimate.n_frozen,
        'thinned_nodes': estimate.n_thinned, 'edges': estimate.n_edges,
        'observed_nodes': estimate.n_observed, 'biases': estimate.n_biases,
        'chi2': estimate.chi2, 'odometry_errors': estimate.odometry_errors._asdict(),
        'status': report.status.value, 'counts': counts, 'judged': judgement(totals, verdicts)})
    write_g2o(backend.graph, options.out / 'graph.g2o')
    refused = dict.fromkeys(
        backend.refused_closures, 'Refused: it could not be attached to the path.')
    told = write_document(Run(
        title, f'replay of {", ".join(path.name for path in options.bags)}', drive, backend,
        estimate, verdicts, result.recorder, values, kinds, result.counts, report,
        None if datum is None or datum.plane is None else datum.plane.origin, facts['seconds'],
        refused | result.recorder.refused), options.out)
    exported = write_exports(options.export, options.out, title, backend=backend,
                             estimate=estimate, datum=datum)
    if live is not None:
        exported.append(options.out / 'live.csv')
        write_lines(exported[-1], live.lines())
    if options.json:
        print((options.out / 'summary.json').read_text(encoding='utf-8'), end='')
        return 0 if report.status is Status.CONVERGED else 1
    print(f'{estimate.n_hidden} hidden nodes, {estimate.n_edges} edges, {estimate.n_observed} '
          f'observed nodes in {facts["seconds"]:.2f} s; {report.status.value}, chi2 '
          f'{report.chi2:.6g}; {estimate.alignment.value}')
    errors = estimate.odometry_errors
    if errors != AS_CLAIMED:
        print(f'{estimate.primary}: noise of the way {short(math.sqrt(errors.way), 3)} times, of '
              f'turns {short(math.sqrt(errors.turn), 3)} times what it claims; corrected by '
              f'{short(errors.rate, 3)} rad/s and {short(100.0 * errors.scale, 3)} % of the way')
    for source, of_source in totals.items():
        print(f'{source}: {totals_text(of_source)}')
    for each in told['findings']:
        print(f'{each["level"]:8} {each["text"]}')
    if 'new_bag' in facts:
        print('new bag: {original} messages copied, {left_out} left out, {corrected} poses of '
              'odometry corrected'.format(**facts['new_bag']))
    print('counts: ' + ', '.join(f'{name} {count}' for name, count in counts.items()))
    names = ['drive.png', 'summary.json', 'run.json', 'graph.g2o',
             *(path.name for path in exported)]
    print('\n'.join(['', table, *consistency_lines(nees), '',
                     f'written: {options.out}/path.tum, {", ".join(names)}']))
    return 0 if report.status is Status.CONVERGED else 1


def judgement(
    totals: Mapping[str, SourceVerdicts], verdicts: Sequence[Verdict],
) -> dict[str, object]:
    """Return counts and scale of each source, and all closures and all that is not believed."""
    return {
        'sources': {source: {
            'states': {state.value: each.counts.get(state, 0) for state in ORDER},
            'scale': each.scale, 'forgotten': each.n_forgotten}
            for source, each in totals.items()},
        'constraints': [as_json(each) for each in verdicts
                        if each.kind is Judged.LOOP_CLOSURE or is_notable(each)]}
