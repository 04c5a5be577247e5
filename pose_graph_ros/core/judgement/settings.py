# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers by which constraints are judged."""

from dataclasses import dataclass
import math


@dataclass(frozen=True, slots=True)
class BeliefSettings:
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
    closure_floors: tuple[float, float, float] = (0.3, 0.3, 0.05)
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
