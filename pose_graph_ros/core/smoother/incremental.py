# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The incremental smoother; `docs/solver.md` describes the method."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.optimizer import chi2_of, Status, to_the_end
from pose_graph_ros.core.config import SmootherConfig
from pose_graph_ros.core.exceptions import GraphUpdateError, INTERRUPTED
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Poses
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.graph_update import Gone
from pose_graph_ros.core.smoother import chain, covariances, forgetting, step, tree_update, trial
from pose_graph_ros.core.smoother.covariances import Innovations, innovations
from pose_graph_ros.core.smoother.trial import Trial

# Reason of an update that has failed because it must not fall back to the batch optimiser.
DIVERGED = 'the iterations diverge'


class UpdateResult(NamedTuple):
    """Status and statistics of an update."""

    # CONVERGED; MAX_ITERATIONS if linearization errors above ten budgets remain for the next
    # update; FAILED if the update was rolled back
    status: Status
    reason: str     # of a failure, else empty
    relinearized: int = 0   # constraints and turned clique frames that were linearized again
    eliminated: int = 0     # nodes whose cliques were, summed over the iterations
    visited: int = 0    # cliques that were solved for, summed over the iterations
    iterations: int = 0     # back-substitutions


class Refinement(NamedTuple):
    """What a call of `IncrementalSmoother.refine` has done."""

    finished: bool  # nothing more can be done before the next update
    moved: float    # largest change of a coordinate of a position [m]


class _Editing:
    """Begins an update of a graph, which is rolled back if an exception ends the context."""

    __slots__ = ('_graph',)

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def __enter__(self) -> None:
        self._graph.begin()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._graph.rollback()


_UNIT = np.eye(3)
_EXTENDED_RESULT = UpdateResult(Status.CONVERGED, '', eliminated=1, visited=1, iterations=1)


