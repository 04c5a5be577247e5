# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The methods of `pose-graph solve --robust` on graphs with wrong loop closures.

    .venv/bin/python -m benchmark.solve_robust --data ../shared/data

A closure is right if the end that it measures is at most 3 m from the true one. Left out are to be
all others, and only these.
"""

import argparse
import json
from pathlib import Path
import subprocess
import sys
import tempfile
import time

import numpy as np

from benchmark.files import DEFAULT_FOLDER
from benchmark.robust_closures import read_recording, Recording, TRUE
from benchmark.robust_worlds import with_false
from pose_graph_ros.cli.arguments import METHODS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import fit_motion
from pose_graph_ros.core.io.g2o import read_g2o

SHARES = (0.1, 0.3, 0.5)
GROUP = 10


def written(recording: Recording, file: Path, to: Path) -> set[tuple[int, int]]:
    """Write odometry of a file with the closures of a recording; return the wrong ones' ends."""
    lines = [line for line in file.read_text(encoding='ascii').splitlines()
             if line.startswith('EDGE') and int(line.split()[2]) == int(line.split()[1]) + 1]
    ends = np.searchsorted(recording.stamps_ns, recording.ends)
    truth = recording.truth.at(recording.stamps_ns)
    claimed = se2.compose(truth[ends[:, 0]], recording.poses)
    wrong = np.hypot(*(claimed - truth[ends[:, 1]])[:, :2].T) > TRUE
    for (i, j), pose, covariance in zip(
            ends.tolist(), recording.poses, recording.covariances, strict=True):
        information = np.linalg.inv(covariance)[np.triu_indices(3)]
        lines.append(f'EDGE_SE2 {i} {j} {" ".join(map(repr, [*pose.tolist(), *information]))}'
                     .replace('np.float64(', '').replace(')', ''))
    to.write_text('\n'.join(lines) + '\n', encoding='ascii')
    return set(map(tuple, ends[wrong].tolist()))


def row(name: str, method: str, recording: Recording, file: Path, folder: Path) -> str:
    """Return the line of a method in the table."""
    graph, out = folder / 'graph.g2o', folder / 'out.g2o'
    wrong = written(recording, file, graph)
    begin = time.perf_counter()
    done = subprocess.run(
        [str(Path(sys.executable).with_name('pose-graph')), 'solve', str(graph), '--robust',
         method, '-o', str(out), '--json'], capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - begin
    values = json.loads(done.stdout)
    left_out = {tuple(pair) for pair in values['doubted']}
    n_right = len(recording.ends) - len(wrong)
    truth = recording.truth.at(recording.stamps_ns)[:, :2]
    path = read_g2o(out).rows.poses[:, :2]
    error = np.linalg.norm(se2.transform(fit_motion(path, truth), path) - truth, axis=1)
    return (f'| {name} | {method} | {len(left_out & wrong)} of {len(wrong)} '
            f'| {len(left_out - wrong)} of {n_right} '
            f'| {np.sqrt(np.mean(error**2)):.2f} | {values["certificate"]["verdict"]} '
            f'| {seconds:.1f} |')


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--data', type=Path, default=DEFAULT_FOLDER.parent)
    parser.add_argument('--only', default='', help='cases whose names hold this')
    options = parser.parse_args()
    place = options.data / 'false_loops'
    bicocca = place / 'B25b_0.150.g2o'
    m3500 = options.data / 'graphs' / 'input_M3500_g2o.g2o'
    clean = read_recording(m3500, m3500.with_name('manhattanOlson3500_groundtruth.txt'))
    cases = [('B25b_0.150', bicocca, read_recording(
        bicocca, place / 'Bicocca25b_GT_GPS.g2o', place / 'B25b_timestamps.txt'))]
    cases += [(f'M3500, {share:.0%} single', m3500, with_false(clean, share, 1, 1))
              for share in SHARES]
    cases += [(f'M3500, {share:.0%} in groups of {GROUP}', m3500, with_false(
        clean, share, GROUP, 1)) for share in SHARES]
    print('| graph | method | wrong ones left out | right ones left out | rms [m] | certificate '
          '| s |\n|---|---|---|---|---|---|---|')
    with tempfile.TemporaryDirectory() as name:
        for case, file, recording in cases:
            for method in METHODS:
                if options.only in case:
                    print(row(case, method, recording, file, Path(name)), flush=True)


if __name__ == '__main__':
    main()
