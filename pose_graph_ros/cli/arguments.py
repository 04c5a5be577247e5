# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Arguments of the tools.

A function has the name of its tool, and its docstring is what the help says, the examples behind
the arguments. Nothing is imported here that takes time: help and wrong words are answered without
the engine.
"""

import argparse
from collections.abc import Callable
import math
from pathlib import Path
from typing import Any, NamedTuple

from pose_graph_ros.core.judgement.settings import BELIEF

ON_EARTH = ('geojson', 'kml', 'gpx')  # whose positions are latitudes and longitudes
FULL = 'tum_full'   # of a path with the poses between its hidden nodes
FORMATS = ('kitti', 'csv', FULL, *ON_EARTH)  # of a path, also the endings of files
EDGE2_ORDERS = ('toro', 'isam')
STARTS = ('chordal', 'file', 'odometry', 'best')
METHODS = ('selection', 'gnc', 'gnc-gm')  # to decide which closures to believe
VIEWS = ('pose-graph', 'factor-graph', 'mrf', 'dbn')
PICTURES = ('.svg', '.png')
LANDMARKS = 'landmarks'
TRUTH_SUFFIXES = ('.tum', '.txt', '.csv')  # of files; no topic has a dot in its name


class Exports(NamedTuple):
    """Formats that were asked for."""

    formats: tuple[str, ...] = ()
    strict: bool = True  # whether it is an error if one of them cannot be written


def replay(parser: argparse.ArgumentParser) -> None:
    """
    Run bags or a g2o file through the engine of the node, without ROS and as fast as possible.

    Bags may be of ROS 1 or ROS 2 and compressed; several are read in the order of recording.
    Messages are read and added as in the node, but without threads, and the same full optimisation
    follows at the end. The path is the one of a node that receives the same messages. Of a g2o
    file, edges to the next vertex are odometry, with the noise of the file (odom.noise:=model
    takes that of the parameters); all others are loop closures, which come when their later end is
    reached.

    examples:
      pose-graph replay my_bag --odom /wheel/odometry --fix /gnss/fix -o tuesday
      pose-graph replay monday.bag tuesday.bag --until 600 --export kitti,csv
      pose-graph replay my_bag --export gpx,geojson --bag corrected_bag
      pose-graph replay my_bag --hold-out 5 --json | jq .errors
      pose-graph replay my_bag --hold-out 4 --stretch 20 --truth truth.tum
    """
    parser.add_argument('bags', metavar='BAG', type=Path, nargs='+',
                        help='rosbag2 folder, .mcap, .db3, ROS 1 .bag; or one .g2o or .graph file')
    parser.add_argument('-o', '--out', metavar='DIR', type=Path, default=Path('replay'),
                        help='folder for the results (default: %(default)s)')
    parser.add_argument('--export', metavar='FORMATS', type=_exports, default=Exports(),
                        help=f'more files with the path: {", ".join(FORMATS)}, separated by '
                        f'commas, or all; {", ".join(ON_EARTH)} need fixes or a datum')
    parser.add_argument('--bag', metavar='OUT', type=Path, dest='new_bag', help='new rosbag2 '
                        'folder with all messages, the corrected path, odometry in the map and '
                        'the transform from map to odom; its poses know all that came later')
    parser.add_argument('--live', action='store_true', help='also write live.csv: the poses that '
                        'a robot would have had at each moment, with their covariances')
    parser.add_argument('--json', action='store_true',
                        help='print the contents of summary.json instead of a text')
    add_replayed(parser)


def report(parser: argparse.ArgumentParser) -> None:
    """
    Make one HTML page of a run: map, errors, residuals by source, what is doubted and why.

    RUN is the folder of a replay or a demo, its run.json, or a bag, which is replayed first with
    the options of `replay`. Of two runs it shows what changed from the first to the second, and
    where. A g2o file is solved first, as by `solve`; for a drive through it, replay it, and make
    the report of that. The page needs no network and no other file.

    examples:
      pose-graph report replay                       # of a replay's folder: replay/report.html
      pose-graph report demo -o tuesday.html --open
      pose-graph report my_bag --odom /wheel/odometry --fix /gnss/fix --run tuesday
      pose-graph report monday tuesday -o changes.html
      pose-graph report graph.g2o --robust
      pose-graph report replay --json | jq '.findings[] | select(.level == "warning")'
    """
    parser.add_argument('runs', metavar='RUN', type=Path, nargs='+', help='folder of a replay or '
                        'a demo, or its run.json; or two of them; or bags; or a .g2o or .graph '
                        'file')
    parser.add_argument('-o', '--out', metavar='FILE', type=Path,
                        help='the page (default: report.html in the folder of the run)')
    parser.add_argument('--run', metavar='DIR', type=Path, default=Path('report'), dest='folder',
                        help='of a bag, a graph or two runs: folder for the results '
                        '(default: %(default)s)')
    parser.add_argument('--robust', nargs='?', choices=METHODS, const=METHODS[0],
                        help='of a graph: decide which loop closures to believe, as solve does')
    parser.add_argument('--json', action='store_true',
                        help='print what was found as JSON instead of a text')
    parser.add_argument('--open', action='store_true', help='show the page in a browser')
    add_replayed(parser)


def demo(parser: argparse.ArgumentParser) -> None:
    """
    Play a bag to the node over DDS, and write the corrected path and a picture.

    The node runs as a process of its own, in a ROS domain that nobody else uses, on this machine
    alone. Without a bag, a drive with known ground truth is simulated first.
    """
    parser.add_argument('--bag', type=Path,
                        help='rosbag2 folder, .mcap or .db3 (default: a simulated drive)')
    parser.add_argument('-o', '--out', metavar='DIR', type=Path, default=Path('demo'),
                        help='folder for the results (default: %(default)s)')
    parser.add_argument('--rate', type=float, default=50.0, help='speed as a multiple of real '
                        'time, 0 for as fast as the node can (default: %(default)s)')
    _add_inputs(parser)
    _add_parameters(parser)


def tune(parser: argparse.ArgumentParser) -> None:
    """
    Estimate the noise of the sources from bags; write a parameter file.

    Parameters are those under which the measurements are the most likely, each with an interval.
    Those that the data do not tell stay as they are, and none becomes surer than the data prove.
    The table shows how well a path predicts fixes (global poses) of whole stretches of the drive
    that were held out, from the tuning too, before and after. If that is not better, no file is
    written. The exit code is 1 then, 2 for wrong input.

    examples:
      pose-graph tune my_bag --odom /wheel/odometry --fix /gnss/fix -o tuned.yaml
      pose-graph tune monday.bag tuesday.bag --params-file robot.yaml --json | jq .parameters
      ros2 run pose_graph_ros pose_graph_node --ros-args --params-file tuned.yaml
    """
    parser.add_argument('bags', metavar='BAG', type=Path, nargs='+',
                        help='rosbag2 folder, .mcap, .db3, ROS 1 .bag')
    parser.add_argument('-o', '--out', metavar='FILE', type=Path, default=Path('tuned.yaml'),
                        help='parameter file to write (default: %(default)s)')
    parser.add_argument('--folds', metavar='N', type=number(2, 50, whole=True), default=4,
                        help='parts of the drive that are held out in turn (default: %(default)s)')
    parser.add_argument('--stretch', metavar='S', type=number(1.0, 3600.0), default=None,
                        help='length of the stretches that a part has [s] (default: by how slowly '
                             'the errors change)')
    parser.add_argument('--json', action='store_true', help='print the results as JSON')
    _add_span(parser)
    _add_inputs(parser, hold_out=False)
    _add_parameters(parser)


def migrate(parser: argparse.ArgumentParser) -> None:
    """
    Make a parameter file of those of robot_localization, fuse or slam_toolbox.

    The files are those of ekf_node, ukf_node and navsat_transform_node, of fuse's
    fixed_lag_smoother or of slam_toolbox, of ROS 2 or ROS 1; give all of a robot at once. Each
    value has a comment that says where it is from. Below stand what is left to do, the call of the
    launch file, and what became of each parameter: taken, not needed, changed, without a
    counterpart, or not known.

    examples:
      pose-graph migrate dual_ekf_navsat_params.yaml                  # to the screen
      pose-graph migrate ekf.yaml navsat_transform.yaml -o pose_graph.yaml

    exit code: 0 made, 2 wrong input
    """
    parser.add_argument('files', metavar='FILE', type=Path, nargs='+', help='parameter file')
    parser.add_argument('-o', '--out', metavar='FILE', type=Path,
                        help='parameter file to write (default: standard output)')
    parser.add_argument('--force', action='store_true', help='overwrite the file of -o')
    parser.add_argument('--replace-local', action='store_true', help='replace a filter in the '
                        'odometry frame as well; the driver of the wheels must then publish the '
                        'transform from there to the robot')


def parameters(parser: argparse.ArgumentParser) -> None:
    """Print the parameters of the node, as tables or as a parameter file."""
    parser.add_argument('--yaml', action='store_true', help='print them as a parameter file')


def compile_kernels(_: argparse.ArgumentParser) -> None:
    """
    Compile the solver and keep its code, so that the next start of the node need not.

    For a robot's image, run this as the user who installs the package, on the model of processor
    that the robot has. The code is kept beside the package, where the node of any user finds it;
    or in NUMBA_CACHE_DIR if that is set, which the node needs as well. Code for another processor,
    another version of Numba or of this package is not used, but compiled again when the node
    starts.
    """


def solve(parser: argparse.ArgumentParser) -> None:
    """
    Optimise a g2o, TORO or iSAM file, and print the constraints with the largest energies.

    With `--robust` wrong loop closures are found first. A file that is written then has them as
    comments, `# not used EDGE_SE2 ...`, so that other programs read the graph without them. Unless
    `--no-certificate` is given, it is proved whether the minimum is the global one, for an
    objective that is nearly chi2; if it is not, a lower one is searched for.

    examples:
      pose-graph solve graph.g2o -o optimised.g2o
      pose-graph solve graph.graph --edge2 toro --start best
      pose-graph solve graph.g2o --marginals newest
      pose-graph solve graph.g2o --marginals all -o covariances.csv --json
      pose-graph solve graph.g2o --robust -o optimised.g2o --picture graph.png
      pose-graph solve graph.g2o --robust gnc --closure-sigma 0 0 --json

    exit code: 0 converged, 1 not converged, 2 wrong input
    """
    parser.add_argument('graph', type=Path, nargs='?',  # in `--robust FILE` it is that of --robust
                        help='g2o, TORO or iSAM file, also compressed by gzip')
    parser.add_argument('-o', '--out', metavar='FILE', type=Path, action='append', default=[],
                        help='optimised g2o file, or marginals if the name ends in .csv; '
                        'may be repeated')
    parser.add_argument('--start', choices=STARTS, default='chordal', help='start from the '
                        'constraints, from the poses in the file, from composed odometry, or from '
                        'each, and take the lowest minimum (default: %(default)s); with --robust, '
                        'from the poses of its decision')
    parser.add_argument('--certificate', action=argparse.BooleanOptionalAction, default=True,
                        help='prove whether the minimum is the global one (default: yes)')
    parser.add_argument('--marginals', metavar='{all,newest,IDS}',
                        help='covariances of these nodes, such as 3,7,20:25, as CSV: the last '
                             'output, or -o FILE.csv (default, with such a file: all)')
    parser.add_argument('--picture', metavar='FILE', type=_picture, help='.svg or .png file of '
                        'the graph before and after, its loop closures by their error')
    parser.add_argument('--json', action='store_true', help='print JSON (docs/tools/solve.md)')
    parser.add_argument('--robust', nargs='?', metavar='|'.join(METHODS), const=METHODS[0],
                        help='decide which loop closures to believe, and leave the others out, '
                        'by comparing sets of them (selection, the default), or by graduated '
                        'non-convexity with the surrogate for truncated least squares (gnc) or '
                        'for Geman-McClure (gnc-gm); an edge is odometry if no id of a pose lies '
                        'between its two; sightings of landmarks are believed')
    usual = BELIEF.closure_floors[::2]
    parser.add_argument('--closure-sigma', nargs=2, type=number(0.0), metavar=('M', 'RAD'),
                        default=usual, help='least standard deviations of loop closures for this '
                        f'decision (default: {usual[0]} {usual[1]}); the result has those of the '
                        'file, times what the residuals show')
    parser.add_argument('--edge2', choices=EDGE2_ORDERS,
                        help='format of the tag EDGE2 in this file; by default both are tried')


def draw(parser: argparse.ArgumentParser) -> None:
    """
    Draw a small graph.

    It is drawn as pose graph, factor graph, Markov random field or dynamic Bayesian network.
    The suffix of the picture's name says what it is: .svg or .png. Hidden nodes stand where they
    are in the file, to scale; ids are those of the file.

    examples:
      pose-graph draw --example -o states.svg             five states of a graph, with H
      pose-graph draw graph.g2o -o graph.svg --pattern
      pose-graph draw graph.g2o --as factor-graph -o factors.png
      pose-graph draw map.json --as dbn --nodes 0:20 -o start.svg
      pose-graph draw graph.g2o --around 17 --hops 3 -o near.svg
    """
    _add_graph(parser, nargs='?')
    parser.add_argument('-o', '--out', metavar='PICTURE', type=_picture, required=True,
                        help='.svg or .png file')
    parser.add_argument('--as', dest='view', choices=VIEWS, default=VIEWS[0],
                        help='(default: %(default)s)')
    parser.add_argument('--pattern', action='store_true',
                        help='with the pattern of H, its blocks in the order of the nodes')
    parser.add_argument('--ordering', choices=('file', 'elimination'), default='file',
                        help='order of the blocks of H; elimination: a fill-reducing one, with '
                             'the fill of the factor R (default: %(default)s)')
    parser.add_argument('--headings', action='store_true', help='show where poses head')
    parser.add_argument('--spring', action='store_true',
                        help='hidden nodes apart from each other, as by springs, not to scale')
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument('--nodes', metavar='IDS', help='draw only these, such as 3,7,20:25')
    chosen.add_argument('--around', metavar='ID', type=int,
                        help='draw only this node and those near it')
    parser.add_argument('--hops', metavar='K', type=int, default=2,
                        help='with --around: how many constraints away (default: %(default)s)')
    parser.add_argument('--example', action='store_true', help='draw five states of a growing '
                        'graph, with --pattern, in place of a file')
    parser.add_argument('--json', action='store_true',
                        help='print what is drawn as JSON (docs/tools/draw.md)')


def marginalize(parser: argparse.ArgumentParser) -> None:
    """
    Take hidden nodes out of a graph; what their constraints say about the others remains.

    What remains is linear at the poses in the file, so solve it first. A single neighbour gets an
    observed node, two poses an edge; more than two a dense prior, which g2o does not have. With
    --sparse, edges stand for it which tell no more than it does.

    examples:
      pose-graph marginalize graph.g2o --nodes landmarks --sparse -o poses.g2o
      pose-graph marginalize graph.g2o --nodes 3,7,20:25 -o smaller.g2o
    """
    _add_graph(parser)
    parser.add_argument('--nodes', metavar='IDS', required=True, help='nodes that leave, such as '
                        f'3,7,20:25, or {LANDMARKS!r} for all of them')
    parser.add_argument('-o', '--out', metavar='FILE', type=Path, required=True,
                        help='g2o file of the graph without them')
    parser.add_argument('--sparse', action='store_true',
                        help='write conservative edges in place of dense priors')
    parser.add_argument('--json', action='store_true',
                        help='print JSON (docs/tools/marginalize.md)')


def _add_graph(parser: argparse.ArgumentParser, *, nargs: str | None = None) -> None:
    """Add the arguments that give a graph."""
    parser.add_argument('graph', type=Path, nargs=nargs, help='g2o file, or saved graph (its '
                        '.json file, or the .g2o file beside it)')
    parser.add_argument('--edge2', choices=EDGE2_ORDERS,
                        help='format of the tag EDGE2 in this file (default: found out)')


def add_replayed(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what is read of bags and of a g2o file, and how."""
    _add_span(parser)
    parser.add_argument('--edge2', choices=EDGE2_ORDERS,
                        help='format of the tag EDGE2 in a .g2o file')
    _add_inputs(parser)
    parser.add_argument('--stretch', metavar='S', type=number(1.0, 3600.0), help='with '
                        '--hold-out: every N-th stretch of S seconds in place of every N-th fix')
    _add_parameters(parser)


