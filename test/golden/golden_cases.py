# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The golden drives and runs of tools: what is run. `golden_runner` runs them.

A drive is simulated by the words of `pose-graph simulate`, or made of public data, and goes
through the engine with parameters of the node. The run of a tool is its command line.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import backend_config
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.io.graph_files import read_graph, write_graph
from pose_graph_ros.core.judgement.verdicts import Decision
from pose_graph_ros.core.measurements import GlobalPose, Measurement, OdometrySample

Stream = Iterable[tuple[str, OdometrySample | Measurement]]
SECOND = 1_000_000_000


@dataclass(frozen=True)
class Drive:
    """A drive through the engine; at some times [s] something is done to it."""

    world: str
    """Words of `pose-graph simulate`; or the name of a public recording."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the node."""
    stream: Callable[[Stream], Stream] = iter
    """What becomes of the measurements on their way to the engine."""
    deeds: Mapping[float, Callable[[PoseGraphBackend, 'Drive'], PoseGraphBackend]] = field(
        default_factory=dict)
    period: float = 1.0
    """Between two updates [s]."""
    refines: bool = False
    """Whether it goes on to the optimum after each update, as the node does in pauses."""
    large: bool = False
    """Whether it takes too long for the tests."""

    @property
    def is_recording(self) -> bool:
        return not self.world.startswith('--')

    def backend(self, saved: Any = None) -> PoseGraphBackend:
        config = backend_config(checked(self.values))
        return PoseGraphBackend(config) if saved is None else PoseGraphBackend.restored(
            config, saved)


@dataclass(frozen=True)
class Tool:
    """
    A run of a tool in the folder of all of them.

    Of files with numbers figures are taken, of others the hash.
    """

    words: str
    files: tuple[str, ...] = ()
    """What is looked at, beside what is printed."""
    after: str = ''
    """The tool whose files it reads."""
    large: bool = False
    """Whether it takes too long for the tests."""


def second_odometry(measurements: Stream) -> Iterator[tuple[str, OdometrySample | Measurement]]:
    """Add odometry `visual`, whose distances are 1 % too long, and with noise of its own."""
    generator = np.random.default_rng(7)
    last, pose = None, np.array((5.0, -3.0, 1.0))
    for source, each in measurements:
        yield source, each
        if not isinstance(each, OdometrySample):
            continue
        if last is not None:
            step = se2.between(last, each.pose)
            pose = se2.compose(pose, step * (1.01, 1.01, 1.0) + generator.normal(
                0.0, (2e-3, 2e-3, 5e-4)) * np.sqrt(abs(step[0])))
        last = each.pose
        yield 'visual', OdometrySample(each.stamp_ns + 10_000_000, pose)


def primary_fails(measurements: Stream) -> Iterator[tuple[str, OdometrySample | Measurement]]:
    """Add `visual`, and let the other odometry be silent for 10 s after 20 s."""
    start = None
    for source, each in second_odometry(measurements):
        start = each.stamp_ns if start is None else start
        if source != 'odom' or not 20 * SECOND < each.stamp_ns - start < 30 * SECOND:
            yield source, each


def two_receivers(measurements: Stream) -> Iterator[tuple[str, OdometrySample | Measurement]]:
    """Let every other fix come from a second receiver, aside by 20 cm to the left."""
    count = 0
    for source, each in measurements:
        if source == 'fix':
            count += 1
            if count % 2 == 0:
                yield 'rear', replace(each, lever_arm=np.array((-1.0, 0.2)))
                continue
        yield source, each


def save_and_go_on(backend: PoseGraphBackend, drive: Drive) -> PoseGraphBackend:
    with tempfile.TemporaryDirectory() as folder:
        write_graph(backend.saved(), Path(folder) / 'map')
        return drive.backend(read_graph(Path(folder) / 'map'))


def decided(backend: PoseGraphBackend, _: Drive) -> PoseGraphBackend:
    """Decide against what is believed and for what is not, of the first two closures each."""
    closures = [each for each in backend.verdicts() if each.source == 'loop_closure']
    for wrong, decision in ((True, Decision.IN), (False, Decision.OUT)):
        for each in [each for each in closures if each.state.in_graph is not wrong][:2]:
            backend.decide(each.id, decision)
    return backend


