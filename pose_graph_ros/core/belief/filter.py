# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The Kalman filter of one hypothesis, along odometry, from one measurement to the next.

Its states are

    x, y, theta      pose of the robot in the map
    w, k             constant errors of the yaw rate and of the scale of odometry
    b_x, b_y         of each source, the slow part of its error

The slow part of a good source is a Gauss-Markov process with a variance in units of the claimed
one; in a fault it stays what it is, but for a random walk.
"""

import math

from numba import from_dtype, types
import numpy as np

from pose_graph_ros.core.belief.rows import TABLE
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.compiled.jit import INTEGER, kernel, NUMBER, NUMBERS
from pose_graph_ros.core.graph import factors

LOG_2PI = math.log(2.0 * math.pi)

# States of the filter after the pose, and the first error of a source.
RATE, SCALE, ERROR = 3, 4, 5
N_STATES = ERROR + 2 * BANK.sources

# Noise of odometry and of sources, in units of what they claim; the time constant in seconds.
NOISE = np.dtype([
    ('way', 'f8'), ('turn', 'f8'), ('white', 'f8', (BANK.sources,)),
    ('slow', 'f8', (BANK.sources,)), ('tau', 'f8', (BANK.sources,))])

NOISES = types.Array(from_dtype(NOISE), 1, 'C')

# Copies of the settings that kernels use.
LN_OUTLIER, LN_NO_OUTLIER = math.log(BANK.outliers), math.log(1.0 - BANK.outliers)
FAULT_SIZE2, SLIP_HEADING2, WANDER2 = BANK.fault_size**2, BANK.slip_heading**2, BANK.wander**2
ASTRAY = BANK.astray
# Variance of a turn after which the heading is not known: it may be any of those tried [rad^2].
LOST = 2.0 * (2.0 * math.pi / BANK.headings)**2
# Variance of the heading and of a position where the filter begins, and of the heading again.
BEGIN_HEADING, BEGIN_POSITION, NEW_HEADING = 0.1, 1e4, 1.0


@kernel
def predict(x, p, n_sources, row, noise, in_fault):  # type: ignore[no-untyped-def]
    """Move the pose along odometry, and let slow errors fade, or wander where in a fault."""
    n = ERROR + 2 * n_sources
    m, lever = row.motion, row.lever
    bx, by = (1.0 + x[SCALE]) * m[0] + x[RATE] * lever[0], (
        (1.0 + x[SCALE]) * m[1] + x[RATE] * lever[1])
    c, s = math.cos(x[2]), math.sin(x[2])
    dx, dy = c * bx - s * by, s * bx + c * by
    # derivatives by the scale and by the rate
    kx, ky = c * m[0] - s * m[1], s * m[0] + c * m[1]
    rx, ry = c * lever[0] - s * lever[1], s * lever[0] + c * lever[1]
    x[0] += dx
    x[1] += dy
    x[2] += m[2] + x[RATE] * lever[2]
    for i in range(n):
        p[i, 0] += kx * p[i, SCALE] + rx * p[i, RATE] - dy * p[i, 2]
        p[i, 1] += ky * p[i, SCALE] + ry * p[i, RATE] + dx * p[i, 2]
        p[i, 2] += lever[2] * p[i, RATE]
    for i in range(n):
        p[0, i] += kx * p[SCALE, i] + rx * p[RATE, i] - dy * p[2, i]
        p[1, i] += ky * p[SCALE, i] + ry * p[RATE, i] + dx * p[2, i]
        p[2, i] += lever[2] * p[RATE, i]
    c, s = math.cos(x[2]), math.sin(x[2])
    turn, way = row.turn, row.way
    xx, xy, yy = (noise.turn * turn[0] + noise.way * way[0],
                  noise.turn * turn[1] + noise.way * way[1],
                  noise.turn * turn[3] + noise.way * way[2])
    p[0, 0] += c * c * xx - 2.0 * c * s * xy + s * s * yy
    p[1, 1] += s * s * xx + 2.0 * c * s * xy + c * c * yy
    cross = c * s * (xx - yy) + (c * c - s * s) * xy
    xt, yt = noise.turn * (c * turn[2] - s * turn[4]), noise.turn * (s * turn[2] + c * turn[4])
    p[0, 1] += cross
    p[1, 0] += cross
    p[0, 2] += xt
    p[2, 0] += xt
    p[1, 2] += yt
    p[2, 1] += yt
    p[2, 2] += noise.turn * turn[5]
    seconds = lever[2]
    for r in range(n_sources):
        part = math.exp(-seconds / noise.tau[r])
        more = (1.0 - part * part) * noise.slow[r] * row.slow
        if in_fault[r] != 0:
            part, more = 1.0, more + WANDER2 * seconds
        for i in range(ERROR + 2 * r, ERROR + 2 * r + 2):
            x[i] *= part
            for j in range(n):
                p[i, j] *= part
                p[j, i] *= part
            p[i, i] += more


@kernel
def innovation(x, p, row, first, white, more):  # type: ignore[no-untyped-def]
    """
    Return the error of a measured position with its covariance, and the arm of the heading.

    The slow error of its source is that at `first`, or not known but for the variance `more`, if
    that is negative.
    """
    c, s = math.cos(x[2]), math.sin(x[2])
    ox, oy = c * row.offset[0] - s * row.offset[1], s * row.offset[0] + c * row.offset[1]
    ex, ey = row.mean[0] - x[0] - ox, row.mean[1] - x[1] - oy
    xx = p[0, 0] - 2.0 * oy * p[0, 2] + oy * oy * p[2, 2] + more
    xx += max(white * row.noise[0], row.least)
    xy = p[0, 1] - oy * p[1, 2] + ox * p[0, 2] - ox * oy * p[2, 2] + white * row.noise[1]
    yy = p[1, 1] + 2.0 * ox * p[1, 2] + ox * ox * p[2, 2] + more
    yy += max(white * row.noise[2], row.least)
    if first >= 0:
        a, b = first, first + 1
        ex, ey = ex - x[a], ey - x[b]
        xx += p[a, a] + 2.0 * (p[0, a] - oy * p[2, a])
        yy += p[b, b] + 2.0 * (p[1, b] + ox * p[2, b])
        xy += p[a, b] + p[0, b] - oy * p[2, b] + p[1, a] + ox * p[2, a]
    if not (xx > 0.0 and xx * yy > xy * xy):
        # far from the origin, rounding may exceed what is left of the covariance
        xx, xy, yy = max(xx, row.noise[0]), 0.0, max(yy, row.noise[2])
    return ex, ey, xx, xy, yy, ox, oy


@kernel
def density(ex, ey, xx, xy, yy):  # type: ignore[no-untyped-def]
    """Return the logarithm of the density of a plane error, and its squared distance."""
    det = xx * yy - xy * xy
    d2 = (yy * ex * ex - 2.0 * xy * ex * ey + xx * ey * ey) / det
    return -LOG_2PI - 0.5 * math.log(det) - 0.5 * d2, d2


@kernel
def heading_density(x, p, row):  # type: ignore[no-untyped-def]
    """Return the logarithm of the density of a measured heading; 0 where there is none."""
    if row.heading_variance <= 0.0:
        return 0.0
    e = factors.wrap(row.mean[2] - row.offset[2] - x[2])
    variance = p[2, 2] + row.heading_variance
    return -0.5 * (LOG_2PI + math.log(variance) + e * e / variance)


@kernel(allocates=True)
def correct(x, p, n, row, first, white, with_heading):  # type: ignore[no-untyped-def]
    """Take in a measured position, and its heading if it has one that counts."""
    ex, ey, xx, xy, yy, ox, oy = innovation(x, p, row, first, white, 0.0)
    det = xx * yy - xy * xy
    ax, ay = (yy * ex - xy * ey) / det, (xx * ey - xy * ex) / det
    gain_x, gain_y = np.empty(N_STATES), np.empty(N_STATES)
    for i in range(n):
        gain_x[i] = p[i, 0] - oy * p[i, 2] + p[i, first]
        gain_y[i] = p[i, 1] + ox * p[i, 2] + p[i, first + 1]
    for i in range(n):
        x[i] += gain_x[i] * ax + gain_y[i] * ay
        kx, ky = ((yy * gain_x[i] - xy * gain_y[i]) / det, (xx * gain_y[i] - xy * gain_x[i]) / det)
        for j in range(i, n):
            p[i, j] -= kx * gain_x[j] + ky * gain_y[j]
            p[j, i] = p[i, j]
    if with_heading and row.heading_variance > 0.0:
        e = factors.wrap(row.mean[2] - row.offset[2] - x[2])
        variance = p[2, 2] + row.heading_variance
        for i in range(n):
            gain_x[i] = p[i, 2]
        for i in range(n):
            x[i] += gain_x[i] * e / variance
            for j in range(i, n):
                p[i, j] -= gain_x[i] * gain_x[j] / variance
                p[j, i] = p[i, j]


@kernel
def cauchy(square, scale2):  # type: ignore[no-untyped-def]
    """Return the logarithm of the Cauchy density in the plane at a squared distance."""
    return 0.5 * math.log(scale2) - LOG_2PI - 1.5 * math.log(square + scale2)


@kernel(signature=(TABLE, NUMBERS, INTEGER, NOISES, NUMBER, NUMBERS), allocates=True)
def log_density(rows, slips, n_sources, noises, heading, constants):  # type: ignore[no-untyped-def]
    """
    Return the logarithm of the density of positions by one filter, each at least an outlier's.

    Those with a negative entry in `slips` are left out; before the others odometry has slipped
    with such a variance. The constants are rate and scale of odometry with their variances: in,
    before the first position; out, after the last one.
    """
    noise, n, in_fault = noises[0], ERROR + 2 * n_sources, np.zeros(n_sources, np.int64)
    x, p = np.zeros(N_STATES), np.zeros((N_STATES, N_STATES))
    x[RATE], x[SCALE], p[RATE, RATE], p[SCALE, SCALE] = constants
    total, n_wrong, has_begun = 0.0, 0, False
    for k in range(len(rows)):
        row = rows[k]
        if has_begun:
            predict(x, p, n_sources, row, noise, in_fault)
            if row.turn[5] * noise.turn > LOST:
                n_wrong = ASTRAY
        if slips[k] < 0.0:
            continue
        if not has_begun:
            x[2] = heading
            for i in range(ERROR, n):
                p[i, i] = noise.slow[(i - ERROR) // 2] * row.slow
        if not has_begun or n_wrong >= ASTRAY:
            # nothing is known of where it is, but what the measurement says
            variance = NEW_HEADING if has_begun else BEGIN_HEADING
            if row.heading_variance > 0.0:
                x[2], variance = row.mean[2] - row.offset[2], row.heading_variance
            c, s = math.cos(x[2]), math.sin(x[2])
            x[0] = row.mean[0] - c * row.offset[0] + s * row.offset[1]
            x[1] = row.mean[1] - s * row.offset[0] - c * row.offset[1]
            p[:3], p[:, :3] = 0.0, 0.0
            p[0, 0] = p[1, 1] = BEGIN_POSITION * row.slow
            p[2, 2] = variance
            has_begun, n_wrong = True, 0
        if slips[k] > 0.0:
            p[0, 0] += slips[k]
            p[1, 1] += slips[k]
            p[2, 2] += SLIP_HEADING2
        r = row.source
        ex, ey, xx, xy, yy, _, _ = innovation(x, p, row, ERROR + 2 * r, noise.white[r], 0.0)
        good, _ = density(ex, ey, xx, xy, yy)
        good += LN_NO_OUTLIER + heading_density(x, p, row)
        wrong = LN_OUTLIER + cauchy(ex * ex + ey * ey, FAULT_SIZE2 + 0.5 * (xx + yy)) - (
            LOG_2PI if row.heading_variance > 0.0 else 0.0)
        total += max(good, wrong)
        n_wrong = n_wrong + 1 if wrong > good else 0
        if n_wrong == 0:
            correct(x, p, n, row, ERROR + 2 * r, noise.white[r], True)
    constants[0], constants[1], constants[2], constants[3] = (
        x[RATE], x[SCALE], p[RATE, RATE], p[SCALE, SCALE])
    return total
