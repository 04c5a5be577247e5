# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The incremental smoother: an update of the graph goes in, the estimate of all poses comes out.

`incremental` is the module to read first: its `IncrementalSmoother` owns the graph, applies each
update as a transaction and returns covariances of the nodes. `step` repeats three stages until
the linearization error is within a budget: `tree_update` eliminates the affected cliques of the
Bayes tree again, `back_substitution` solves as far as values change, and `step` itself selects the
constraints to linearize again. `chain` appends a node to a chain in constant time, and
`forgetting` takes nodes out. `trial` lets the batch optimiser work on copies: the whole graph if a
step diverges, or one with other weights, part by part. `covariances` computes marginal covariances
from the tree, and those of the errors of new constraints.
"""