class IncrementalSmoother:
    """
    Keep the estimate of a growing pose graph at the minimum of chi2, within a budget.

    The cost of an update is proportional to what it changes. Every connected part of the graph
    needs a fixed or an observed node. An update that leaves a node undetermined is rolled back,
    bit for bit. It begins with a graph that the batch optimiser has solved, or an empty one.
    """

    def __init__(self, config: SmootherConfig | None = None, graph: Graph | None = None) -> None:
        self._config = SmootherConfig() if config is None else config
        self.graph = Graph() if graph is None else graph
        """The pose graph; only this object edits it."""
        self._memory = self.graph.memory
        scalars = self._memory['scalars']
        scalars['alpha'] = self._config.alpha
        scalars['budget'] = self._config.budget
        scalars['share'] = self._config.budget_share

    @property
    def poses(self) -> Poses:
        """Estimates of all hidden nodes in the map, as a view that stays current."""
        return self.graph.poses

    def update(self, update: GraphUpdate, *, fall_back: bool = True) -> UpdateResult:
        """
        Return the result of editing the graph and bringing the estimate up to date.

        If the iterations diverge, the whole graph is optimised at once, which takes ten times as
        long as them; without the fallback the result is FAILED with the reason `DIVERGED`, and a
        `trial` can find the optimum part by part. A GraphUpdateError, for a part that does not fit
        the graph, leaves the graph unchanged, as any other exception does.
        """
        with _Editing(self.graph):
            self.graph.apply(update)
            return self._step(step.FIRST, update if fall_back else None)

    def append(self, update: GraphUpdate) -> bool:
        """
        Add rows with weight 0 without a step; tell whether that was possible.

        It is not, and nothing has changed, if the update asks for anything to be eliminated.
        Raises GraphUpdateError as `update` does.
        """
        with _Editing(self.graph):
            self.graph.apply(update)
        if self.graph.has_touched:
            self.graph.rollback()
            return False
        self.graph.commit()
        return True

    def refine(self) -> Refinement:
        """
        Do one iteration from the estimate, which is within a budget of it, to the minimum of chi2.

        The first call after an update solves for all that updates have changed; see `step`.
        After a failure or an interruption the graph is as before, bit for bit. Raises ValueError
        if edits of the graph wait for an update.
        """
        self._require_solved()
        if self.graph.newest_pose < 0:
            return Refinement(finished=True, moved=0.0)
        code = self._refinement_step(tb.REFINEMENT)
        if code in (tree_update.DONE, tree_update.UNFINISHED):
            moved = float(self._memory['scalars']['largest_move'][0])
            return Refinement(finished=code == tree_update.DONE, moved=moved)
        self.interrupt(tb.REFINEMENT, on=False)
        return Refinement(
            finished=code != tree_update.INTERRUPTED or self._memory.interrupted, moved=0.0)

    def _refinement_step(self, heeds: int) -> int:
        """Do an iteration in a transaction; return the code of `step.refine`."""
        self._memory.head[tb.HEEDS] = heeds
        while True:     # each time with more memory
            with _Editing(self.graph):
                code: int = step.refine(self._memory.head)
            if code in (tree_update.DONE, tree_update.UNFINISHED):
                self.graph.commit()
                return code
            self.graph.rollback()
            if code != tree_update.MORE_MEMORY:
                return code
            self._make_room()

    def trial(self, update: GraphUpdate, poses: Poses | None = None) -> Trial:
        """Return a trial of new weights, on a copy; raises ValueError as `refine` does."""
        self._require_solved()
        other = IncrementalSmoother(self._config, Graph(self.graph))
        return Trial(self.graph, other.graph, update,
                     lambda: other._eliminate().status is not Status.FAILED, poses)

    def adopt(self, trial: Trial) -> UpdateResult:
        """
        Replace the graph by the copy of a trial, with all that was added to the graph meanwhile.

        FAILED, and nothing has changed, if the trial has failed or is outdated, or if what was
        added cannot be solved for. The trial must have come to its end, and cannot be used again.
        """
        failed = UpdateResult(Status.FAILED, 'the trial has failed')
        if trial.result is None or trial.result.status is Status.FAILED or trial.is_outdated:
            return failed
        other = IncrementalSmoother(self._config, trial.graph)
        other.graph.begin()
        trial.catch_up()
        result = other._step(step.AFTER_BATCH)
        if result.status is not Status.FAILED:
            self._memory.take(other.graph.memory)
        return result

    def interrupt(self, what: int = tb.REFINEMENT, *, on: bool = True) -> None:
        """
        Let the running or the next `refine` end early, without effect; any thread may call.

        With `ALL` everything that runs or begins fails, at its next clique or iteration, as long
        as that is on.
        """
        self._memory['interrupt'][what] = on

    def extend(self, mean: se2.PoseVector, information: FloatArray,
               weight: float = 1.0) -> UpdateResult:
        """
        Return the result of appending a hidden node to the newest pose by an odometry edge.

        Equal to an update with one hidden node at the pose that odometry predicts and one edge, at
        a fraction of the cost. The information is in the frame of the new node. Raises
        GraphUpdateError as `update` does, and if the graph has no hidden node.
        """
        head = self._memory.head
        try:
            code = chain.extend(head, mean, information, weight)
        except TypeError:
            # the kernel is compiled for contiguous arrays of float64 only
            mean, information = (np.array(argument, dtype=np.float64, order='C')
                                 for argument in (mean, information))
            code = chain.NO_ROOM
        if code == chain.EXTENDED:
            return _EXTENDED_RESULT
        shapes = np.shape(mean), np.shape(information)
        if shapes != ((3,), (3, 3)):
            raise GraphUpdateError(
                f'extend: expected arrays of shapes (3,) and (3, 3), got {shapes}')
        if code == chain.NO_ROOM:
            self.graph.ensure(self.graph.n_nodes + 1, self.graph.n_factors + 1)
            self._make_room()
            return self.extend(mean, information, weight)
        node, last = self.graph.next_ids.node, self.graph.newest_pose
        if last < 0:
            raise GraphUpdateError('extend: expected a graph with a hidden node to go on from')
        return self.update(GraphUpdate(
            hidden=se2.compose(self.graph.poses_of(last), mean)[None],
            factors=Factors([last], [node], mean[None], information[None], [FactorKind.ODOMETRY],
                            [weight])))

    def forget(self, nodes: Collection[int]) -> Gone:
        """
        Take nodes out of the graph; what their constraints say about the others becomes priors.

        The result is that of `marginalize`, with a prior for each connected part of the nodes.
        Constraints that are far from linear are linearized again first, see `linearize`. If the
        nodes are whole subtrees, as the oldest ones of a chain are, nothing else is eliminated,
        and neither the estimate nor any covariance changes; else they are ordered first, in a step
        like that of an update. Raises GraphUpdateError for a node that is not in the graph, for
        the newest pose, and if that step fails; ValueError as `refine` does.
        """
        rows, head = self.linearize(nodes), self._memory.head
        for again in (False, True, True):   # what a step linearizes again may mix others
            with _Editing(self.graph):
                if not forgetting.touch_mixed(head, rows, again):
                    self.graph.rollback()
                    break
                result = self._step(step.FIRST, GraphUpdate())
            if result.status is Status.FAILED:
                raise GraphUpdateError(f'forget: {result.reason}')
        else:
            raise GraphUpdateError('forget: the nodes cannot be ordered first')
        while forgetting.drop(self._memory.head, rows) == tree_update.MORE_MEMORY:
            self._make_room()
        return self.graph.commit()

    def linearize(self, nodes: Collection[int]) -> IntArray:
        """
        Linearize again what an update has left, by an iteration of `refine`, before nodes leave.

        What `forget` makes of them keeps its linearization. Nothing happens if the linearization
        errors of the constraints of the nodes are within the budget of an update that moves them.
        Whoever wants their last estimate asks for it between the two. Returns the rows of the
        nodes, ascending; raises as `forget` does, also if it is interrupted.
        """
        self._require_solved()
        ids, head = np.fromiter(nodes, np.int64, len(nodes)), self._memory.head
        if not (ids[1:] > ids[:-1]).all():
            ids = np.unique(ids)    # takes 20 us
        rows = self.graph.node_rows(ids)
        if (rows < 0).any():
            raise GraphUpdateError(f'forget: no hidden node has id {ids[np.argmin(rows)]}')
        if (rows == head[tb.NEWEST]).any():
            raise GraphUpdateError(f'forget: {self.graph.newest_pose} is the newest pose')
        if forgetting.far_from_linear(head, rows) and (
                self._refinement_step(tb.ALL) == tree_update.INTERRUPTED):
            raise GraphUpdateError(f'forget: {INTERRUPTED}')
        return rows

    def newest_covariance(self) -> se2.Covariance:
        """Return the covariance of the newest pose in map axes."""
        head, out = self._memory.head, np.empty((3, 3))
        newest = int(head[tb.NEWEST])
        if newest < 0 or head[tb.N_TOUCHED] > 0:
            return self.covariance(self.graph.newest_pose)  # raises an error with the cause
        covariances.write_covariance(head, newest, _UNIT, -1, _UNIT, out)
        return out

    def covariance(self, node: int) -> se2.Covariance:
        """
        Return the covariance of a hidden node in map axes.

        Raises ValueError if there is no such node, or edits of the graph are not solved for.
        """
        row, out = self._eliminated([node])[0], np.empty((3, 3))
        covariances.write_covariance(self._memory.head, row, _UNIT, -1, _UNIT, out)
        return out

    def joint_covariance(self, i: int, j: int) -> FloatArray:
        """Return the joint covariance, (6, 6), of two hidden nodes; raises as `covariance`."""
        row_i, row_j = self._eliminated([i, j])
        out = np.empty((6, 6))
        covariances.write_covariance(
            self._memory.head, row_i, np.eye(6, 3), row_j, np.eye(6, 3, -3), out)
        return out

    def covariances(self) -> se2.Covariances:
        """Return those of all hidden nodes; raises as `covariance`."""
        self._require_solved()
        out = np.zeros((self.graph.n_nodes, 3, 3))
        covariances.all_covariances(self._memory.head, out)
        return out

    def innovations(self, edges: Factors) -> Innovations:
        """
        Return by how much edges, not in the graph or with weight 0, disagree with the estimate.

        Raises as `covariance` does.
        """
        return innovations(self._memory.head, edges.renumbered(self._eliminated))

    def _require_solved(self) -> None:
        waiting = int(self._memory.head[tb.N_TOUCHED])
        if waiting > 0:
            raise ValueError(
                f'covariances: expected a graph whose edits have all been solved for, got one '
                f'with {waiting} hidden nodes that wait for the solver')

    def _eliminated(self, nodes: Sequence[int] | IntArray) -> IntArray:
        """Return the rows of hidden nodes in a graph whose edits have all been solved for."""
        self._require_solved()
        rows = self.graph.node_rows(nodes)
        if (rows < 0).any():
            raise ValueError(
                f'covariances: hidden node {nodes[int(np.argmin(rows))]} is not in the graph')
        return rows

    def chi2(self) -> float:
        """Return the energy of all constraints."""
        return chi2_of(self.graph)

    def _eliminate(self) -> UpdateResult:
        """Eliminate what waits, from poses of the batch optimiser."""
        self.graph.begin()
        return self._step(step.AFTER_BATCH)

    def _step(self, entered: int, again: GraphUpdate | None = None) -> UpdateResult:
        """
        Bring the estimate up to date, growing the memory as needed, or roll the update back.

        If the iterations diverge, the batch optimiser begins again with the update, if given.
        """
        head = self._memory.head
        iterations = self._config.max_iterations
        while (code := step.run(head, iterations, entered)) == tree_update.MORE_MEMORY:
            self._make_room()
            entered = step.AFTER_BATCH if entered == step.AFTER_BATCH else step.RESUMED
        if code in (tree_update.DONE, tree_update.UNFINISHED):
            self.graph.commit()
            status = Status.CONVERGED if code == tree_update.DONE else Status.MAX_ITERATIONS
            return UpdateResult(status, '', *head[tb.N_RELINEARIZED:tb.N_ITERATIONS + 1].tolist())
        reason = DIVERGED if code == tree_update.DIVERGED else INTERRUPTED
        if code == tree_update.BAD_PIVOT:
            reason = f'hidden node {self.graph.node_ids[head[tb.BAD_NODE]]} is not determined'
        self.graph.rollback()
        if code == tree_update.DIVERGED and again is not None:
            return self._fall_back_to_batch(again)
        return UpdateResult(Status.FAILED, reason)

    def _make_room(self) -> None:
        """Let the pools and the work space grow to what a kernel needs."""
        memory, head = self._memory, self._memory.head
        floats, integers, work = head[tb.NEED_F:tb.NEED_WORK + 1].tolist()
        memory.ensure('pool_f', floats, keep=int(head[tb.POOL_F_END]))
        memory.ensure('pool_i', integers, keep=int(head[tb.POOL_I_END]))
        memory.ensure('work_f', work)

    def _fall_back_to_batch(self, update: GraphUpdate) -> UpdateResult:
        """
        Restart from the poses that the batch optimiser finds, with all nodes eliminated anew.

        This is done on a copy with the update, which replaces the graph on success.
        """
        other = IncrementalSmoother(self._config, Graph(self.graph))
        solved = to_the_end(trial.solved(other.graph, self.graph.rows(), update))
        if solved.status is not Status.FAILED:
            result = other._eliminate()
            if result.status is not Status.FAILED:
                self._memory.take(other.graph.memory)
                return result
        return UpdateResult(
            Status.FAILED, INTERRUPTED if self._memory.interrupted else
            'the iterations do not converge, and there is no batch solution')
