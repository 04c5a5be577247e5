#!/usr/bin/env bash
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# usage: dev/test.sh VENV [arguments of pytest...]
# Run the checks and then the tests, all of them even if one fails; fail if any has failed.

set -uo pipefail
cd -- "$(dirname -- "$0")/.." || exit 1
VENV=$1
shift
failed=()

run() { # name, command...
    local name=$1
    shift
    printf -- '--- %s\n' "$name"
    "$@" || failed+=("$name")
}

run ruff "$VENV/bin/ruff" check
if [ -z "${ROS_DISTRO:-}" ]; then
    run mypy "$VENV/bin/python" -m mypy
else
    echo '--- mypy: left out, it is exact only with the NumPy of requirements.lock'
fi
# once, not in each of the processes that tests start
run kernels "$VENV/bin/python" -c 'from pose_graph_ros.core.warm_up import warm_up
print(f"compiled, or loaded, in {warm_up():.1f} s")'
run pytest "$VENV/bin/python" -m pytest -ra --durations=10 "$@"

if [ "${#failed[@]}" -gt 0 ]; then
    printf 'failed: %s\n' "${failed[*]}" >&2
    exit 1
fi
