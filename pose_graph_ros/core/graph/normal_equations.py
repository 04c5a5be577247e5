# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What factors add to the normal equations: to the front of a clique, or to a gradient.

Symbols are those of `factors`. With G the two columns of a third node, a factor adds the blocks of
`J^T W J` and `-J^T W h`, with J = (-T, F, G) in map axes.
"""

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import factors as fc, tables as tb


@kernel
def weakest(xx, xy, xt, yy, yt, tt):  # type: ignore[no-untyped-def]
    """
    Return what an information matrix tells in its weakest direction, and of the heading.

    The first is the smaller eigenvalue of the information on the position, the second that on the
    heading if the position is unknown; both are lower bounds, to rounding.
    """
    trace, determinant = xx + yy, xx * yy - xy * xy
    if not determinant > 0.0:
        return 0.0, 0.0
    joint = (yy * xt * xt - 2.0 * xy * xt * yt + xx * yt * yt) / determinant
    return determinant / trace, max(tt - joint, 0.0)


@kernel(forceinline=True)
def _add_to_row(front, at, x, y, z):  # type: ignore[no-untyped-def]
    front[at] += x
    front[at + 1] += y
    front[at + 2] += z


@kernel
def add(head, e, at, front, ld):  # type: ignore[no-untyped-def]
    """
    Add a factor to a front; `at` says where the blocks of its ends i, j and k begin, -1 for none.

    The front is an upper triangle, stored by rows of `ld` numbers, the last of which is the
    right-hand side.
    """
    nodes, f = tb.nodes(head), tb.factors(head)[e]
    kind, i, j, k = fc.kind_and_ends(f)
    start, end, third = nodes[i].reference, nodes[j].reference, fc.NO_THIRD[0]
    if k >= 0:
        third = fc.by_state(f, nodes[k].reference[0], nodes[k].reference[1])
    a, b, k = at
    c, s = fc.frame(f, kind)
    # the weighted information, turned into map axes
    i, w, cc, ss, cs = f.information, f.weight, c * c, s * s, c * s
    xx, yy = cc * i[0] - 2.0 * cs * i[1] + ss * i[3], ss * i[0] + 2.0 * cs * i[1] + cc * i[3]
    xx, xy, yy = w * xx, w * (cs * (i[0] - i[3]) + (cc - ss) * i[1]), w * yy
    xt, yt, tt = w * (c * i[2] - s * i[4]), w * (s * i[2] + c * i[4]), w * i[5]
    ft, fth = fc.factors_of_end(f, kind)
    px, py = -f.lin_arm[1], f.lin_arm[0]  # S a
    kx, ky = fc.constant(f, kind, c, s, py, -px)
    hx = ft * end[0] - start[0] + kx + px * f.lin_th
    hy = ft * end[1] - start[1] + ky + py * f.lin_th
    hx, hy = hx + c * third[0] - s * third[1], hy + s * third[0] + c * third[1]
    hth = f.lin_k
    # W T: the third column is W (S a, 1)
    wx, wy, wt = xx * px + xy * py + xt, xy * px + yy * py + yt, xt * px + yt * py + tt
    gx = xx * hx + xy * hy + xt * hth
    gy = xy * hx + yy * hy + yt * hth
    gth = xt * hx + yt * hy + tt * hth
    # block ii is T^T W T
    r = a * ld + a
    _add_to_row(front, r, xx, xy, wx)
    front[r + ld + 1] += yy
    front[r + ld + 2] += wy
    front[r + 2 * ld + 2] += px * wx + py * wy + wt
    right = ld - 1
    front[a * ld + right] += gx
    front[(a + 1) * ld + right] += gy
    front[(a + 2) * ld + right] += px * gx + py * gy + gth
    if b < 0:
        return
    front[b * ld + right] -= ft * gx
    front[(b + 1) * ld + right] -= ft * gy
    front[(b + 2) * ld + right] -= fth * gth
    if k >= 0:
        _add_third(f, (c, s, px, py), (xx, xy, xt, yy, yt, tt), (gx, gy, gth), at, front, ld)
    # from here on with the columns of j multiplied by F
    xx, xy, xt, yy, yt = ft * xx, ft * xy, fth * xt, ft * yy, fth * yt
    wx, wy, wt = ft * wx, ft * wy, fth * wt
    r = b * ld + b
    _add_to_row(front, r, ft * xx, ft * xy, ft * xt)
    front[r + ld + 1] += ft * yy
    front[r + ld + 2] += ft * yt
    front[r + 2 * ld + 2] += fth * fth * tt
    # block ij is -T^T W F, block ji its transpose
    if a < b:
        r = a * ld + b
        _add_to_row(front, r, -xx, -xy, -xt)
        _add_to_row(front, r + ld, -xy, -yy, -yt)
        _add_to_row(front, r + 2 * ld, -wx, -wy, -wt)
    else:
        r = b * ld + a
        _add_to_row(front, r, -xx, -xy, -wx)
        _add_to_row(front, r + ld, -xy, -yy, -wy)
        _add_to_row(front, r + 2 * ld, -xt, -yt, -wt)


@kernel
def _add_third(f, turned, information, gradient, at, front, ld):  # type: ignore[no-untyped-def]
    """
    Add the blocks of a third node to a front.

    `turned` has cosine and sine of the frame, and S a; `information` is W, and `gradient` W h.
    """
    c, s, px, py = turned
    xx, xy, xt, yy, yt, tt = information
    a, b, k = at
    # the columns of G, in map axes
    (bx, by, bth), (sx, sy, sth) = fc.by_state(f, 1.0, 0.0), fc.by_state(f, 0.0, 1.0)
    columns = ((c * bx - s * by, s * bx + c * by, bth), (c * sx - s * sy, s * sx + c * sy, sth))
    for m in range(2):
        x, y, th = columns[m]
        front[(k + m + 1) * ld - 1] -= x * gradient[0] + y * gradient[1] + th * gradient[2]
        wx, wy, wth = xx * x + xy * y + xt * th, xy * x + yy * y + yt * th, (
            xt * x + yt * y + tt * th)
        for n in range(m, 2):
            x, y, th = columns[n]
            front[(k + m) * ld + k + n] += x * wx + y * wy + th * wth
        of_i = -wx, -wy, -(px * wx + py * wy + wth)
        of_j = wx, wy, wth
        for n in range(3):
            for row, value in ((a + n, of_i[n]), (b + n, of_j[n])):
                front[min(row, k + m) * ld + max(row, k + m)] += value


@kernel
def gradient(head, e, right):  # type: ignore[no-untyped-def]
    """
    Add -b of a factor to `right`, shape (N, 3); return its energy and two sums of magnitudes.

    These are of the gradient's coordinates of a position, and of the diagonal terms of the
    energy, which cancel each other where W is nearly singular.
    """
    nodes, f = tb.nodes(head), tb.factors(head)[e]
    kind, v, j, k = fc.kind_and_ends(f)
    by_pose, _ = fc.third(nodes, f, k)
    ex, ey, eth, c, s, ax, ay = fc.model(f, kind, nodes[v].pose, nodes[j].pose, by_pose)
    i, w = f.information, f.weight
    gx = w * (i[0] * ex + i[1] * ey + i[2] * eth)
    gy = w * (i[1] * ex + i[3] * ey + i[4] * eth)
    gth = w * (i[2] * ex + i[4] * ey + i[5] * eth)
    energy = ex * gx + ey * gy + eth * gth
    terms = w * (i[0] * ex * ex + i[3] * ey * ey + i[5] * eth * eth)
    if k >= 0:
        for m in range(2):
            x, y, th = fc.by_state(f, 1.0 - m, float(m))
            right[k, m] -= x * gx + y * gy + th * gth
    gx, gy = c * gx - s * gy, s * gx + c * gy
    right[v, 0] += gx
    right[v, 1] += gy
    right[v, 2] += ax * gy - ay * gx + gth
    if kind < fc.OBSERVED:
        ft, fth = fc.factors_of_end(f, kind)
        right[j, 0] -= ft * gx
        right[j, 1] -= ft * gy
        right[j, 2] -= fth * gth
    return energy, abs(gx) + abs(gy), terms
