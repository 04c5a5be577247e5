# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements in the map as rows of a table, each with the motion since the one before it."""

from collections.abc import Sequence
import math
from typing import Any

from numba import from_dtype, types
import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.compiled.jit import INTEGER, INTEGERS, kernel, NUMBERS, ROWS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.sources.bias import STRETCH

# What a measurement tells a bank: it follows one that decides, and tells nothing; it is the first
# of its source in its period; or it follows one, but counts as evidence of noise.
FOLLOWS, DECIDES, COUNTS = range(3)

# A measurement in the map, and the motion by odometry since the one before it.
MEASURED = np.dtype([
    ('stamp_ns', 'i8'),
    ('id', 'i8'),  # of its factor
    ('source', 'i8'),  # place of its error among those of all sources
    ('node', 'i8'),  # id of the hidden node before it
    ('judged', 'i8'),  # whether its source may be in a fault; others only tell of noise
    ('decides', 'i8'),  # `FOLLOWS`, `DECIDES` or `COUNTS`
    ('gap', 'f8'),  # time since the one of its source before it that decides [s]
    ('offset', 'f8', (3,)),  # pose of what was measured in the node [m, m, rad]
    ('mean', 'f8', (3,)),  # what was measured; of a position, the heading is 0 [m, m, rad]
    # claimed covariance of the position in map axes: xx, xy, yy [m^2]
    ('noise', 'f8', (3,)),
    ('least', 'f8'),  # least white variance of a coordinate to decide by [m^2]
    # variance that the slow error is measured in units of: the claimed one, or its own [m^2]
    ('slow', 'f8'),
    ('heading_variance', 'f8'),  # 0 of a position [rad^2]
    ('motion', 'f8', (3,)),  # from node to node, as odometry says [m, m, rad]
    # covariance of the motion in the frame at its end: what errors of headings make, as the upper
    # triangle, and what they do not, as xx, xy, yy [m^2, m rad, rad^2]
    ('turn', 'f8', (6,)),
    ('way', 'f8', (3,)),
    ('lever', 'f8', (3,)),  # derivative of the motion by the yaw rate [m s, m s, s]
    ('travel', 'f8')])  # length of the motion [m]

Records = npt.NDArray[Any]
TABLE = types.Array(from_dtype(MEASURED), 1, 'C')


def measured(given: Factors, stamps_ns: Sequence[int], ids: Sequence[int],
             least_position: float = BANK.least_sigmas[0]) -> Records:
    """
    Return rows for factors in the map or to biases, but for sources and motions.

    Those that measure no position are left out.
    """
    information, biased = given.information, given.j >= 0
    rows = np.zeros(len(given), MEASURED)
    rows['stamp_ns'], rows['id'], rows['node'] = stamps_ns, ids, given.i
    rows['offset'], rows['mean'] = given.constants[:, :3], given.mean
    rows['offset'][biased, 2] = 0.0
    has_heading = np.where(biased, information[:, 2, 2] > 0.0, given.kind != FactorKind.POSITION)
    placed = information[:, 1, 1] > 0.0
    for n, which in ((2, placed & ~has_heading), (3, placed & has_heading)):
        if not np.any(which):
            continue
        # from the axes of measured poses to those of the map
        turned = se2.adjoint(
            given.mean[which] * (0.0, 0.0, 1.0) * ~biased[which, None])[:, :n, :n]
        noise = turned @ np.linalg.inv(information[which, :n, :n]) @ np.swapaxes(turned, 1, 2)
        rows['noise'][which] = noise[:, (0, 0, 1), (0, 1, 1)]
        if n == 3:
            rows['heading_variance'][which] = np.maximum(
                noise[:, 2, 2] + np.where(
                    biased[which], given.constants[which, 3] / STRETCH, 0.0)**2,
                BANK.least_sigmas[2]**2)
    rows['least'] = least_position**2
    rows['slow'] = np.where(biased, given.constants[:, 2]**2, 0.5 * (
        rows['noise'][:, 0] + rows['noise'][:, 2]))
    return np.asarray(rows[placed])


