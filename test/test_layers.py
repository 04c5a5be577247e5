# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who may import whom, read from the imports themselves."""

import ast
from pathlib import Path
import subprocess
import sys

import pytest

import pose_graph_ros

PACKAGE = Path(pose_graph_ros.__file__).parent
MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob('*.py'))

# A module of core may import those before it, and no others.
CORE = (
    'kernel_cache', 'jit', 'exceptions', 'arrays', 'sources', 'se2', 'motion', 'saved_columns',
    'covariance', 'measurements', 'config', 'admission', 'constraints', 'linearize', 'robust',
    # the graph, which knows nothing of how it is solved
    'tables', 'vectors', 'cholesky', 'factors', 'undo', 'rows', 'editing', 'graph',
    # elimination
    'ordering', 'frames', 'fronts', 'structure', 'assembly', 'elimination',
    # the batch optimiser, which knows nothing of the smoother
    'symbolic', 'complex_system', 'initialization', 'joint_start', 'gauss_newton', 'descent',
    'batch', 'starts',
    # the incremental smoother
    'carrying', 'back_substitution', 'relinearization', 'step', 'chain', 'sparse_inverse',
    'marginals', 'rescue', 'incremental',
    # what drives it
    'timeline', 'unheard', 'odometry_stream', 'trajectory', 'consensus', 'alignment', 'binding',
    'hidden_nodes', 'anchoring', 'pending', 'reweighing', 'closing', 'autocorrelation',
    'correlated', 'joining', 'arrivals', 'springs', 'estimate', 'aligning',
    # the whole as a value, with its place on the Earth, and who drives all that
    'tangent_plane', 'saved_graph', 'saving', 'backend', 'prediction', 'io', 'io.g2o', 'io.tum',
    'io.plain', 'io.whole_files', 'io.graph_files', 'helper_process', 'warm_up',
)
CORE_NEEDS = {'numpy', 'scipy', 'numba', 'pyproj'}

# Modules of ros that the offline tools share: they know messages by their fields alone.
WITHOUT_RCLPY = {
    'bag_writer', 'bags', 'continuity', 'conversions', 'fixes', 'hearing', 'inputs', 'intake',
    'markers', 'memory', 'parameter_changes', 'parameter_texts', 'parameters', 'reader', 'rewind',
    'setting', 'slew', 'sources', 'static_frames'}
ROS = {'rclpy', 'rosidl_runtime_py', 'ament_index_python', 'launch', 'launch_ros'}

MOST_LINES = 450


def imports(path: Path, *, at_run_time: bool = False) -> set[str]:
    """
    Return the full names of all that a module imports, anywhere in it.

    `from a import b` counts as `a.b`; whether b is a module or a name in a does not matter here.
    At run time leaves out what stands under `if TYPE_CHECKING`.
    """
    tree = ast.parse((PACKAGE / path).read_text(encoding='utf-8'))
    skipped: set[ast.AST] = set()
    if at_run_time:
        for node in ast.walk(tree):
            if isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.unparse(node.test):
                skipped |= {inner for statement in node.body for inner in ast.walk(statement)}
    names = set()
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: a relative import'
            names |= {f'{node.module}.{alias.name}' for alias in node.names}
    return names


def tops(names: set[str]) -> set[str]:
    """Return the packages that the names begin with, without the standard library."""
    return {name.partition('.')[0] for name in names} - set(sys.stdlib_module_names)


def own(names: set[str], layer: str) -> set[str]:
    """Return what follows `pose_graph_ros.<layer>.` in the names that have it."""
    prefix = f'pose_graph_ros.{layer}.'
    return {name.removeprefix(prefix) for name in names if name.startswith(prefix)}


def is_ros(name: str) -> bool:
    top = name.partition('.')[0]
    return top in ROS or top.endswith(('_msgs', '_srvs', '_interfaces'))


def modules(layer: str) -> list[Path]:
    return [path for path in MODULES if path.parts[0] == layer]


def core_name(path: Path) -> str:
    return '.'.join(path.with_suffix('').parts[1:]).removesuffix('.__init__')


CORE_MODULES = [path for path in modules('core') if path != Path('core/__init__.py')]


def test_every_layer_is_looked_at() -> None:
    assert {path.parts[0] for path in MODULES} == {'core', 'ros', 'cli', '__init__.py'}
    assert {core_name(path) for path in CORE_MODULES} == set(CORE)
    assert all(len(modules(layer)) > 5 for layer in ('core', 'ros', 'cli'))


@pytest.mark.parametrize('path', CORE_MODULES, ids=core_name)
def test_core_imports_only_numbers(path: Path) -> None:
    assert tops(imports(path)) <= CORE_NEEDS | {'pose_graph_ros'}
    assert not own(imports(path), 'ros')
    assert not own(imports(path), 'cli')


@pytest.mark.parametrize('path', CORE_MODULES, ids=core_name)
def test_a_module_of_core_imports_only_those_before_it(path: Path) -> None:
    before = CORE[:CORE.index(core_name(path))]
    for name in own(imports(path), 'core'):
        module = name if name in CORE else name.rpartition('.')[0]
        assert module in before, f'{core_name(path)} imports {name}'


@pytest.mark.parametrize('path', modules('ros'), ids=str)
def test_ros_never_imports_cli_and_shares_what_it_promises(path: Path) -> None:
    assert not own(imports(path), 'cli')
    if path.stem in WITHOUT_RCLPY:
        assert not {name for name in imports(path) if is_ros(name)}
        others = own(imports(path), 'ros')
        assert {name.partition('.')[0] for name in others} <= WITHOUT_RCLPY


@pytest.mark.parametrize('path', modules('cli'), ids=str)
def test_cli_never_imports_ros_packages(path: Path) -> None:
    names = imports(path)
    assert not {name for name in names if is_ros(name)}
    shared = {name.partition('.')[0] for name in own(names, 'ros')}
    assert shared <= WITHOUT_RCLPY


@pytest.mark.parametrize('module', [
    'pose_graph_ros.cli.main', 'pose_graph_ros.cli.replay', 'pose_graph_ros.cli.solve',
    'pose_graph_ros.core.backend'])
def test_a_fresh_interpreter_has_no_rclpy_after_an_import(module: str) -> None:
    code = f'import sys, {module}; print(*sys.modules)'
    loaded = subprocess.run(
        [sys.executable, '-c', code], check=True, capture_output=True, text=True,
        timeout=60).stdout.split()
    assert module in loaded
    assert not {name for name in loaded if is_ros(name)}
    if '.core.' in module:
        # (Numba reads a settings file, with PyYAML if that is there)
        assert not {name for name in loaded if name.startswith(('rosbags', 'matplotlib'))}


@pytest.mark.parametrize('path', MODULES, ids=str)
def test_no_module_is_longer_than_a_reader_can_hold(path: Path) -> None:
    assert len((PACKAGE / path).read_text(encoding='utf-8').splitlines()) <= MOST_LINES
