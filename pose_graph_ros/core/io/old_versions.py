# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Saved graphs of older versions.

Version 1 holds losses and kinds as numbers, version 2 holds names. Neither has judgements. In
version 3 the ids of hidden nodes are `rows`. In version 4 loop closures may have doubted odometry.
"""

from typing import Any

LOSSES = ('none', 'huber', 'cauchy')
EDGES = ('odometry', 'loop_closure', 'bias')
OBSERVED = ('global_pose', 'position', 'heading')
# Names by member and field of the JSON file, in the order of their numbers.
NUMBERED = {
    ('edge_losses', 'losses'): LOSSES, ('observed_losses', 'losses'): LOSSES,
    ('graph', 'edge_kind'): EDGES, ('graph', 'observed_kind'): OBSERVED,
    ('waiting', 'kind'): EDGES, ('set_aside', 'kind'): EDGES, ('alignment', 'kind'): OBSERVED}
_NO_NAMES: dict[str, list[Any]] = {'names': [], 'of': []}
_EMPTY: dict[str, dict[str, Any]] = {
    'closures': {'state': _NO_NAMES, 'decision': _NO_NAMES, **{name: [] for name in (
        'sources', 'scales', 'rows', 'source', 'stamps_ns', 'since_ns', 'distance')}},
    'fixes': {'decision': _NO_NAMES, **{name: [] for name in (
        'sources', 'rows', 'edges', 'source', 'stamps_ns', 'believed', 'since_ns', 'observed',
        'distance', 'loosened', 'weights')}},
    'odometry': {}}


def upgraded(members: dict[str, Any], version: int) -> dict[str, Any]:
    """Return the members of a file of an older version as those of version 5."""
    for member, name in NUMBERED if version < 2 else ():
        column = {'names': list(NUMBERED[member, name]), 'of': members[member][name]}
        members[member] = {**members[member], name: column}
    if version < 3:
        members = {'judgement': _EMPTY, 'verdicts': {}, **members}
        for name in ('waiting', 'set_aside'):
            members[name] = {'stamps_ns': [[-1, -1]] * len(members[name]['sources']),
                             **members[name]}
    if version < 4:
        nodes = members['nodes']
        members['nodes'] = {'ids' if name == 'rows' else name: nodes[name] for name in nodes}
    if version < 5:
        # odometry that closures had doubted keeps the weight that it has in the file
        odometry = members['judgement']['odometry']
        kept = {name: odometry[name] for name in odometry.keys() & {'left_sources', 'left'}}
        members['judgement'] = {**members['judgement'], 'odometry': kept}
    return members
