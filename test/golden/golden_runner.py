# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run the golden cases, and compare what comes out with the files beside this one.

A record has `figures` (numbers, which other processors give to some digits, and decisions, which
they give exactly) and `hashes` (of all bits, for the same processor).
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout
import hashlib
import io
from itertools import groupby
import json
import math
from pathlib import Path
import re
from typing import Any

from bag_of_messages import write_bag
from golden_cases import CASES, Drive, SECOND, Tool
import numpy as np
from public_data import PUBLIC
from tum_files import read_tum

from pose_graph_ros.adapters.bags import Bag, choose_inputs, open_bag, reader_of
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import source_list
from pose_graph_ros.cli.drive import measured_in
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.simulate import fix_messages, odometry_messages
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import OdometrySample

FILES = Path(__file__).parent / 'files'
DIGITS = 12
"""Significant ones of the figures in files."""
PORTABLE = 1e-6
"""What figures may differ by, relatively, or [m, rad], on another processor."""
LEAST_EIGENVALUE = 1e-10  # of a covariance that is compared with errors
FEW = 8
"""Numbers of a list, or different texts, that are written out."""
TIMES = re.compile(r'seconds|bags|written|elapsed|^ms$|^gap|relative_gap|lambda_min|created|bytes')
"""What a tool tells that is not the same each time, or nothing but rounding."""
TIMED = 'time to run', 'longest update'
"""Labels of facts of which the same holds."""

Record = dict[str, Any]


class Runner:
    """Runs cases, in any order, in a folder; what is simulated or run before is kept in there."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._made = folder, dict[str, Any]()

    def run(self, name: str) -> Record:
        """Return the record of a case."""
        case = CASES[name]
        if isinstance(case, Drive):
            bag, truth = self._once(case.world, lambda: self._recording(case))
            return driven(case, bag, truth)
        return self._once(name, lambda: self._tool(case))

    def _once(self, key: str, make: Callable[[], Any]) -> Any:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def _recording(self, case: Drive) -> tuple[Path, Trajectory | None]:
        folder = self._folder / f'recording_{len(self._made)}'
        if case.world == 'robot/plaza1':
            return plaza(PUBLIC / case.world, folder), None
        if case.is_recording:
            return PUBLIC / case.world, None
        said(['simulate', str(folder), '--tum', *case.world.split()])
        return folder, read_tum(folder.with_name(f'{folder.name}_truth.tum'))

    def _tool(self, tool: Tool) -> Record:
        if tool.after != '':
            self.run(tool.after)
        folder = self._folder / 'tools'
        folder.mkdir(exist_ok=True)
        with chdir(folder):
            text = said(tool.words.split())
            record = record_of('printed', text)
            for file in tool.files:
                other = record_of(file, Path(file).read_text(encoding='utf-8'))
                record = {part: record[part] | other[part] for part in record}
        return record


def said(words: list[str]) -> str:
    """Run a tool, and return what it prints."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        found = main(words)
    assert found == 0, f'{" ".join(words)}: {out.getvalue()}{err.getvalue()}'
    return out.getvalue()


def plaza(source: Path, folder: Path) -> Path:
    """Write a bag of odometry and of fixes of 1 m at 1 Hz that are made from the truth."""
    odometry, truth = (np.loadtxt(source / name, delimiter=',', skiprows=1)
                       for name in ('odom.csv', 'gt.csv'))
    stamps, true_stamps = (np.round(each[:, 0] * 1e9).astype(np.int64)
                           for each in (odometry, truth))
    path = Trajectory(true_stamps, se2.wrapped(truth[:, 1:4]))
    fixed = np.arange(max(stamps[0], true_stamps[0]) + SECOND // 3,
                      min(stamps[-1], true_stamps[-1]), SECOND)
    places = path.at(fixed)[:, :2] + np.random.default_rng(7).normal(0.0, 1.0, (len(fixed), 2))
    write_bag(folder, (
        *odometry_messages('/odom', 'odom', Trajectory(stamps, odometry[:, 1:4]), (0.0,) * 6),
        *fix_messages('/fix', fixed, TangentPlane(40.44, -79.94).to_geodetic(places), sigma=1.0)))
    return folder


