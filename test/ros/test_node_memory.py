# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The memory of the process of the node."""

import subprocess
import sys

import pytest

# Blocks of 4 MB, freed, after one of 24 MB was; something small is kept behind them. Prints by
# how much the process has grown [MB].
FREED = """
from pathlib import Path
import numpy as np
from pose_graph_ros.ros.main import return_when_freed
def resident():
    return int(Path('/proc/self/statm').read_text().split()[1]) * 4096e-6
if {returned}:
    return_when_freed()
np.ones(3_000_000)
before = resident()
blocks = [np.ones(500_000) for _ in range(10)]
small = [bytearray(1000) for _ in range(1000)]
del blocks
print(resident() - before)
"""


@pytest.mark.parametrize('returned', [True, False])
def test_large_blocks_of_numpy_are_returned_when_they_are_freed(returned: bool) -> None:
    done = subprocess.run([sys.executable, '-c', FREED.format(returned=returned)], check=True,
                          capture_output=True, text=True)
    # if the C library kept no more without it, it would not be needed
    assert (float(done.stdout) < 10.0) is returned
