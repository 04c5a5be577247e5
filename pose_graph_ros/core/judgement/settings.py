# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers by which constraints are judged."""

import math
from typing import NamedTuple

from pose_graph_ros.core.belief.settings import BANK


class BeliefSettings(NamedTuple):
    """Meaning and unit of each number stand beside it."""

    # --- tests of loop closures
    # most tests at once, and most nodes times these: without closures the tree is as deep as the
    # path is long, and so is what a test has to solve for
    tests_in_part: int = 16
    nodes_in_part: int = 160_000
    # nodes above which an update adds closures with weight 0 and leaves all tests to the work
    # after it, so that it has nothing to solve for but what is new
    large: int = 500
    # the graph has to grow by this share, and by so many nodes, before the next test of a closure
    # that was thrown out or that an update has diverged with, and the next solution of a copy
    pause: float = 0.02
    least_rest: int = 10
    small: int = 100  # nodes up to which there is no pause: all is solved for in milliseconds

    # --- when a closure is believed
    # least sigmas to decide by, as claimed covariances are mostly too small [m, m, rad]
    closure_floors: tuple[float, float, float] = BANK.least_sigmas
    clique: int = 3  # members of a clique that supports it
    clique_travel: float = 1.0  # way from the first to the last of them [m]
    near: float = 10.0  # closures are neighbours if both ends are so near along the path [m]
    most_compared: int = 20  # neighbours that one is compared with
    # largest odds that one is wrong which is believed alone; if a random one passes more often,
    # a lone one is only believed weakly
    wrong_odds: float = 0.02

    # --- memory
    most_waiting: int = 20_000  # closures of a source that are not believed, and judged again
    most_changes: int = 1000  # changes that are kept until they are announced

    # --- the best set of closures of a whole graph
    search_again: float = 0.2  # growth of the graph until the next search, as a share of it
    most_at_end: int = 30_000  # nodes and closures above which the set is only improved
    # entries of the factorisation with a set of closures, per node: above, some must be wrong
    most_numbers: int = 400
    round_factor: float = 4.0  # volumes up to this times the smallest one count as equal
    most_rounds: int = 200  # in which the surest ones are believed
    thrown_out: int = 2  # times after which one is doubted
    # from so many believed closures on, limits are lowered to what 90 % of them show, with a
    # margin
    limits_from: int = 50
    limits_margin: float = 3.0
    least_limits: float = 0.02  # as a share
    first_volumes: int = 200  # the smallest so many volumes are looked at before all others
    # what is not measured of an error could be anything within this [m, m, rad]
    error_extent: tuple[float, float, float] = (100.0, 100.0, 2.0 * math.pi)

    # --- measurements in the map
    newest: int = 3  # measurements of a source that tell whether it is doubted

    # squared distance from which on a measurement contradicts others: 99.9 % of chi2
    event: float = 13.8
    much_less: float = 0.25  # weight of odometry below which it is told as doubted

BELIEF = BeliefSettings()