def _add_span(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which part of a bag is read."""
    parser.add_argument('--from', metavar='SECONDS', type=number(0.0), dest='begin', default=None,
                        help='leave out what was recorded before, counted from the first message')
    parser.add_argument('--until', metavar='SECONDS', type=number(0.0),
                        help='leave out what was recorded from then on')


def _add_inputs(parser: argparse.ArgumentParser, *, hold_out: bool = True) -> None:
    """Add the options that choose topics and, if it is asked for, the fixes to hold out."""
    group = parser.add_argument_group('topics in the bag', 'by default, the only topic of the '
                                      'type is used, apart from that of the truth')
    pose = 'geometry_msgs/PoseWithCovarianceStamped'
    for option, text in (
            ('--odom', 'nav_msgs/Odometry'), ('--fix', 'sensor_msgs/NavSatFix'),
            ('--global-pose', f'{pose} in the map'),
            ('--loop-closure', f'{pose} relative to another pose'),
            ('--imu', 'sensor_msgs/Imu with an absolute heading, if the parameter sources lists '
                      'imu'),
            ('--gyro', 'sensor_msgs/Imu with an angular velocity, if the parameter sources lists '
                       'gyro'),
            ('--truth', 'only used for comparison: Odometry, PoseStamped or PoseWithCovariance'
                        f'Stamped; or a file, {", ".join(TRUTH_SUFFIXES)} (TUM or a table)')):
        metavar, kind = ('TOPIC|FILE', _topic_or_file) if option == '--truth' else (
            'TOPIC', _topic)
        group.add_argument(option, metavar=metavar, help=text, type=kind)
    parser.add_argument('--align', action=argparse.BooleanOptionalAction, default=None,
                        help='compare the truth where it fits the path best (default: yes)')
    if hold_out:
        parser.add_argument('--hold-out', metavar='N', type=int, default=0,
                            help='keep every N-th fix out of the graph and use it for comparison')


def _add_parameters(parser: argparse.ArgumentParser) -> None:
    """Add the options that set parameters of the node."""
    parser.add_argument('--params-file', '--parameters', metavar='FILE', type=Path,
                        help='ROS 2 parameter file of the node')
    parser.add_argument('-p', '--param', '--set', metavar='NAME:=VALUE', action='append',
                        default=[], help='parameter of the node, as after --ros-args; may be '
                        'repeated')


def _topic(name: str) -> str:
    """Return a topic with the slash that recorders of ROS 1 may leave out."""
    return '/' + name.removeprefix('/')


def _topic_or_file(name: str) -> str | Path:
    return Path(name) if name.endswith(TRUTH_SUFFIXES) else _topic(name)


def number(least: float = -math.inf, most: float = math.inf, *, whole: bool = False,
           factor: float = 1) -> Callable[[str], Any]:
    """Return what reads a finite number, times a factor; it raises ArgumentTypeError."""
    kind = 'a whole number' if whole else 'a number'
    expected = kind if least == -math.inf else f'{kind} of at least {least:g}'
    expected += '' if most == math.inf else f' and at most {most:g}'

    def read(text: str) -> Any:
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and least <= value <= most):
            raise argparse.ArgumentTypeError(f'expected {expected}, got {text!r}')
        return value * factor
    return read


def _exports(text: str) -> Exports:
    """Return the formats that a comma-separated text names."""
    if text == 'all':
        return Exports(FORMATS, strict=False)
    names = tuple(dict.fromkeys(name.strip() for name in text.split(',')))
    for name in names:
        if name not in FORMATS:
            raise argparse.ArgumentTypeError(
                f'{name!r} is no format; expected all or some of {", ".join(FORMATS)}')
    return Exports(names)


def _picture(text: str) -> Path:
    """Return the path of a picture whose format is known."""
    if Path(text).suffix.lower() not in PICTURES:
        raise argparse.ArgumentTypeError(
            f'expected a name that ends with {", ".join(PICTURES)}, got {text!r}')
    return Path(text)
