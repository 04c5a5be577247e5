# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Random poses, information matrices and graphs, and a slow reference of errors and Jacobians.

The reference evaluates one constraint at a time, with 3x3 homogeneous matrices and with the
Jacobians as the source prints them; it shares no code with the package.
"""

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate


def random_poses(rng: np.random.Generator, n: int, spread: float = 5.0) -> FloatArray:
    """Return poses, shape (n, 3), with positions in a square and any heading."""
    return np.column_stack((rng.uniform(-spread, spread, (n, 2)), rng.uniform(-np.pi, np.pi, n)))


def random_information(rng: np.random.Generator, n: int) -> FloatArray:
    """Return well-conditioned anisotropic matrices with correlations, shape (n, 3, 3)."""
    root = rng.uniform(-1.0, 1.0, (n, 3, 3)) + 2.0 * np.eye(3)
    return root @ np.swapaxes(root, 1, 2) * rng.uniform(0.5, 20.0, (n, 1, 1))


def random_edges(rng: np.random.Generator, i: list[int], j: list[int]) -> Factors:
    """Return edges with random means: their errors are large."""
    return Factors(i, j, random_poses(rng, len(i)), random_information(rng, len(i)),
                 [FactorKind.LOOP_CLOSURE] * len(i))


def random_observed(rng: np.random.Generator, node: list[int], *, offset: bool = True) -> Factors:
    """Return observed nodes with random means; every third has no information on the heading."""
    information = random_information(rng, len(node))
    mean = random_poses(rng, len(node))
    information[::3, 2, :] = information[::3, :, 2] = 0.0
    mean[::3, 2] = 0.0
    kind = np.full(len(node), FactorKind.GLOBAL_POSE)
    kind[::3] = FactorKind.POSITION
    offsets = random_poses(rng, len(node), 2.0) if offset else np.zeros((len(node), 3))
    return Factors.on(node, offsets, mean, information, kind)


def random_graph(  # noqa: PLR0917
    seed: int, n_nodes: int = 7, n_edges: int = 12, n_observed: int = 5,
    fix: tuple[int, ...] = (), n_biases: int = 0,
) -> Graph:
    """
    Return a connected graph with duplicate and reversed edges and large errors.

    The biases are the last nodes: a chain whose first bias is observed, with edges from poses, and
    third nodes of odometry.
    """
    rng = np.random.default_rng(seed)
    i, j = list(range(n_nodes - 1)), list(range(1, n_nodes))
    for _ in range(n_edges - len(i)):
        a, b = rng.choice(n_nodes, 2, replace=False).tolist()
        i, j = [*i, a], [*j, b]
    i, j = [*i, i[0], j[0], j[-1]], [*j, j[0], i[0], i[-1]]
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=random_poses(rng, n_nodes), fix=fix, factors=Factors.joined([
            random_edges(rng, i, j),
            random_observed(rng, rng.integers(0, n_nodes, n_observed).tolist())])))
    if n_biases > 0:
        biases = np.arange(n_nodes, n_nodes + n_biases)
        calibrated = random_edges(rng, i[:n_nodes], j[:n_nodes])
        graph.apply(GraphUpdate(
            biases=random_poses(rng, n_biases), factors=Factors.joined([
                random_edges_to_biases(rng, biases[1:], biases[:-1]),
                random_edges_to_biases(rng, rng.integers(0, n_nodes, 3 * n_biases),
                                       rng.choice(biases, 3 * n_biases)),
                calibrated.replaced(
                    kind=np.full(n_nodes, FactorKind.ODOMETRY), k=rng.choice(biases, n_nodes),
                    constants=rng.normal(size=(n_nodes, 4)) * (0.0, 0.0, 0.0, 1.0)),
                random_observed(rng, [0, n_nodes]).rows(slice(1, 2))])))
    return graph


def random_edges_to_biases(rng: np.random.Generator, i: FloatArray, j: FloatArray) -> Factors:
    """Return edges to biases with large errors; every third has no information on the heading."""
    edges, n = random_edges(rng, i, j), len(i)
    edges.information[::3, 2, :] = edges.information[::3, :, 2] = 0.0
    bias = np.column_stack((random_poses(rng, n, 2.0)[:, :2], rng.uniform(0.3, 1.5, (n, 2))))
    return Factors(i, j, edges.mean, edges.information, [FactorKind.BIAS] * n, constants=bias)


def consistent_graph(seed: int, noise: float = 0.0, n_nodes: int = 8) -> Graph:
    """
    Return a graph of odometry and three loop closures that agree but for noise; node 0 is fixed.

    Without noise the poses are the minimum; with noise they are those by odometry alone.
    """
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, n_nodes)
    i = [*range(n_nodes - 1), n_nodes - 1, 0, 2]
    j = [*range(1, n_nodes), 0, n_nodes // 2, n_nodes - 1]
    mean = np.array([vector(np.linalg.inv(matrix(truth[a])) @ matrix(truth[b]))
                     for a, b in zip(i, j, strict=True)])
    mean += noise * rng.standard_normal(mean.shape)
    poses = truth.copy()
    for k in range(1, n_nodes):
        poses[k] = vector(matrix(poses[k - 1]) @ matrix(mean[k - 1]))
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=poses, fix=(0,),
        factors=Factors(i, j, mean, random_information(rng, len(i)),
                        [FactorKind.ODOMETRY] * len(i))))
    return graph


def snapshot(graph: Graph) -> tuple[bytes, ...]:
    """Return all numbers of a graph as bytes, for comparison bit by bit."""
    columns = graph.poses, graph.fixed, *graph.factors.columns
    return tuple(column.tobytes() for column in columns)


def matrix(pose: FloatArray) -> FloatArray:
    """Return the homogeneous 3x3 matrix of one pose."""
    x, y, theta = pose
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def vector(transformation: FloatArray) -> FloatArray:
    """Return the pose of one homogeneous matrix, the heading by arctan2."""
    return np.array([transformation[0, 2], transformation[1, 2],
                     np.arctan2(transformation[1, 0], transformation[0, 0])])


def slow_edge(
    x_i: FloatArray, x_j: FloatArray, z: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the error of one edge as in g2o, and its Jacobians (3.49), (3.50)."""
    error = vector(np.linalg.inv(matrix(z)) @ np.linalg.inv(matrix(x_i)) @ matrix(x_j))
    R_z, R_i = matrix(z)[:2, :2], matrix(x_i)[:2, :2]
    c, s = np.cos(x_i[2]), np.sin(x_i[2])
    dR_i_transposed = np.array([[-s, c], [-c, -s]])
    A, B = np.zeros((3, 3)), np.zeros((3, 3))
    A[:2, :2] = -R_z.T @ R_i.T
    A[:2, 2] = R_z.T @ dR_i_transposed @ (x_j[:2] - x_i[:2])
    A[2, 2] = -1.0
    B[:2, :2] = R_z.T @ R_i.T
    B[2, 2] = 1.0
    return error, A, B