def moved(backend: PoseGraphBackend, _: Drive) -> PoseGraphBackend:
    """Say that the robot is 2 m ahead and 1 m to the left of where it is believed to be."""
    estimate = backend.estimate(with_path=False)
    assert estimate is not None
    backend.set_pose(GlobalPose(
        estimate.stamp_ns, se2.compose(estimate.T_map_base, np.array((2.0, 1.0, 0.1))),
        np.diag((0.1, 0.1, 0.01))), 'set_pose')
    return backend


def reconfigured(backend: PoseGraphBackend, drive: Drive) -> PoseGraphBackend:
    backend.configure(backend_config(checked({
        **drive.values, 'odom.sigma_distance': 0.1, 'minimum_travel_distance': 2.0,
        'fix.robust': 'none', 'window.seconds': 15.0})))
    return backend


CITY = '--duration 45 --closures 0'
HALL = '--world hall --duration 45'
LOOPS = '--world grid --seed 101 --duration 100 --closures 1'
FALSE = f'{LOOPS} --false-rate 0.3 --false-groups 2:4'
GYRO = {'sources': ['odom', 'fix', 'gyro'], 'gyro.mounting': 'up'}
VISUAL = {'sources': ['odom', 'visual', 'fix'], 'visual.type': 'odometry'}
THIN = {'thinning.cell': 2.0}

DRIVES = {
    'fixes': Drive(CITY),
    'fixes_other_seed': Drive(f'{CITY} --seed 8', large=True),
    'fixes_refined': Drive(CITY, period=0.2, refines=True),
    'fixes_white': Drive(CITY, {'fix.correlation_time': 0.0}),
    'fixes_correlated_as_told': Drive(
        f'{CITY} --fix-correlated 1.0,20', {'fix.correlation_time': 20.0}, large=True),
    'fixes_correlated_as_found': Drive(
        '--world hall --fix --fix-correlated 1.5,20 --fix-sigma 0.2 --duration 100', large=True),
    'fixes_aside': Drive(f'{CITY} --jump /gps/fix:20:14,-9:10', {'fix.correlation_time': 0.0}),
    'fixes_aside_lossy': Drive(f'{CITY} --jump /gps/fix:20:14,-9:10', {
        'fix.robust': 'loss', 'fix.robust_loss': 'cauchy'}, large=True),
    'fixes_out_and_sparse': Drive(f'{CITY} --outage /gps/fix:15:30 --fix-period 2'),
    'fixes_claim_too_little': Drive(
        f'{CITY} --claimed-sigma /gps/fix:0.3 --fix-correlated 0,1', large=True),
    'fixes_late_and_shuffled': Drive(f'{CITY} --delay /gps/fix:2:6 --duplicate /gps/fix:0.2'),
    'clock_ahead': Drive(
        f'{CITY} --clock-offset /gps/fix:0.3', {'fix.time_offset': -0.3}, large=True),
    'datum': Drive(CITY, {'datum': [50.7, 7.1, 0.4]}),
    'receivers': Drive(CITY, {'sources': ['odom', 'fix', 'rear'], 'rear.type': 'fix',
                              'fix.lever_arm': [1.0, 0.0]}, two_receivers),
    'odometry_jumps': Drive(f'{CITY} --jump /odom:15:3,1,0.5 --jump /odom:30:reset'),
    'odometry_fails': Drive(f'{CITY} --outage /odom:20:26'),
    'odometry_slips': Drive(f'{HALL} --global-pose 2 --slip 20'),
    'odometries': Drive(CITY, VISUAL, second_odometry, large=True),
    'odometries_primary_fails': Drive(CITY, VISUAL, primary_fails),
    'twist_noise': Drive(CITY, {'odom.noise': 'twist'}),
    'twist_integrated': Drive(CITY, {'odom.integrate': 'twist', 'odom.sigma_scale': 1.5}),
    'gyro': Drive(f'{CITY} --gyro --heading-drift 0.002', GYRO, large=True),
    'gyro_outage': Drive(f'{CITY} --gyro --heading-drift 0.002 --outage /gps/fix:15:40 '
                         '--outage /imu/data:20:25', {**GYRO, 'gyro.bias_period': 5.0}),
    'poses': Drive(f'{HALL} --global-pose 1 --jump /global_pose:20:3,2,0.5:8'),
    'poses_without_heading': Drive(
        f'{HALL} --global-pose 1', {'global_pose.heading': 'never'}, large=True),
    'closures': Drive(LOOPS),
    'closures_false': Drive(FALSE),
    'closures_false_late': Drive(
        f'{FALSE} --delay /loop_closure:5:20 --duplicate /loop_closure:0.2'),
    'closures_false_believed': Drive(FALSE, {'loop_closure.robust': 'none'}, large=True),
    'closures_false_lossy': Drive(FALSE, {
        'loop_closure.robust': 'loss', 'loop_closure.robust_loss': 'geman_mcclure'}, large=True),
    'closures_decided': Drive(FALSE, deeds={80.0: decided}),
    'window': Drive(LOOPS, {'window.seconds': 30.0}),
    'window_sparse': Drive(LOOPS, {'window.metres': 60.0, 'window.prior': 'sparse'}),
    'window_gyro': Drive(f'{CITY} --gyro', {**GYRO, 'window.nodes': 60.0}, large=True),
    'thinning': Drive(LOOPS, THIN, large=True),
    'thinning_window_false': Drive(FALSE, {**THIN, 'window.seconds': 60.0}),
    'saved': Drive(f'{CITY} --gyro', GYRO, deeds={25.0: save_and_go_on}, large=True),
    'saved_closures': Drive(
        f'{FALSE} --delay /loop_closure:2', deeds={80.0: save_and_go_on}),
    'saved_window': Drive(FALSE, {**THIN, 'window.seconds': 40.0}, deeds={
        50.0: save_and_go_on, 85.0: save_and_go_on}),
    'set_pose': Drive(CITY, deeds={25.0: moved}),
    'reconfigured': Drive(CITY, deeds={25.0: reconfigured}),
    'two_laps': Drive('--duration 400', large=True),
    'hall_false': Drive('--world hall --duration 900 --false-rate 0.3 --false-groups 3:5',
                        large=True),
    'grid_thinning': Drive('--world grid --duration 400 --false-rate 0.1', THIN, large=True),
    'husky': Drive('robot/husky_test1_ros2', large=True),
    'plaza1': Drive('robot/plaza1', large=True),
}

