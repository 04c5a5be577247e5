# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Programs in a process of their own, where what Linux says of a process counts."""

import subprocess
import sys

_RESIDENT = '''
from pathlib import Path
def resident(*names):
    """Return the sum of entries of the status of this process [MB]."""
    lines = Path('/proc/self/status').read_text().splitlines()
    values = dict(line.split(':', 1) for line in lines if ':' in line)
    return sum(int(values[name].split()[0]) for name in names) / 1000.0
'''


def run(program: str) -> list[float]:
    """Return the numbers that a program prints."""
    done = subprocess.run([sys.executable, '-c', _RESIDENT + program], check=True,
                          stdout=subprocess.PIPE, text=True, timeout=240)
    return [float(word) for word in done.stdout.split()]
