# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Saved graphs of older versions.

Version 1 holds losses and kinds as numbers, version 2 holds names. Neither has judgements. In
version 3 the ids of hidden nodes are `rows`. In version 4 loop closures may have doubted odometry.
Up to version 5 closures and fixes have columns of their own in judgements, samples that wait are
columns as well, and edges and observed nodes have ids of their own; those of observed nodes follow
here on those of the edges. Up to version 6 biases of gyroscopes and of other sources are chains of
two kinds, and what waits is in columns with other names. Some files of version 7 hold, as all
before, measurements for the next check of the alignment.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import count
from operator import itemgetter
from typing import Any

import numpy as np

from pose_graph_ros.core.graph.constraints import FactorKind, Factors, full
from pose_graph_ros.core.saved_columns import encoded
from pose_graph_ros.core.sources.gyro import turn
from pose_graph_ros.core.sources.queued import SavedQueue

Json = dict[str, Any]
Moved = Callable[[list[int]], list[int]]  # from ids to new ones
LOSSES = ('none', 'huber', 'cauchy')
EDGES = ('odometry', 'loop_closure', 'bias')
OBSERVED = ('global_pose', 'position', 'heading')
# Names by member and field of the JSON file, in the order of their numbers.
NUMBERED = {
    ('edge_losses', 'losses'): LOSSES, ('observed_losses', 'losses'): LOSSES,
    ('graph', 'edge_kind'): EDGES, ('graph', 'observed_kind'): OBSERVED,
    ('waiting', 'kind'): EDGES, ('set_aside', 'kind'): EDGES}
TURN = ('i', 'j', 'stamp_ns', 'angle', 'variance', 'seconds', 'rest_rate', 'rest_variance')
_EDGES_IN_G2O = ('odometry', 'loop_closure', 'prior')
# Columns of the graph that version 5 has as well.
_KEPT = ('fixed', 'biases', 'bias_values', 'node_ids', 'priors', 'bias_dimensions', 'landmarks')
_NO_NAMES: Json = {'names': [], 'of': []}
# Closures and fixes of versions 3 to 5, where none were judged.
_NONE = defaultdict[str, Any](list, state=_NO_NAMES, decision=_NO_NAMES)


def upgraded(members: Json, version: int) -> Json:
    """Return the members of a file of an older version as those of version 7."""
    for member, name in NUMBERED if version < 2 else ():
        column = {'names': list(NUMBERED[member, name]), 'of': members[member][name]}
        members[member] = {**members[member], name: column}
    if version < 3:
        members = {'judgement': {'closures': _NONE, 'fixes': _NONE, 'odometry': {}},
                   'verdicts': {}, **members}
    if version < 4:
        nodes = members['nodes']
        members['nodes'] = {'ids' if name == 'rows' else name: nodes[name] for name in nodes}
    for stream in members['nodes']['streams'].values() if version < 6 else ():
        _list_samples(stream)
    for gyro in members.get('gyros', {}).values() if version < 6 else ():
        rates = gyro['rates']
        gyro['rates'] = [
            {'stamp_ns': stamp_ns, 'rate': rate, 'variance': variance}
            for stamp_ns, (rate, variance) in zip(
                rates['stamps_ns'], rates['rates'], strict=True)]
        gyro['waiting'] = [
            dict(zip(TURN, (*ends, stamp_ns, *numbers), strict=True))
            for stamp_ns, ends, numbers in zip(
                gyro.pop('waiting_ns'), gyro.pop('waiting_ends'), gyro['waiting'], strict=True)]
    if version < 6:
        members = _with_one_table(members)
    if version < 7:
        members = _with_states(members)
    # measurements for the next check of the alignment, which the judge's bank has now
    members['alignment'] = {name: members['alignment'][name]
                            for name in ('state', 'sigma', 'next_verdict')}
    return members


def _list_samples(stream: Json) -> None:
    """Make one value of the state of odometry at its newest sample, and of each that waits."""
    twists = stream.pop('waiting_twists', ())
    stream['waiting'] = [
        {'stamp_ns': stamp_ns, 'pose': row[:3], 'speed': row[3], 'variance': row[4:]}
        for stamp_ns, row in zip(stream.pop('waiting_ns'), stream['waiting'], strict=True)]
    for sample, twist in zip(stream['waiting'], twists, strict=len(twists) > 0):
        sample['twist'] = twist
    if stream['last'] is None:
        return
    last, (x, y, theta, distance, turn, *variance) = stream['last'], stream['samples'][-1]
    rate = last.pop('rate') or [0.0, 0.0, 0.0, 1e30, 1e30, 1e30, 1e30]
    last['window'] = {
        'speeds': {'velocity': rate[:3], 'recent': rate[3:5], 'greatest': rate[5:]},
        'since_ns': last.pop('since_ns'), 'since': last.pop('since'), 'path': last.pop('way')}
    last['row'] = {
        'stamp_ns': stream['stamps_ns'][-1], 'pose': [x, y, theta], 'distance': distance,
        'turn': turn, 'variance': variance,
        **{name: last.pop(name) for name in ('counted', 'counted_ns', 'held')}}


