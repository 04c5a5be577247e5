# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What fuzzing has found and what it began with: each is answered soon, and in one line."""

from pathlib import Path
import resource
import time

from fuzz_targets import CORPUS, run_target, TARGETS
import pytest

LONGEST = 5.0  # [s]
MEMORY = 500_000  # [kB]


@pytest.mark.parametrize('name', TARGETS)
def test_no_input_ends_a_reader(name: str) -> None:
    inputs = sorted(Path(CORPUS, name).iterdir())
    run_target(name, inputs[0].read_bytes())    # loads what it needs
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for path in inputs:
        begin = time.process_time()
        run_target(name, path.read_bytes())
        assert time.process_time() - begin < LONGEST, path
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY
    assert {each.name for each in CORPUS.iterdir()} == {*TARGETS}
