# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory that is returned to the system; in separate processes, as all of a process counts."""

import sys

import pytest
from separate_process import run

pytestmark = pytest.mark.skipif(sys.platform != 'linux', reason='what Linux says of a process')

def test_pages_of_files_go_and_the_process_goes_on() -> None:
    before, after, same = run('''
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.ros import memory
import llvmlite.binding, numpy as np
def work():
    llvmlite.binding.parse_assembly('define i32 @f() { ret i32 1 }').verify()
    return np.linalg.solve(np.eye(50) + 0.1, np.arange(50.0))
first, before = work(), resident('RssFile')
memory.release_memory()
print(before, resident('RssFile'), int(np.array_equal(first, work())))
''')
    assert same == 1.0
    assert before > 50.0
    assert after < 0.5 * before


def test_nothing_that_was_changed_or_can_be_is_let_go() -> None:
    (wrong,) = run('''
from pose_graph_ros.ros import memory
chosen = memory.unchanged_mappings()
wrong = 0 if len(chosen) > 3 else 1000
for line in Path('/proc/self/maps').read_text().splitlines():
    span, permissions, *rest = line.split()
    begin, end = (int(number, 16) for number in span.split('-'))
    if (begin, end) in chosen:
        wrong += permissions not in ('r--p', 'r-xp', '---p') or not rest[3].startswith('/')
print(wrong)
''')
    assert wrong == 0.0


def test_large_arrays_give_their_pages_back() -> None:
    kept, given_back = (run(f'''
import numpy as np
from pose_graph_ros.ros import memory
{call}
np.ones(1_000_000)          # the first that is freed
before = resident('RssAnon')
arrays = [np.ones(1_000_000) for _ in range(8)]
last = bytearray(100_000)   # lies above them where they are in the heap
del arrays
print(resident('RssAnon') - before)
''')[0] for call in ('', 'memory.give_back_large_arrays()'))
    assert given_back < 4.0 <= kept
