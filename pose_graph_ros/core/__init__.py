# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The engine of pose-graph SLAM: arrays and nanosecond stamps, no ROS, no clock, no printing.

Each package says in its `__init__` what happens in it; docs/design.md has which imports which.
Public names; import each from its own module, as importing all of them costs start time:

- `backend.PoseGraphBackend`: add odometry and measurements, update, and get the estimate.
- `config.BackendConfig`: all settings with their defaults.
- `measurements.OdometrySample`, `GlobalPose`, `Position`, `HeadingOnly`, `LoopClosure`: inputs.
- `measurements.Answer`: whether an input was accepted, waits, or was rejected, and why.
- `estimate.Estimate`, `estimate.UpdateReport`: immutable outputs.
- `estimate.predict`: propagate an estimate to newer odometry, without the back end.
- `warm_up.warm_up`: compile or load all kernels before the first measurement.
- `geometry.geodesy.TangentPlane`: convert latitude and longitude to map coordinates and back.
- `geometry.trajectory.Trajectory`: stamped poses with interpolation.
- `graph.graph.Graph`, `graph.graph.GraphUpdate`: a graph without sources, and an edit of it.
- `smoother.incremental.IncrementalSmoother`: solve such a graph edit by edit.
- `batch.optimizer.optimize`: optimise such a graph as a whole.
- `io.g2o.read_g2o`, `io.g2o.write_g2o`, `io.path_files.write_tum`: files for others.
- `io.graph_files.read_graph`, `io.graph_files.write_graph`: saved graphs.
- `exceptions.PoseGraphError`: base class of all exceptions of the engine.
"""
