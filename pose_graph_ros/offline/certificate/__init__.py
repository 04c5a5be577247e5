# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Certificates of global optimality: whether a minimum of a pose graph is the lowest of all.

Input are the constraints of a graph as arrays and poses at a minimum; the result is a
`Certificate`, with the lower bound that was proved. It applies to an objective that is nearly
chi2, but quadratic in complex headings and positions (`formulation`). `certify`, the module to
read first, checks the minimum and, if it is not the global one, searches for a lower one.
`spectrum` has the proof, `quadratic_form` and `riemannian` the optimisation over unit headings.
"""
