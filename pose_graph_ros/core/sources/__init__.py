# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From a measurement with its own stamp to constraints of the graph.

Global poses, positions, headings and loop closures come in, in any order of stamps; updates of
the graph go out. `pipeline` is the module to read first: a measurement is checked (`validation`),
waits until odometry covers its stamp (`waiting`), and is attached to the hidden node before that
stamp (`measurement_constraints`). `factor_builder` turns the attached measurements into one update
and records which constraints belong to which source; `gauss_markov` does so for sources whose
errors are correlated in time. `source_report` and `autocorrelation` evaluate how well a source
fits the estimate, and `constraint_names` names the constraints with the largest energies.
"""
