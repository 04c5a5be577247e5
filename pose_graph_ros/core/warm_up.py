# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Compile all kernels before the first measurement, or load them from the cache.

Importing this module imports all modules that hold kernels, so that `jit.registered` is complete.
Each step is a small job for the engine, through its own front doors: what a kernel is called with
is then what it will be called with.

To compile them all takes half a minute of computing. Where there are two processors, and a cache
to meet at, a second process does about half of it.
"""

from collections.abc import Callable, Iterator
import contextlib
import gc
import os
import time

import numpy as np

from pose_graph_ros.core import batch, complex_system, gauss_newton, jit, se2, symbolic
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import SmootherConfig, SolverConfig
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph import Graph, GraphUpdate
from pose_graph_ros.core.helper_process import end_with_parent, HelperProcess
from pose_graph_ros.core.incremental import IncrementalSmoother
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample, Position
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.sparse_inverse import all_covariances
from pose_graph_ros.core.starts import solve_from_two_starts
from pose_graph_ros.core.tables import Memory

# Of a drive in circles, a lap in so many nodes. Odometry is a little wrong, so that there is
# something to correct.
LAP = 12
STEP: FloatArray = np.array([1.0, 0.0, 2.0 * np.pi / LAP])
ERROR: FloatArray = np.array([0.02, -0.01, 0.01])
INFORMATION: FloatArray = np.diag((400.0, 900.0, 2500.0))
# So many laps that there are old nodes and new ones.
N_NODES = 4 * LAP
# What the helper process is to call.
HELPER = (__name__, 'help_along')
MANY_OBJECTS = 200_000


def warm_up(stopped: Callable[[], bool] = lambda: False) -> float:
    """
    Run all kernels once, on a few numbers.

    Parameters
    ----------
    stopped : callable
        Asked before each step; once it says yes, the rest is left out.

    Returns
    -------
    seconds : float
        How long it took [s].

    """
    start = time.perf_counter()
    with _rare_collections(), contextlib.ExitStack() as stack:
        helper = None
        if _is_worth_a_helper() and not stopped():
            helper = stack.enter_context(HelperProcess(*HELPER))
        for step in STEPS:
            if helper is not None and step in HELPED:
                # one that takes twice as long as this process is stuck: its part is done here
                helper.wait(time.perf_counter() - start, stopped)
            if stopped():
                break
            step()
    return time.perf_counter() - start


def help_along() -> None:
    """Do the part of the helper process; what it has compiled is in the cache as soon as it is."""
    end_with_parent()
    with _rare_collections():
        for step in HELPERS_STEPS:
            step()


def _is_worth_a_helper() -> bool:
    """Tell whether there is something to compile, a cache to meet at and a processor to spare."""
    return (len(os.sched_getaffinity(0)) > 1 and jit.can_be_kept()
            and not jit.is_cached(*HELPERS_KERNELS))


@contextlib.contextmanager
def _rare_collections() -> Iterator[None]:
    """Look for cycles seldom: the compiler makes many objects, and keeps most of them."""
    thresholds = gc.get_threshold()
    gc.set_threshold(MANY_OBJECTS)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)


def _chain(config: SmootherConfig | None = None) -> IncrementalSmoother:
    """Return a chain that is held at its first node, and by every fifth."""
    smoother, truth = IncrementalSmoother(config), np.zeros(3)
    smoother.update(GraphUpdate(hidden=truth[None], fix=(0,)))
    for k in range(1, N_NODES):
        truth = se2.compose(truth, STEP)
        smoother.extend(STEP + ERROR, INFORMATION, *((truth, INFORMATION) if k % 5 == 0 else ()))
    return smoother


def _closures(node: int) -> Edges:
    """Return the edges that say that this node and the next are where they were a lap before."""
    return Edges([node - LAP, node - LAP + 1], [node, node + 1], np.zeros((2, 3)),
                 np.repeat(INFORMATION[None], 2, axis=0), [EdgeKind.LOOP_CLOSURE] * 2)


def _pose_of(node: int) -> ObservedNodes:
    return ObservedNodes(
        [node], [STEP], np.zeros((1, 3)), INFORMATION[None], [ObservedKind.GLOBAL_POSE])


def _with_a_bias(node: int) -> GraphUpdate:
    """Return a bias, the node after this one, and an old node that was measured with it."""
    return GraphUpdate(
        biases=np.zeros((1, 3)), observed=ObservedNodes(
            [node + 1], None, np.zeros((1, 3)), INFORMATION[None], [ObservedKind.GLOBAL_POSE]),
        edges=Edges([3], [node + 1], STEP[None], INFORMATION[None], [EdgeKind.BIAS],
                    bias=[[0.3, 0.1, 1.0, 0.1]]))


def _update() -> None:
    """Tie far nodes together, observe an old one, weigh, remove, fix and free."""
    # with hardly any budget, so that something is linearized again
    smoother = _chain(SmootherConfig(alpha=1e-6, budget=1e-12, budget_share=1e-12))
    for update in (
            GraphUpdate(edges=_closures(N_NODES - 5)), GraphUpdate(observed=_pose_of(3)),
            _with_a_bias(N_NODES - 1),
            GraphUpdate(weigh_edges={N_NODES - 1: 0.5}, weigh_observed={0: 0.5}),
            GraphUpdate(remove_edges=(N_NODES,), remove_observed=(1,)),
            GraphUpdate(fix=(5,)), GraphUpdate(free=(0, 5)), GraphUpdate()):
        smoother.update(update, chi2=True)


def _rescue() -> None:
    """Tie far nodes together as they cannot be."""
    _chain().update(GraphUpdate(edges=Edges(
        [2], [N_NODES - 3], [[40.0, -30.0, 2.5]], 1e4 * INFORMATION[None],
        [EdgeKind.LOOP_CLOSURE])))


def _undo() -> None:
    """Add a node that nothing holds, and go on without it."""
    smoother = _chain()
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), edges=_closures(N_NODES - 5)))
    smoother.update(GraphUpdate(edges=_closures(N_NODES - 5)))


def _covariances_of_some() -> None:
    smoother = _chain()
    smoother.newest_covariance()
    smoother.covariance(3)
    smoother.joint_covariance(3, N_NODES - 3)


def _covariances_of_all() -> None:
    """Ask for those of all nodes where there are none: that needs no smoother."""
    all_covariances(Memory().head, np.zeros((0, 3, 3)))


def _eliminate_nothing() -> None:
    """Order and eliminate no node at all, which needs no more than empty tables."""
    head = Memory().head
    gauss_newton.eliminate(head, 0.0)
    symbolic.analyse(head)


def _optimize() -> None:
    """Optimise a whole graph, with damping and without, from all starts; it needs no smoother."""
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
    batch.optimize(graph, SolverConfig(initial_damping=1.0))
    batch.optimize_from_nothing(graph, SolverConfig())
    # without the joint start: it has no kernels, and SciPy can be loaded when it is needed
    solve_from_two_starts(graph, SolverConfig(), batch.optimize, closing=False)
    # only optimisations that stall, or take many iterations, call these
    right = np.zeros((graph.n_nodes, 3))
    gauss_newton.product_with_step(graph.memory.head, right)
    gauss_newton.chord_step(graph.memory.head, right)


def _drive() -> None:
    """Drive the whole engine: align with positions, take what comes late, optimise at the end."""
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


def _close() -> None:
    """Optimise a drive at its end, which nothing ties to the map."""
    backend = PoseGraphBackend()
    for k in range(1, N_NODES):
        backend.add_odometry(OdometrySample(k * 1_000_000_000, k * STEP))
    backend.add_measurement(LoopClosure(
        5_000_000_000, ERROR, 0.01 * np.eye(3), reference_node=1), 'closure')
    backend.optimize()


# Between two of them the warm-up can be stopped.
STEPS: tuple[Callable[[], object], ...] = (
    IncrementalSmoother, _chain, _update, _undo, _covariances_of_some, _optimize,
    _covariances_of_all, _rescue, _drive, _close)
# Those for which the helper compiles, and what it does for them: first what the smoother needs
# too, before this process comes to it. What edits a graph this process has compiled by then.
HELPED = (_optimize, _covariances_of_all)
HELPERS_STEPS: tuple[Callable[[], object], ...] = (
    _eliminate_nothing, _optimize, _covariances_of_all)
# The largest that it compiles: they are kept only with all that they call.
HELPERS_KERNELS = (gauss_newton.eliminate, complex_system.solve, all_covariances)
