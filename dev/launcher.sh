#!/bin/sh
# `ros2 run` looks for executables in lib/pose_graph_ros, pip puts them into bin: start that one.
here=$(dirname -- "$(readlink -f -- "$0")")
exec "$here/../../bin/$(basename -- "$0")" "$@"