@kernel(signature=(ROWS, ROWS, INTEGERS, NUMBERS, TABLE, INTEGER, INTEGER, INTEGER))
def join_motions(  # type: ignore[no-untyped-def]
    poses, sums, stamps_ns, errors, table, row, begin, end,
):
    """
    Write into a row the motion along a chain of odometry, between two places in it.

    Poses and sums are those of an `OdometryChain`, stamps those of its nodes; its steps know of
    errors (way, turn, rate, scale) of odometry, which are taken back.
    """
    out = table[row]
    way_factor, turn_factor, rate, length = errors[0], errors[1], errors[2], 1.0 + errors[3]
    x = y = theta = lever_x = lever_y = time = travel = 0.0
    way_xx = way_xy = way_yy = 0.0
    xx = xy = xt = yy = yt = tt = 0.0
    for n in range(begin, end):
        seconds = (stamps_ns[n + 1] - stamps_ns[n]) * 1e-9
        px, py, pt = poses[n + 1, 0], poses[n + 1, 1], poses[n + 1, 2]
        c, s = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        far_x, far_y = px - poses[n, 0], py - poses[n, 1]
        dx, dy = (c * far_x + s * far_y) / length, (c * far_y - s * far_x) / length
        bend = rate * seconds
        turn = factors.wrap(pt - poses[n, 2]) - bend
        c, s = math.cos(0.5 * bend), math.sin(0.5 * bend)
        dx, dy = c * dx + s * dy, c * dy - s * dx
        # the noise of the step, from the axes of the chain to those at its end
        a, b, d, e, f, g = (sums[n + 1, 0] - sums[n, 0], sums[n + 1, 1] - sums[n, 1],
                            sums[n + 1, 2] - sums[n, 2], sums[n + 1, 3] - sums[n, 3],
                            sums[n + 1, 4] - sums[n, 4], sums[n + 1, 5] - sums[n, 5])
        a, b, e = a - 2.0 * py * d + py * py * g, b + px * d - py * f - px * py * g, (
            e + 2.0 * px * f + px * px * g)
        d, f = d - py * g, f + px * g
        c, s = math.cos(pt), math.sin(pt)
        a, b, e = (c * c * a + 2.0 * c * s * b + s * s * e,
                   c * s * (e - a) + (c * c - s * s) * b,
                   s * s * a - 2.0 * c * s * b + c * c * e)
        d, f = c * d + s * f, c * f - s * d
        # what errors of the heading make, and the rest; rounding may leave nothing of it
        g = max(g, 1e-18)
        own_xx, own_xy, own_yy = max(a - d * d / g, 0.0), b - d * f / g, max(e - f * f / g, 0.0)
        # adjoint of the inverse of the step
        c, s = math.cos(turn), math.sin(turn)
        arm_x, arm_y = -c * dy + s * dx, s * dy + c * dx
        nxt, nyt = c * xt + s * yt + arm_x * tt, c * yt - s * xt + arm_y * tt
        nxx = (c * c * xx + 2.0 * c * s * xy + s * s * yy
               + 2.0 * arm_x * (c * xt + s * yt) + arm_x * arm_x * tt)
        nyy = (s * s * xx - 2.0 * c * s * xy + c * c * yy
               + 2.0 * arm_y * (c * yt - s * xt) + arm_y * arm_y * tt)
        nxy = (c * s * (yy - xx) + (c * c - s * s) * xy + arm_y * (c * xt + s * yt)
               + arm_x * (c * yt - s * xt) + arm_x * arm_y * tt)
        xx, xy, yy = (nxx + d * d / g / turn_factor, nxy + d * f / g / turn_factor,
                      nyy + f * f / g / turn_factor)
        xt, yt, tt = nxt + d / turn_factor, nyt + f / turn_factor, tt + g / turn_factor
        way_xx, way_xy, way_yy = (
            c * c * way_xx + 2.0 * c * s * way_xy + s * s * way_yy + own_xx / way_factor,
            c * s * (way_yy - way_xx) + (c * c - s * s) * way_xy + own_xy / way_factor,
            s * s * way_xx - 2.0 * c * s * way_xy + c * c * way_yy + own_yy / way_factor)
        c, s = math.cos(theta), math.sin(theta)
        wx, wy = c * dx - s * dy, s * dx + c * dy
        # a rate turns this step by all of what it has turned before, and by half of its own
        turned = time + 0.5 * seconds
        lever_x, lever_y = lever_x - wy * turned, lever_y + wx * turned
        time += seconds
        x, y, theta = x + wx, y + wy, theta + turn
        travel += math.sqrt(dx * dx + dy * dy)
    out.motion[0], out.motion[1], out.motion[2] = x, y, theta
    out.turn[0], out.turn[1], out.turn[2] = xx, xy, xt
    out.turn[3], out.turn[4], out.turn[5] = yy, yt, tt
    out.way[0], out.way[1], out.way[2] = way_xx, way_xy, way_yy
    out.lever[0], out.lever[1], out.lever[2] = lever_x, lever_y, time
    out.travel = travel


@kernel(signature=(TABLE, INTEGER, INTEGER))
def count(table, first, period_ns):  # type: ignore[no-untyped-def]
    """Write from a row on which rows decide, and how long ago their source decided before."""
    for row in range(first, len(table)):
        one, before = table[row], row - 1
        while before >= 0 and not (
                table[before].source == one.source and table[before].decides == DECIDES):
            before -= 1
        one.gap = (one.stamp_ns - table[max(before, 0)].stamp_ns) * 1e-9
        one.decides = DECIDES
        if before >= 0 and one.stamp_ns // period_ns == table[before].stamp_ns // period_ns:
            one.decides = FOLLOWS