def _judgement(moved: Moved, closures: Json, fixes: Json, odometry: Json) -> Json:
    """Return judgements as one table of each kind, with the new ids of observed nodes."""
    # odometry that closures had doubted keeps the weight that it has in the file
    held = [number if is_edge else moved([number])[0]
            for number, is_edge in zip(fixes['rows'], fixes['edges'], strict=True)]
    return {
        'closures': {
            **_common(closures, [[n - used - doubted, used, 0, doubted]
                                 for n, used, doubted in closures.get('left', [])]),
            'scales': closures['scales'], 'held': closures['rows'], 'added': closures['rows'],
            'stamps_ns': closures['stamps_ns'], 'state': closures['state']},
        'fixes': {
            **_common(fixes, [[0, n - unused, 0, unused] for n, unused in fixes.get('left', [])]),
            'scales': [1.0] * len(fixes['sources']), 'held': held,
            'added': [number if seen < 0 else moved([seen])[0]
                      for number, seen in zip(held, fixes['observed'], strict=True)],
            'stamps_ns': [[stamp, -1] for stamp in fixes['stamps_ns']],
            'state': {'names': ['doubted', 'believed'], 'of': fixes['believed']}},
        'loosened': fixes['loosened'], 'weights': fixes['weights'],
        'odometry_left': dict(zip(
            odometry.get('left_sources', ()), odometry.get('left', ()), strict=True))}


def _common(old: Json, left: list[list[int]]) -> Json:
    """Return the columns that closures and fixes had in common."""
    # without numbers they are counted from 0 in each source
    counted = defaultdict[int, Iterator[int]](count)
    return {
        **{name: old[name] for name in ('sources', 'source', 'since_ns', 'decision', 'distance')},
        'left': left or [[0] * 4] * len(old['sources']),
        'number': old.get('numbers') or [next(counted[source]) for source in old['source']]}


def _with_one_table(members: Json) -> Json:
    """Return members in which edges and observed nodes have the same ids."""
    rows = members['graph']
    n_edges, n_observed = (len(rows[f'{name}_weight']) for name in ('edge', 'observed'))
    end = rows.get('next_ids') or {'node': None, 'edge': n_edges, 'observed': n_observed}
    first = end['edge']

    def moved(ids: list[int]) -> list[int]:
        return [first + number if number >= 0 else number for number in ids]

    edge_ids, observed_ids = (
        rows.get(f'{name}_ids') or list(range(n))
        for name, n in (('edge', n_edges), ('observed', n_observed)))
    kinds = [rows['edge_kind']['names'][k] for k in rows['edge_kind']['of']]
    given = [row for row, kind in enumerate(kinds) if kind not in {*_EDGES_IN_G2O}]
    n_given, n_on_bias = len(given), len(rows['bias_observed_node'])
    losses = members['observed_losses']
    members = {name: members[name] for name in members
               if name not in {'edge_losses', 'observed_losses'}} | {
        'graph': {name: rows[name] for name in _KEPT if name in rows} | {
            'factor_kind': _joined(rows['edge_kind'], {
                **rows['observed_kind'], 'names': [
                    'node_prior' if name == 'prior' else name
                    for name in rows['observed_kind']['names']]}),
            'factor_weight': rows['edge_weight'] + rows['observed_weight'],
            'others': given + [n_edges + row for row in rows['observed_on_bias']],
            'other_i': rows['bias_edge_i'] + rows['bias_observed_node'],
            'other_j': rows['bias_edge_j'] + [-1] * n_on_bias,
            'other_mean': rows['bias_edge_mean'] + rows['bias_observed_mean'],
            'other_information': rows['bias_edge_information'] + rows['bias_observed_information'],
            'other_constants': rows['bias_edge_bias'] + [
                [*offset, 0.0] for offset in rows['bias_observed_offset']],
            'other_k': (rows.get('bias_edge_k') or [-1] * n_given) + [-1] * n_on_bias,
            'factor_ids': edge_ids + moved(observed_ids)},
        'losses': {
            'losses': _joined(members['edge_losses']['losses'], losses['losses']),
            'rows': members['edge_losses']['rows'] + moved(losses['rows']),
            **{name: members['edge_losses'][name] + losses[name]
               for name in ('thresholds', 'shares')}, 'cursor': 0},
        'judgement': _judgement(moved, **members['judgement']),
        'sources': {name: _of_source(source, moved)
                    for name, source in members['sources'].items()}}
    if end['node'] is not None:
        members['graph']['next_ids'] = {'node': end['node'], 'factor': first + end['observed']}
    return members


