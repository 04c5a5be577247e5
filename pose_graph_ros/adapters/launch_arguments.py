# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The arguments of the launch file, and what they mean for the node; no ROS, and no launch."""

from collections.abc import Collection, Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
import re

from pose_graph_ros.adapters.parameter_table import DEFAULT_SOURCES, OUTPUTS, ROBOT_LOCALIZATION
from pose_graph_ros.adapters.parameters import LIKENESS
from pose_graph_ros.adapters.sources import CLOSURES, KNOWN_SOURCES
from pose_graph_ros.core.exceptions import ConfigError

AS_IN_FILE = 'as in params_file'  # default of what sets a parameter only if it is given
SWITCHES = {'true': True, '1': True, 'false': False, '0': False}


def arguments(share: Path) -> dict[str, tuple[str, str]]:
    """Return default and description by name, given the folder of the installed package."""
    config = share / 'config'
    return {
        'params_file': (str(config / 'pose_graph.yaml'), 'yaml file of parameters'),
        'name': ('pose_graph', 'name of the node'),
        'namespace': ('', 'namespace of the node and its topics'),
        'remap_tf': ('true', 'true or false: in a namespace, use its tf and tf_static instead of '
                     '/tf and /tf_static, as Nav2 does'),
        'use_sim_time': (AS_IN_FILE, 'true or false: take the time from /clock (simulation, '
                         'ros2 bag play --clock)'),
        'log_level': ('info', 'debug, info, warn, error or fatal'),
        'autostart': (AS_IN_FILE, 'true or false: configure and activate the node; otherwise a '
                      'lifecycle manager does'),
        'rviz': ('false', 'true or false: start RViz as well, if it is installed'),
        'rviz_config': (str(config / 'pose_graph.rviz'), 'configuration of RViz'),
        'state_file': (AS_IN_FILE, 'file in which the node keeps all that it accepts, and from '
                       'which it continues when it is started again'),
        'compatible': (AS_IN_FILE, f'{ROBOT_LOCALIZATION}: offer the services of its nodes as '
                       'well, such as fromLL'),
        'sources': (AS_IN_FILE, 'names of the sources, such as [odom, fix, gyro]'),
        **{source: (AS_IN_FILE, f'topic of the input, {kind.message_type}; sets {source}.topic' + (
            '' if source in {*DEFAULT_SOURCES, CLOSURES} else f', if sources lists {source}'))
           for source, (kind, _) in KNOWN_SOURCES.items()},
        **{name: (AS_IN_FILE, f'topic of the output, {type_name}; sets outputs.{name}, by default '
                              f'{topic}') for name, (topic, type_name, _) in OUTPUTS.items()}}


def switch(given: Mapping[str, str], name: str) -> bool:
    """Return an argument that is true or false, or 1 or 0, in any case of letters."""
    if (text := given[name].strip().lower()) not in SWITCHES:
        raise ConfigError(f'argument {name}: expected true or false, got {given[name]!r}')
    return SWITCHES[text]


def parameter_file(given: Mapping[str, str]) -> str:
    """Return the path of the parameter file; raises `ConfigError` if there is none."""
    path = Path(given['params_file']).expanduser()
    if not path.is_file():
        raise ConfigError(f'argument params_file: expected a file, got {str(path)!r}')
    return str(path)


def unknown(typed: Iterable[str], own: Collection[str], *, included: bool) -> list[str]:
    """
    Return what to say of arguments `name:=value` that the launch file does not have.

    Launch ignores them. If the file is included by another one, which may have arguments of its
    own, only those that resemble one of this file are told.
    """
    said = []
    for name in (each.partition(':=')[0] for each in typed if ':=' in each):
        nearest = get_close_matches(name, own, 1, LIKENESS)
        if name not in own and (len(nearest) > 0 or not included):
            said.append(f'argument {name} is not known and has no effect: ' + (
                f'did you mean {nearest[0]}?' if len(nearest) > 0 else '--show-args lists all'))
    return said


def parameters(given: Mapping[str, str]) -> dict[str, bool | str | list[str]]:
    """Return the parameters that arguments set; they take precedence over the parameter file."""
    own = {name for name, text in given.items() if text not in ('', AS_IN_FILE)}
    values: dict[str, bool | str | list[str]] = {
        name: switch(given, name) for name in ('use_sim_time', 'autostart') if name in own}
    if 'sources' in own:
        values['sources'] = names = re.findall(r'[^\s,\[\]\'"]+', given['sources'])
        if len(names) == 0:
            raise ConfigError(f'argument sources: expected names, got {given["sources"]!r}')
    values |= {name: given[name] for name in ('state_file', 'compatible') if name in own}
    # not by remaps: one of /odometry/filtered would move the input as well as the output
    return values | {f'{name}.topic': given[name] for name in KNOWN_SOURCES if name in own} | {
        f'outputs.{name}': given[name] for name in OUTPUTS if name in own}


def remappings(given: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the remaps of topics by the arguments, for the node and for RViz."""
    return [(f'/{topic}', topic) for topic in ('tf', 'tf_static') if switch(given, 'remap_tf')]


def display_remappings(given: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the remaps of topics by the arguments for RViz, which has no parameters of them."""
    return remappings(given) + [(topic, given[name]) for name, (topic, *_) in OUTPUTS.items()
                                if given[name] not in ('', AS_IN_FILE)]
