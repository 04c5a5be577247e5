# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What only tools use, on top of the engine: certificates, tuning, simulation, drawing.

Arrays and graphs go in and come out, as in `core`. Nothing in `core`, `adapters` or `ros` imports
from here, and nothing here knows of files or colours. `certify` proves whether a minimum of a pose
graph is the lowest of all, for the objective of `chordal_objective`. `source_residuals` and
`variance_components` tell whether residuals are as large, and as independent, as covariances
claim; `noise` tells it from the measurements of a whole drive. `graph_views` are those of a small
graph, `pattern` those of H and R. `simulation` has drives whose truth is known.
"""
