# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Compile all kernels before the first measurement, or load them from the cache.

Importing this module imports all modules with kernels. Each step runs a small problem through the
public methods of the engine, so that each kernel is compiled for the argument types of later
calls.

Compiling all kernels takes half a minute of processor time. With two processors and a cache on
disk, a second process compiles about half of them.
"""

from collections.abc import Callable, Iterator
import contextlib
import gc
import os
import time

import numpy as np

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch import complex_system, gauss_newton, optimizer
from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.config import SmootherConfig, SolverConfig
from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.tables import Memory
from pose_graph_ros.core.helper_process import end_with_parent, HelperProcess
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample, Position
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.sparse_inverse import all_covariances

# The example is a drive in circles with LAP nodes per lap. STEP is the true motion between two
# nodes and ERROR the error of odometry, both [m, m, rad].
LAP = 12
STEP: FloatArray = np.array([1.0, 0.0, 2.0 * np.pi / LAP])
ERROR: FloatArray = np.array([0.02, -0.01, 0.01])
INFORMATION: FloatArray = np.diag((400.0, 900.0, 2500.0))
# Number of hidden nodes: four laps, so that there are old nodes and new ones.
N_NODES = 4 * LAP
# Function that the helper process calls.
HELPER = (__name__, 'help_along')
# Threshold of the garbage collector while kernels are compiled [objects].
MANY_OBJECTS = 200_000


def warm_up(stopped: Callable[[], bool] = lambda: False) -> float:
    """
    Run all kernels once, on a small problem, and return the duration [s].

    `stopped` is called before each step; the remaining steps are skipped once it returns True.
    """
    start = time.perf_counter()
    with _rare_collections(), contextlib.ExitStack() as stack:
        helper = None
        if _is_worth_a_helper() and not stopped():
            helper = stack.enter_context(HelperProcess(*HELPER))
        for step in STEPS:
            if helper is not None and step in HELPED:
                # a helper that takes twice as long as this process counts as stuck
                helper.wait(time.perf_counter() - start, stopped)
            if stopped():
                break
            step()
    return time.perf_counter() - start


def help_along() -> None:
    """Run the steps of the helper process, which store the kernels in the cache."""
    end_with_parent()
    with _rare_collections():
        for step in HELPERS_STEPS:
            step()


def _is_worth_a_helper() -> bool:
    """Tell whether kernels must be compiled, and there are a cache and two processors."""
    return (len(os.sched_getaffinity(0)) > 1 and jit.can_be_kept()
            and not jit.is_cached(*HELPERS_KERNELS))


@contextlib.contextmanager
def _rare_collections() -> Iterator[None]:
    """Collect garbage rarely, as the compiler creates many objects and keeps most of them."""
    thresholds = gc.get_threshold()
    gc.set_threshold(MANY_OBJECTS)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)


def _chain(config: SmootherConfig | None = None) -> IncrementalSmoother:
    """Return a chain with a fixed first node, and an observed node at every fifth node."""
    smoother, truth = IncrementalSmoother(config), np.zeros(3)
    smoother.update(GraphUpdate(hidden=truth[None], fix=(0,)))
    for k in range(1, N_NODES):
        truth = se2.compose(truth, STEP)
        smoother.extend(STEP + ERROR, INFORMATION, *((truth, INFORMATION) if k % 5 == 0 else ()))
    return smoother


def _closures(node: int) -> Edges:
    """Return loop closures from a node and the next to those of the previous lap."""
    return Edges([node - LAP, node - LAP + 1], [node, node + 1], np.zeros((2, 3)),
                 np.repeat(INFORMATION[None], 2, axis=0), [EdgeKind.LOOP_CLOSURE] * 2)


def _pose_of(node: int) -> ObservedNodes:
    return ObservedNodes(
        [node], [STEP], np.zeros((1, 3)), INFORMATION[None], [ObservedKind.GLOBAL_POSE])


def _with_a_bias(node: int) -> GraphUpdate:
    """Return an update with a bias as node `node + 1`, and a measurement of node 3 with it."""
    return GraphUpdate(
        biases=np.zeros((1, 3)), observed=ObservedNodes(
            [node + 1], None, np.zeros((1, 3)), INFORMATION[None], [ObservedKind.GLOBAL_POSE]),
        edges=Edges([3], [node + 1], STEP[None], INFORMATION[None], [EdgeKind.BIAS],
                    bias=[[0.3, 0.1, 1.0, 0.1]]))


def _update() -> None:
    """Apply each kind of `GraphUpdate`: closures, observed nodes, biases, weights and so forth."""
    # with a small budget, so that constraints are linearised again
    smoother = _chain(SmootherConfig(alpha=1e-6, budget=1e-12, budget_share=1e-12))
    for update in (
            GraphUpdate(edges=_closures(N_NODES - 5)), GraphUpdate(observed=_pose_of(3)),
            _with_a_bias(N_NODES - 1),
            GraphUpdate(weigh_edges={N_NODES - 1: 0.5}, weigh_observed={0: 0.5}),
            GraphUpdate(remove_edges=(N_NODES,), remove_observed=(1,)),
            GraphUpdate(fix=(5,)), GraphUpdate(free=(0, 5)), GraphUpdate()):
        smoother.update(update)
    smoother.chi2()


def _fall_back_to_batch() -> None:
    """Add a loop closure that is so wrong that the smoother optimises the whole graph."""
    _chain().update(GraphUpdate(edges=Edges(
        [2], [N_NODES - 3], [[40.0, -30.0, 2.5]], 1e4 * INFORMATION[None],
        [EdgeKind.LOOP_CLOSURE])))


def _roll_back() -> None:
    """Add a node without constraints, which fails, and continue with another update."""
    smoother = _chain()
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), edges=_closures(N_NODES - 5)))
    smoother.update(GraphUpdate(edges=_closures(N_NODES - 5)))


def _covariances_of_some() -> None:
    smoother = _chain()
    smoother.newest_covariance()
    smoother.covariance(3)
    smoother.joint_covariance(3, N_NODES - 3)


def _covariances_of_all() -> None:
    """Compute the covariances of an empty graph, which needs no smoother."""
    all_covariances(Memory().head, np.zeros((0, 3, 3)))


def _eliminate_nothing() -> None:
    """Order and eliminate an empty graph."""
    head = Memory().head
    gauss_newton.eliminate(head, 0.0)
    symbolic.analyse(head)


def _optimize() -> None:
    """Optimise a whole graph from all starts, without a smoother."""
    graph, last = Graph(), N_NODES - 1
    kinds = [EdgeKind.ODOMETRY] * last
    nodes, truth = np.arange(N_NODES), np.zeros((N_NODES, 3))
    for k in range(1, N_NODES):
        truth[k] = se2.compose(truth[k - 1], STEP)
    graph.apply(GraphUpdate(
        hidden=truth, fix=(0,), edges=Edges(
            nodes[:-1], nodes[1:], np.tile(STEP + ERROR, (last, 1)),
            np.tile(INFORMATION, (last, 1, 1)), kinds)))
    graph.apply(GraphUpdate(edges=_closures(N_NODES - 5), observed=_pose_of(3), free=(0,)))
    optimizer.optimize(graph, SolverConfig())
    optimizer.optimize_from_linear_start(graph, SolverConfig())
    # optimisations call these only if they stall or take many iterations
    right = np.zeros((graph.n_nodes, 3))
    gauss_newton.product_with_step(graph.memory.head, right)
    gauss_newton.chord_step(graph.memory.head, right)


def _drive() -> None:
    """Run the back end with alignment by positions, a late pose and a loop closure."""
    backend, truth = PoseGraphBackend(), np.zeros(3)
    for k in range(1, N_NODES):
        stamp_ns = k * 1_000_000_000
        backend.add_odometry(OdometrySample(stamp_ns, truth))
        backend.add_measurement(
            Position(stamp_ns, 3.0 - truth[:2], 0.01 * np.eye(2), np.zeros(2)), 'position')
        truth = se2.compose(truth, STEP + ERROR)
        backend.update()
        backend.estimate()
    stamp_ns = (N_NODES - LAP) * 1_000_000_000
    pose = np.array([3.0, 3.0, np.pi])
    backend.add_measurement(GlobalPose(stamp_ns, pose, 0.01 * np.eye(3)), 'pose')
    backend.add_measurement(
        LoopClosure(stamp_ns, np.zeros(3), 0.01 * np.eye(3), reference_node=3), 'closure')
    backend.finish()
    backend.update()
    backend.estimate()
    backend.view()


def _optimize_drive() -> None:
    """Run the final optimisation of a drive without measurements in the map."""
    backend = PoseGraphBackend()
    for k in range(1, N_NODES):
        backend.add_odometry(OdometrySample(k * 1_000_000_000, k * STEP))
    backend.add_measurement(LoopClosure(
        5_000_000_000, ERROR, 0.01 * np.eye(3), reference_node=1), 'closure')
    backend.optimize()


# Steps of the warm-up, which can be stopped between two of them.
STEPS: tuple[Callable[[], object], ...] = (
    IncrementalSmoother, _chain, _update, _roll_back, _covariances_of_some, _optimize,
    _covariances_of_all, _fall_back_to_batch, _drive, _optimize_drive)
# Steps whose kernels the helper compiles, and the steps that it runs for this: first those whose
# kernels the smoother uses, too.
HELPED = (_optimize, _covariances_of_all)
HELPERS_STEPS: tuple[Callable[[], object], ...] = (
    _eliminate_nothing, _optimize, _covariances_of_all)
# The largest kernels that the helper compiles; if they are cached, so are all that they call.
HELPERS_KERNELS = (gauss_newton.eliminate, complex_system.solve, all_covariances)
