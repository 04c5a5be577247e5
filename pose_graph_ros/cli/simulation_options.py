# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Arguments of `pose-graph simulate`, and what they change of the usual sensors and disturbances.

As in `arguments`, nothing is imported here that takes time.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
import math
from pathlib import Path
from typing import Any

from pose_graph_ros.cli.arguments import number
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.offline.simulation import settings
from pose_graph_ros.offline.simulation.settings import DURATIONS_S, Jump, OdometryErrors, Setup

PICTURES = ('.png', '.pdf', '.svg')
FALSE_SIZE = 4  # closures of a group of false ones
# Options of what a graph does not have, and where their values are.
ONLY_IN_BAGS = {'--odometry': 'wheels.errors', '--slip': 'wheels.slip_events_per_s',
                '--heading-drift': 'wheels.heading_drift',
                '--gyro': 'gyro', '--delay': 'delay', '--duplicate': 'duplicate',
                '--clock-offset': 'clock_offset'}
SENSORS: dict[str, Any] = {'wheels': settings.Wheels, 'gyro': settings.Gyro,
                           'fixes': settings.Fixes, 'poses': settings.GlobalPoses,
                           'closures': settings.Closures}
# Grammar, class, name in the setup and help of each disturbance, by its option.
DISTURBANCES: dict[str, tuple[str, Callable[..., Any], str, str]] = {
    'outage': ('TOPIC:FROM:TO', settings.Outage, 'outages', 'nothing is measured in between'),
    'jump': ('TOPIC:AT:DX,DY[,RAD][:FOR]', Jump, 'jumps', 'step of odometry in the frame of '
             'the robot; or step of fixes or global poses, east and north, for so many seconds; '
             '/odom:AT:reset: odometry begins again at its origin'),
    'delay': ('TOPIC:S[:JITTER]', settings.Delay, 'delays', 'recorded so long after the stamp, '
              'plus 0 to JITTER at random, which shuffles messages'),
    'duplicate': ('TOPIC:SHARE', settings.Duplicates, 'duplicates',
                  'share of the messages that come again within a second'),
    'clock_offset': ('TOPIC:S', settings.ClockOffset, 'offsets',
                     'the clock of this sensor is ahead'),
    'claimed_sigma': ('TOPIC:FACTOR', settings.ClaimedSigma, 'claims',
                      'ratio of the sigmas in the messages to the true ones (default: 1, honest)')}
Change = tuple[str, Any]  # a topic and what happens to it, None if nothing shall


def simulate(parser: argparse.ArgumentParser) -> None:
    """
    Simulate a drive with known ground truth, and write it as a rosbag2 or as a g2o file.

    Worlds: `drive`, a car that laps some city blocks twice; `hall`, a robot in the aisles of a
    hall; `grid`, a walk at random through the streets of a small Manhattan. Each has the sensors
    and the disturbances that are usual there; options change them. Equal options give equal
    drives, and what is said of one sensor changes no other.

    A bag has the true poses on /ground_truth. What was false, moved or left out is in
    OUT_truth.json; of a graph OUT.g2o the truth is in OUT_truth.g2o, with the same ids.

    examples:
      pose-graph simulate city                                        # as in `pose-graph demo`
      pose-graph simulate hall --world hall --duration 3600 --closures 0.5 --false-rate 0.1
      pose-graph simulate gnss --world grid --closures 0 --fix-sigma 0.5 --fix-correlated 1,30
      pose-graph simulate bad --outage /gps/fix:60:90 --jump /odom:90:3,0 --jump /gps/fix:95:9,5:30
      pose-graph simulate late --delay /gps/fix:2:3 --duplicate /loop_closure:0.2 --gyro
      pose-graph simulate city.g2o --world grid --duration 2300 --false-rate 0.3 --false-groups 9:5
      pose-graph replay hall --odom /odom --truth /ground_truth

    exit code: 0 written, 2 wrong input
    """
    parser.usage = '%(prog)s OUT [options]'
    parser.add_argument('out', metavar='OUT', type=Path,
                        help='folder of the rosbag2, or a graph if the name ends in .g2o')
    parser.add_argument('--world', choices=DURATIONS_S, default='drive',
                        help='(default: %(default)s)')
    parser.add_argument('--duration', metavar='S', type=number(10.0, 100_000.0),
                        help=f'length [s] (default: {_by_world(DURATIONS_S)})')
    parser.add_argument('--seed', metavar='N', type=number(0, whole=True), default=1,
                        help='(default: %(default)s)')
    _add_sensors(parser)
    group = parser.add_argument_group(
        'disturbances', 'each may be repeated; times are seconds since the start. The drive has '
        'an outage and a jump\nof /gps/fix, which yours replace; "/gps/fix:none" removes them')
    for option, (grammar, kind, _, text) in DISTURBANCES.items():
        group.add_argument(f'--{option.replace("_", "-")}', metavar=grammar, action='append',
                           type=_disturbance(grammar, kind), default=[], help=text)
    out = parser.add_argument_group('output')
    out.add_argument('--node-distance', metavar='M', type=number(0.01), help='distance of the '
                     f'nodes of a graph [m] (default: {_by_world(settings.NODE_DISTANCES)})')
    out.add_argument('--tum', action='store_true', help='also write the truth as OUT_truth.tum')
    out.add_argument('--plot', metavar='FILE', type=Path,
                     help=f'draw a map; the name ends in {", ".join(PICTURES)}')
    out.add_argument('--json', action='store_true', help='print what was simulated, the content '
                     'of OUT_truth.json, as JSON (docs/tools/simulate.md)')


