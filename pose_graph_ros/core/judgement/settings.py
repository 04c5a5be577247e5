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
    stated: float = 2.0  # factor on covariances that are stated, which are often too small
    # the same on the sigmas of odometry: what sources show of them depends on what is believed
    odometry_scale: float = 2.0
    # change of the logarithm of a source's factor by one measurement: it remembers about a
    # hundred, so that a fault of a minute hardly changes it
    noise_step: float = 0.03
    most_noise: float = 4.0  # largest factor of a source
    more_of_pose: float = 2.5  # squared distance of a pose, beyond a position's: as few in doubt
    wide_prediction: float = 9.0  # a prediction with so many times the variance begins a new run
    begin_heading: float = 0.2  # sigma of the heading at the begin of a run [rad]
    nowhere: float = 1e6  # variance of a position that is not known [m^2]
    known_before: float = 100.0  # what was in the graph before is a run that lasted so long [s]
    most_runs: int = 24  # that are remembered
    short_lived_ns: int = 30_000_000_000  # runs of few members are forgotten then [ns]
    hopeless_run: float = 50.0  # excess of a believed run's price over that of a hopeless one
    newest: int = 3  # measurements of a source that tell whether it is doubted
    records_near: int = 100  # measurements around one among which one alike is looked for
    most_again: int = 100_000  # measurements that are all judged again at the end

    # --- prices of what may be wrong, in units of chi2
    # one run of wrong measurements or one fault of odometry, and the squared distance from which
    # on a measurement is in doubt: chi2 with 2 degrees of freedom, 99.9 %
    event: float = 13.8
    wrong_rate: float = 0.25  # a second of wrong measurements [1/s]
    longest_wrong: float = 10.0  # time that one of them counts [s]
    fault: float = 20.0  # how far a receiver in a fault is off, about [m]
    slip: float = 1.0  # how far a slip of odometry goes [m]
    slip_heading: float = 0.3  # heading that it leaves unknown [rad]
    slips_rarer: float = 30.0  # slips come in hours, faults of receivers in minutes
    # wheels that spin make the way too long: that the robot moved without them is less likely by
    # so much, once it would be by so far [m]
    unmoved: float = 14.0
    unmoved_way: float = 5.0
    cut_above: float = 6.0  # price above which the run before may have ended with wrong members
    turn_allowed: float = 9.0  # that the direction of a run is off for nothing [sigma^2]
    most_of_turn: float = 40.0  # highest price of it
    turn_after: float = 30.0  # a run must last so long for that, as errors drift as well [s]
    much_less: float = 0.25  # weight of odometry below which it is told as doubted

    # --- runs of measurements
    least_members: int = 3  # of a run that can show a fault of odometry
    # members that may tell the heading anew, and their squared deviation, each, from odometry
    fitted_members: int = 10
    fitted_d2: float = 2.5
    fitted_heading: float = 0.4  # largest sigma of a heading that is told so [rad]
    begin_members: int = 40  # the pose at the begin of a run is estimated from so many, over
    begin_way: float = 50.0  # such a way [m]
    noted_every_ns: int = 3_000_000_000  # time between the states that a run notes [ns]
    noted_ratio: float = 1.4  # ratio of the ages of one's neighbours, below which it is dropped
    noted: int = 20  # states that are kept, which reach back about 7 minutes


BELIEF = BeliefSettings()
