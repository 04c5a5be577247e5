# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The incremental smoother: an estimate of all poses that is kept up to date, step by step.

A step costs what it changes. What an edit touches is eliminated again, from there to the root of
the tree of cliques (`elimination`); the solution is passed down as far as values move
(`back_substitution`); what has become wrong by linearization is linearized again
(`relinearization`), and the loop (`step`) goes on until the rest is below a budget. Along a
chain a step is a constant amount of work (`chain`). `docs/solver.md` tells the whole story.
"""

from typing import NamedTuple

from numba import types
import numpy as np

from pose_graph_ros.core import (
    chain,
    gauss_newton,
    marginals,
    rescue,
    se2,
    step,
    tables as tb,
)
from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.config import SmootherConfig
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.graph import Graph, GraphUpdate
from pose_graph_ros.core.jit import compile_only
from pose_graph_ros.core.se2 import FloatArray

NAN = float('nan')


class UpdateResult(NamedTuple):
    """What an update did."""

    status: Status
    """
    CONVERGED; MAX_ITERATIONS if linearization errors above the budget are left over for the next
    update; FAILED if the update was undone.
    """
    reason: str
    """One sentence when the status is FAILED, else empty."""
    relinearized: int
    """Constraints, and turned frames of cliques, that were linearized again."""
    eliminated: int
    """Nodes whose cliques were eliminated again, counted in each iteration."""
    visited: int
    """Cliques that were solved for, counted in each iteration."""
    iterations: int
    chi2: float
    """Energy of the whole graph after the update, if it was asked for, else NaN."""


_ALONG_THE_CHAIN = UpdateResult(Status.CONVERGED, '', 0, 1, 1, 1, NAN)
_NO_POSE: FloatArray = np.zeros(3)
_NO_MATRIX: FloatArray = np.zeros((3, 3))
_EXTEND = (types.int64[::1], types.float64[::1], types.float64[:, ::1], types.float64[::1],
           types.float64[:, ::1], types.boolean)


class IncrementalSmoother:
    """
    Keeps the estimate of a growing pose graph at the minimum of chi2, to a stated tolerance.

    Parameters
    ----------
    config : SmootherConfig

    Notes
    -----
    Every part of the graph must be tied to the map, by a fixed or an observed node. An update that
    would leave a node undetermined is undone, bit for bit.

    """

    def __init__(self, config: SmootherConfig | None = None) -> None:
        self._config = SmootherConfig() if config is None else config
        self.graph = Graph()
        """The pose graph, which only this object edits."""
        self._memory = self.graph.memory
        scalars = self._memory['scalars']
        scalars[tb.SETTING_ALPHA] = self._config.alpha
        scalars[tb.SETTING_BUDGET] = self._config.budget
        scalars[tb.SETTING_SHARE] = self._config.budget_share
        compile_only(chain.extend, _EXTEND)  # `extend` converts other arrays

    @property
    def poses(self) -> FloatArray:
        """Estimates of all hidden nodes in the map, shape (N, 3): a view, always up to date."""
        return self.graph.poses

    def update(self, update: GraphUpdate, *, chi2: bool = False) -> UpdateResult:
        """
        Edit the graph and bring the estimate up to date.

        Parameters
        ----------
        update : GraphUpdate
        chi2 : bool
            Evaluate chi2, which takes time in proportion to the graph.

        Raises
        ------
        GraphUpdateError
            If a part of the update does not fit the graph; as with any other exception, nothing
            has changed then.

        """
        self.graph.begin()
        try:
            self.graph.apply(update)
            result = self._step(step.FIRST)
        except BaseException:
            self.graph.undo()
            raise
        return result._replace(chi2=self.chi2()) if chi2 else result

    def extend(
        self, mean: FloatArray, information: FloatArray,
        observed_mean: FloatArray | None = None, observed_information: FloatArray | None = None,
    ) -> UpdateResult:
        """
        Append a hidden node behind the newest pose, tied by odometry: the step along a chain.

        The same as an update with one hidden node, where odometry puts it, one edge and perhaps
        one observed node, at a fraction of the cost.

        Parameters
        ----------
        mean : ndarray, shape (3,)
            Pose of the new node in the newest one [m, m, rad].
        information : ndarray, shape (3, 3)
        observed_mean : ndarray, shape (3,), optional
            Observed pose of the new node in the map.
        observed_information : ndarray, shape (3, 3), optional

        Raises
        ------
        GraphUpdateError
            As `update`, and if there is no node yet.

        """
        head = self._memory.head
        with_observed = observed_mean is not None
        if observed_mean is None or observed_information is None:
            observed_mean, observed_information = _NO_POSE, _NO_MATRIX
        try:
            code = chain.extend(
                head, mean, information, observed_mean, observed_information, with_observed)
        except TypeError:
            # not the arrays that the kernel is compiled for
            mean, information, observed_mean, observed_information = (
                np.array(argument, dtype=np.float64, order='C')
                for argument in (mean, information, observed_mean, observed_information))
            code = chain.NO_ROOM
        if code == chain.EXTENDED:
            return self._solve_extended() if with_observed else _ALONG_THE_CHAIN
        arguments = (mean, information, observed_mean, observed_information)
        shapes = tuple(np.shape(argument) for argument in arguments)
        if shapes != ((3,), (3, 3), (3,), (3, 3)):
            raise GraphUpdateError(
                f'extend: expected arrays of shapes (3,) and (3, 3), got {shapes}')
        if code == chain.NO_ROOM:
            self.graph.ensure(*(int(count) + 1 for count in head[tb.N_NODES:tb.N_OBSERVED + 1]))
            self._make_room(int(head[tb.POOL_F_END]) + 256, int(head[tb.POOL_I_END]) + 8, 256)
            return self.extend(*(arguments if with_observed else arguments[:2]))
        return self._extend_in_general(arguments, with_observed=with_observed)

    def newest_covariance(self) -> FloatArray:
        """Return the covariance of the newest pose in map axes, shape (3, 3)."""
        covariance = np.empty((3, 3))
        if not marginals.newest_covariance(self._memory.head, covariance):
            # it says what is missing
            return marginals.covariance(self.graph, self.graph.newest_pose)
        return covariance

    def covariance(self, node: int) -> FloatArray:
        """Return the covariance of a hidden node in map axes, shape (3, 3)."""
        return marginals.covariance(self.graph, node)

    def joint_covariance(self, i: int, j: int) -> FloatArray:
        """Return the covariance of two hidden nodes together in map axes, shape (6, 6)."""
        return marginals.joint_covariance(self.graph, i, j)

    def covariances(self) -> FloatArray:
        """Return the covariances of all hidden nodes in map axes, shape (N, 3, 3)."""
        return marginals.covariances(self.graph)

    def chi2(self) -> float:
        """Return the energy of all constraints; takes time in proportion to the graph."""
        gradient = np.empty((self.graph.n_nodes, 3))
        return float(gauss_newton.evaluate(self._memory.head, gradient)[0])

    def _solve_extended(self) -> UpdateResult:
        """Solve after a chain was extended by an observed node, which stays in any case."""
        try:
            result = self._step(step.EXTENDED)
        except BaseException:
            self.graph.undo()
            raise
        return result._replace(status=Status.MAX_ITERATIONS) if result.reason else result

    def _extend_in_general(
        self, arguments: tuple[FloatArray, ...], *, with_observed: bool,
    ) -> UpdateResult:
        mean, information, observed_mean, observed_information = arguments
        node, last = self.graph.n_nodes, self.graph.newest_pose
        if last < 0:
            raise GraphUpdateError('extend: expected a graph with a hidden node to go on from')
        observed = ObservedNodes()
        if with_observed:
            observed = ObservedNodes([node], None, observed_mean[None], observed_information[None],
                                     [ObservedKind.GLOBAL_POSE])
        return self.update(GraphUpdate(
            hidden=se2.compose(self.graph.poses[last], mean)[None],
            edges=Edges([last], [node], mean[None], information[None], [EdgeKind.ODOMETRY]),
            observed=observed))

    def _step(self, entered: int) -> UpdateResult:
        """Bring the estimate up to date, with as much memory as it takes, or undo the update."""
        head = self._memory.head
        code = step.run(head, self._config.max_iterations, entered)
        while code == step.MORE_MEMORY:
            self._make_room(*head[tb.NEED_F:tb.NEED_WORK + 1].tolist())
            entered = step.RESCUED if entered == step.RESCUED else step.RESUMED
            code = step.run(head, self._config.max_iterations, entered)
        if code == step.ASTRAY:
            return self._rescue()
        if code == step.BAD_PIVOT:
            reason = f'hidden node {head[tb.BAD_NODE]} is not determined'
            self.graph.undo()
            return UpdateResult(Status.FAILED, reason, 0, 0, 0, 0, NAN)
        status = Status.CONVERGED if code == step.SETTLED else Status.MAX_ITERATIONS
        relinearized, eliminated, visited, iterations = (
            head[tb.N_RELINEARIZED:tb.N_ITERATIONS + 1].tolist())
        return UpdateResult(status, '', relinearized, eliminated, visited, iterations, NAN)

    def _make_room(self, floats: int, integers: int, work: int) -> None:
        memory, head = self._memory, self._memory.head
        memory.ensure('pool_f', floats, keep=int(head[tb.POOL_F_END]))
        memory.ensure('pool_i', integers, keep=int(head[tb.POOL_I_END]))
        memory.ensure('work_f', work)

    def _rescue(self) -> UpdateResult:
        """
        Start over from the poses that the batch optimiser finds, everything eliminated anew.

        That is done on a copy, which takes the place of this graph if it has worked.
        """
        other = IncrementalSmoother(self._config)
        if rescue.optimize_copy(self.graph, other.graph):
            other.graph.begin()
            result = other._step(step.RESCUED)
            if result.status is not Status.FAILED:
                self.graph.memory = self._memory = other.graph.memory
                return result
        self.graph.undo()
        return UpdateResult(
            Status.FAILED, 'the iterations do not converge, and there is no batch solution',
            0, 0, 0, 0, NAN)
