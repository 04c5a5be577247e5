# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Format the tables of parameters for docs/parameters.md and as a parameter file; no ROS."""

from collections.abc import Iterator

from pose_graph_ros.adapters.parameter_table import (
    Change,
    OF_ALL,
    Parameter,
    PARAMETERS,
    Value,
)
from pose_graph_ros.adapters.parameters import listed_sources, source_parameters, type_parameter
from pose_graph_ros.adapters.sources import KINDS, TYPE

# Examples for lists that are not set by default.
_EXAMPLES = {'datum': '[0.0, 0.0]', 'covariance_override': '[1.0, 0.1]',
             'beacons': '["anchor_1 12.5 -3.0"]'}


def as_yaml() -> str:
    """Return the content of `config/pose_graph_full.yaml`: all parameters with their defaults."""
    lines = ['# All parameters with their defaults. In brackets: unit; range; when it can change.',
             '# Generated from the tables in pose_graph_ros/adapters/parameter_table.py by',
             '# `pose-graph parameters --yaml`. pose_graph.yaml has what most robots need.',
             '/**:', '  ros__parameters:']
    commented: set[str] = set()
    group = ''
    for parameter in PARAMETERS:
        before, (group, _, leaf) = group, parameter.name.rpartition('.')
        if group not in ('', before):
            lines.append(f'    {group}:')
        lines += _entry(parameter, leaf, '    ' if group == '' else '      ', commented)
    for source in listed_sources({}):
        lines.append(f'    {source}:')
        for parameter in source_parameters(source, str(type_parameter(source).default)):
            lines += _entry(parameter, parameter.name.partition('.')[2], '      ', commented)
    return '\n'.join(lines) + '\n'


def _entry(
    parameter: Parameter, leaf: str, indent: str, commented: set[str],
) -> Iterator[str]:
    """Return the lines of one parameter; a comment in `commented` is not repeated."""
    facts = '; '.join(fact for fact in (
        parameter.unit, _range(parameter), parameter.change.value) if fact != '')
    comment = f'{indent}# {parameter.description} [{facts}]'
    if comment not in commented:
        commented.add(comment)
        yield comment
    if parameter.default == []:
        yield f'{indent}# {leaf}: {_EXAMPLES[leaf]}'
    else:
        yield f'{indent}{leaf}: {_yaml(parameter.default)}'


def as_markdown() -> str:
    """Return the table in docs/parameters.md of the parameters of the node."""
    lines = ['| parameter | default | unit | range | changes | description |',
             '|---|---|---|---|---|---|']
    lines += (f'| `{parameter.name}` | {_facts(parameter)}' for parameter in PARAMETERS)
    return '\n'.join(lines) + '\n'


def sources_as_markdown() -> str:
    """Return the table in docs/parameters.md of the parameters of a source."""
    lines = ['| parameter | types | default | unit | range | changes | description |',
             '|---|---|---|---|---|---|---|']
    every = [TYPE, *OF_ALL]
    for kind in KINDS.values():
        every += [each for each in kind.parameters if each not in every]
    lines += (f'| `<source>.{parameter.name}` | {_kinds(parameter)} | {_facts(parameter)}'
              for parameter in every)
    return '\n'.join(lines) + '\n'


def _facts(parameter: Parameter) -> str:
    """Return the columns from the default on."""
    value = '' if parameter.name in ('type', 'topic') else (
        'unset' if parameter.default == [] else _yaml(parameter.default))
    return (f'{value} | {parameter.unit} | {_range(parameter)} | {parameter.change.value} | '
            f'{parameter.description} |')


def _kinds(parameter: Parameter) -> str:
    """Return the names of the kinds of sources that have a parameter."""
    names = [kind.name for kind in KINDS.values() if parameter in kind.parameters]
    return ', '.join(names) or 'all'


def _range(parameter: Parameter) -> str:
    if len(parameter.choices) > 0:
        return ', '.join(parameter.choices)
    return '' if parameter.smallest is None else (
        f'{parameter.smallest:g} to {parameter.largest:g}')


def constraints(parameter: Parameter) -> str:
    """Return what `ros2 param describe` tells of the values that a parameter can have."""
    sizes = ' or '.join(str(size) for size in parameter.sizes if size > 0)
    facts = (
        f'one of: {", ".join(parameter.choices)}' if len(parameter.choices) > 0 else '',
        f'{sizes} numbers' + (', or unset' if 0 in parameter.sizes else '') if sizes else '',
        f'unit: {parameter.unit}' if parameter.unit != '' else '',
        'only while the node is not configured' if parameter.change is Change.UNCONFIGURED else '')
    return '; '.join(fact for fact in facts if fact != '')


def _yaml(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f'[{", ".join(_yaml(item) for item in value)}]'
    return value if isinstance(value, str) and value != '' else repr(value)