def _by_world(values: dict[str, float]) -> str:
    return ', '.join(f'{value:g} for {name}' for name, value in values.items())


def _add_sensors(parser: argparse.ArgumentParser) -> None:
    """Add the options on sensors; `dest` is the sensor, with the fields of it that are set."""
    wheels = parser.add_argument_group('odometry on /odom, 20 Hz')
    wheels.add_argument('--odometry', dest='wheels.errors', choices=[*map(str, OdometryErrors)],
                        type=lambda text: next((e for e in OdometryErrors if e == text), text),
                        help='errors of two wheels, or a random walk as the node assumes it '
                        '(default: wheels; a graph always has the latter)')
    wheels.add_argument('--slip', dest='wheels.slip_events_per_s', metavar='PER_MINUTE',
                        type=number(0.0, factor=1.0 / 60.0), help='events of slip of each wheel, '
                        'which then measures 1 cm too much at 1 m/s (default: 1; hall: 0.5)')
    wheels.add_argument('--heading-drift', dest='wheels.heading_drift', metavar='RAD_PER_M',
                        type=number(), help='drift of the heading by the wheels '
                        '[rad/m] (default: 0)')
    gyro = parser.add_argument_group('gyroscope on /imu/data, 100 Hz')
    gyro.add_argument('--gyro', action='store_true', help='with a gyroscope')
    fixes = parser.add_argument_group('GNSS on /gps/fix')
    fixes.add_argument('--fix', action=argparse.BooleanOptionalAction,
                       help='with fixes (default: in the drive; the options below imply it)')
    fixes.add_argument('--fix-period', dest='fixes.period_s', metavar='S', type=number(0.01),
                       help='(default: 0.5)')
    fixes.add_argument('--fix-sigma', dest='fixes.white', metavar='M', type=number(0.0),
                       help='white error of a coordinate (default: 0.4)')
    fixes.add_argument('--fix-correlated', dest='fixes.correlated,correlation_s', metavar='M,S',
                       type=_pair, help='standard deviation and time constant of the correlated '
                       '(Gauss-Markov) error of a coordinate; 0,1 for none (default: 1.2,60)')
    poses = parser.add_argument_group('global poses on /global_pose')
    poses.add_argument('--global-pose', dest='poses.period_s', metavar='PERIOD', type=number(0.01),
                       help='a pose in the map every so many seconds (default: there are none)')
    loops = parser.add_argument_group('loop closures on /loop_closure')
    loops.add_argument('--closures', dest='closures.rate', metavar='RATE', type=number(0.0, 1.0),
                       help='share of the stretches driven before in which a closure is found, 0 '
                       'to 1; stretches are of 25 m (drive), 5 m (hall), 1 m (grid) '
                       '(default: 1; grid: 0.5)')
    loops.add_argument('--false-rate', metavar='SHARE', type=number(0.0),
                       help='share of all closures that tie two different places '
                            '(default: 0; drive: 4 single ones and a group of 4)')
    loops.add_argument('--false-groups', metavar='N[:SIZE]', type=_groups,
                       help='of the false ones so many groups agree with one another, as if a '
                            f'stretch was taken for another (default of SIZE: {FALSE_SIZE})')


