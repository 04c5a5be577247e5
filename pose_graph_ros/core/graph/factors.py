# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The types of factors: the error of each, and what solvers derive from it.

`constraints.FACTORS` says which nodes a kind of factor has for ends, which rows its error has, and
its tag in g2o files. `error` has the errors with their Jacobians, each defined here and nowhere
else. Numbers in parentheses are equations of C. Merfels, "Sensor fusion for localization of
automated vehicles", section 3.4.6. A node is x = (t, th), its theta wrapped; R_i and R_z are the
rotations (3.47) of node i and of the measured pose z = (t_z, th_z), o an offset in node i. With
F = diag(f_t, f_t, f_th) and `d = f_t t_j - t_i` the errors are

    odometry, loop closure (3.48)    e = (R_z^T (R_i^T d - t_z), wrap(th_j - th_i - th_z)), F = 1
    bias j of a measurement at i     e = (d + t_z - R_i o, wrap(f_th th_j - th_i + th_z))
    turn (integrated yaw rate)       e_th = wrap(th_j - th_i - th_z)
    point (landmark j seen from i)   e_t = R_i^T d - t_z
    range (landmark j, antenna o)    e_x = |d - R_i o| - r
    observed node (3.52), F = 0      e = -(R_z^T (t_i + R_i o - t_z), wrap(th_i + th_o - th_z))

Odometry and turns may have a third node k, the bias b of a yaw rate [rad/s] and the error s of a
scale. With f the duration for which the bias acts [s], negative where the motion is to be turned
by b, and with o here for R_z^T t_z, it adds to the error

    (-s o + f b S o / 2, f b)

so that the way is longer by the part s, and its chord turned by half of what the end is. That is
linear in k, in axes that do not depend on k.

A row that a type has not is given no information: a point is an edge without a heading, a turn one
without a position. All of them are, turned into map axes by the rotation R of their *frame*,

    R e_t' = d - S a dth_i + constant,    e_th' = f_th dth_j - dth_i + constant

for small changes, S = ((0, -1), (1, 0)). Frame and *arm* a are all that a type says of its
Jacobians; with them `R e_t = d + constant`.

Solvers need the linearization of a factor, its linearization error, and its energy. The
unknown of a node is its pose minus a constant reference, delta = x - x_ref, in map axes.
Translation and heading are added as plain numbers, so every constraint may be linearized at a
point of its own; a bar marks values there. In map axes an error is

    e' = h + F delta_j - T delta_i,    T = ((1, 0, -a_y), (0, 1, a_x), (0, 0, 1)) at a_bar
    h_t = f_t x_ref_j - x_ref_i + constant + S a_bar delta_bar_th,   h_th constant

(and what a third node adds, turned by R_bar), and its information is turned by R_bar likewise.
The residual of the linear model,

    r = e - R_bar^T e',

depends only on the change of the heading since the linearization and on the present d; unless
positions enter an error otherwise than by d, as they do that of a range, it is the difference that
the heading makes to `error`. The Jacobians change as well: the direction of the weighted error W e
rotates, which changes the gradient by the relative change c of the Jacobian times W e. The squared
linearization error, `r^T W r + c^2 e^T W e` [sigma^2], decides what is linearized again (fluid
relinearization, M. Kaess et al., "iSAM2", IJRR 2012, with whitened errors). Its sum over all
constraints is about the distance of chi2 from its minimum.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import INTEGERS, kernel, NUMBERS, ROWS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, Poses
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind, Factors

# Numbers of the definitions; all kinds from OBSERVED on have one end.
BIAS, TURN, PRIOR, RANGE, OBSERVED = (int(kind) for kind in (
    FactorKind.BIAS, FactorKind.TURN, FactorKind.PRIOR, FactorKind.RANGE, FactorKind.GLOBAL_POSE))
# Smallest squared linearization error for which a factor is linearized again, as a fraction of
# `SmootherConfig.budget_share`.
LEAST_FRACTION = 0.01
# Squared relative change of the arm of a Jacobian above which it is added to the squared
# linearization error whatever the energy.
MUCH_LONGER = 1e-4
# Angle of a clique's frame, with its cosine and sine.
NO_TURN = (0.0, 1.0, 0.0)
# What a third node adds to an error, and its solution to the heading's, where there is none.
NO_THIRD = ((0.0, 0.0, 0.0), 0.0)


@kernel(forceinline=True)
def turned_by(angle):  # type: ignore[no-untyped-def]
    """Return cosine - 1 and sine of an angle that is small as a rule, exact to rounding."""
    if abs(angle) < 0.1:    # by their series
        square = angle * angle
        return (-square * (0.5 - square * (1 / 24 - square * (1 / 720 - square * (
                    1 / 40320 - square / 3628800)))),
                angle * (1.0 - square * (1 / 6 - square * (1 / 120 - square * (
                    1 / 5040 - square * (1 / 362880 - square / 39916800))))))
    return math.cos(angle) - 1.0, math.sin(angle)


