# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Start the node with its parameter file, and optionally RViz.

    ros2 launch pose_graph_ros pose_graph.launch.py odom:=/wheel/odometry fix:=/gnss/fix rviz:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'pose_graph_ros'

# Launch argument, topic of the node, and type of the messages of each input.
INPUTS = (
    ('odom', 'odom', 'nav_msgs/Odometry'),
    ('fix', 'gps/fix', 'sensor_msgs/NavSatFix'),
    ('imu', 'imu/data', 'sensor_msgs/Imu, if the parameter sources lists imu'),
    ('global_pose', 'global_pose', 'geometry_msgs/PoseWithCovarianceStamped'),
    ('loop_closure', 'loop_closure', 'geometry_msgs/PoseWithCovarianceStamped'),
)
# The same of each output.
OUTPUTS = (
    ('path', 'path', 'nav_msgs/Path'),
    ('pose', 'pose', 'geometry_msgs/PoseWithCovarianceStamped'),
    ('filtered_odometry', 'odometry/filtered', 'nav_msgs/Odometry'),
)
TRUE_OR_FALSE = ['true', 'false']


def generate_launch_description() -> LaunchDescription:
    config = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config'])
    arguments = [
        DeclareLaunchArgument(
            'params_file', default_value=PathJoinSubstitution([config, 'pose_graph.yaml']),
            description='yaml file of parameters'),
        DeclareLaunchArgument(
            'name', default_value='pose_graph', description='name of the node'),
        DeclareLaunchArgument(
            'namespace', default_value='', description='namespace of the node and its topics'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', choices=TRUE_OR_FALSE,
            description='take the time from /clock (simulation, ros2 bag play --clock)'),
        DeclareLaunchArgument(
            'log_level', default_value='info', description='debug, info, warn, error or fatal'),
        DeclareLaunchArgument(
            'autostart', default_value='true', choices=TRUE_OR_FALSE,
            description='configure and activate the node; otherwise a lifecycle manager does'),
        DeclareLaunchArgument(
            'rviz', default_value='false', choices=TRUE_OR_FALSE,
            description='start RViz as well; rviz2 must be installed'),
        DeclareLaunchArgument(
            'rviz_config', default_value=PathJoinSubstitution([config, 'pose_graph.rviz']),
            description='configuration of RViz'),
        *(
            DeclareLaunchArgument(name, default_value=topic, description=f'topic of {type_name}')
            for name, topic, type_name in (*INPUTS, *OUTPUTS)
        ),
    ]
    use_sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    autostart = ParameterValue(LaunchConfiguration('autostart'), value_type=bool)
    outputs = [(topic, LaunchConfiguration(name)) for name, topic, _ in OUTPUTS]
    node = Node(
        package=PACKAGE,
        executable='pose_graph_node',
        name=LaunchConfiguration('name'),
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[
            LaunchConfiguration('params_file'),
            {'use_sim_time': use_sim_time, 'autostart': autostart},
        ],
        remappings=[(topic, LaunchConfiguration(name)) for name, topic, _ in INPUTS] + outputs,
        ros_arguments=['--log-level', LaunchConfiguration('log_level')],
    )
    # The topics in the configuration of RViz are relative, so this namespace and these remappings
    # apply to them as well.
    rviz = Node(
        condition=IfCondition(LaunchConfiguration('rviz')),
        package='rviz2',
        executable='rviz2',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        arguments=['-d', LaunchConfiguration('rviz_config')],
        parameters=[{'use_sim_time': use_sim_time}],
        remappings=outputs,
    )
    return LaunchDescription([*arguments, node, rviz])
