# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of parameters that are not known: which one may have been meant; no ROS."""

from collections.abc import Collection
from difflib import get_close_matches

LIKENESS = 0.7  # from which on one name may be meant by another, as difflib measures it


def explanation(name: str, known: Collection[str], of_sources: Collection[str]) -> str:
    """
    Return what may be wrong with a name that is not known; empty if no other is like it.

    Parameters
    ----------
    known : collection of str, names of all parameters
    of_sources : collection of str
        Names of the parameters that sources can have, without the name of a source.

    """
    source, _, own = name.rpartition('.')
    if source == '' or own not in of_sources:
        return _question(get_close_matches(name, known, 1, LIKENESS))
    if f'{source}.type' in known:
        return f'a source of the type of {source} has none'
    others = [each.removesuffix(f'.{own}') for each in known if each.endswith(f'.{own}')]
    question = _question(
        [f'{other}.{own}' for other in get_close_matches(source, others, 1, LIKENESS)])
    return f'{source} is not in sources' + (question and f'; {question}')


def is_own(name: str, known: Collection[str], of_sources: Collection[str]) -> bool:
    """
    Tell whether a name that is not known is probably meant for this node.

    A file may have parameters for several nodes: those in a group that this node does not have
    are for others, unless they resemble one of its own.

    Parameters
    ----------
    known, of_sources : collection of str, as for `explanation`

    """
    group, dot, _ = name.partition('.')
    return (dot == '' or any(each.startswith(f'{group}.') for each in known)
            or explanation(name, known, of_sources) != '')


def _question(nearest: list[str]) -> str:
    return '' if len(nearest) == 0 else f'did you mean {nearest[0]}?'
