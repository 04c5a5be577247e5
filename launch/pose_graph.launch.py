# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Start the node with its parameter file, and optionally RViz, such as on a robot.

    ros2 launch pose_graph_ros pose_graph.launch.py odom:=/wheel/odom state_file:=~/.ros/map.db
"""

from pathlib import Path
from sys import argv

from ament_index_python import packages
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.logging import get_logger
from launch_ros.actions import Node

from pose_graph_ros.adapters import launch_arguments

PACKAGE = 'pose_graph_ros'


def generate_launch_description() -> LaunchDescription:
    arguments = launch_arguments.arguments(Path(packages.get_package_share_directory(PACKAGE)))
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=description)
          for name, (default, description) in arguments.items()),
        OpaqueFunction(function=_nodes, args=[list(arguments)])])


def _nodes(context: LaunchContext, names: list[str]) -> list[LaunchDescriptionEntity]:
    """Return the node and RViz, by the arguments as they are given."""
    for sentence in launch_arguments.unknown(
            context.argv, names, included=all(Path(__file__).name not in item for item in argv)):
        get_logger(PACKAGE).warning(sentence)
    given = {name: context.launch_configurations[name] for name in names}
    # what comes later takes precedence
    parameters = [launch_arguments.parameter_file(given), launch_arguments.parameters(given)]
    node = Node(package=PACKAGE, executable='pose_graph_node', name=given['name'],
                namespace=given['namespace'], output='screen', parameters=parameters,
                remappings=launch_arguments.remappings(given),
                ros_arguments=['--log-level', given['log_level']])
    if not launch_arguments.switch(given, 'rviz'):
        return [node]
    try:
        packages.get_package_prefix('rviz2')
    except packages.PackageNotFoundError:
        return [node, LogInfo(msg='rviz:=true has no effect: the package rviz2 is not installed')]
    # The topics in the configuration of RViz are relative, so this namespace and these remappings
    # apply to them as well.
    return [node, Node(
        package='rviz2', executable='rviz2', namespace=given['namespace'], output='screen',
        arguments=['-d', given['rviz_config']], parameters=parameters,
        remappings=launch_arguments.display_remappings(given))]
