# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What came of a migration: a parameter file, what became of each parameter, and what is left to do.
"""

from collections.abc import Iterator, Sequence
import math
from pathlib import Path
import re
import shlex
import textwrap

import yaml

from pose_graph_ros.adapters.parameters import FRAMES
from pose_graph_ros.adapters.sources import KINDS
from pose_graph_ros.cli.migration.engine import GLOBAL, Migration
from pose_graph_ros.cli.migration.inputs import in_map, place, plugins, Section, System
from pose_graph_ros.cli.migration.rules import Fate

WIDTH = 97


def parameter_file(migration: Migration, out: Path, words: Sequence[str]) -> str:
    """Return the content of the parameter file: values, where they are from, and the lists."""
    lines = [f'# Made by `pose-graph migrate {shlex.join(words)}`.',
             '# What is left to do, and what became of each parameter, stands below.', '/**:',
             '  ros__parameters:']
    groups: dict[str, list[str]] = {}
    for name, setting in migration.settings.items():
        group, _, leaf = name.rpartition('.')
        text = yaml.safe_dump([setting.value], default_flow_style=True, width=math.inf)
        groups.setdefault(group, []).append(f'{leaf}: {text.strip()[1:-1]}'.ljust(
            36 if group == '' else 34) + f'  # {setting.why}')
    for group, own in groups.items():
        lines += [f'    {line}' for line in own] if group == '' else [
            f'    {group}:', *(f'      {line}' for line in own)]
    lines += ['', *(f'# {line}'.rstrip() for line in lists(migration, out)), '']
    return '\n'.join(lines)


def lists(migration: Migration, out: Path) -> Iterator[str]:
    """Yield lines: what is left to do, the launch call, and what became of each parameter."""
    yield 'What to do'
    for k, step in enumerate((*steps(migration), 'Start this node:'), start=1):
        yield from _wrapped(f'{k}. ', step)
    yield ' ' * 5 + launch_call(migration, out)
    for fate in Fate:
        groups: dict[str, dict[str, list[str]]] = {}  # names by place and sentence
        entries = [each for each in migration.entries if each.fate is fate]
        for each in entries:
            groups.setdefault(place(each.section), {}).setdefault(
                each.sentence, []).append(each.name)
        if len(entries) > 0:
            yield from ('', f'{fate.value}: {len(entries)}')
        for where, some in groups.items():
            yield f'  {where}'
            for sentence, names in some.items():
                yield from _wrapped('  - ', ': '.join(filter(None, (', '.join(names), sentence))))


def _wrapped(head: str, text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=f'  {head}',
                         subsequent_indent='  ' + ' ' * len(head), break_long_words=False,
                         break_on_hyphens=False)


# --- what no parameter file can tell

def steps(migration: Migration) -> Iterator[str]:
    """Yield what is to be done before the start, a sentence or a few each."""
    settings, kept, replaced = migration.settings, migration.kept, migration.replaced
    frames = [settings[name].value if name in settings else usual
              for name, usual in zip(FRAMES, ('map', 'odom', 'base_link'), strict=True)]
    upper, lower = ' -> '.join(frames[:2]), ' -> '.join(frames[1:])
    stopped = [each.node for each in migration.of(System.FILTER, System.NAVSAT, System.FUSE)
               if each is not kept]
    if len(stopped) > 0:
        yield f'Stop {" and ".join(stopped)}: this node does the work.'
    if kept is not None:
        yield from _beside(migration, kept.node, upper, lower)
    elif replaced is not None and _publishes_odometry(replaced):
        yield (f'Let the driver of the wheels publish {lower}, which {replaced.node} did. This '
               f'node does not: its corrections are in {upper}. Or keep {replaced.node} for that, '
               'without inputs that know the map, such as GNSS; then write its output to '
               'odom.topic, and take imu and gyro out of sources, as it has them.')
    else:
        yield (f'Another node has to publish {lower}, such as the driver of the wheels. If a '
               'filter of robot_localization does, give its file as well.')
    yield from _of_inputs(migration)
    if 'fix.topic' in settings:
        yield ('fix.topic is the usual name of what navsat_transform_node listens to: look for a '
               'remap of gps/fix. The place of the antenna is taken from /tf_static, or set '
               'fix.lever_arm.')
    if len(migration.of(System.SLAM_TOOLBOX)) > 0:
        yield ('This node matches no scans. Let a front end send loop closures to the topic '
               'loop_closure, or use the topic pose of slam_toolbox (global_pose in sources, '
               f'global_pose.topic: pose). Only one node may publish {upper}.')
    elif not any(KINDS[migration.type_of(name)].in_map for name in settings['sources'].value):
        yield ('Nothing tells where the robot is in the map: add fix or global_pose to sources. '
               'Loop closures are always listened to, on the topic loop_closure.')
    if migration.type_of(settings['sources'].value[0]) == 'twist':
        yield (f'A twist has no odometry frame, so {upper} is not published: take what publishes '
               f'{lower} as odometry.')
    if (space := _namespace(migration)) != '':
        yield (f'In {space} the launch file uses the topics tf and tf_static of the namespace: '
               'where the other nodes use /tf, add remap_tf:=false.')
    if settings['sources'].value[0] == 'odom' and 'no file' in settings['odom.topic'].why:
        yield 'Write the topic of the odometry to odom.topic: no file tells it.'


def _of_inputs(migration: Migration) -> Iterator[str]:
    """Yield what is to be looked at of single inputs."""
    for one, names in migration.names.items():
        if 'odometry' in names and migration.kept is None and not one.uses & {'yaw', 'vyaw'}:
            yield (f'The yaw of {one.topic} was not used before and is now: if it is bad, set '
                   f'{names["odometry"]}.sigma_heading_turn to 1, so that others decide.')
        if 'imu' in names:
            yield (f'The yaw of {one.topic} is used as it is, 0 in the east, whatever /tf_static '
                   'says: if the IMU is turned on the robot, counterclockwise by some angle, take '
                   f'that off {names["imu"]}.yaw_offset. It tells where the robot heads before it '
                   'has driven; without a compass that does, take it out of sources.')


def _beside(migration: Migration, node: str, upper: str, lower: str) -> Iterator[str]:
    """Yield what is to be done with a filter that stays, given the transforms."""
    yield (f'Keep {node}: it publishes {lower}, which this node does not. Its output is the '
           f'odometry here, since {upper} has to fit that transform. Look up in your launch file '
           'what odometry/filtered of it is remapped to, and write that to odom.topic.')
    for one in migration.heard:
        if one.message == 'pose' and {'x', 'y'} <= one.uses and not one.moves:
            yield (f'If {one.topic} is a pose in the map, such as that of AMCL, take it out of '
                   f'{node}, whose output must know nothing of the map, and add it here as a '
                   'source of type global_pose.')
    if any(one.message == 'imu' for one in migration.heard):
        yield ('There is no source of type gyro: what the IMU tells of turns is in the output of '
               f'{node} already, and would count twice. More exact are the wheels and the '
               'gyroscope themselves, whose bias is then estimated.')
    yield (f'Where the driver of the wheels publishes {lower} itself, {node} can go, too: migrate '
           'with --replace-local.')


def launch_call(migration: Migration, out: Path) -> str:
    """Return the command that starts the node with the parameter file."""
    words = [f'params_file:={out}']
    if len(migration.of(System.FILTER, System.NAVSAT)) > 0:
        words.append('compatible:=robot_localization')
    output = migration.settings.get('outputs.filtered_odometry')
    if output is not None and output.value == GLOBAL:
        words.append(f'filtered_odometry:={GLOBAL}')
    if (space := _namespace(migration)) != '':
        words.append(f'namespace:={space}')
    if any(each.values.get('use_sim_time') is True for each in migration.sections):
        words.append('use_sim_time:=true')
    return shlex.join(['ros2', 'launch', 'pose_graph_ros', 'pose_graph.launch.py', *words])


def _namespace(migration: Migration) -> str:
    """Return the namespace that the nodes have in common; empty if there is none."""
    spaces = {each.node.rpartition('/')[0].strip('/') for each in migration.sections
              if each.system is not None}
    return space if len(spaces) == 1 and re.fullmatch(
        r'[\w/]+', space := min(spaces)) else ''


def _publishes_odometry(section: Section) -> bool:
    """Tell whether a node publishes the transform from odometry to the robot."""
    values = section.values
    if section.system is System.FILTER:
        return not in_map(section) and values.get('publish_tf', True) is True
    return any(values.get(f'{name}.world_frame_id', 'odom') == values.get(
        f'{name}.odom_frame_id', 'odom') and values.get(f'{name}.publish_tf', True) is True
        for name, kind in plugins(section).items() if kind == 'Odometry2DPublisher')
