# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What came of a migration as a parameter file, and as a list of what became of each parameter."""

from collections.abc import Iterator, Sequence
import math
from pathlib import Path
import shlex
import textwrap

import yaml

from pose_graph_ros.cli.migration.engine import Migration
from pose_graph_ros.cli.migration.files import place
from pose_graph_ros.cli.migration.steps import launch_call, steps
from pose_graph_ros.cli.migration.tables import Fate

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
