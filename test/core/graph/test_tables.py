# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory of the tables: what they take, and whose it is; in separate processes."""

import sys

import pytest
from separate_process import run

pytestmark = pytest.mark.skipif(sys.platform != 'linux', reason='what Linux says of a process')

_CHAIN = '''
import os
import numpy as np
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
def chain(n):
    smoother = IncrementalSmoother()
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=(0,)))
    for k in range(n - 1):
        smoother.extend(np.array([1.0, 0.0, 0.001]), np.diag([100.0, 100.0, 1000.0]))
    return smoother
def close(smoother):
    ends = [0], [smoother.graph.n_nodes - 1]
    smoother.update(GraphUpdate(factors=Factors(
        *ends, np.array([[5.0, 1.0, 0.5]]), np.eye(3)[None], [FactorKind.LOOP_CLOSURE])))
    return smoother.poses.copy()
'''


def test_a_forked_process_has_a_graph_of_its_own() -> None:
    moved, kept, goes_on = run(_CHAIN + '''
smoother = chain(20_000)
before, rows = smoother.poses.copy(), smoother.graph.rows()
child = os.fork()
if child == 0:
    os._exit(int(np.max(np.abs(close(smoother) - before)) > 100.0))
moved = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
kept = np.array_equal(smoother.poses, before) and all(
    np.array_equal(*columns) for columns in zip(
        rows.factors.columns, smoother.graph.factors.columns))
print(moved, int(kept), int(np.array_equal(close(smoother), close(chain(20_000)))))
''')
    assert (moved, kept, goes_on) == (1, 1, 1)


def test_tables_take_memory_for_the_rows_in_use_alone() -> None:
    reserved, filled = run(_CHAIN + '''
memory = 'RssAnon', 'RssShmem'
close(chain(2))         # loads the kernels
smoother, before = IncrementalSmoother(), resident(*memory)
smoother.graph.ensure(300_000, 600_000)
reserved = resident(*memory) - before
before, big = resident(*memory), chain(20_000)
print(reserved, resident(*memory) - before)
''')
    assert reserved < 2.0       # of 1 GB of addresses
    assert filled < 25.0        # 1 kB for each node with its edge and its clique


def test_a_table_grows_by_less_where_the_system_has_no_more() -> None:
    less, told, most = run('''
import resource
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.graph.tables import Memory
memory, rows = Memory(), 50_000_000
memory.ensure('pool_f', rows)
memory['pool_f'][:3] = 1.0, 2.0, 3.0
size = int(next(line for line in open('/proc/self/status') if 'VmSize' in line).split()[1]) * 1024
resource.setrlimit(resource.RLIMIT_AS, (size + 3 * 8 * rows, resource.RLIM_INFINITY))
memory.ensure('pool_f', rows + 1, keep=3)   # not four times as many
less = rows < len(memory['pool_f']) < 2 * rows and memory['pool_f'][:3].tolist() == [1.0, 2.0, 3.0]
def told(rows):
    try:
        memory.ensure('pool_f', rows, keep=3)
    except LinearSolveError as error:
        return str(rows) in str(error) and memory['pool_f'][2] == 3.0
print(int(less), int(told(10 * rows)), int(told(2**31)))
''')
    assert (less, told, most) == (1, 1, 1)
