# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which package may import which, read from the imports themselves."""

import ast
import functools
from graphlib import TopologicalSorter
from pathlib import Path
import subprocess
import sys

import pose_graph_ros

PACKAGE = Path(pose_graph_ros.__file__).parent
MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob('*.py'))

# What everything in `core` may import: settings, values and errors.
BASE = {'core.exceptions', 'core.config', 'core.measurements', 'core.quantities',
        'core.saved_columns'}
# The packages of `core`, and the other packages that each may import.
CORE = {
    'core.compiled': set(),
    'core.geometry': set(),
    'core.graph': {'core.compiled', 'core.geometry'},
    'core.elimination': {'core.compiled', 'core.graph'},
    'core.sparse': {'core.geometry'},
    'core.batch': {
        'core.compiled', 'core.geometry', 'core.graph', 'core.elimination', 'core.sparse'},
    'core.marginalization': {
        'core.compiled', 'core.geometry', 'core.graph', 'core.sparse'},
    'core.smoother': {
        'core.compiled', 'core.geometry', 'core.graph', 'core.elimination', 'core.batch'},
    'core.odometry': {'core.compiled', 'core.geometry', 'core.graph'},
    'core.sources': {'core.compiled', 'core.geometry', 'core.graph', 'core.odometry'},
    'core.belief': {
        'core.compiled', 'core.geometry', 'core.graph', 'core.odometry', 'core.sources'},
    'core.judgement': {
        'core.belief', 'core.compiled', 'core.geometry', 'core.graph', 'core.elimination',
        'core.batch', 'core.smoother', 'core.odometry', 'core.sources'},
    'core.window': {
        'core.compiled', 'core.geometry', 'core.graph', 'core.elimination',
        'core.marginalization', 'core.batch', 'core.smoother', 'core.odometry'},
}
CORE['core.alignment'] = {
    'core.belief', 'core.geometry', 'core.graph', 'core.judgement', 'core.odometry',
    'core.sources'}
CORE['core.io'] = set(CORE)
# What only tools use, and the packages of `core` that each may import.
OFFLINE = {
    'offline.chordal_objective': {'core.batch', 'core.geometry', 'core.graph', 'core.sparse'},
    'offline.certify': {'core.geometry', 'core.sparse', 'offline.chordal_objective'},
    'offline.graph_views': {'core.geometry', 'core.graph'},
    'offline.pattern': {
        'core.geometry', 'core.graph', 'core.elimination', 'offline.graph_views'},
    'offline.source_residuals': {
        'core.geometry', 'core.graph', 'core.sources', 'core.disagreement', 'core.parts'},
    'offline.variance_components': {
        'core.geometry', 'core.graph', 'core.sources', 'core.parts', 'offline.source_residuals'},
    'offline.simulation': {'core.geometry', 'core.graph'},
    'offline.noise': {
        'core.batch', 'core.belief', 'core.geometry', 'core.sources', 'core.parts'},
}
# The modules on top of the packages: the facade, what it hands out, and who drives it.
TOP = {'core.backend', 'core.disagreement', 'core.error_tuner', 'core.estimate',
       'core.forgetting', 'core.parts', 'core.recovery', 'core.refiner',
       'core.transaction', 'core.warm_up'}
# Third-party libraries of `core`.
LIBRARIES = {'numpy', 'scipy', 'numba', 'pyproj'}
DASK = {'dask', 'distributed', 'fsspec', 'pyarrow'}  # the extra `fleet`
ROS = {'rclpy', 'rosidl_runtime_py', 'ament_index_python', 'launch', 'launch_ros'}

# What the node decides without ROS, so that it can be tested without.
LOGIC = ('input', 'log', 'stored_graphs', 'watchdog', 'worker')

MOST_LINES = 450


