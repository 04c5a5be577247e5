# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers by which constraints are judged."""

from dataclasses import dataclass
import math


@dataclass(frozen=True, slots=True)
class BeliefSettings:
    """Meaning and unit of each number stand beside it."""

    # --- tests of loop closures
    # tests in a part of the work, of new closures before an update, and in one after it: without
    # closures the tree is as deep as the path is long, and so is what a test has to solve for
    tests_in_part: int = 32
    tests_of_new: int = 32
    tests_in_update: int = 16
    nodes_in_part: int = 160_000  # most nodes times tests in a part
    # nodes above which an update adds closures with weight 0 and leaves all tests to the work
    # after it, so that it has nothing to solve for but what is new
    large: int = 500
    leaving_rounds: int = 4  # rounds of tests of closures that leave the graph
    most_turns: int = 2  # times that one is thrown out before it waits for the next one to come
    # the graph has to grow by this share, and by so many nodes, before the next test of a closure
    # that an update has diverged with
    rest_share: float = 0.1
    least_rest: int = 10

    # --- when a closure is believed
    # least sigmas to decide by, as claimed covariances are mostly too small [m, m, rad]
    closure_floors: tuple[float, float, float] = (0.3, 0.3, 0.05)
    clique: int = 3  # members of a clique that supports it
    clique_travel: float = 1.0  # way from the first to the last of them [m]
    near: float = 10.0  # closures are neighbours if both ends are so near along the path [m]
    most_compared: int = 40  # neighbours that one is compared with
    most_in_clique: int = 12
    wrong_odds: float = 0.02  # largest odds that one is wrong which is believed alone
    weak_chance: float = 0.02  # a random one passes: above, a lone one is only believed weakly
    narrow_chance: float = 1e-3  # below, several are believed at once, as none moves the others

    # --- memory of closures that are not believed
    most_waiting: int = 20_000  # of a source that are judged again
    left_waiting: int = 18_000  # of these, when there are more
    hopeless_closure: float = 10.0  # squared distance of one that nobody supports [gates]
    most_changes: int = 1000  # changes that are kept until they are announced

    # --- what is solved on a copy
    pause: float = 0.02  # growth of the graph until the next trial, as a share of it
    small: int = 100  # nodes up to which there is no pause: all is solved for in milliseconds
    search_again: float = 0.2  # growth until the next search of another set

    # --- the best set of closures of a whole graph
    most_at_end: int = 30_000  # nodes and closures above which the set is only improved
    retests_at_end: int = 3  # so often
    # entries of the factorisation with all closures, per node: above, some must be wrong
    most_numbers: int = 400

    # --- the surest closures first
    round_factor: float = 4.0  # volumes up to this times the smallest one count as equal
    most_rounds: int = 200
    thrown_out: int = 2  # times after which one is doubted
    # limits are lowered by so many believed closures, and this share of them with its chi2 of
    # three degrees of freedom; they stay above what these show by a factor, and above the least
    limits_from: int = 50
    limits_share: float = 0.9
    limits_chi2: float = 6.25
    limits_margin: float = 3.0
    least_limits: float = 0.02
    # the smallest so many volumes, or this share of them, are looked at before all others
    first_volumes: int = 200
    first_volumes_share: float = 0.125
    # what is not measured of an error could be anything within this [m, m, rad]
    error_extent: tuple[float, float, float] = (100.0, 100.0, 2.0 * math.pi)

    # --- factors on the sigmas of sources of closures
    most_looked_at: int = 100  # closures, while measurements come
    most_looked_at_at_end: int = 1000
    more_believed: float = 0.25  # a source is looked at again with this share more, and
    and_more_believed: int = 5  # so many closures more
    least_shown: int = 10  # closures, or sum of their redundancies, that show anything
    prior_closures: float = 10.0  # closures that a factor of 1 is believed as much as
    most_counted: int = 100  # of those that have left the graph
    place_length: float = 2.0  # closures with both ends in one such stretch are of one place [m]
    scale_steps: int = 50  # to the limits of squares
    scale_rounds: int = 6  # of a whole graph
    largest_scale: float = 10.0
    # ratio of successive factors: few values, so that closures are rarely weighed anew, and the
    # factor does not depend on rounding
    scale_ratio: float = 1.2

    # --- measurements in the map
    newest: int = 3  # measurements of a source that tell whether it is doubted
    records_near: int = 100  # measurements around one among which one alike is looked for

    # squared distance from which on a measurement contradicts others: 99.9 % of chi2
    event: float = 13.8
    much_less: float = 0.25  # weight of odometry below which it is told as doubted

BELIEF = BeliefSettings()
