# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What several tools share: topics, parameters and times by their options; progress bars."""

import argparse
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from dataclasses import replace
import math
from pathlib import Path
import sys
import threading
from typing import Any, TypeVar

from pose_graph_ros.adapters import bags
from pose_graph_ros.adapters.parameters import checked, yaml_value
from pose_graph_ros.adapters.sources import source_list, Values
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.judgement.texts import short
from pose_graph_ros.core.quantities import Seconds

DELAY = 0.5  # after which a bar appears [s]
Item = TypeVar('Item')


def wanted_topics(options: argparse.Namespace) -> dict[str, str | None]:
    """Return the topics given by the options, by name of the source; None if not given."""
    return {source: getattr(options, source) for source in bags.OPTIONS}


def parameter_values(options: argparse.Namespace) -> dict[str, Any]:
    """Return all parameters by the options, as the node reads them; raises `ConfigError`."""
    return checked(given_parameters(options))


def given_parameters(options: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters that the options set, not yet checked; raises `ConfigError`."""
    given = _read_file(options.params_file)
    for text in options.param:
        name, separator, value = text.partition(':=')
        if separator == '':
            raise ConfigError(f'--param: expected NAME:=VALUE, got {text!r}')
        try:
            given[name] = yaml_value(value)
        except ValueError as error:
            raise ConfigError(f'--param {name}: {value!r} is not YAML') from error
    return given


def ros_arguments(options: argparse.Namespace) -> list[str]:
    """Return the command line arguments that give the node the same parameters."""
    file = options.params_file
    return ['--ros-args', *([] if file is None else ['--params-file', str(file.resolve())]),
            *(word for text in options.param for word in ('-p', text))]


def _read_file(path: Path | None) -> dict[str, Any]:
    """Return the parameters for the node in a ROS 2 parameter file, if there is one."""
    if path is None:
        return {}
    try:
        content = yaml_value(path.read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise ConfigError(f'{path}: cannot be read as yaml: {bags.one_line(error)}') from error
    given: dict[str, Any] = {}
    for name, section in (content if isinstance(content, Mapping) else {}).items():
        if str(name).rpartition('/')[2] not in ('**', '*', 'pose_graph'):
            continue
        parameters = section.get('ros__parameters') if isinstance(section, Mapping) else None
        if not isinstance(parameters, Mapping):
            raise ConfigError(f'{path}: {name}: expected ros__parameters')
        given.update(_flat(parameters))
    # `ros2 param dump` writes null for what is not set, and what every node has
    return {name: value for name, value in given.items() if value is not None and not (
        name.startswith(('qos_overrides.', 'use_sim_time', 'start_type_description_service')))}


def _flat(tree: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        yield from (_flat(value, f'{prefix}{name}.') if isinstance(value, Mapping)
                    else [(f'{prefix}{name}', value)])


def inputs_of(bag: bags.Bag, options: argparse.Namespace, values: Values,
              hold_out: int = 0, stretch: Seconds | None = None) -> bags.Inputs:
    """Return what is read of a bag by the options; raises `BagError` if that is nothing."""
    limits = [None if seconds is None else bag.start_ns + round(seconds * 1e9)
              for seconds in (options.begin, options.until)]
    length = (bag.end_ns - bag.start_ns) * 1e-9
    if (options.begin or 0.0) >= min(length, math.inf if options.until is None else options.until):
        raise bags.BagError(f'{bag.path}: nothing was recorded between --from and --until; the '
                            f'recording is {max(length, 0.0):.3f} s long')
    inputs = bags.choose_inputs(bag, source_list(values), wanted_topics(options), hold_out,
                              bags.Span(*limits), truth=options.truth if isinstance(
                                  options.truth, str) else None)
    if hold_out == 0 or stretch is None:
        if stretch is not None:
            raise ConfigError('--stretch: expected --hold-out N, which says how many are held out')
        return inputs
    check_stretch(bag.path, stretch, min(length, math.inf if options.until is None else
                                         options.until) - (options.begin or 0.0), hold_out)
    return replace(inputs, stretch=stretch)


def check_stretch(path: str, stretch: Seconds | None, duration: Seconds, parts: int) -> None:
    """Raise `BagError` if stretches are so long that one of the parts would have none."""
    if stretch is not None and stretch > duration / parts:
        raise bags.BagError(
            f'{path}: expected stretches of at most {short(duration / parts)} s, '
            f'as it lasts {short(duration)} s in {parts} parts, got {short(stretch)}')


def watched(items: Iterable[Item], **looks: Any) -> Iterable[Item]:
    """Return the same items, with a bar on standard error if that is a terminal."""
    # a thread is one of several that would draw over each other
    if not sys.stderr.isatty() or threading.current_thread() is not threading.main_thread():
        return items
    from tqdm import tqdm  # noqa: PLC0415  (not needed without a terminal)

    return tqdm(items, leave=False, delay=DELAY, **looks)


def watched_bag(bag: bags.Bag, title: str) -> bags.Bag:
    """Return a bag that shows on a terminal how far its messages have been read."""
    seen = copy(bag)
    seen.watch = lambda messages, total: watched(messages, desc=title, total=total)
    return seen
