# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Least squares with a complex unknown for each node against dense matrices."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import random_graph

from pose_graph_ros.core.batch.complex_system import solve, Terms
from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.graph.graph import Graph

seeds = st.integers(0, 2**32 - 1)


def parts(numbers: np.ndarray) -> np.ndarray:
    return np.column_stack((numbers.real, numbers.imag))


def random_terms(graph: Graph, rng: np.random.Generator) -> Terms:
    """Return terms with any weights, also zero, whose factors are rotations."""
    n_edges, n_observed = graph.n_edges, graph.n_observed
    factor = np.exp(1j * rng.uniform(-np.pi, np.pi, n_edges))
    shift, target = (rng.normal(0.0, 3.0, (n, 2)) for n in (n_edges, n_observed))
    weight = rng.choice([0.0, 0.1, 1.0, 30.0], n_edges)
    weight[:graph.n_nodes] = np.maximum(weight[:graph.n_nodes], 0.1)    # still connected
    return Terms(np.column_stack((weight, parts(factor), shift)),
                 np.column_stack((rng.uniform(0.1, 5.0, n_observed), target)),
                 rng.normal(0.0, 3.0, (graph.n_nodes, 2)))


def dense(graph: Graph, terms: Terms) -> np.ndarray:
    m, n = graph.n_edges, graph.n_nodes
    matrix, right = np.zeros((m + graph.n_observed, n), complex), np.zeros(
        m + graph.n_observed, complex)
    for k, (w, f_re, f_im, s_re, s_im) in enumerate(terms.edges.tolist()):
        root = np.sqrt(w)
        matrix[k, graph.edges.j[k]] += root
        matrix[k, graph.edges.i[k]] -= root * complex(f_re, f_im)
        right[k] = root * complex(s_re, s_im)
    for k, (w, g_re, g_im) in enumerate(terms.observed.tolist()):
        matrix[m + k, graph.observed.node[k]] = np.sqrt(w)
        right[m + k] = np.sqrt(w) * complex(g_re, g_im)
    v = terms.known @ np.array([1.0, 1j])
    free = ~graph.fixed
    right -= matrix[:, ~free] @ v[~free]
    v[free] = np.linalg.lstsq(matrix[:, free], right, rcond=None)[0]
    return parts(v)


@given(seeds, st.integers(2, 30), st.integers(0, 40), st.sets(st.integers(0, 1)))
@settings(max_examples=60)
def test_the_solution_is_that_of_dense_least_squares(
    seed: int, n_nodes: int, extra: int, fix: set[int],
) -> None:
    graph = random_graph(seed, n_nodes, n_nodes - 1 + extra, 4, tuple(fix))
    terms = random_terms(graph, np.random.default_rng(seed))
    cliques = symbolic.analyse(graph.memory.head).cliques
    v, bad = solve(graph.memory.head, cliques, terms)
    assert bad == -1
    np.testing.assert_allclose(v, dense(graph, terms), rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(v[graph.fixed], terms.known[graph.fixed])


@pytest.mark.parametrize('n_nodes', [2, 12])
def test_without_anything_that_holds_it_a_node_is_named(n_nodes: int) -> None:
    graph = random_graph(3, n_nodes, n_nodes - 1, 2)
    terms = random_terms(graph, np.random.default_rng(0))
    terms.observed[:, 0] = 0.0
    terms.edges[:, 1:3] = 1.0, 0.0      # any constant can be added
    cliques = symbolic.analyse(graph.memory.head).cliques
    assert 0 <= solve(graph.memory.head, cliques, terms)[1] < n_nodes
