#!/usr/bin/env bash
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# usage: dev/test.sh VENV [arguments of pytest...]
# Run the checks and then the tests, all of them even if one fails; fail if any has failed.
# Without arguments, all tests run, in parallel, and the coverage is measured and gated.

set -uo pipefail
cd -- "$(dirname -- "$0")/.." || exit 1
PYTHON=$1/bin/python
shift
CORE_COVERAGE=95
OTHER_COVERAGE=88
failed=()
# The tests start a hundred interpreters, which need not compile the same modules each.
unset PYTHONDONTWRITEBYTECODE

run() { # name, command...
    local name=$1
    shift
    printf -- '--- %s\n' "$name"
    "$@" || failed+=("$name")
}

coverage() { "$PYTHON" -m coverage "$@"; }

with_coverage() { # files in parallel: many of their tests wait for other processes
    coverage erase
    coverage run -m pytest -ra --durations=20 -n "${PYTEST_WORKERS:-3}" --dist loadfile \
        --no-loadscope-reorder
    local status=$?
    coverage combine --quiet
    return "$status"
}

run ruff "$PYTHON" -m ruff check
if [ -z "${ROS_DISTRO:-}" ]; then
    run mypy "$PYTHON" -m mypy
else
    echo '--- mypy: left out, it is exact only with the NumPy of requirements.lock'
fi
# once on all processors, and not by each worker of its own accord
run kernels "$PYTHON" -m pose_graph_ros.cli.main compile-kernels
if [ "$#" -gt 0 ]; then
    run pytest "$PYTHON" -m pytest -ra --durations=10 "$@"
else
    run pytest with_coverage
    run 'coverage of core' coverage report --skip-covered --sort=cover \
        --include='pose_graph_ros/core/*' --fail-under="$CORE_COVERAGE"
    run 'coverage of the rest' coverage report --skip-covered --sort=cover \
        --omit='pose_graph_ros/core/*' --fail-under="$OTHER_COVERAGE"
fi

if [ "${#failed[@]}" -gt 0 ]; then
    printf 'failed: %s\n' "${failed[*]}" >&2
    exit 1
fi
