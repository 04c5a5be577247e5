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


EMPTY_JUDGEMENT: dict[str, Any] = {'closures': {
    'sources': [], 'scales': [], 'rows': [], 'source': [], 'stamps_ns': [],
    'state': {'names': [], 'of': []}, 'since_ns': [], 'decision': {'names': [], 'of': []},
    'distance': []}, 'fixes': {
    'sources': [], 'rows': [], 'edges': [], 'source': [], 'stamps_ns': [], 'believed': [],
    'since_ns': [], 'decision': {'names': [], 'of': []}, 'observed': [], 'distance': [],
    'loosened': [], 'weights': []}, 'odometry': {}}


def with_judgement(members: dict[str, Any]) -> dict[str, Any]:
    """Return the members of a file of version 2 as those of version 3: nothing is judged."""
    upgraded = {'judgement': EMPTY_JUDGEMENT, 'verdicts': {}, **members}
    for name in ('waiting', 'set_aside'):
        edges = upgraded.get(name)
        if isinstance(edges, dict):
            upgraded[name] = {'stamps_ns': [[-1, -1]] * len(edges.get('sources', [])), **edges}
    return upgraded


def with_names(members: dict[str, Any]) -> dict[str, Any]:
    """Return the members of a file of version 1 as those of version 2."""
    upgraded = dict(members)
    for (member, field), names in NUMBERED.items():
        fields = upgraded.get(member)
        if isinstance(fields, dict) and field in fields:
            upgraded[member] = {**fields, field: {'names': list(names), 'of': fields[field]}}
    return upgraded


def with_ids(members: dict[str, Any]) -> dict[str, Any]:
    """Return the members of a file of version 3 as those of version 4."""
    nodes = members.get('nodes')
    if not isinstance(nodes, dict) or 'rows' not in nodes:
        return members
    renamed = {'ids' if name == 'rows' else name: value for name, value in nodes.items()}
    return {**members, 'nodes': renamed}


def without_jumps(members: dict[str, Any]) -> dict[str, Any]:
    """
    Return the members of a file of version 4 as those of version 5.

    Odometry that closures had doubted keeps the weight that it has in the file.
    """
    judgement = members.get('judgement')
    odometry = judgement.get('odometry') if isinstance(judgement, dict) else None
    if not isinstance(judgement, dict) or not isinstance(odometry, dict):
        return members
    kept = {name: odometry[name] for name in odometry.keys() & {'left_sources', 'left'}}
    return {**members, 'judgement': {**judgement, 'odometry': kept}}
