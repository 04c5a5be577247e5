# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Elimination of hidden nodes: a multifrontal Cholesky factorisation of the normal equations.

`ordering` chooses the order of elimination and with it the cliques of the Bayes tree; `symbolic`
has what it starts from and what becomes of its result, and does so for a whole graph at once.
`assembly`, the module to read first, eliminates one clique: it takes the constraints of the
frontal nodes and the update matrices of the children, and stores rows of R and the update matrix
for the parent. `fronts` has the dense kernels, `clique_frames` the rotation of cliques with their
separators. The incremental smoother and the batch optimisation are built on these parts.
"""
