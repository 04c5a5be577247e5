# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Check the values of parameters and their changes, say what is wrong with names, and print them all.

`parameter_table` and `sources` say what there is. This module imports no ROS.
"""

from array import array
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
import re
import sys
from typing import Any, cast

import yaml

from pose_graph_ros.adapters import parameter_table as table, sources
from pose_graph_ros.adapters.conversions import datum_of, frame
from pose_graph_ros.adapters.parameter_table import Change, OF_ALL, Parameter, PARAMETERS, Value
from pose_graph_ros.adapters.sources import KINDS, KNOWN_SOURCES, TYPE, Values
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.judgement.texts import shortened

LONGEST_TEXT = 4096  # characters of a text, as of the path of a file
LIKENESS = 0.7  # from which on one name may be meant by another, as difflib measures it
FRAMES = ('map_frame', 'odom_frame', 'base_link_frame')
NOTHING = (None, 'null', 'None')
"""What is not set, as rcl and `ros2 param load` read what `ros2 param dump` has written."""

# Names of sources are prefixes of parameters and of counts in the diagnostics.
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')
_TOPIC = re.compile(r'(~?/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')
_OF_SOURCES = {TYPE.name, *(each.name for kind in KINDS.values()
                            for each in (*OF_ALL, *kind.parameters))}
_TAKEN = {'solver', 'worker', 'tf_static', 'received', 'alignment', 'window', 'thinning',
          'outputs', 'qos_overrides', 'use_sim_time', 'start_type_description_service'} | {
              parameter.name for parameter in PARAMETERS}


def type_parameter(source: str) -> Parameter:
    """Return the parameter with the kind of a source, on which its other parameters depend."""
    kind = KNOWN_SOURCES[source][0].name if source in KNOWN_SOURCES else ''
    return replace(TYPE, name=f'{source}.{TYPE.name}', default=kind)


def source_parameters(source: str, kind: str) -> tuple[Parameter, ...]:
    """Return all parameters of a source with their full names, if it has a kind."""
    of_type = type_parameter(source)
    checked_value(of_type, kind)
    _, topic = KNOWN_SOURCES.get(source, (None, source))
    return of_type, *(replace(each, name=f'{source}.{each.name}', default=(
        topic if each.name == 'topic' else each.default)) for each in (
            *OF_ALL, *KINDS[kind].parameters))


def listed_sources(given: Values) -> list[str]:
    """Return the names of all sources; raises `ConfigError` for equal or bad names."""
    names: list[str] = checked_value(
        PARAMETERS[0], given.get('sources', list(table.DEFAULT_SOURCES)))
    for name in names:
        if _NAME.fullmatch(name) is None or name in _TAKEN:
            raise ConfigError(f'parameter sources: {name!r} cannot be the name of a source; '
                              'expected letters, digits and _, and no reserved name')
    if len(set(names)) < len(names):
        raise ConfigError(f'parameter sources: expected different names, got {list(names)}')
    return sources.source_names(names)


def all_parameters(given: Values) -> tuple[Parameter, ...]:
    """Return the parameters of the node and of the sources in the given parameters."""
    parameters = list(PARAMETERS)
    for source in listed_sources(given):
        kind = type_parameter(source)
        parameters += source_parameters(source, given.get(kind.name, kind.default))
    return tuple(parameters)


def checked(given: Values) -> dict[str, Any]:
    """Return all parameters: the given values, after a check of type and range, or defaults."""
    parameters = all_parameters(given)
    known = {parameter.name for parameter in parameters}
    if len(wrong := [str(unknown(name, known)) for name in sorted(set(given) - known)]) > 0:
        raise ConfigError('; '.join(wrong))
    return {parameter.name: checked_value(parameter, given[parameter.name])
            if parameter.name in given else parameter.default for parameter in parameters}


def unknown(name: str, known: Collection[str]) -> ConfigError:
    """Return the error for a parameter that is not known, with what to do about it."""
    name = shortened(name)
    hint = explanation(name, known) or 'CHANGELOG.rst has those that are gone'
    return ConfigError(f'parameter {name} is not known: {hint}')


def explanation(name: str, known: Collection[str]) -> str:
    """Return what may be wrong with a name that is not known; empty if no other is like it."""
    source, _, own = name.rpartition('.')
    if source == '' or own not in _OF_SOURCES:
        nearest, said = get_close_matches(name, known, 1, LIKENESS), []
    elif f'{source}.type' in known:
        return f'a source of the type of {source} has none'
    else:
        others = [each.removesuffix(f'.{own}') for each in known if each.endswith(f'.{own}')]
        said = [f'{source} is not in sources']
        nearest = [f'{other}.{own}' for other in get_close_matches(source, others, 1, LIKENESS)]
    return '; '.join((*said, *(f'did you mean {each}?' for each in nearest)))


def is_own(name: str, known: Collection[str]) -> bool:
    """
    Tell whether a name that is not known is probably meant for this node.

    A file may have parameters for several nodes: those in a group that this node does not have
    are for others, unless they resemble one of its own.
    """
    group, dot, _ = name.partition('.')
    return (dot == '' or any(each.startswith(f'{group}.') for each in known)
            or explanation(name, known) != '')


def checked_value(parameter: Parameter, value: Any) -> Any:
    """Return the value of a parameter with the type in the table, such as a float for 5."""
    if not isinstance(parameter.default, list):
        return _checked(parameter, parameter.default, value)
    item: Value = '' if parameter.unit == '' else 0.0   # numbers in a list have a unit
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise _wrong(parameter, f'a list of {"names" if item == "" else "numbers"}', value)
    if len(parameter.sizes) > 0 and len(value) not in parameter.sizes:
        sizes = ' or '.join(map(str, parameter.sizes))
        raise _wrong(parameter, f'{sizes} numbers [{parameter.unit}]', list(value))
    return [_checked(parameter, item, each) for each in value]


def _checked(parameter: Parameter, default: Value, value: Any) -> Value:
    """Return a value, or one of a list, with the type of a default."""
    if isinstance(default, float):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise _wrong(parameter, 'a number', value)
        low = -sys.float_info.max if parameter.smallest is None else parameter.smallest
        high = sys.float_info.max if parameter.largest is None else parameter.largest
        if not low <= value <= high:
            raise _wrong(parameter, 'a finite number' if parameter.smallest is None
                         else f'a number in [{low:g}, {high:g}]', value)
        return float(value)
    if type(value) is not type(default):
        raise _wrong(parameter, type(default).__name__, value)
    if isinstance(value, str) and (len(value) > LONGEST_TEXT or '\0' in value):
        raise _wrong(parameter, f'at most {LONGEST_TEXT} characters without NUL', value)
    if len(parameter.choices) > 0 and value not in parameter.choices:
        raise _wrong(parameter, f'one of {", ".join(parameter.choices)}', value)
    is_topic = parameter.name.endswith('.topic') or parameter.name.startswith('outputs.')
    if is_topic and _TOPIC.fullmatch(str(value)) is None:
        raise _wrong(parameter, 'the name of a topic', value)
    return cast('Value', value)


def _wrong(parameter: Parameter, expected: str, value: object) -> ConfigError:
    return ConfigError(f'parameter {parameter.name}: expected {expected}, got '
                       + (f'{shortened(value)!r}' if isinstance(value, str) else
                          shortened(repr(value))))


def plain(value: Any) -> Any:
    """Return the value of a ROS parameter with an array as a list."""
    return list(value) if isinstance(value, array | tuple) else value


def is_same(one: Any, other: Any) -> bool:
    """Tell whether two plain values are equal as parameters: 5 and 5.0 are, 1 and True are not."""
    return bool(one == other) and isinstance(one, bool) == isinstance(other, bool)


def changed(values: Values, wanted: Values, *, configured: bool) -> dict[str, Any]:
    """
    Return all parameters with some of them changed, after all checks.

    None and an empty list unset a parameter that can be unset, and each can be set to the value
    that it has. Some can only be changed before the node is configured.
    """
    parameters = {parameter.name: parameter for parameter in all_parameters(values)}
    new = {name: values.get(name, parameter.default) for name, parameter in parameters.items()}
    for name, value in wanted.items():
        if name not in parameters:
            raise unknown(name, parameters)
        parameter = parameters[name]
        good = checked_value(parameter, [] if value is None and parameter.default == [] else value)
        if good == new[name]:
            continue
        if parameter.change is Change.START:
            raise ConfigError(f'parameter {name} is read at the start: give it in a parameter '
                              f'file or by -p {name}:=..., and start the node again')
        if parameter.change is Change.UNCONFIGURED and configured:
            raise ConfigError(f'parameter {name} is taken when the node is configured: '
                              '`ros2 lifecycle set` it to deactivate and cleanup, change it, and '
                              'configure it again')
        new[name] = good
    return checked_together(new)


def checked_together(given: Values) -> dict[str, Any]:
    """Return all parameters as `checked`, after a check of conditions on more than one."""
    values = checked(given)
    frames = [frame(values[name]) for name in FRAMES]
    if '' in frames:
        raise ConfigError(f'parameter {FRAMES[frames.index("")]}: expected the name of a frame, '
                          "got ''")
    if len(set(frames)) < len(frames):
        raise ConfigError(f'parameters {", ".join(FRAMES)}: expected three different names, got '
                          f'{", ".join(map(repr, frames))}')
    datum_of(values)
    sources.backend_config(values)
    return values


def yaml_value(text: str) -> Any:
    """Return what a text in YAML says, whose tree is as large as its text; or raise ValueError."""
    depth = 0
    try:
        for event in yaml.parse(text):
            depth += (isinstance(event, yaml.CollectionStartEvent)
                      - isinstance(event, yaml.CollectionEndEvent))
            if depth > 50 or isinstance(event, yaml.AliasEvent):
                raise ValueError(
                    'too deep, or an alias, which rcl does not read: write what it is of')
        return yaml.safe_load(text)
    except Exception as error:  # the parser can raise anything
        raise ValueError(' '.join(str(error).split())) from error


def without_effect(arguments: Sequence[str], node: str) -> Iterator[str]:
    """Yield what to say of each parameter file that has no section for a node."""
    for option, name in pairwise(arguments):
        if option != '--params-file':
            continue
        try:
            content = yaml_value(Path(name).read_text(encoding='utf-8'))
        except (OSError, ValueError):
            continue  # what rcl cannot read ends the node
        sections = list(_sections(content))
        # with wildcards as rcl matches them
        if not any(re.fullmatch(re.escape(section).replace(r'/\*\*', r'(/\w+)*').replace(
                r'/\*', r'/\w+'), node) for section in sections):
            yield (f'{name} has no effect: it has parameters for '
                   f'{", ".join(sections) or "no node"}, and none for {node}: begin it with '
                   f'{node} or /**')


def _sections(content: Any, name: str = '') -> Iterator[str]:
    """Yield the names of the nodes that have parameters; namespaces may be nested."""
    if isinstance(content, dict):
        for key, inner in content.items():
            if key == 'ros__parameters':
                yield name
            else:
                yield from _sections(inner, f'{name}/{str(key).strip("/")}')


# --- the tables as text

# Examples for lists that are not set by default.
_EXAMPLES = {'datum': '[0.0, 0.0]', 'covariance_override': '[1.0, 0.1]',
             'beacons': '["anchor_1 12.5 -3.0"]'}


def as_yaml() -> str:
    """Return the content of `config/pose_graph_full.yaml`: all parameters with their defaults."""
    lines = ['# All parameters with their defaults. In brackets: unit; range; when it can change.',
             '# Generated from the tables in pose_graph_ros/adapters/parameter_table.py by',
             '# `pose-graph parameters --yaml`. pose_graph.yaml has what most robots need.',
             '/**:', '  ros__parameters:']
    group = ''
    for parameter in all_parameters({}):
        before, (group, _, leaf) = group, parameter.name.rpartition('.')
        if group not in ('', before):
            lines.append(f'    {group}:')
        indent = '    ' if group == '' else '      '
        facts = '; '.join(filter(None, (
            parameter.unit, _range(parameter), parameter.change.value)))
        comment = f'{indent}# {parameter.description} [{facts}]'
        # the same one is not repeated
        lines += [] if comment in lines else [comment]
        lines.append(f'{indent}# {leaf}: {_EXAMPLES[leaf]}' if parameter.default == [] else
                     f'{indent}{leaf}: {yaml_text_of(parameter.default)}')
    return '\n'.join(lines) + '\n'


def as_markdown() -> str:
    """Return the tables in docs/parameters.md: of the node's parameters, and of a source's."""
    every = [TYPE, *OF_ALL]
    for kind in KINDS.values():
        every += [each for each in kind.parameters if each not in every]
    head = 'default | unit | range | changes | description |'
    lines = [f'| parameter | {head}', '|---|---|---|---|---|---|',
             *(f'| `{each.name}` | {_facts(each)}' for each in PARAMETERS), '',
             f'| parameter | types | {head}', '|---|---|---|---|---|---|---|']
    for each in every:
        kinds = [kind.name for kind in KINDS.values() if each in kind.parameters]
        lines.append(f'| `<source>.{each.name}` | {", ".join(kinds) or "all"} | {_facts(each)}')
    return '\n'.join(lines) + '\n'


def _facts(parameter: Parameter) -> str:
    """Return the columns from the default on."""
    value = '' if parameter.name in ('type', 'topic') else (
        'unset' if parameter.default == [] else yaml_text_of(parameter.default))
    return (f'{value} | {parameter.unit} | {_range(parameter)} | {parameter.change.value} | '
            f'{parameter.description} |')


def _range(parameter: Parameter) -> str:
    return ', '.join(parameter.choices) if parameter.smallest is None else (
        f'{parameter.smallest:g} to {parameter.largest:g}')


def constraints(parameter: Parameter) -> str:
    """Return what `ros2 param describe` tells of the values that a parameter can have."""
    sizes = ' or '.join(str(size) for size in parameter.sizes if size > 0)
    return '; '.join(filter(None, (
        f'one of: {", ".join(parameter.choices)}' if len(parameter.choices) > 0 else '',
        f'{sizes} numbers' + (', or unset' if 0 in parameter.sizes else '') if sizes else '',
        f'unit: {parameter.unit}' if parameter.unit != '' else '', 'only while the node is not '
        'configured' if parameter.change is Change.UNCONFIGURED else '')))


def _is_plain(text: str) -> bool:
    """Return whether YAML takes a text for itself, also in a list, without quotes."""
    with suppress(ValueError):
        return bool(yaml_value(f'[{text}]') == [text])
    return False


def yaml_text_of(value: Value) -> str:
    """Return the value of a parameter as YAML."""
    if isinstance(value, list | tuple):
        return f'[{", ".join(map(yaml_text_of, value))}]'
    if isinstance(value, str):
        return value if _is_plain(value) else "'" + value.replace("'", "''") + "'"
    text = repr(value)
    return text.lower() if isinstance(value, bool) else (   # YAML takes 1e-05 for a text
        text.replace('e', '.0e') if isinstance(value, float) and '.' not in text else text)