TOOLS = {
    'simulate': Tool('simulate city --duration 40 --gyro --json --tum', ('city_truth.tum',)),
    'simulate_graph': Tool(
        'simulate grid.g2o --world grid --duration 400 --seed 101 --false-rate 0.1 --json',
        ('grid.g2o', 'grid_truth.g2o')),
    'replay': Tool('replay city -o run --live -p frequency:=2 --export all --bag corrected '
                   '--hold-out 5 --json',
                   ('run/path.tum', 'run/live.csv', 'run/graph.g2o', 'run/run.json'),
                   after='simulate', large=True),
    'replay_graph': Tool('replay grid.g2o -o rung --json', ('rung/path.tum', 'rung/run.json'),
                         after='simulate_graph'),
    'report': Tool('report rung --json', after='replay_graph'),
    'solve': Tool('solve grid.g2o -o solved.g2o --json', ('solved.g2o',), after='simulate_graph'),
    'solve_robust': Tool('solve grid.g2o --robust -o robust.g2o --json', ('robust.g2o',),
                         after='simulate_graph'),
    'solve_gnc': Tool('solve grid.g2o --robust gnc --no-certificate --json',
                      after='simulate_graph'),
    'marginals': Tool('solve grid.g2o --marginals all -o marginals.csv --json',
                      ('marginals.csv',), after='simulate_graph'),
    'marginalize': Tool('marginalize robust.g2o --nodes 3,7,20:40 --sparse -o smaller.g2o --json',
                        ('smaller.g2o',), after='solve_robust'),
    'draw': Tool('draw robust.g2o --around 17 --hops 3 --pattern -o near.svg --json',
                 ('near.svg',), after='solve_robust'),
    'draw_factor_graph': Tool('draw robust.g2o --nodes 0:15 --as factor-graph -o factors.svg '
                              '--json', ('factors.svg',), after='solve_robust'),
    'simulate_wrong_claims': Tool(
        'simulate claims --duration 45 --closures 0 --claimed-sigma /gps/fix:0.3 '
        '--fix-correlated 0,1 --json'),
    'tune': Tool('tune claims -o tuned.yaml --folds 2 --json', ('tuned.yaml',),
                 after='simulate_wrong_claims', large=True),
    'parameters': Tool('parameters --yaml'),
}

CASES: dict[str, Drive | Tool] = {**DRIVES, **TOOLS}


def needs(name: str) -> list[str]:
    """Return the public data that a case needs."""
    case = CASES[name]
    return [case.world] if isinstance(case, Drive) and case.is_recording else []


def is_large(name: str) -> bool:
    """Return whether a case takes too long for the tests."""
    return CASES[name].large