@kernel(forceinline=True)
def is_relative(kind):  # type: ignore[no-untyped-def]
    """Tell whether an error lies in the frame of the pose that was measured from node i."""
    return kind < BIAS or TURN < kind < RANGE


@kernel(forceinline=True)
def anchors(f):  # type: ignore[no-untyped-def]
    """Tell whether axes of a factor's errors or unknowns do not turn with its clique."""
    return (f.kind >= BIAS and f.kind != PRIOR) or f.ends[2] >= 0


@kernel
def prepare(f, kind):  # type: ignore[no-untyped-def]
    """Set what a factor needs of its mean: `R_z^T t_z`."""
    if is_relative(kind):
        c, s = math.cos(f.mean[2]), math.sin(f.mean[2])
        f.constants[0] = c * f.mean[0] + s * f.mean[1]
        f.constants[1] = c * f.mean[1] - s * f.mean[0]


@kernel(forceinline=True)
def kind_and_ends(f):  # type: ignore[no-untyped-def]
    """Return kind and ends i, j, k of a factor; i = j where a node is observed."""
    i, j = f.ends[0], f.ends[1]
    return f.kind, i, j if j >= 0 else i, f.ends[2]


@kernel(forceinline=True)
def factors_of_end(f, kind):  # type: ignore[no-untyped-def]
    """Return f_t and f_th of node j."""
    if kind == BIAS:
        return f.constants[2], f.constants[3]
    return (1.0, 1.0) if kind < OBSERVED else (0.0, 0.0)


@kernel(forceinline=True)
def frame(f, kind):  # type: ignore[no-untyped-def]
    """Return cosine and sine of the frame at the linearization."""
    if is_relative(kind) or kind == RANGE:  # it moves with the nodes
        return f.lin_cos, f.lin_sin
    if kind < OBSERVED or f.mean[2] == 0.0:
        return 1.0, 0.0
    return math.cos(f.mean[2]), math.sin(f.mean[2])


@kernel(forceinline=True)
def constant(f, kind, c, s, ax, ay):  # type: ignore[no-untyped-def]
    """Return `R e_t - d`, in map axes, for cosine and sine of the frame R, and the arm a."""
    if is_relative(kind):
        return s * f.constants[1] - c * f.constants[0], -s * f.constants[0] - c * f.constants[1]
    if kind == RANGE:
        return -ax - c * f.mean[0], -ay - s * f.mean[0]
    return f.mean[0] - ax, f.mean[1] - ay


@kernel(forceinline=True)
def by_state(f, b, s):  # type: ignore[no-untyped-def]
    """Return what a state (b, s) of the third node adds to the error; it is linear in it."""
    turn, ox, oy = f.constants[3] * b, f.constants[0], f.constants[1]
    return -s * ox - 0.5 * turn * oy, 0.5 * turn * ox - s * oy, turn


@kernel(forceinline=True)
def third(nodes, f, k):  # type: ignore[no-untyped-def]
    """Return what the third node k adds to the error, and its solution to the heading's."""
    if k < 0:
        return NO_THIRD
    pose, delta = nodes[k].pose, nodes[k].delta
    return by_state(f, pose[0], pose[1]), f.constants[3] * delta[0]


@kernel
def motion(nodes, f):  # type: ignore[no-untyped-def]
    """Return the pose of j in i that a relative error has measured, as the third node says."""
    (x, y, th), _ = third(nodes, f, f.ends[2])
    c, s = math.cos(f.mean[2]), math.sin(f.mean[2])
    return f.mean[0] - c * x + s * y, f.mean[1] - s * x - c * y, f.mean[2] - th


@kernel(forceinline=True)
def error(f, kind, dx, dy, heading):  # type: ignore[no-untyped-def]
    """Return the error e_t, cosine and sine of its frame, and its arm, for d and th_i."""
    ox, oy = f.constants[0], f.constants[1]
    if is_relative(kind):
        c, s = math.cos(heading + f.mean[2]), math.sin(heading + f.mean[2])
        return c * dx + s * dy - ox, c * dy - s * dx - oy, c, s, dx, dy
    ax = ay = 0.0
    if ox != 0.0 or oy != 0.0:
        c, s = math.cos(heading), math.sin(heading)
        ax, ay = c * ox - s * oy, s * ox + c * oy
    c, s = 1.0, 0.0
    if kind == RANGE:
        vx, vy = dx - ax, dy - ay
        length = math.sqrt(vx * vx + vy * vy)
        if length > 0.0:
            c, s = vx / length, vy / length
    elif kind >= OBSERVED and f.mean[2] != 0.0:
        c, s = math.cos(f.mean[2]), math.sin(f.mean[2])
    kx, ky = constant(f, kind, c, s, ax, ay)
    ex, ey = dx + kx, dy + ky
    return c * ex + s * ey, c * ey - s * ex, c, s, ax, ay