def driven(drive: Drive, path: Path, truth: Trajectory | None) -> Record:
    """Return the record of a drive through the engine."""
    values = checked(drive.values)
    backend, online = drive.backend(), list[Any]()
    deeds, update_ns, start_ns = sorted(drive.deeds.items()), 0, 0
    with open_bag(path) as bag:
        inputs = choose_inputs(bag, source_list(values), {}, truth='/ground_truth')
        digest = input_hash(bag, list(inputs.topics.values()))
        every = measured_in(
            bag, inputs, reader_of(bag, values), refused := Counter(), held_out=False)
        for source, each in drive.stream(each[:2] for each in every):
            if not isinstance(each, OdometrySample):
                backend.add_measurement(each, source)
                continue
            backend.add_odometry(each, source)
            start_ns = start_ns or each.stamp_ns
            if each.stamp_ns < update_ns or len(backend.node_stamps_ns) == 0:
                continue
            update_ns = each.stamp_ns + round(drive.period * SECOND)
            backend.update()
            while drive.refines and not backend.refine().finished:
                pass
            while len(deeds) > 0 and each.stamp_ns - start_ns >= deeds[0][0] * SECOND:
                backend = deeds.pop(0)[1](backend, drive)
            estimate = backend.estimate(with_path=False)
            online.append((estimate.stamp_ns, *estimate.T_map_base, *estimate.covariance.ravel()))
    report = backend.optimize()
    record = state_of(backend, report.status.value, truth, np.array(online))
    record['figures']['refused'] = {'.'.join(key): n for key, n in sorted(refused.items())}
    record['hashes']['input'] = digest
    return record


def state_of(
    backend: PoseGraphBackend, status: str, truth: Trajectory | None, online: np.ndarray,
) -> Record:
    """Return the record of an engine; `online` has stamps, poses and covariances of updates."""
    estimate, verdicts = backend.estimate(), backend.verdicts()
    path = estimate.path
    covariances = backend.path_covariances(estimate)
    some = np.linspace(0, len(path) - 1, 5).round().astype(int)
    figures = {
        'status': status, 'alignment': estimate.alignment.value, 'primary': estimate.primary,
        'counts': {'.'.join(key): n for key, n in sorted(backend.counts.items())},
        'nodes': estimate.n_hidden, 'frozen': estimate.n_frozen, 'thinned': estimate.n_thinned,
        'edges': estimate.n_edges, 'observed': estimate.n_observed, 'biases': estimate.n_biases,
        'priors': estimate.n_priors, 'set aside': backend.n_quarantined,
        'chi2': estimate.chi2, 'odometry errors': list(estimate.odometry_errors),
        'believed': {source: states_text([each.state.value for each in verdicts
                                          if each.source == source])
                     for source in sorted({each.source for each in verdicts})},
        'fit': {source: {'used': fit.n, 'energy': fit.energy,
                         'errors': None if fit.in_use is None else [
                             fit.in_use.tau, fit.in_use.correlated, fit.in_use.white]}
                for source, fit in sorted(backend.reports().items())},
        'stamps': [(stamp - int(path.stamps_ns[0])) / SECOND
                   for stamp in path.stamps_ns[some].tolist()],
        'poses': path.poses[some].tolist(),
        'sigmas': [np.sqrt(np.diag(each)).tolist() for each in covariances[some]]}
    rows = np.array(online)
    if truth is not None:
        figures['path'] = errors_of(path.stamps_ns, path.poses, covariances, truth)
        figures['online'] = errors_of(
            rows[:, 0].astype(np.int64), rows[:, 1:4], rows[:, 4:].reshape(-1, 3, 3), truth)
    return {'figures': figures, 'hashes': {
        'path to 1 um': hashed(path.stamps_ns, np.round(path.poses, 6) + 0.0),
        'path': hashed(path.stamps_ns, path.poses), 'covariances': hashed(covariances),
        'online': hashed(rows[:, 1:]),
        'verdicts': hashed(np.array([each.distance for each in verdicts]))}}


def errors_of(
    stamps_ns: np.ndarray, poses: np.ndarray, covariances: np.ndarray, truth: Trajectory,
) -> Record:
    """Return rms errors [m, rad] to the truth, and the mean NEES of a coordinate."""
    inside = truth.covers(stamps_ns)
    off = poses[inside] - truth.at(stamps_ns[inside])
    off[:, 2] = se2.wrap(off[:, 2])
    known = covariances[inside]
    sure = np.zeros(len(known), dtype=bool)
    finite = np.isfinite(known).all(axis=(1, 2))
    sure[finite] = np.linalg.eigvalsh(known[finite])[:, 0] > LEAST_EIGENVALUE
    nees = np.einsum('ki,ki->k', off[sure],
                     np.linalg.solve(known[sure], off[sure][:, :, None])[:, :, 0]) / 3.0
    return {'position rms': math.sqrt(np.mean(np.sum(off[:, :2]**2, axis=1))),
            'heading rms': math.sqrt(np.mean(off[:, 2]**2)),
            'NEES': float(np.mean(nees)) if len(nees) > 0 else None, 'NEES of': len(nees)}


def states_text(states: Sequence[str]) -> str:
    """Return states in their order, equal ones in a row as one: `12 believed, 2 doubted`."""
    return ', '.join(f'{len(list(each))} {state}' for state, each in groupby(states))


