# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Compare trajectories: which poses belong together, how far they differ, and how well that is known.

An estimate and a reference go in as `PoseSequence`; `association` finds their common poses,
`similarity` aligns one with the other, `errors` has absolute and relative errors, and
`statistics` their summaries and the consistency of covariances. All are functions of arrays,
defined as the tool evo defines them where it has them. Read `comparison` first: it does all this
in one call.
"""
