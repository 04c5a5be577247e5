# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which packages the set-up installs: those that run the node, and those that only tests need."""

from pathlib import Path
import re

TREE = Path(__file__).resolve().parents[1]


def pins(name: str) -> set[str]:
    lines = (TREE / name).read_text(encoding='utf-8').splitlines()
    found = [line.split('==') for line in lines if line and not line.startswith('#')]
    assert all(len(words) == 2 for words in found)
    names = {words[0] for words in found}
    assert len(names) == len(found)
    return names


def asked_for(text: str) -> set[str]:
    """Return the names of the requirements in a part of setup.py."""
    return {name.lower() for name in re.findall(r"'([A-Za-z][\w-]*)[^']*'", text)}


RUN, TEST = pins('requirements.lock'), pins('requirements-test.lock')
_, RUNS, TESTS = re.split('install_requires=|extras_require=', (TREE / 'setup.py').read_text())


def test_no_package_is_in_both_locks() -> None:
    assert not RUN & TEST


def test_what_runs_the_node_comes_without_tests_and_linters() -> None:
    assert asked_for(RUNS) <= RUN
    assert asked_for(TESTS) - {'fleet', 'test', 'dev'} <= TEST
    assert not {name for name in RUN if name.startswith(('colcon', 'pytest'))}


def test_the_installers_are_pinned() -> None:
    assert {'pip', 'setuptools', 'uv'} <= RUN