@kernel
def wrap(angle):  # type: ignore[no-untyped-def]
    """Return the angle in [-pi, pi), as `se2.wrap` does."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped if wrapped < math.pi else -math.pi


@kernel
def refer_to_pose(f):  # type: ignore[no-untyped-def]
    """Set the reference of a node, to its pose."""
    for k in range(3):
        f.reference[k] = f.pose[k]
        f.delta[k] = f.seen[k] = 0.0
    f.checked_turn = 0.0


@kernel(forceinline=True)
def model(f, kind, start, end, third):  # type: ignore[no-untyped-def]
    """
    Return the error of a factor at poses, cosine and sine of its frame, and its arm.

    `third` is what its third node adds.
    """
    ft, fth = factors_of_end(f, kind)
    dx, dy = ft * end[0] - start[0], ft * end[1] - start[1]
    ex, ey, c, s, ax, ay = error(f, kind, dx, dy, start[2])
    offset = f.mean[2] if kind == BIAS else -f.mean[2]
    if kind >= OBSERVED:
        offset = f.mean[2] - f.constants[2]
    eth = fth * end[2] - start[2] + offset + third[2]
    return ex + third[0], ey + third[1], wrap(eth), c, s, ax, ay


@kernel
def linearize(head, e):  # type: ignore[no-untyped-def]
    """Linearize a factor at the present estimate; the caller has logged its row."""
    nodes, f = tb.nodes(head), tb.factors(head)[e]
    kind, i, j, k = kind_and_ends(f)
    start, end, (by_pose, delta_k) = nodes[i], nodes[j], third(nodes, f, k)
    _, _, eth, c, s, ax, ay = model(f, kind, start.pose, end.pose, by_pose)
    _, fth = factors_of_end(f, kind)
    if is_relative(kind) or kind == RANGE:
        f.lin_cos, f.lin_sin = c, s
    f.lin_arm[0], f.lin_arm[1], f.lin_th = ax, ay, start.delta[2]
    f.lin_k = eth - (fth * end.delta[2] - start.delta[2] + delta_k)


@kernel
def check(head, e, clique_turn):  # type: ignore[no-untyped-def]
    """
    Set squared linearization error and energy of a factor; the caller has logged them.

    `clique_turn` is the turn of its clique's frame since the linearization [rad], see
    `clique_frames`, with its cosine and sine; `NO_TURN` at the linearization, in anchored cliques
    and for observed nodes.
    """
    nodes, f = tb.nodes(head), tb.factors(head)[e]
    kind, i, j, k = kind_and_ends(f)
    start, end, (phi, cos, sin) = nodes[i], nodes[j], clique_turn
    (by_x, by_y, _), delta_k = third(nodes, f, k)
    ft, fth = factors_of_end(f, kind)
    dx, dy = ft * end.pose[0] - start.pose[0], ft * end.pose[1] - start.pose[1]
    if phi != 0.0:
        dx, dy = cos * dx + sin * dy, cos * dy - sin * dx
    th = start.delta[2]
    turn = th - phi - f.lin_th
    # S a_bar turn, and the linear model, in the axes of the error
    c_bar, s_bar = frame(f, kind)
    bx, by = f.lin_arm[0], f.lin_arm[1]
    gx, gy = c_bar * bx + s_bar * by, c_bar * by - s_bar * bx
    turned = turn * turn
    if is_relative(kind):
        # d in the axes of the linearized frame, and by how much the turn changes it
        qx, qy = c_bar * dx + s_bar * dy, c_bar * dy - s_bar * dx
        versine, sine = turned_by(turn)
        px, py = versine * qx + sine * qy, versine * qy - sine * qx
        ax, ay = qx + px, qy + py
        ex, ey = ax - f.constants[0] + by_x, ay - f.constants[1] + by_y
        rx, ry = px - gy * turn, py + gx * turn
    else:   # its clique is anchored, so phi is zero
        kx, ky = constant(f, kind, c_bar, s_bar, bx, by)
        lx = c_bar * (dx + kx) + s_bar * (dy + ky)
        ly = c_bar * (dy + ky) - s_bar * (dx + kx)
        if bx == 0.0 and by == 0.0:
            turned = 0.0
        ex, ey, c, s, ax, ay = error(f, kind, dx, dy, start.pose[2])
        rx, ry = ex - lx - gy * turn, ey - ly + gx * turn
        turned += (c - c_bar) ** 2 + (s - s_bar) ** 2
    linear = f.lin_k + fth * end.delta[2] - th + delta_k
    eth = wrap(linear)
    if kind == BIAS:    # a factor times a heading that is wrapped
        eth = wrap(fth * end.pose[2] - start.pose[2] + f.mean[2])
    rth = eth - linear
    if abs(rth) < 1.0:
        rth = 0.0  # rounding of the wrap; at a jump it is a multiple of 2 pi
    w = f.weight
    energy = w * _form(f, ex, ey, eth)
    f.energy = energy
    if not is_relative(kind):
        f.error2 = w * _form(f, rx, ry, rth) + turned * energy
        return
    # the arm has changed, too; a large change would falsify the covariances even where the energy
    # is zero
    iso = 0.5 * (f.information[0] + f.information[3])
    longer = (ax - gx) ** 2 + (ay - gy) ** 2
    longer *= iso / (f.information[5] + iso * (gx * gx + gy * gy) + 1e-300)
    f.error2 = w * _form(f, rx, ry, rth) + (turned + longer) * energy + (
        longer if longer > MUCH_LONGER else 0.0)


@kernel
def linearize_all(head):  # type: ignore[no-untyped-def]
    """Make the poses of all nodes the references, and linearize all factors there."""
    for v in range(head[tb.N_NODES]):
        refer_to_pose(tb.nodes(head)[v])
    for e in range(head[tb.N_FACTORS]):
        if tb.factors(head)[e].weight > 0.0:
            linearize(head, e)


@kernel
def as_measured(head):  # type: ignore[no-untyped-def]
    """
    After `linearize_all`, give edges the Jacobians of ends that are where they were measured.

    So the linear system does not depend on the positions of the nodes, only on their headings.
    """
    for e in range(head[tb.N_FACTORS]):
        f = tb.factors(head)[e]
        if is_relative(f.kind):
            c, s, x, y = f.lin_cos, f.lin_sin, f.constants[0], f.constants[1]
            f.lin_arm[0], f.lin_arm[1] = c * x - s * y, s * x + c * y


@kernel(forceinline=True)
def _form(f, x, y, th):  # type: ignore[no-untyped-def]
    """Return e^T information e."""
    w = f.information
    return (x * (w[0] * x + 2.0 * (w[1] * y + w[2] * th))
            + y * (w[3] * y + 2.0 * w[4] * th) + th * w[5] * th)


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS))
def write_energies(head, rows, out):  # type: ignore[no-untyped-def]
    """Write the unweighted energies of the factors in some rows at the present poses [sigma^2]."""
    nodes = tb.nodes(head)
    for n in range(len(rows)):
        f = tb.factors(head)[rows[n]]
        kind, i, j, k = kind_and_ends(f)
        by_pose, _ = third(nodes, f, k)
        ex, ey, eth, _, _, _, _ = model(f, kind, nodes[i].pose, nodes[j].pose, by_pose)
        out[n] = _form(f, ex, ey, eth)


# --- constraints that need not be in a graph, at given poses -------------------------------------

def errors(poses: Poses, factors: Factors) -> FloatArray:
    """
    Return the errors (3.48), (3.52) of factors, shape (M, 3) [m, m, rad], theta in [-pi, pi).

    They are in the frames of the measured poses, those of edges to a bias in map axes.
    """
    error = np.empty((len(factors), 3))
    # as kernels take arrays
    _write_errors(*(np.require(each, requirements=('C', 'W'))
                    for each in (poses, factors.records)), error)
    observed = factors.j < 0    # of which (3.52) has the other sign
    if np.any(observed):
        error[observed] *= -1.0
        error[observed, 2] = se2.wrap(error[observed, 2])
    return error


@kernel
def write_data(f, new):  # type: ignore[no-untyped-def]
    """Write what the error of a factor depends on, from a record of `Factors`."""
    for m in range(3):
        f.mean[m] = new.mean[m]
    for m in range(4):
        f.constants[m] = new.constants[m]
    prepare(f, new.kind)


@kernel(signature=(ROWS, tb.RECORDS, ROWS), allocates=True)
def _write_errors(poses, records, error):  # type: ignore[no-untyped-def]
    record = np.empty(1, tb.FACTOR)
    for e in range(len(records)):
        f = record[0]   # in here, as Numba frees the array after its last use
        new = records[e]
        write_data(f, new)
        third, _ = NO_THIRD
        if new.k >= 0:
            third = by_state(f, poses[new.k, 0], poses[new.k, 1])
        error[e, 0], error[e, 1], error[e, 2], _, _, _, _ = model(
            f, new.kind, poses[new.i], poses[new.j if new.j >= 0 else new.i], third)


def energies(error: FloatArray, information: FloatArray) -> FloatArray:
    """Return the energies [sigma^2] for information in the frames of the errors."""
    return np.einsum('mi,mij,mj->m', error, information, error)