def slow_to_bias(
    x_i: FloatArray, m_j: FloatArray, z: FloatArray, bias: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the error of one edge to a bias and its Jacobians."""
    F = np.diag(bias[[2, 2, 3]])
    error = F @ m_j + z - (matrix(x_i) @ matrix(np.append(bias[:2], 0.0)))[[0, 1, 2], 2]
    error[2] = np.arctan2(*(f(F[2, 2] * m_j[2] + z[2] - x_i[2]) for f in (np.sin, np.cos)))
    c, s = np.cos(x_i[2]), np.sin(x_i[2])
    A = -np.eye(3)
    A[:2, 2] = -np.array([[-s, -c], [c, -s]]) @ bias[:2]
    return error, A, F


def slow_third(z: FloatArray, duration: float) -> FloatArray:
    """Return the Jacobian of the error of one edge by bias of the yaw rate and error of scale."""
    own = np.linalg.inv(matrix(z))[:2, :2] @ z[:2]
    return np.array([[-0.5 * duration * own[1], -own[0], 0.0],
                     [0.5 * duration * own[0], -own[1], 0.0], [duration, 0.0, 0.0]])


def slow_observed(
    x: FloatArray, offset: FloatArray, z: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the error of one observed node and its Jacobian."""
    error = vector(np.linalg.inv(matrix(z)) @ matrix(x) @ matrix(offset))
    R_z = matrix(z)[:2, :2]
    c, s = np.cos(x[2]), np.sin(x[2])
    J = np.zeros((3, 3))
    J[:2, :2] = R_z.T
    J[:2, 2] = R_z.T @ np.array([[-s, -c], [c, -s]]) @ offset[:2]
    J[2, 2] = 1.0
    return error, J


def dense_system(graph: Graph) -> tuple[FloatArray, FloatArray]:
    """Return H, shape (3N, 3N), and b, shape (3N,), of all nodes, fixed or not."""
    H, b = np.zeros((3 * graph.n_nodes,) * 2), np.zeros(3 * graph.n_nodes)
    edges, observed = graph.factors.edges, graph.factors.observed
    of_edges, of_observed = edges.weighted_information, observed.weighted_information
    for k, (i, j) in enumerate(zip(edges.i, edges.j, strict=True)):
        given = graph.poses[i], graph.poses[j], edges.mean[k]
        e, A, B = (slow_to_bias(*given, edges.constants[k]) if edges.kind[k] == FactorKind.BIAS
                   else slow_edge(*given))
        ends = [(i, A), (j, B)]
        if edges.k[k] >= 0:
            ends.append((edges.k[k], slow_third(edges.mean[k], edges.constants[k, 3])))
            e = e + ends[2][1] @ graph.poses[edges.k[k]]
            e[2] = np.arctan2(np.sin(e[2]), np.cos(e[2]))
        for row, J_row in ends:
            b[3 * row:3 * row + 3] += J_row.T @ of_edges[k] @ e
            for column, J_column in ends:
                H[3 * row:3 * row + 3, 3 * column:3 * column + 3] += (
                    J_row.T @ of_edges[k] @ J_column)
    for k, i in enumerate(observed.i):
        e, J = slow_observed(graph.poses[i], observed.offset[k], observed.mean[k])
        b[3 * i:3 * i + 3] += J.T @ of_observed[k] @ e
        H[3 * i:3 * i + 3, 3 * i:3 * i + 3] += J.T @ of_observed[k] @ J
    return H, b


def free_part(graph: Graph, H: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return H and b without the rows and columns of the fixed nodes."""
    free = np.repeat(~graph.fixed, 3)
    return H[np.ix_(free, free)], b[free]


def corridor_graph(seed: int, sigma: float, length: int = 150, width: int = 3) -> Graph:
    """
    Return a graph of lanes beside each other, with measured headings as bad as sigma [rad].

    Node 0 is fixed; each node is connected with its neighbours. The poses are the truth.
    """
    rng = np.random.default_rng(seed)
    lane, column = np.divmod(np.arange(length * width), length)
    truth = np.column_stack((np.where(lane % 2 == 0, column, length - 1 - column), lane,
                             np.where(lane % 2 == 0, 0.0, -np.pi))).astype(np.float64)
    number = {(x, y): k for k, (x, y) in enumerate(truth[:, :2].tolist())}
    pairs = [(k, k + 1) for k in range(len(truth) - 1)]
    pairs += [(k, number[x, y + 1]) for k, (x, y) in enumerate(truth[:, :2].tolist())
              if (x, y + 1) in number and number[x, y + 1] != k + 1]
    i, j = np.array(pairs).T
    sigmas = np.array([0.15, 0.15, sigma])
    mean = se2.wrapped(se2.between(truth[i], truth[j]) + sigmas * rng.standard_normal((len(i), 3)))
    information = np.tile(np.diag(sigmas**-2), (len(i), 1, 1))
    kind = np.where(j - i == 1, FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE)
    graph = Graph()
    graph.apply(GraphUpdate(hidden=truth, factors=Factors(i, j, mean, information, kind), fix=[0]))
    return graph
