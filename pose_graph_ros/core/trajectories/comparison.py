# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare one trajectory with a reference, in one call."""

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from pose_graph_ros.core.exceptions import TrajectoryError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.trajectories.association import associate, MAX_DIFFERENCE_NS
from pose_graph_ros.core.trajectories.errors import (
    absolute_errors,
    choose_pairs,
    relative_errors,
    Unit,
)
from pose_graph_ros.core.trajectories.sequence import Key, PoseSequence
from pose_graph_ros.core.trajectories.similarity import fit_similarity, IDENTITY, Similarity
from pose_graph_ros.core.trajectories.statistics import (
    Consistency,
    consistency,
    normalized_squares,
    Statistics,
    summarize,
)

MOST_METRES = 1e12  # beyond this, squares of errors lose all digits


class Alignment(Enum):
    """What an estimate may be moved by before it is compared."""

    NONE = 'none'
    SE2 = 'se2'
    SIM2 = 'sim2'


@dataclass(frozen=True, slots=True)
class Options:
    """How trajectories are compared; the defaults are evo's."""

    alignment: Alignment = Alignment.NONE
    max_difference_ns: int = MAX_DIFFERENCE_NS
    offset_ns: int = 0
    interpolate: bool = False
    delta: float = 1.0
    unit: Unit = Unit.FRAMES
    all_pairs: bool = False
    pairs_from_reference: bool = False


@dataclass(frozen=True, slots=True)
class Comparison:
    """Errors of an estimate; statistics are None where there are no errors."""

    key: Key
    """By what the poses were associated."""
    keys: IntArray
    """Of the associated poses, shape (N,)."""
    reference: FloatArray
    """Associated poses of the reference, shape (N, 3) [m, m, rad]."""
    estimate: FloatArray
    """The same of the estimate, aligned."""
    alignment: Similarity
    best_rmse: float
    """Of the positions, if they were aligned by a rigid motion [m]."""
    ate: FloatArray
    """Absolute errors, shape (N, 3), in map axes [m, m, rad]."""
    rpe: FloatArray
    """Relative errors, shape (K, 3) [m, m, rad]."""
    rpe_ends: IntArray
    """Index of the associated pose at the end of each relative error, shape (K,)."""
    nees: dict[str, FloatArray] = field(default_factory=dict)
    """Of `position` and `pose`, shape (N,), if there are covariances; NaN if invalid."""

    def statistics(self) -> dict[str, Statistics | None]:
        """Return those of `ate` and `rpe` [m], `ate_heading` and `rpe_heading` [deg]."""
        rows = {}
        for name, errors in (('ate', self.ate), ('rpe', self.rpe)):
            rows[name] = summarize(np.hypot(errors[:, 0], errors[:, 1]))
            rows[f'{name}_heading'] = summarize(np.rad2deg(np.abs(errors[:, 2])))
        return rows

    def consistency(self) -> dict[str, Consistency | None]:
        """Return that of `position` and `pose`, if there are covariances."""
        return {name: consistency(squares, 2 if name == 'position' else 3)
                for name, squares in self.nees.items()}


def compare(
    reference: PoseSequence, estimate: PoseSequence, options: Options | None = None,
) -> Comparison:
    """
    Return the errors of an estimate against a reference.

    The covariances of the estimate are turned and scaled as it is. Aligned errors are smaller than
    the covariances say, as the alignment takes a part of them away.

    Parameters
    ----------
    options : Options, optional, by default as evo

    Raises
    ------
    TrajectoryError
        If nothing of the two belongs together, or the pairs are not defined.

    """
    options = Options() if options is None else options
    found = associate(reference, estimate, options.max_difference_ns, options.offset_ns,
                      interpolate=options.interpolate)
    for poses in (found.reference, found.estimate):
        if not np.all(np.abs(poses[:, :2]) <= MOST_METRES):
            raise TrajectoryError(f'positions are not finite, or beyond {MOST_METRES:g} m')
    rigid = fit_similarity(found.estimate[:, :2], found.reference[:, :2])
    best = np.linalg.norm((rigid.apply(found.estimate) - found.reference)[:, :2])
    similarity = {
        Alignment.NONE: lambda: IDENTITY, Alignment.SE2: lambda: rigid,
        Alignment.SIM2: lambda: fit_similarity(
            found.estimate[:, :2], found.reference[:, :2], with_scale=True),
    }[options.alignment]()
    moved = replace(
        found, estimate=similarity.apply(found.estimate),
        covariances=None if found.covariances is None
        else similarity.apply_to_covariances(found.covariances))
    ate = absolute_errors(moved.reference, moved.estimate)
    i, j = choose_pairs(moved, options.delta, options.unit, all_pairs=options.all_pairs,
                        of_reference=options.pairs_from_reference)
    rpe = relative_errors(moved.reference, moved.estimate, i, j)
    nees = {}
    if moved.covariances is not None:
        nees = {'position': normalized_squares(ate[:, :2], moved.covariances[:, :2, :2]),
                'pose': normalized_squares(ate, moved.covariances)}
    return Comparison(
        moved.key, moved.keys, moved.reference, moved.estimate, similarity,
        float(best / np.sqrt(len(moved))), ate, rpe, j, nees)
