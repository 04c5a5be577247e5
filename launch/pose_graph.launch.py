# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Start the node with its parameter file.

    ros2 launch pose_graph_ros pose_graph.launch.py odom:=/wheel/odometry fix:=/gnss/fix
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'pose_graph_ros'

# launch argument, topic of the node, what arrives there
INPUTS = (
    ('odom', 'odom', 'nav_msgs/Odometry'),
    ('fix', 'gps/fix', 'sensor_msgs/NavSatFix'),
    ('imu', 'imu/data', 'sensor_msgs/Imu, if the parameter sources lists imu'),
    ('global_pose', 'global_pose', 'geometry_msgs/PoseWithCovarianceStamped'),
    ('loop_closure', 'loop_closure', 'geometry_msgs/PoseWithCovarianceStamped'),
)


def generate_launch_description() -> LaunchDescription:
    parameter_file = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'pose_graph.yaml'])
    arguments = [
        DeclareLaunchArgument(
            'params_file', default_value=parameter_file, description='yaml file of parameters'),
        DeclareLaunchArgument(
            'namespace', default_value='', description='namespace of the node and its topics'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', choices=['true', 'false'],
            description='take the time from /clock (simulation, ros2 bag play --clock)'),
        DeclareLaunchArgument(
            'log_level', default_value='info', description='debug, info, warn, error or fatal'),
        *(
            DeclareLaunchArgument(name, default_value=topic, description=f'topic of {type_name}')
            for name, topic, type_name in INPUTS
        ),
    ]
    node = Node(
        package=PACKAGE,
        executable='pose_graph_node',
        name='pose_graph',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[
            LaunchConfiguration('params_file'),
            {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)},
        ],
        remappings=[(topic, LaunchConfiguration(name)) for name, topic, _ in INPUTS],
        ros_arguments=['--log-level', LaunchConfiguration('log_level')],
    )
    return LaunchDescription([*arguments, node])
