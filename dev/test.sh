#!/usr/bin/env bash
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# usage: dev/test.sh VENV [arguments of pytest...]
# Run the checks and the tests, all of them even if one fails; fail if any has failed.
# Without arguments, all tests run, in parallel.

set -uo pipefail
cd -- "$(dirname -- "$0")/.." || exit 1
PYTHON=$1/bin/python
shift
failed=()
# else each of the processes that the tests start compiles all modules anew
unset PYTHONDONTWRITEBYTECODE

run() { # name, command...
    printf -- '--- %s\n' "$1"
    "${@:2}" || failed+=("$1")
}

run ruff "$PYTHON" -m ruff check
# mypy takes one processor, so it runs beside the tests
if [ -z "${ROS_DISTRO:-}" ]; then
    types=$(mktemp)
    "$PYTHON" -m mypy >"$types" 2>&1 &
    mypy=$!
    trap 'kill "$mypy" 2>/dev/null; rm -f "$types"' EXIT
else
    echo '--- mypy: left out, it is exact only with the NumPy of requirements.lock'
fi
# Files in parallel: many of their tests wait for other processes, those of the node longest, so they
# come first.
[ "$#" -gt 0 ] || set -- -n "${PYTEST_WORKERS:-3}" --dist loadfile --no-loadscope-reorder test/ros test
run pytest "$PYTHON" -m pytest -ra --durations=20 "$@"
if [ -n "${mypy:-}" ]; then
    wait "$mypy"
    status=$?
    run mypy bash -c 'cat "$1"; exit "$2"' mypy "$types" "$status"
fi

if [ "${#failed[@]}" -gt 0 ]; then
    printf 'failed: %s\n' "${failed[*]}" >&2
    exit 1
fi
