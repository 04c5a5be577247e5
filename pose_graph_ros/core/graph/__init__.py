# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose graph: hidden nodes and factors as rows of flat tables.

`graph` is the module to read first: a `Graph` takes in `GraphUpdate`s, each applied whole or not
at all, and gives out poses, factors and energies. `constraints` describes factors as arrays,
`checks` validates all that goes in; `tables` holds all rows in memory that compiled kernels
share, and names every column. The kernels in `rows` and `editing` write rows and take them out,
those in `factors` evaluate and linearize factors, and `transaction_log` logs changes for a
rollback. `reweighting` has the robust losses, and `graph_view` what is shown of a graph. Solving
is done in `elimination`, `smoother` and `batch`.
"""