def changed(usual: Setup, options: argparse.Namespace) -> Setup:
    """Return what is simulated, by the usual of the world and the options; raises ConfigError."""
    given: dict[str, dict[str, Any]] = {
        sensor: {} for sensor, there in (('gyro', options.gyro), ('fixes', options.fix)) if there}
    for place, value in vars(options).items():
        sensor, dot, names = place.partition('.')
        if dot and value is not None:
            fields = names.split(',')
            given.setdefault(sensor, {}).update(
                zip(fields, value if len(fields) > 1 else (value,), strict=True))
    given.setdefault('closures', {})
    if options.false_rate is not None or options.false_groups is not None:
        groups, size = options.false_groups or (0, FALSE_SIZE)
        given['closures']['false'] = replace((usual.closures or SENSORS['closures']()).false,
                                             share=options.false_rate, singles=0, groups=groups,
                                             size=size, loose=False)
    if options.fix is False and 'fixes' in given:
        raise ConfigError('--no-fix: expected no other option on fixes, but there is one')
    values: dict[str, Any] = {sensor: replace(getattr(usual, sensor) or SENSORS[sensor](), **of)
                              for sensor, of in given.items()}
    if options.fix is False:
        values['fixes'] = None
    present = replace(usual, **values).sensors
    for option, (_, _, name, _) in DISTURBANCES.items():
        found: Sequence[Change] = getattr(options, option)
        replaced = {topic for topic, _ in found}
        for topic in replaced - present.keys():
            raise ConfigError(f'--{option.replace("_", "-")} {topic}: nothing is simulated there, '
                              f'expected one of {", ".join(present)}')
        kept = (each for each in getattr(usual, name) if each.topic in present.keys() - replaced)
        values[name] = (*kept, *(each for _, each in found if each is not None))
    return replace(usual, **values)


def refuse_what_graphs_lack(options: argparse.Namespace) -> None:
    """Raise ConfigError if an option is given that a graph cannot have."""
    for option, place in ONLY_IN_BAGS.items():
        if getattr(options, place) not in (None, False, []):
            raise ConfigError(f'{option}: only a bag has it, but {options.out} is a graph')
    if any(topic == settings.ODOMETRY for topic, _ in options.outage):
        raise ConfigError(f'--outage {settings.ODOMETRY}: a graph cannot do without odometry')


def _pair(text: str) -> tuple[float, ...]:
    """Return two numbers with a comma between them."""
    try:
        values = tuple(map(float, text.split(',')))
    except ValueError:
        values = ()
    if len(values) != 2 or not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(
            f'expected 2 numbers with commas between them, got {text!r}')
    return values


def _groups(text: str) -> tuple[int, int]:
    """Return the number of groups of false closures and their size."""
    if len(words := text.split(':')) > 2 or not all(each.isdecimal() for each in words):
        raise argparse.ArgumentTypeError(f'expected N or N:SIZE, got {text!r}')
    groups, size = int(words[0]), int(words[1]) if len(words) == 2 else FALSE_SIZE
    if size < 2:
        raise argparse.ArgumentTypeError(f'expected groups of at least 2, got {text!r}')
    return groups, size


def _disturbance(grammar: str, kind: Callable[..., Any]) -> Callable[[str], Change]:
    """Return what reads a disturbance, and says what was expected if it cannot."""
    def read(text: str) -> Change:
        topic, *words = text.split(':')
        if words == ['none']:
            return topic, None
        try:
            if kind is not Jump:
                return topic, kind(topic, *map(float, words))
            at, step, seconds = words if len(words) == 3 else (*words, 'inf')
            dx, dy, *turn = (0.0, 0.0) if step == 'reset' else map(float, step.split(','))
            heading, = turn or [0.0]
            return topic, Jump(topic, float(at), None if step == 'reset' else (dx, dy, heading),
                               float(seconds))
        except ConfigError as error:
            raise argparse.ArgumentTypeError(f'{text!r}: {error}') from error
        except (TypeError, ValueError):
            raise argparse.ArgumentTypeError(f'expected {grammar}, got {text!r}') from None
    return read
