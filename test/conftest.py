# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Coverage is measured in the processes that run tests, and not in the nodes that these start.

Nodes would take twice as long under a tracer, and what they run has tests without a process.
"""

import os

if 'PYTEST_XDIST_WORKER' in os.environ:
    os.environ.pop('COVERAGE_PROCESS_CONFIG', None)
