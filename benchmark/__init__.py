# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure the engine against GTSAM; not installed and not needed by anything else.

`worlds`, `streets` and `files` make the graphs, `ours` and `gtsam_peer` run them, `excess` judges
the estimates, the `row_...` modules are the requirements, `metrics` holds the figures and gates
them, `report` writes them down.
"""

import os

# One thread, also in what NumPy, SciPy and GTSAM call: set before any of them is imported.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'TBB_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
