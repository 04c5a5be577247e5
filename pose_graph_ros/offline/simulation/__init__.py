# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Simulated drives, whose truth is known.

A world gives a true motion, sensors measure along it with errors of their own, and disturbances
take away, move, delay or repeat what they measured. In go a seed and settings; out come arrays of
stamps and measurements, or a graph, with what is false in them. Equal seeds give equal drives,
and each sensor has random numbers of its own. Read first `recording`, then `worlds`.
"""
