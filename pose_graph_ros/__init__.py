# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Online back end of pose-graph SLAM for ROS 2.

`core` holds the engine (arrays and nanoseconds, no ROS), `ros` the node, `cli` the offline tools.
"""

import os

# Before NumPy is imported: all its matrices are small here, and with several threads it takes ten
# times as long for them where other programs want the processor as well.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

__version__ = '0.1.0'