def hashed(*parts: bytes | np.ndarray) -> str:
    """Return a hash of arrays, to the last bit."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return total.hexdigest()[:16]


def input_hash(bag: Bag, topics: Sequence[str]) -> str:
    """Return a hash of what is read of a bag, and of its times of recording."""
    return hashed(*(part for each in bag.messages(topics)
                    for part in (each.recorded_ns.to_bytes(8, 'little'), each.raw)))


def record_of(name: str, text: str) -> Record:
    """Return the record of what a tool has written: JSON, lines with numbers, or another text."""
    kind = Path(name).suffix
    figures: Any = {}
    if text.startswith('{'):
        content = lasting(json.loads(text))
        figures, text = summary(content), json.dumps(content)
    elif kind in ('.csv', '.tum', '.g2o'):
        figures = summary(rows_by_tag(text))
    return {'figures': {name: figures} if figures else {}, 'hashes': {name: hashed(text.encode())}}


def lasting(value: Any) -> Any:
    """Return a value of JSON without what is not the same each time."""
    if isinstance(value, dict):
        return {key: lasting(each) for key, each in value.items() if not TIMES.search(key)}
    if isinstance(value, list):
        return [lasting(each) for each in value
                if not (isinstance(each, dict) and each.get('label') in TIMED)]
    return value


def rows_by_tag(text: str) -> dict[str, list[list[float]]]:
    """Return the numbers of lines by the tags with which these begin."""
    rows: dict[str, list[list[float]]] = {}
    for line in text.splitlines():
        words = line.replace(',', ' ').split()
        tag = '' if re.match(r'[-+\d]', line) else words[0]
        numbers = [float(word) for word in words if re.fullmatch(r'[-+\d.e]*\d|nan', word)]
        rows.setdefault(tag, []).append(numbers)
    return {tag: each for tag, each in rows.items() if len(each[0]) > 0}


def summary(value: Any) -> Any:
    """Return a value of JSON with long lists summed up: numbers, texts, or dicts by their keys."""
    if isinstance(value, dict):
        return {key: summary(each) for key, each in value.items()}
    if not isinstance(value, list) or (len(value) <= FEW and all(
            isinstance(each, int | float) for each in value)):
        return value
    if all(isinstance(each, dict) for each in value):
        keys = list(dict.fromkeys(key for each in value for key in each))
        return {'n': len(value), **{key: summary([each[key] for each in value if key in each])
                                    for key in keys}}
    if all(isinstance(each, str | bool) for each in value):
        counts = Counter(map(str, value))
        return dict(sorted(counts.items())) if len(counts) <= FEW else f'{len(counts)} texts'
    if all(isinstance(each, list) for each in value):
        return {'n': len(value), 'all': summary([one for each in value for one in each])}
    numbers = np.array([each for each in value if isinstance(each, int | float)], dtype=float)
    numbers = numbers[np.isfinite(numbers)]
    return {'n': len(value), 'numbers': len(numbers), 'mean': float(np.mean(numbers)),
            'rms': float(np.sqrt(np.mean(numbers**2)))} if len(numbers) > 0 else len(value)


def rounded(value: Any) -> Any:
    """Return figures as they are written: with some digits, and infinity as a text."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(each) for each in value]
    if isinstance(value, float):
        return float(f'{value:.{DIGITS}g}') if math.isfinite(value) else str(value)
    return value


def text_of(record: Record) -> str:
    """Return the text of a file; the numbers of a list stand on one line."""
    text = json.dumps(rounded(record), indent=1, sort_keys=True)
    return re.sub(r'\[[^][{}]*\]', lambda each: ' '.join(each.group().split()), text) + '\n'


def differences(
    expected: Any, found: Any, tolerance: float, *, where: str = '',
) -> Iterator[str]:
    """Yield where two records differ, as lines."""
    if isinstance(expected, Mapping) and isinstance(found, Mapping):
        for key in dict.fromkeys((*expected, *found)):
            yield from differences(expected.get(key), found.get(key), tolerance,
                                   where=f'{where}.{key}' if where else key)
    elif isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for k, (one, other) in enumerate(zip(expected, found, strict=True)):
            yield from differences(one, other, tolerance, where=f'{where}[{k}]')
    elif isinstance(expected, float) and isinstance(found, float):
        if not math.isclose(expected, found, rel_tol=tolerance, abs_tol=tolerance):
            yield f'{where}: {expected:.9g} -> {found:.9g} ({found - expected:+.1e})'
    elif expected != found:
        yield f'{where}: {expected} -> {found}'


def compared(name: str, record: Record, tolerance: float, *, exact: bool = False) -> list[str]:
    """
    Return where the record of a case differs from its file.

    Parameters
    ----------
    exact : bool, whether all bits are compared; else `tolerance` is for the figures

    """
    file = FILES / f'{name}.json'
    if not file.is_file():
        return [f'no {file.name}: make it with `make golden`']
    expected = json.loads(file.read_text(encoding='utf-8'))
    found = rounded(record)
    if exact:
        return list(differences(expected, found, 0.0))
    return list(differences(expected['figures'], found['figures'], tolerance))
