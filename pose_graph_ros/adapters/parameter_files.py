# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter files that have nothing for the node, which rcl passes over in silence; no ROS."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
import re
from typing import Any

import yaml

OPTION, SECTION = '--params-file', 'ros__parameters'


def without_effect(arguments: Sequence[str], node: str) -> Iterator[str]:
    """
    Yield what to say of each parameter file that has no section for a node.

    Parameters
    ----------
    arguments : sequence of str, the command line
    node : str, full name of the node

    """
    for option, name in pairwise(arguments):
        if option != OPTION:
            continue
        try:
            content = yaml.safe_load(Path(name).read_text(encoding='utf-8'))
        except (OSError, ValueError, yaml.YAMLError):
            continue  # what rcl cannot read ends the node
        sections = list(_sections(content))
        if not any(_matches(section, node) for section in sections):
            yield (f'{name} has no effect: it has parameters for '
                   f'{", ".join(sections) or "no node"}, and none for {node}: begin it with '
                   f'{node} or /**')


def _sections(content: Any, name: str = '') -> Iterator[str]:
    """Yield the names of the nodes that have parameters; namespaces may be nested."""
    if isinstance(content, dict):
        for key, inner in content.items():
            if key == SECTION:
                yield name
            else:
                yield from _sections(inner, f'{name}/{str(key).strip("/")}')


def _matches(section: str, node: str) -> bool:
    """Match a name with wildcards as rcl does."""
    pattern = re.escape(section).replace(r'/\*\*', r'(/\w+)*').replace(r'/\*', r'/\w+')
    return re.fullmatch(pattern, node) is not None
