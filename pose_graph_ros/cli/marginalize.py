# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Take hidden nodes out of a graph; what their constraints say about the others remains."""

import argparse
import json
import sys

import numpy as np

from pose_graph_ros.cli import arguments, graph_input
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.graph.constraints import NodeKind
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.io.g2o import write_g2o
from pose_graph_ros.core.marginalization.marginalize import marginalize, standing_for


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    file = graph_input.read(options.graph, options.edge2)
    if options.nodes == arguments.LANDMARKS:
        if len(leaving := np.flatnonzero(file.rows.node_kind == NodeKind.LANDMARK)) == 0:
            raise ConfigError(f'{options.graph}: has no landmarks')
    else:
        leaving = graph_input.rows_of(file.ids, options.nodes, '--nodes')
    if not np.any(np.delete(file.rows.is_pose, leaving)):
        raise ConfigError('--nodes: no pose would be left')
    graph = Graph()
    graph.fill(file.rows)
    before = graph.energies().chi2
    graph.apply(marginalize(graph, file.rows.node_ids[leaving]))
    if len(sizes := [len(prior.nodes) for prior in graph.priors]) > 0 and not options.sparse:
        raise ConfigError(f'{options.graph}: without these nodes there are {len(sizes)} dense '
                          f'priors, the largest one on {max(sizes)} nodes, which g2o does not '
                          'have; --sparse puts edges in their place')
    if len(sizes) > 0:
        rows, without = graph.rows(), Graph()
        without.fill(rows._replace(priors=()))
        without.apply(GraphUpdate(factors=standing_for(rows)))
        graph = without
    if (n_biases := int(np.count_nonzero(graph.is_bias))) > 0:
        print(f'warning: {n_biases} biases are left out of the g2o file; measurements with them '
              'are written as if their errors were white', file=sys.stderr)
    write_g2o(graph, options.out, np.delete(file.ids, leaving))
    n_edges = len(graph.factors.edges)
    n_observed = graph.n_factors - n_edges
    print(json.dumps({
        'file': str(options.out), 'removed_nodes': len(leaving), 'hidden_nodes': graph.n_nodes,
        'edges': n_edges, 'observed_nodes': n_observed, 'dense_priors': len(sizes),
        'largest_dense_prior': max(sizes, default=0), 'chi2_before': before}, indent=2)
        if options.json else
        f'{len(leaving)} hidden nodes removed; {graph.n_nodes} left, with {n_edges} edges and '
        f'{n_observed} observed nodes\n' + (
            f'edges stand for {len(sizes)} dense priors, the largest one on {max(sizes)} nodes\n'
            if len(sizes) > 0 else '') + f'written: {options.out}')
    return 0
