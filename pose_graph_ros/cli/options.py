# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics and parameters that the options of several tools give."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from pose_graph_ros.adapters.bag_inputs import OPTIONS
from pose_graph_ros.adapters.bags import one_line
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.core.exceptions import ConfigError

OF_RCLPY = ('qos_overrides.', 'use_sim_time', 'start_type_description_service')
"""What the names of parameters begin with that every node has."""


def wanted_topics(options: argparse.Namespace) -> dict[str, str | None]:
    """Return the topics given by the options, by name of the source; None if not given."""
    return {source: getattr(options, source) for source in OPTIONS}


def parameter_values(
    options: argparse.Namespace, usual: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """
    Return all parameters by the options, as the node reads them; raises `ConfigError`.

    Parameters
    ----------
    usual : mapping, values that replace the node's defaults

    """
    given = {**usual, **({} if options.params_file is None else _read_file(options.params_file))}
    for text in options.param:
        name, separator, value = text.partition(':=')
        if separator == '':
            raise ConfigError(f'--param: expected NAME:=VALUE, got {text!r}')
        try:
            given[name] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f'--param {name}: {value!r} is not YAML') from error
    return checked(given)


def ros_arguments(options: argparse.Namespace) -> list[str]:
    """Return the command line arguments that give the node the same parameters."""
    arguments = ['--ros-args']
    if options.params_file is not None:
        arguments += ['--params-file', str(options.params_file.resolve())]
    for text in options.param:
        arguments += ['-p', text]
    return arguments


def _read_file(path: Path) -> dict[str, Any]:
    """Return the parameters for the node in a ROS 2 parameter file."""
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f'{path}: cannot be read as yaml: {one_line(error)}') from error
    given: dict[str, Any] = {}
    for name, section in (content if isinstance(content, Mapping) else {}).items():
        if str(name).rpartition('/')[2] not in ('**', '*', 'pose_graph'):
            continue
        parameters = section.get('ros__parameters') if isinstance(section, Mapping) else None
        if not isinstance(parameters, Mapping):
            raise ConfigError(f'{path}: {name}: expected ros__parameters')
        _flatten(parameters, '', given)
    # `ros2 param dump` writes null for what is not set
    return {name: value for name, value in given.items()
            if value is not None and not name.startswith(OF_RCLPY)}


def _flatten(tree: Mapping[str, Any], prefix: str, flat: dict[str, Any]) -> None:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            _flatten(value, f'{prefix}{name}.', flat)
        else:
            flat[prefix + name] = value
