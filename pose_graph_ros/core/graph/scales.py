# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Diagonal scales of nodes: the information that the constraints of each have on it alone."""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import factor_types, tables as tb


@kernel
def add_to_scale(head, v, position, heading):  # type: ignore[no-untyped-def]
    """
    Add information to the squared diagonal scales of a node.

    Parameters
    ----------
    v : int, node
    position, heading : float, information, or the change of it [1/m^2, 1/rad^2]

    """
    node_f = tb.node_f(head)
    f = node_f[v]
    f[tb.SCALE_T] = math.sqrt(max(f[tb.SCALE_T] * f[tb.SCALE_T] + position, 0.0))
    f[tb.SCALE_R] = math.sqrt(max(f[tb.SCALE_R] * f[tb.SCALE_R] + heading, 0.0))


@kernel
def scale_by_edge(head, e, weight):  # type: ignore[no-untyped-def]
    """
    Add the information of an edge to the diagonal scales of its ends.

    Parameters
    ----------
    e : int
    weight : float, its weight, or the change of it

    """
    edge_f, edge_i = tb.edge_f(head), tb.edge_i(head)
    f = edge_f[e]
    position = 0.5 * weight * (f[tb.INFO] + f[tb.INFO + 3])
    heading = weight * f[tb.INFO + 5]
    # of a relative error the length of the mean, of others that of the offset
    arm2 = f[tb.OWN] * f[tb.OWN] + f[tb.OWN + 1] * f[tb.OWN + 1]
    add_to_scale(head, edge_i[e, tb.END_I], position, heading + position * arm2)
    ft, fth = factor_types.factors_of_end(f, edge_i[e, tb.EDGE_KIND])
    add_to_scale(head, edge_i[e, tb.END_J], ft * ft * position, fth * fth * heading)
    if edge_i[e, tb.END_K] >= 0:
        rate2 = f[tb.FACTOR_TH] * f[tb.FACTOR_TH]
        add_to_scale(head, edge_i[e, tb.END_K], weight * f[tb.INFO + 5] * rate2, 0.0)


@kernel
def scale_by_observed(head, k, weight):  # type: ignore[no-untyped-def]
    """
    Add the information of an observed node to the diagonal scales of its hidden node.

    Parameters
    ----------
    k : int
    weight : float, its weight, or the change of it

    """
    observed_f, observed_i = tb.observed_f(head), tb.observed_i(head)
    f = observed_f[k]
    position = 0.5 * weight * (f[tb.INFO] + f[tb.INFO + 3])
    arm2 = (f[tb.OFFSET] * f[tb.OFFSET]
            + f[tb.OFFSET + 1] * f[tb.OFFSET + 1])
    add_to_scale(head, observed_i[k, tb.OBS_NODE], position,
                  weight * f[tb.INFO + 5] + position * arm2)