@functools.cache
def imports(path: Path) -> list[str]:
    """Return the full names of all that a module imports; `from a import b` counts as `a.b`."""
    found: list[str] = []
    for node in ast.walk(ast.parse((PACKAGE / path).read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: a relative import'
            found += [f'{node.module}.{alias.name}' for alias in node.names]
    return found


def package_of(module: str) -> str:
    """Return `core.graph` for `core.graph.graph.Graph`, `core.config` for `core.config.X`."""
    parts = module.split('.')
    return '.'.join(parts[:2]) if parts[0] in {'core', 'offline'} else parts[0]


def own_imports(path: Path) -> set[str]:
    """Return the packages of this project that a module imports, but for its own."""
    prefix = 'pose_graph_ros.'
    found = {package_of(name.removeprefix(prefix)) for name in imports(path)
             if name.startswith(prefix)}
    return found - {package_of('.'.join(path.with_suffix('').parts)), '__version__'}


def libraries(path: Path) -> set[str]:
    """Return the third-party libraries that a module imports."""
    tops = {name.partition('.')[0] for name in imports(path)}
    return tops - set(sys.stdlib_module_names) - {'pose_graph_ros'}


def is_ros(name: str) -> bool:
    top = name.partition('.')[0]
    return top in ROS or top.endswith(('_msgs', '_srvs', '_interfaces'))


def modules(*parts: str) -> list[Path]:
    return [path for path in MODULES if path.with_suffix('').parts[:len(parts)] == parts]


def test_every_package_is_looked_at() -> None:
    assert {path.parts[0] for path in MODULES} == {
        'core', 'offline', 'adapters', 'ros', 'cli', 'examples', '__init__.py'}
    inside = {package_of('.'.join(path.with_suffix('').parts)) for path in modules('core')}
    assert inside == {*CORE, *BASE, *TOP, 'core.__init__'}
    tools = {package_of('.'.join(path.with_suffix('').parts)) for path in modules('offline')}
    assert tools == {*OFFLINE, 'offline.__init__'}


def test_core_imports_only_numbers() -> None:
    assert not [(path, found) for path in modules('core')
                if (found := libraries(path) - LIBRARIES
                    | own_imports(path) & {'adapters', 'ros', 'cli', *OFFLINE})]


def test_only_one_module_imports_what_is_not_public_in_numba() -> None:
    # all the others are stable interfaces by Numba's documentation
    public = ('numba.types', 'numba.extending.', 'numba.config', 'numba.from_dtype')
    assert {path.name for path in MODULES for name in imports(path)
            if name.startswith('numba.') and not name.startswith(public)
            } <= {'numba_internals.py'}


def test_a_package_imports_only_those_below_it() -> None:
    assert not [(path, found) for package, below in (CORE | OFFLINE).items()
                for path in modules(*package.split('.'))
                if (found := own_imports(path) - below - BASE)]


def test_the_arrows_between_packages_form_no_circle() -> None:
    below: set[str] = set()
    for package, allowed in CORE.items():
        assert allowed <= below, package
        below.add(package)


def test_the_modules_of_core_import_each_other_in_no_circle() -> None:
    names = {'.'.join(('pose_graph_ros', *path.with_suffix('').parts)): path
             for path in modules('core')}
    graph: dict[str, set[str]] = {}
    for name, path in names.items():
        # `from a import b` imports a module b of a, or something that a module a defines
        graph[name] = {each for found in imports(path)
                       for each in (found, found.rpartition('.')[0]) if each in names} - {name}
    assert sum(map(len, graph.values())) > 200
    TopologicalSorter(graph).prepare()


def test_the_base_of_core_imports_no_engine() -> None:
    paths = [Path(*name.split('.')).with_suffix('.py') for name in BASE]
    assert not [(path, found) for path in paths
                if (found := own_imports(path) - BASE - {'core.geometry'})]


def test_only_the_node_imports_ros() -> None:
    # the demo of `cli` imports the player of `ros` by its name when it runs
    logic = [Path('ros', f'{name}.py') for name in LOGIC]
    assert not [(path, name) for path in (*modules('adapters'), *modules('cli'), *logic)
                for name in imports(path) if is_ros(name)]
    assert not [(path, name) for path in logic for name in imports(path)
                if name.startswith('pose_graph_ros.ros.') and name.split('.')[2] not in LOGIC]


def test_adapters_node_and_tools_import_nothing_above_them() -> None:
    above = {'adapters': {'ros', 'cli', *OFFLINE}, 'ros': {'cli', *OFFLINE}, 'cli': {'ros'}}
    assert not [(path, found) for folder, names in above.items() for path in modules(folder)
                if (found := own_imports(path) & names)]


def test_only_the_fleet_imports_dask() -> None:
    assert {path.parts[:2] for path in MODULES if libraries(path) & DASK} == {('cli', 'fleet')}
    # and the module that is imported first looks for them before
    assert not libraries(Path('cli', 'fleet', '__init__.py')) & DASK


def test_without_dask_one_line_says_what_to_install() -> None:
    code = (f'import sys; sys.modules |= dict.fromkeys({sorted(DASK)!r})\n'
            'from pose_graph_ros.cli.main import main; sys.exit(main(sys.argv[1:]))')
    for words, expected in ((['fleet', 'bags'], 2), (['parameters'], 0), (['fleet', '-h'], 0)):
        done = subprocess.run([sys.executable, '-c', code, *words], check=False, text=True,
                              capture_output=True, timeout=240)
        assert done.returncode == expected, done.stderr
        assert done.stderr == ('' if expected == 0 else (
            'error: pose-graph fleet needs dask, distributed, fsspec, pyarrow: pip install '
            "'dask[distributed]' pyarrow bokeh\n"))


def test_examples_can_be_copied_out_of_the_package() -> None:
    assert not [(path, found) for path in modules('examples') if (found := own_imports(path))]


def test_a_fresh_interpreter_has_no_rclpy_after_an_import() -> None:
    tools = ('pose_graph_ros.cli.main', 'pose_graph_ros.cli.replay', 'pose_graph_ros.cli.solve')
    code = ('import sys, pose_graph_ros.core.backend; print(*sys.modules)\n'
            f'import {", ".join(tools)}; print(*sys.modules)')
    done = subprocess.run(
        [sys.executable, '-c', code], check=True, capture_output=True, text=True, timeout=240)
    core, loaded = (line.split() for line in done.stdout.splitlines())
    assert {'pose_graph_ros.core.backend', *tools} <= set(loaded)
    assert not {name for name in loaded if is_ros(name) or name in DASK}
    # (Numba reads a settings file, with PyYAML if that is there)
    assert not {name for name in core if name.startswith(('rosbags', 'matplotlib'))}


def test_no_module_is_longer_than_a_reader_can_hold() -> None:
    lengths = {path: len((PACKAGE / path).read_text(encoding='utf-8').splitlines())
               for path in MODULES}
    assert not {path: length for path, length in lengths.items() if length > MOST_LINES}
