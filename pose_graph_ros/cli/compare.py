# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Compare trajectories: absolute and relative errors (ATE, RPE), and NEES where covariances exist.

A trajectory is a TUM or KITTI file, a CSV file with a header, the vertices of a g2o file, the
folder of a replay or a demo, or a topic of a bag, BAG:/TOPIC. Figures are those of evo, in the
plane. Without --truth the first trajectory is the reference of the others.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
import json
from pathlib import Path
import sys
from typing import Any

from pose_graph_ros.adapters.bag_poses import read_poses
from pose_graph_ros.adapters.bags import BAG_FILE_SUFFIXES, BagError, open_bag
from pose_graph_ros.core.exceptions import ConfigError, FileFormatError, TrajectoryError
from pose_graph_ros.core.io.trajectory_files import PLANES, read_trajectory
from pose_graph_ros.core.trajectories.comparison import (
    Alignment,
    compare,
    Comparison,
    Options,
)
from pose_graph_ros.core.trajectories.errors import Unit
from pose_graph_ros.core.trajectories.sequence import PoseSequence

EXAMPLES = """
examples:
  pose-graph compare replay --truth truth.tum                 # a replay's folder
  pose-graph compare odometry.csv replay --truth gt.csv --align se2 --plot errors.png
  pose-graph compare a.tum b.tum --delta 100 --unit metres --all-pairs
  pose-graph compare drive.mcap:/odom drive.mcap:/amcl_pose --max-difference 0.05 --json
"""
PATH_FILES = ('path.csv', 'path.tum')
"""In the folder of a run, the one with covariances first."""
PICTURES = ('.png', '.pdf', '.svg')
STATISTICS = ('rmse', 'mean', 'median', 'std', 'min', 'max', 'sse')
LONGEST_NAME = 23
MOST_SECONDS = 4e9  # of an offset
MUCH_BETTER = 0.5  # ratio of the errors with and without an alignment, below which it is told
NEES_NOTE = ('the interval of the mean holds for independent errors and a reference without any; '
             'the errors\nalong one path are not independent, so that its true interval is wider')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this tool."""
    parser.epilog = EXAMPLES
    parser.add_argument('trajectories', nargs='+', metavar='TRAJECTORY',
                        help='file, folder, or BAG:/TOPIC with Odometry, PoseStamped, '
                             'PoseWithCovarianceStamped or Path (the last one)')
    parser.add_argument('--truth', metavar='TRAJECTORY', help='reference of all')
    parser.add_argument('--align', choices=[each.value for each in Alignment], default='none',
                        help='by which motion an estimate is first laid over the reference: a '
                             'rigid one, or with scale (default: %(default)s)')
    parser.add_argument('--plane', choices=PLANES, default='xy',
                        help='plane of poses in space; camera poses of KITTI move in xz '
                             '(default: %(default)s)')
    association = parser.add_argument_group('association of stamps')
    association.add_argument('--max-difference', metavar='S', type=_difference, default=0.01,
                             help='largest difference of stamps [s] (default: %(default)s)')
    association.add_argument('--offset', metavar='S', type=_seconds, default=0.0,
                             help='added to the stamps of the estimates [s]')
    association.add_argument('--interpolate', action='store_true',
                             help='of the poses so associated, interpolate those of the '
                                  'trajectory with more poses at the stamps of the other')
    relative = parser.add_argument_group('relative errors')
    relative.add_argument('--delta', metavar='N', type=float, default=1.0,
                          help='length of the motions (default: %(default)g)')
    relative.add_argument('--unit', choices=[each.value for each in Unit], default='frames',
                          help='of --delta (default: %(default)s)')
    relative.add_argument('--all-pairs', action='store_true',
                          help='motions that overlap, of this length to 10 %%; else each begins '
                               'where the one before ends')
    relative.add_argument('--pairs-from-reference', action='store_true',
                          help='the motion of the reference has this length, not the estimate')
    parser.add_argument('--json', action='store_true', help='print JSON (see docs/tools.md)')
    parser.add_argument('--plot', metavar='FILE', type=Path,
                        help=f'draw paths and errors; the name ends in {", ".join(PICTURES)}')


def _seconds(text: str) -> float:
    """Return seconds that fit into a stamp."""
    value = float(text)
    if not abs(value) <= MOST_SECONDS:
        raise argparse.ArgumentTypeError(f'expected at most {MOST_SECONDS:g} s, got {text}')
    return value


def _difference(text: str) -> float:
    """Return seconds, not below 0."""
    value = _seconds(text)
    if value < 0.0:
        raise argparse.ArgumentTypeError(f'expected at least 0 s, got {text}')
    return value


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.plot is not None and options.plot.suffix not in PICTURES:
        raise ConfigError(f'--plot {options.plot}: the name must end in {", ".join(PICTURES)}')
    names = list(options.trajectories)
    reference_name = names.pop(0) if options.truth is None else options.truth
    if len(names) == 0:
        raise ConfigError(f'{reference_name}: nothing to compare it with; name a second '
                          f'trajectory, or --truth')
    reference = read(reference_name, options.plane)
    chosen = Options(
        Alignment(options.align), round(options.max_difference * 1e9),
        round(options.offset * 1e9), options.interpolate, options.delta, Unit(options.unit),
        options.all_pairs, options.pairs_from_reference)
    sequences = [read(name, options.plane) for name in names]
    results = []
    for name, sequence in zip(names, sequences, strict=True):
        try:
            results.append(compare(reference, sequence, chosen))
        except TrajectoryError as error:
            raise TrajectoryError(f'{reference_name} and {name}: {error}') from error
    for name, sequence in zip((reference_name, *names), (reference, *sequences), strict=True):
        if sequence.dropped > 0:
            print(f'warning: {name}: {sequence.dropped} poses have the stamp of another and are '
                  f'left out', file=sys.stderr)
    if options.json:
        estimates = list(zip(names, sequences, results, strict=True))
        print(json.dumps(_values(reference_name, reference, chosen, estimates), indent=2))
    else:
        print(table(reference_name, chosen, names, results))
    if options.plot is not None:
        # matplotlib takes longer to load than all else here
        from pose_graph_ros.cli.comparison_picture import draw_comparison  # noqa: PLC0415
        draw_comparison(results, names, reference_name, options.plot)
    return 0


def read(text: str, plane: str) -> PoseSequence:
    """
    Return the trajectory that an argument names.

    Parameters
    ----------
    text : str, a file, a folder of a run, or BAG:/TOPIC
    plane : str, of poses in space in a file

    Raises
    ------
    FileFormatError, BagError
        If there is none.

    """
    path, (bag, colon, topic) = Path(text), text.rpartition(':/')
    if colon and not path.exists():
        with open_bag(bag) as reader:
            return read_poses(reader, f'/{topic}')
    if not path.exists():
        raise FileFormatError(f'{text}: does not exist')
    if path.suffix in BAG_FILE_SUFFIXES or (path / 'metadata.yaml').exists():
        with open_bag(path) as reader:
            raise BagError(f'{text}: name a topic of the bag, as {text}:/TOPIC; it has '
                           f'{reader.describe()}')
    if not path.is_dir():
        return read_trajectory(path, plane)
    found = next((path / name for name in PATH_FILES if (path / name).is_file()), None)
    if found is None:
        raise FileFormatError(f'{text}: no folder of a replay or a demo, it has none of '
                              f'{", ".join(PATH_FILES)}')
    return read_trajectory(found)


def table(
    reference: str, options: Options, names: Sequence[str], results: Sequence[Comparison],
) -> str:
    """
    Return the results as a plain text table.

    Parameters
    ----------
    reference : str, its name
    names : sequence of str, of the estimates

    """
    lines = [f'reference: {reference}']
    for name, result in zip(names, results, strict=True):
        text = f'{name}: {len(result.keys)} poses by {result.key.value}'
        if options.alignment is not Alignment.NONE:
            (x, y, theta), scale = result.alignment
            text += f', moved by ({x:.6g} m, {y:.6g} m, {theta:.6g} rad)'
            text += f', scaled by {scale:.6g}' if options.alignment is Alignment.SIM2 else ''
        lines.append(text)
    short = [name if len(name) <= LONGEST_NAME else f'...{name[3 - LONGEST_NAME:]}'
             for name in names]
    per = f'over {options.delta:g} {options.unit.value}'
    statistics = [result.statistics() for result in results]
    for key, title in (('ate', 'ATE [m]'), ('ate_heading', 'ATE heading [deg]'),
                       ('rpe', f'RPE [m], {per}'), ('rpe_heading', 'RPE heading [deg]')):
        lines += ['', f'{title:24}' + ''.join(f'{each:>9}' for each in STATISTICS)]
        for name, each in zip(short, statistics, strict=True):
            row = each[key]
            lines.append(f'{name:24}' + ('  no such error' if row is None else ''.join(
                _figure(getattr(row, statistic)) for statistic in STATISTICS)))
    return '\n'.join([*lines, *_consistency_lines(short, results),
                      *_hints(options, names, results)])


def _figure(value: float) -> str:
    if value < 100.0:
        return f'{value:9.4f}'
    return f'{value:9.6g}' if value < 1e6 else f'{value:9.2e}'


def _consistency_lines(names: Sequence[str], results: Sequence[Comparison]) -> list[str]:
    lines = []
    for kind, expected in (('position', 2), ('pose', 3)):
        found = [(name, result.consistency()[kind]) for name, result in zip(
            names, results, strict=True) if kind in result.nees]
        title = f'NEES of the {kind}'
        lines += ['', f'{title:24}     mean expected   interval of 95 %   below 95 %   poses'] \
            if found else []
        for name, each in found:
            lines.append(f'{name:24}' + ('  no valid covariance' if each is None else (
                f'{each.mean:9.4g} {expected:8}   {each.interval[0]:7.4f} {each.interval[1]:7.4f}'
                f'   {100.0 * each.within:8.1f} % {each.count:7}')))
    return [*lines, NEES_NOTE] if lines else []


def _hints(
    options: Options, names: Sequence[str], results: Sequence[Comparison],
) -> list[str]:
    """Return what to try if trajectories do not lie on each other."""
    hints = []
    for name, result in zip(names, results, strict=True):
        ate = result.statistics()['ate']
        if (options.alignment is Alignment.NONE and ate is not None
                and result.best_rmse < MUCH_BETTER * ate.rmse and len(result.keys) > 2):
            hints += ['', f'{name}: moved as a whole, its rmse would be {result.best_rmse:.4g} m '
                          f'(--align se2)']
    return hints


def _values(
    reference: str, sequence: PoseSequence, options: Options,
    estimates: Sequence[tuple[str, PoseSequence, Comparison]],
) -> dict[str, Any]:
    """Return all figures as plain Python values."""
    return {
        'reference': reference, 'reference_poses': len(sequence),
        'align': options.alignment.value, 'max_difference_s': options.max_difference_ns * 1e-9,
        'offset_s': options.offset_ns * 1e-9, 'interpolate': options.interpolate,
        'delta': options.delta, 'unit': options.unit.value, 'all_pairs': options.all_pairs,
        'pairs_from_reference': options.pairs_from_reference,
        'estimates': [{
            'name': name, 'poses': len(estimate), 'associated': len(result.keys),
            'associated_by': result.key.value,
            'alignment': {**dict(zip(('x', 'y', 'theta'), result.alignment.pose.tolist(),
                                     strict=True)), 'scale': result.alignment.scale},
            **{key: None if row is None else asdict(row)
               for key, row in result.statistics().items()},
            **{f'nees_{key}': None if row is None else asdict(row)
               for key, row in result.consistency().items()},
        } for name, estimate, result in estimates]}
