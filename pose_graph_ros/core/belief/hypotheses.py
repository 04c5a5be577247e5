# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The hypotheses of the bank, and how each measurement lets them fork, join and go.

At a measurement, every hypothesis forks: the measurement is good; it alone is wrong; a fault of
its source begins, or its offset jumps; the fault goes on; or odometry has slipped, and it is good.
The weight of a hypothesis is the logarithm of its probability, up to a constant for all.
"""

import math

from numba import from_dtype, types
import numpy as np

from pose_graph_ros.core.belief import filter as ft
from pose_graph_ros.core.belief.rows import COUNTS, DECIDES, TABLE
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.compiled.jit import INTEGER, kernel
from pose_graph_ros.core.graph import factors

MOST, N_SOURCES = BANK.hypotheses, BANK.sources

# In a fault a source is as noisy as it is else, or at least as noisy as it claims.
QUIET, NOISY = 1, 2
N_MODES = 3

HYPOTHESIS = np.dtype([
    ('weight', 'f8'),
    ('in_fault', 'i8', (N_SOURCES,)),  # whether a source is in a fault, `QUIET` or `NOISY`; or 0
    ('turned', 'f8', (N_SOURCES,)),  # by what the last heading of a source in a fault was off
    ('slips', 'i8'),  # whether odometry slipped before the last good measurement
    ('state', 'f8', (ft.N_STATES,)),
    ('covariance', 'f8', (ft.N_STATES, ft.N_STATES))])

# What a hypothesis says of a measurement.
GOOD, ALONE, BEGINS, GOES_ON, SLIPPED, BEGINS_NOISY = range(6)
N_CHOICES = 6
LN_KINDS = math.log(0.5)  # either kind of fault is as likely

# A hypothesis after a measurement, as a member of the tree of all.
BRANCH = np.dtype([
    ('before', 'i2'),  # number of the hypothesis that it has come from
    ('choice', 'i2'),
    ('far', 'f4'),  # distance of the measurement from where it was expected [m]
    ('d2', 'f4')])  # the same as a squared Mahalanobis distance

HYPOTHESES = types.Array(from_dtype(HYPOTHESIS), 1, 'C')
TREE = types.Array(from_dtype(BRANCH), 2, 'C')

# Copies of the settings that kernels use.
BETWEEN_FAULTS, FAULT, BETWEEN_JUMPS = BANK.between_faults, BANK.fault, BANK.fault / 3.0
BETWEEN_SLIPS, SLIP, SLIP_SIZE2 = BANK.between_slips, BANK.slip, BANK.slip_size**2
UNMOVED_WAY, UNMOVED, JUMP_SIZE2 = 5.0 * BANK.slip_size, BANK.unmoved, BANK.jump_size**2
HEADINGS, HEADING2, RATE2, SCALE2 = BANK.headings, BANK.heading**2, BANK.rate**2, BANK.scale**2
NEAR2, FAR2 = (2.0 * BANK.fault_size)**2, BANK.far_fault**2
HOPELESS, ALIKE, ALIKE_SPREAD = BANK.hopeless, BANK.alike, BANK.alike_spread
SAME_PLACE2, SAME_HEADING = BANK.same_place**2, BANK.same_place
EQUAL2, EQUAL = BANK.equal**2, BANK.equal
LEAST = -1e300


@kernel
def _white(white, one, r):  # type: ignore[no-untyped-def]
    """Return the white variance of a source in units of what it claims."""
    return max(white, 1.0) if one.in_fault[r] == NOISY else white


@kernel
def _begin(bank, n, seen, n_sources, noise, leaves):  # type: ignore[no-untyped-def]
    """
    Write the hypotheses on a first measurement: any heading, good or in a fault.

    After others it is as if nothing were known of where the robot is, after the best of them.
    """
    best, before, r = 0, 0.0, seen.source
    for k in range(1, n):
        if bank[k].weight > bank[best].weight:
            best = k
    if n > 0:
        # where it is seen is as likely as a fault makes it, so that to be lost gains nothing
        one = bank[best]
        ft.predict(one.state, one.covariance, n_sources, seen, noise, one.in_fault)
        ex, ey, xx, _, yy, _, _ = ft.innovation(
            one.state, one.covariance, seen, -1, 1.0, seen.slow)
        before = one.weight + ft.cauchy(ex * ex + ey * ey, ft.FAULT_SIZE2 + 0.5 * (xx + yy))
    in_fault = FAULT / (FAULT + BETWEEN_FAULTS)
    n, n_faults = 0, 0
    if seen.judged != 0:
        n_faults = 4 if noise.white[r] < 1.0 else 2
    for fault in range(1 + n_faults):
        # in a fault the heading of a pose is wrong as well
        n_headings = 1 if fault == 0 and seen.heading_variance > 0.0 else HEADINGS
        for k in range(n_headings):
            one = bank[n]
            x, p = one.state, one.covariance
            x[:], p[:, :], one.in_fault[:], one.slips = 0.0, 0.0, 0, 0
            heading, variance = 2.0 * math.pi * k / n_headings, HEADING2
            if n_headings == 1:
                heading, variance = seen.mean[2] - seen.offset[2], seen.heading_variance
            c, s = math.cos(heading), math.sin(heading)
            x[0] = seen.mean[0] - c * seen.offset[0] + s * seen.offset[1]
            x[1] = seen.mean[1] - s * seen.offset[0] - c * seen.offset[1]
            x[2] = heading
            p[2, 2] = variance
            one.turned[:] = 0.0
            one.turned[r] = factors.wrap(seen.mean[2] - seen.offset[2] - heading)
            p[ft.RATE, ft.RATE], p[ft.SCALE, ft.SCALE] = RATE2, SCALE2
            for i in range(ft.ERROR, ft.ERROR + 2 * n_sources):
                p[i, i] = noise.slow[(i - ft.ERROR) // 2] * seen.slow
            slow = noise.slow[r] * seen.slow
            if fault > 0:
                slow = NEAR2 if fault % 2 == 1 else FAR2
                one.in_fault[r] = QUIET if fault <= 2 else NOISY
            white = _white(noise.white[r], one, r)
            p[0, 0] = max(white * seen.noise[0], seen.least) + slow
            p[0, 1] = p[1, 0] = white * seen.noise[1]
            p[1, 1] = max(white * seen.noise[2], seen.least) + slow
            for i in range(2):
                j = ft.ERROR + 2 * r + i
                p[j, j] = slow
                p[i, j] = p[j, i] = -slow
            share = 1.0 - in_fault if fault == 0 else in_fault / n_faults
            one.weight = before + math.log(share / n_headings)
            leaf = leaves[n]
            leaf.before, leaf.far, leaf.d2 = best, 0.0, 0.0
            leaf.choice = GOOD if fault == 0 else BEGINS
            n += 1
    return n


@kernel
def _weigh(one, number, row, noise, weights, branches):  # type: ignore[no-untyped-def]
    """Write the weights of the choices of a hypothesis, and how far the measurement is off."""
    x, p, r = one.state, one.covariance, row.source
    white, slow = noise.white[r], noise.slow[r] * row.slow
    first, in_fault = ft.ERROR + 2 * r, one.in_fault[r] != 0
    ex, ey, xx, xy, yy, _, _ = ft.innovation(x, p, row, first, _white(white, one, r), 0.0)
    with_error, d2 = ft.density(ex, ey, xx, xy, yy)
    square, spread = ex * ex + ey * ey, 0.5 * (xx + yy)
    gx, gy, gxx, gxy, gyy, fresh = ex, ey, xx, xy, yy, with_error
    if in_fault:
        gx, gy, gxx, gxy, gyy, _, _ = ft.innovation(x, p, row, -1, white, slow)
        fresh, d2 = ft.density(gx, gy, gxx, gxy, gyy)
    fresh_square, fresh_spread = gx * gx + gy * gy, 0.5 * (gxx + gyy)
    heading = ft.heading_density(x, p, row)
    any_heading = -ft.LOG_2PI if row.heading_variance > 0.0 else 0.0
    size2 = JUMP_SIZE2 if in_fault else ft.FAULT_SIZE2
    # nothing happens before one that does not decide
    gap = row.gap if row.decides == DECIDES else 0.0
    begins = 1.0 - math.exp(-gap / (BETWEEN_JUMPS if in_fault else BETWEEN_FAULTS))
    ends, slips = 1.0 - math.exp(-gap / FAULT), 1.0 - math.exp(-gap / BETWEEN_SLIPS)
    if one.slips != 0 and row.decides == DECIDES:
        slips = math.exp(-gap / SLIP)
    changed = math.log(max(ends if in_fault else 1.0 - begins, 1e-12))
    weights[GOOD] = changed + ft.LN_NO_OUTLIER + fresh + heading
    weights[ALONE] = ft.LN_OUTLIER + ft.cauchy(square, ft.FAULT_SIZE2 + spread) + any_heading
    weights[BEGINS] = (math.log(max(begins, 1e-12)) + ft.LN_NO_OUTLIER
                       + ft.cauchy(square, size2 + spread) + any_heading)
    weights[BEGINS_NOISY] = LEAST
    if not in_fault and white < 1.0:
        weights[BEGINS] += LN_KINDS
        weights[BEGINS_NOISY] = weights[BEGINS]
    weights[GOES_ON] = LEAST
    if in_fault:
        stays = math.log(max(1.0 - ends, 1e-12))
        weights[BEGINS] += stays
        if row.heading_variance > 0.0:
            # in a fault the heading stays off by what it was, or is any
            e = factors.wrap(row.mean[2] - row.offset[2] - x[2] - one.turned[r])
            variance = 2.0 * row.heading_variance + noise.turn * row.turn[5]
            heading = max(-0.5 * (ft.LOG_2PI + math.log(variance) + e * e / variance), any_heading)
        weights[GOES_ON] = (stays + math.log(max(1.0 - begins, 1e-12)) + ft.LN_NO_OUTLIER
                            + with_error + heading)
    weights[SLIPPED] = (math.log(max(slips, 1e-12)) + changed + ft.LN_NO_OUTLIER
                        + ft.cauchy(fresh_square, SLIP_SIZE2 + fresh_spread) + any_heading)
    if math.sqrt(fresh_square) > row.travel + UNMOVED_WAY:
        weights[SLIPPED] -= UNMOVED
    holds = math.log(max(1.0 - slips, 1e-12))
    for choice in (GOOD, BEGINS, BEGINS_NOISY, GOES_ON):
        weights[choice] += holds
    if row.judged == 0:
        weights[BEGINS] = weights[BEGINS_NOISY] = weights[SLIPPED] = LEAST
    for choice in range(N_CHOICES):
        weights[choice] += one.weight
        if not weights[choice] > LEAST:
            weights[choice] = LEAST
        branch = branches[choice]
        branch.before, branch.choice = number, choice
        branch.far, branch.d2 = math.sqrt(fresh_square), d2


@kernel(allocates=True)
def _follow(one, row, branch, noise, n_sources):  # type: ignore[no-untyped-def]
    """Let a hypothesis have made a choice."""
    n, r = ft.ERROR + 2 * n_sources, row.source
    x, p = one.state, one.covariance
    first, choice = ft.ERROR + 2 * r, branch.choice
    if choice == ALONE:
        return
    if row.decides == DECIDES:
        one.slips = 1 if choice == SLIPPED else 0
    one.turned[r] = factors.wrap(row.mean[2] - row.offset[2] - x[2])
    if choice in (BEGINS, BEGINS_NOISY):
        ex, ey, _, _, _, _, _ = ft.innovation(x, p, row, first, 0.0, 0.0)
        more = ((JUMP_SIZE2 if one.in_fault[r] != 0 else ft.FAULT_SIZE2) + ex * ex + ey * ey) / 3.0
        p[first, first] += more
        p[first + 1, first + 1] += more
        if one.in_fault[r] == 0:
            one.in_fault[r] = QUIET if choice == BEGINS else NOISY
    elif choice != GOES_ON:
        if one.in_fault[r] != 0:
            # nothing is known of the slow error but its variance
            for i in range(first, first + 2):
                x[i] = 0.0
                for j in range(n):
                    p[i, j] = p[j, i] = 0.0
                p[i, i] = noise.slow[r] * row.slow
        one.in_fault[r] = 0
        if choice == SLIPPED:
            more = (SLIP_SIZE2 + branch.far * branch.far) / 3.0
            p[0, 0] += more
            p[1, 1] += more
            p[2, 2] += ft.SLIP_HEADING2
    ft.correct(x, p, n, row, first, _white(noise.white[r], one, r), one.in_fault[r] == 0)


@kernel
def _joins(bank, n, n_sources, modes, spreads):  # type: ignore[no-untyped-def]
    """
    Tell whether hypothesis n joins one before it, and which, or -1: it stays, or -2: it goes.

    It goes if enough are in its place with the same faults already. Its faults as one number and
    its spread are noted for later ones.
    """
    one, n_alike = bank[n], 0
    x, p = one.state, one.covariance
    modes[n], spreads[n] = one.slips, p[0, 0] + p[1, 1]
    for r in range(n_sources):
        modes[n] = N_MODES * modes[n] + one.in_fault[r]
    for m in range(n):
        if modes[m] != modes[n]:
            continue
        # what is known exactly and what is hardly known are not in the same place
        spread, most = min(spreads[m], spreads[n]), max(spreads[m], spreads[n])
        if not most < ALIKE_SPREAD * spread:
            continue
        other = bank[m]
        y, q = other.state, other.covariance
        far2 = (x[0] - y[0])**2 + (x[1] - y[1])**2
        if not far2 < SAME_PLACE2 * spread:
            continue
        turn = abs(factors.wrap(x[2] - y[2])) / math.sqrt(min(p[2, 2], q[2, 2]))
        if not turn < SAME_HEADING:
            continue
        equal = far2 < EQUAL2 * spread and turn < EQUAL and most < 2.0 * spread
        for r in range(n_sources):
            i = ft.ERROR + 2 * r
            if one.in_fault[r] != 0:
                # of pose and offset, what is seen is their sum, which is known much better
                dx, dy = x[0] + x[i] - y[0] - y[i], x[1] + x[i + 1] - y[1] - y[i + 1]
                seen = (p[0, 0] + p[i, i] + 2.0 * p[0, i]
                        + p[1, 1] + p[i + 1, i + 1] + 2.0 * p[1, i + 1])
                equal = equal and dx * dx + dy * dy < EQUAL2 * seen
        if equal:
            return m
        n_alike += 1
    return -1 if n_alike < ALIKE else -2


@kernel(signature=(HYPOTHESES, INTEGER, TABLE, INTEGER, INTEGER, INTEGER, ft.NOISES, TREE),
        allocates=True)
def advance(  # type: ignore[no-untyped-def]
    bank, n, table, first, end, n_sources, noises, tree,
):
    """
    Take the n hypotheses of a bank along rows of measurements; return how many there are then.

    The branches of all hypotheses after each row are written to the tree.
    """
    noise = noises[0]
    before, branches = np.empty_like(bank), np.empty((MOST, N_CHOICES), tree.dtype)
    weights = np.empty((MOST, N_CHOICES))
    modes, spreads = np.empty(MOST, np.int64), np.empty(MOST)
    for at in range(first, end):
        row = table[at]
        if n == 0 or row.turn[5] * noise.turn > ft.LOST:
            n = _begin(bank, n, row, n_sources, noise, tree[at])
            continue
        for k in range(n):
            one = bank[k]
            ft.predict(one.state, one.covariance, n_sources, row, noise, one.in_fault)
            _weigh(one, k, row, noise, weights[k], branches[k])
        if row.decides != DECIDES:
            # what follows so closely has mostly the same error, so that it tells nothing: it is
            # what the one before it of its source is, unless it alone is wrong
            for k in range(n):
                choice = GOES_ON if bank[k].in_fault[row.source] != 0 else GOOD
                if weights[k, ALONE] > weights[k, choice]:
                    choice = ALONE
                tree[at, k] = branches[k, choice]
                if row.decides == COUNTS:
                    bank[k].weight = weights[k, choice]
                    _follow(bank[k], row, branches[k, choice], noise, n_sources)
            continue
        for k in range(n):
            before[k] = bank[k]
        flat, n = weights[:n].copy().reshape(-1), 0
        least = max(np.max(flat) - HOPELESS, LEAST)
        for place in np.argsort(-flat, kind='mergesort'):
            weight = flat[place]
            if n == MOST or not weight > least:
                break
            branch = branches[place // N_CHOICES, place % N_CHOICES]
            bank[n] = before[branch.before]
            bank[n].weight = weight
            _follow(bank[n], row, branch, noise, n_sources)
            other = _joins(bank, n, n_sources, modes, spreads)
            if other >= 0:
                bank[other].weight += math.log1p(math.exp(weight - bank[other].weight))
            if other == -1:
                tree[at, n] = branch
                n += 1
    return n
