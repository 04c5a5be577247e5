# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The measurements of one source in the graph, and what holds each of them."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.odometry.odometry_errors import AS_CLAIMED, OdometryErrors
from pose_graph_ros.core.saved_columns import Integers, Numbers, Pairs, Rows2
from pose_graph_ros.core.sources.error_estimate import LEAST_POSITIONS
from pose_graph_ros.core.sources.gauss_markov import CorrelatedErrors, SavedBins
from pose_graph_ros.core.sources.past_path import PastPath
from pose_graph_ros.core.sources.source_report import SourceReport


@dataclass(frozen=True, slots=True)
class SavedSource:
    """The measurements and constraints of one source."""

    seen_ns: Integers
    """Stamps of all measurements that were received [ns], sorted."""
    seen_references: Integers
    """For each stamp the reference of the loop closure, 0 for others; see `waiting`."""
    rows: Pairs
    """
    Stamp [ns] and id of each constraint, shape (K, 2). The ids are those of edges if a bias with
    a given correlation time was estimated, else those of observed nodes.
    """
    n_otherwise: int
    """Number of constraints that were added under other settings."""
    ties: Integers
    """Ids of its edges between hidden nodes, except those of the primary odometry."""
    bins: SavedBins | None
    """States of its bias, if it has one."""
    errors: CorrelatedErrors | None = None
    """Estimated statistics of its errors that are in use; None for white or given ones."""
    noise: Rows2 = field(default_factory=lambda: np.empty((0, 2)))
    """What the motion since the node adds to the variances, or empty; see `motion_noise`."""
    edges: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """With estimated statistics, ids of the edges that hold the measurements, or empty."""
    next_estimate: int = LEAST_POSITIONS
    """Number of measurements at which its errors are estimated next."""
    odometry_scale: float = 1.0
    """In files of older versions, factor on the sigmas of odometry."""
    n_gone: int = 0
    """Number of its measurements that have left the graph."""
    past: PastPath | None = None
    """Their positions, where its errors are estimated."""
    odometry: Numbers = field(default_factory=lambda: np.empty(0))
    """`OdometryErrors` that its measurements show; empty in files of older versions."""


class Held(NamedTuple):
    """The constraint that holds each of some measurements."""

    ids: IntArray
    is_edge: BoolArray


class SourceConstraints:
    """
    The constraints of one source.

    A measurement whose error was found to be correlated keeps its observed node, with weight 0;
    an edge to the bias holds it instead. So it can become white again, or get another bias.
    """

    def __init__(self) -> None:
        self.rows = GrowingArray((2,), np.int64)
        """Stamp [ns] of each measurement, and the id of what it was first added as."""
        self.noise = GrowingArray((2,), np.float64)
        """What the motion since the node adds to its variances; see `motion_noise`."""
        self.edges = GrowingArray((), np.int64)
        """Id of the edge that holds it instead, or -1."""
        self.report: SourceReport | None = None
        """The newest report."""
        self.n_reported = 0
        """Number of measurements when it was made; 0 if none of them was used."""
        self.n_gone = 0
        """Number of measurements that have left the graph."""
        self.past: PastPath | None = None
        """Their positions, where the errors are estimated."""
        self.n_otherwise = 0
        """Constraints of a loaded graph that were added under other settings."""
        self.next_estimate = LEAST_POSITIONS
        """Number of measurements at which the errors are estimated next."""
        self.odometry = AS_CLAIMED
        """Errors of odometry that the measurements show."""

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def n_ever(self) -> int:
        """Number of measurements, with those that have left the graph."""
        return len(self) + self.n_gone

    def leaving(self, edges: IntArray, observed: IntArray, *, added_as_edges: bool) -> BoolArray:
        """
        Return which measurements leave with constraints, shape (K,).

        Parameters
        ----------
        edges, observed : ndarray of int, ids
        added_as_edges : bool, whether the measurements were first added as edges

        """
        return np.asarray(np.isin(self.rows.values[:, 1], edges if added_as_edges else observed))

    def forget(self, gone: BoolArray) -> IntArray:
        """Return the numbers of the measurements that are left, after forgetting the others."""
        kept = np.flatnonzero(~gone)
        if len(kept) < len(self):
            self.n_gone += len(self) - len(kept)
            for column in (self.rows, self.noise, self.edges):
                column.select(kept)
        return kept

    def append(self, stamp_ns: int, number: int, noise: FloatArray, edge: int) -> None:
        """
        Append a measurement.

        Parameters
        ----------
        number : int, id of what it was added as
        noise : ndarray, shape (2,), see `motion_noise`
        edge : int, id of the edge that holds it instead, or -1

        """
        self.rows.append_one((stamp_ns, number))
        self.noise.append_one(noise)
        self.edges.append_one(edge)

    def held(self, which: IntArray) -> Held:
        """Return what holds some measurements, given by their numbers."""
        edges = self.edges.values[which]
        return Held(np.where(edges >= 0, edges, self.rows.values[which, 1]), edges >= 0)

    def used(self, graph: Graph, *, added_as_edges: bool) -> BoolArray:
        """
        Return which measurements have a weight above 0, shape (K,).

        Parameters
        ----------
        added_as_edges : bool, whether the measurements were first added as edges

        """
        held = self.held(np.arange(len(self)))
        is_edge = held.is_edge | added_as_edges
        used = np.empty(len(self), dtype=bool)
        used[is_edge] = graph.edges_at(held.ids[is_edge]).weight > 0.0
        used[~is_edge] = graph.observed_at(held.ids[~is_edge]).weight > 0.0
        return used

    def stamp_ns(self, number: int, *, edge: bool, added_as_edges: bool) -> int | None:
        """
        Return the stamp of the measurement that a constraint holds [ns], or None.

        Parameters
        ----------
        number : int, id
        edge : bool, whether it is that of an edge
        added_as_edges : bool, whether the measurements were first added as edges

        """
        if edge is added_as_edges:
            # ids are appended in increasing order
            at = int(np.searchsorted(self.rows.values[:, 1], number))
            found = at < len(self.rows) and self.rows.values[at, 1] == number
            return int(self.rows.values[at, 0]) if found else None
        if not edge:
            return None
        found_at = np.flatnonzero(self.edges.values == number)
        return int(self.rows.values[found_at[0], 0]) if len(found_at) > 0 else None

    def restore(self, saved: SavedSource) -> None:
        """Restore saved measurements."""
        n = len(saved.rows)
        self.rows.append(saved.rows)
        self.noise.append(saved.noise if len(saved.noise) == n else np.zeros((n, 2)))
        self.edges.append(saved.edges if len(saved.edges) == n else np.full(n, -1))
        self.n_gone, self.past = saved.n_gone, saved.past
        if self.past is not None and len(self.past.lever) == 0:
            self.past = None    # of an older version, which knew less of odometry
        self.next_estimate = saved.next_estimate
        self.odometry = (OdometryErrors(*saved.odometry.tolist()) if len(saved.odometry) > 0
                         else OdometryErrors.scaled(saved.odometry_scale))