def _of_source(source: Json, moved: Moved) -> Json:
    """Return the saved state of a source with the new ids of its observed nodes."""
    bins, stamps_and_ids = source['bins'], source['rows']
    # with a given correlation time measurements are edges
    if bins is None or source.get('errors') is not None:
        stamps_and_ids = [[stamp_ns, *moved([number])] for stamp_ns, number in stamps_and_ids]
    if bins is not None and len(bins['ties']) > 0 and -1 not in bins['ties']:
        bins = {**bins, 'ties': moved(bins['ties'][:1]) + bins['ties'][1:]}
    return {**source, 'rows': stamps_and_ids, 'bins': bins}


def _joined(one: Json, other: Json) -> Json:
    """Return one column of names for two."""
    n = len(one['names'])
    return {'names': one['names'] + other['names'], 'of': one['of'] + [n + k for k in other['of']]}


def _with_states(members: Json) -> Json:
    """Return members with one state of each source, and queues as tables of factors."""
    sources, gyros = members.pop('sources'), members.pop('gyro_biases', {})
    rotations = [queued for name, gyro in members.get('gyros', {}).items()
                 for i, j, stamp_ns, *numbers in map(itemgetter(*TURN), gyro.pop('waiting'))
                 for queued in turn(name, (i, j), stamp_ns, numbers[:3], numbers[3:])]
    for name, more in ('waiting', rotations), ('set_aside', []):
        old = members[name]
        n, kinds = len(old['sources']), old['kind']
        queue = SavedQueue(tuple(old['sources']), Factors(
            old['i'], old['j'], np.reshape(old['mean'], (-1, 3)),
            full(np.reshape(old['information'], (-1, 6))),
            np.array([FactorKind[kinds['names'][k].upper()] for k in kinds['of']], np.uint8)),
            np.reshape(np.array(old.get('stamps_ns', n * [[-1, -1]]), np.int64), (n, 2)),
            np.zeros((n, 2)))
        members[name] = encoded(SavedQueue.of([*queue.queue(), *more]))
    return {**members, 'seen': {name: {
        'stamps_ns': each['seen_ns'], 'references': each['seen_references']}
        for name, each in sources.items()}, 'sources': {
        **{name: _state(**each) for name, each in sources.items()},
        **{name: _state_of_gyro(**each) for name, each in gyros.items()}}}


def _state(*, rows: list[list[int]], ties: list[int], bins: Json | None, **others: Any) -> Json:
    """Return the state of a source of measurements or closures."""
    n, noise, bias = len(rows), others.get('noise', ()), None
    if bins is not None:
        # each edge was that of the state behind it, as seen from the one with the prior
        at = bins['ties'].index(-1) if -1 in bins['ties'] else 0
        bias = _chain(bins, bins['rows'], [-1, *bins['ties'][:at], *bins['ties'][at + 1:]], at)
    return {
        'measured': {
            'stamp_ns': [stamp_ns for stamp_ns, _ in rows], 'id': [number for _, number in rows],
            'held_by': others.get('edges') or n * [-1],
            'noise': noise if len(noise) == n else n * [[0.0, 0.0]]},
        'edges': {'stamp_ns': len(ties) * [-1], 'id': ties}, 'bias': bias,
        **{name: others[name] for name in ('errors', 'n_otherwise', 'n_gone') if name in others}}


def _state_of_gyro(*, ids: list[int], edges: list[list[int]], **bins: Any) -> Json:
    chain = _chain(bins, ids, len(ids) * [-1], 0)
    begins_ns = dict(zip(ids, chain['begins_ns'], strict=True))
    return {
        **_state(rows=[], ties=[], bins=None),
        'edges': {'stamp_ns': [begins_ns[node] for _, node in edges],
                  'id': [number for number, _ in edges]},
        'bias': chain}


def _chain(bins: Json, nodes: list[int], ties: list[int], anchor: int) -> Json:
    return {'begins_ns': [number * bins['width_ns'] for number in bins['numbers']],
            'nodes': nodes, 'ties': ties[:len(nodes)], 'bin_ns': bins['width_ns'],
            'anchor': nodes[anchor] if len(nodes) > 0 else -1}
