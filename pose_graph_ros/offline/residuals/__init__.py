# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether the residuals of each source are as large, and as independent, as its covariances claim.

The graph at its estimate comes in, with the covariances of all nodes. What goes out are the
residuals by source, with what is expected of them, the factor on the claimed sigmas that they show
and its uncertainty, and their correlation in time. Nothing is changed. Read first
`source_residuals`, then `variance_components`.
"""
