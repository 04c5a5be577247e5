# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure the engine, beside GTSAM or alone; not installed and not needed by anything else.

`engine`, `solve`, `inputs`, `robust`, `window`, `load` and `malformed` are the pages, each with
its sections; `worlds`, `files`, `drives`, `recordings`, `wrong_closures` and `course` are what is
measured on; `runs` drives `ours` and `gtsam_peer` step by step, `peer` is a program around GTSAM;
`section` and `metrics` hold what was found, `report` writes it down, `__main__` reads the command
line. `belief` is a program of its own.
"""

import os

# One thread, also in what NumPy, SciPy and GTSAM call: set before any of them is imported.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'TBB_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
