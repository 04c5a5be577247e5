# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The package installed by pip, by pip -e and by colcon.

Each way gets a copy of the tree and must leave behind what `ros2 run` and `ros2 launch` look for:
the package in the ament index, its executables in lib/pose_graph_ros, its files in share/.
"""

from dataclasses import dataclass
import functools
import json
import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any
from xml.etree import ElementTree

import pytest

import pose_graph_ros

pytest.importorskip('rclpy')
pytest.importorskip('setuptools')

PACKAGE = 'pose_graph_ros'
EXECUTABLES = ('pose_graph', 'pose_graph_node')    # for `ros2 run`
TREE = Path(__file__).resolve().parents[1]
# whoever adds a file to one of the folders wants it to be installed
SHARED_FILES = ('package.xml', *(
    str(path.relative_to(TREE)) for folder in ('config', 'launch')
    for path in sorted((TREE / folder).iterdir()) if path.is_file()))
LEFT_OUT = shutil.ignore_patterns(
    '.*', '*.egg-info', '__pycache__', 'build', 'install', 'log', 'demo', 'docs', 'test')
DEADLINE = 240.0    # [s] of any one command, below the time limit of a test

ASK = f"""
from importlib.metadata import distribution, requires
import json
from ament_index_python import get_package_prefix, get_package_share_directory
import {PACKAGE}
from {PACKAGE}.cli.report import render
points = distribution('{PACKAGE}').entry_points.select(group='console_scripts')
print(json.dumps({{
    'prefix': get_package_prefix('{PACKAGE}'), 'module': {PACKAGE}.__file__,
    'share': get_package_share_directory('{PACKAGE}'), 'version': {PACKAGE}.__version__,
    'commands': sorted(point.name for point in points if callable(point.load())),
    'page': render({{}}), 'requires': requires('{PACKAGE}')}}))
"""

pytestmark = [pytest.mark.ros, pytest.mark.slow]


@dataclass(frozen=True)
class Installation:
    """One way of installing, done."""

    prefix: Path
    """Holds lib/ and share/ of the package."""
    modules: Path
    """The folder that the Python modules must come from."""
    python: Path
    environment: dict[str, str]
    """As after `source install/setup.bash`, or in the activated virtual environment."""

    @functools.cached_property
    def answers(self) -> dict[str, Any]:
        """What a program finds there."""
        found: dict[str, Any] = json.loads(run(
            self.python, '-c', ASK, env=self.environment, cwd=Path('/')))
        return found


def run(*command: str | Path, env: dict[str, str], cwd: Path | None = None) -> str:
    """Return the output of a command; if the command fails, the output is in the message."""
    done = subprocess.run(
        [str(word) for word in command], env=env, cwd=cwd, timeout=DEADLINE, check=False,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, f'{command} ended with {done.returncode}:\n{done.stdout}'
    return done.stdout


def source_files() -> list[str] | None:
    """Return what git tracks or would add, as relative paths; None where this is no checkout."""
    if shutil.which('git') is None or not (TREE / '.git').exists():
        return None
    listed = subprocess.run(
        ['git', 'ls-files', '-coz', '--exclude-standard'],
        cwd=TREE, capture_output=True, text=True, check=False)
    return listed.stdout.split('\0')[:-1] if listed.returncode == 0 else None


def copy_tree(target: Path) -> Path:
    files = source_files()
    if files is None:
        return Path(shutil.copytree(TREE, target, ignore=LEFT_OUT))
    for name in files:
        if (TREE / name).is_file():     # git also lists what has just been deleted
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(TREE / name, target / name)
    return target


def base_environment() -> dict[str, str]:
    """
    Return the environment of this process without the package under test.

    If the tests run from the ROS wheels, LD_LIBRARY_PATH leads to these wheels, and the variable
    that keeps them from setting it again is there, too. Both are right for the interpreters
    started here, because they use the very same wheels.
    """
    environment = dict(os.environ)
    paths = environment.pop('PYTHONPATH', '').split(os.pathsep)
    paths = [path for path in paths if path and not Path(path, PACKAGE).is_dir()]
    if len(paths) > 0:
        environment['PYTHONPATH'] = os.pathsep.join(paths)
    return environment


def ament_prefixes(*prefixes: Path) -> str:
    inherited = os.environ.get('AMENT_PREFIX_PATH', '')
    return os.pathsep.join([*map(str, prefixes), *filter(None, inherited.split(os.pathsep))])


def make_venv(folder: Path) -> Path:
    """Return the Python of a new environment that sees the packages of this one."""
    run(sys.executable, '-m', 'venv', '--without-pip', folder, env=base_environment())
    python = folder / 'bin' / 'python'
    site_packages = run(
        python, '-c', 'import sysconfig; print(sysconfig.get_path("purelib"))',
        env=base_environment()).strip()
    seen = [path for path in sys.path if Path(path).name in {'site-packages', 'dist-packages'}]
    Path(site_packages, 'underlay.pth').write_text('\n'.join(seen) + '\n', encoding='utf-8')
    return python


def install_with_pip(folder: Path, *options: str) -> Installation:
    tree = copy_tree(folder / 'tree')
    prefix = folder / 'venv'
    python = make_venv(prefix)
    environment = base_environment() | {'AMENT_PREFIX_PATH': ament_prefixes(prefix)}
    run(sys.executable, '-m', 'pip', '--python', python, 'install', '--no-deps',
        '--no-build-isolation', '--no-index', *options, tree, env=environment)
    return Installation(prefix, tree if '-e' in options else prefix, python, environment)


def install_with_colcon(folder: Path) -> Installation:
    places = (str(Path(sys.prefix, 'bin')), os.environ['PATH'])
    colcon = shutil.which('colcon', path=os.pathsep.join(places))
    if colcon is None:
        pytest.skip('colcon is not installed')
    if ' ' in sys.executable:
        pytest.skip('the scripts that colcon writes cannot name a Python whose path has a space')
    copy_tree(folder / 'src' / PACKAGE)
    environment = base_environment() | {
        'AMENT_PREFIX_PATH': ament_prefixes(Path(sys.prefix)), 'COLCON_HOME': str(folder / 'home')}
    run(colcon, 'build', '--event-handlers', 'console_direct+', env=environment, cwd=folder)
    sourced = run('bash', '-c', 'source install/setup.bash && env -0', env=environment, cwd=folder)
    environment = dict(entry.split('=', 1) for entry in sourced.split('\0')[:-1])
    prefix = folder / 'install' / PACKAGE
    return Installation(prefix, prefix, Path(sys.executable), environment)


@pytest.fixture(scope='module', params=['pip', 'pip -e', 'colcon'])
def installation(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory,
) -> Installation:
    folder = tmp_path_factory.mktemp('installation').resolve()
    if request.param == 'colcon':
        return install_with_colcon(folder)
    return install_with_pip(folder, *request.param.split()[1:])


def test_ament_index_leads_to_the_installation(installation):
    found = installation.answers
    assert Path(found['prefix']) == installation.prefix
    assert Path(found['share']) == installation.prefix / 'share' / PACKAGE
    assert Path(found['module']).is_relative_to(installation.modules)
    assert found['version'] == pose_graph_ros.__version__


def test_shared_files_are_those_of_the_tree(installation):
    for name in SHARED_FILES:
        installed = installation.prefix / 'share' / PACKAGE / name
        assert installed.read_bytes() == (TREE / name).read_bytes()


def test_executables_are_where_ros2_run_looks(installation):
    found = {path.name for path in (installation.prefix / 'lib' / PACKAGE).iterdir()
             if os.access(path, os.X_OK) and path.is_file()}
    assert found >= set(EXECUTABLES)


def test_executable_starts(installation):
    executable = installation.prefix / 'lib' / PACKAGE / 'pose_graph'
    assert 'usage: pose-graph replay' in run(
        executable, 'replay', '--help', env=installation.environment, cwd=Path('/'))


def test_no_common_word_is_put_on_the_path(installation):
    assert installation.answers['commands'] == ['pose-graph', 'pose_graph_node']


def test_what_tools_read_is_installed_with_them(installation):
    folder = TREE / PACKAGE / 'cli'
    expected = {path.relative_to(folder) for path in folder.rglob('*.*')
                if path.suffix not in {'.py', '.pyc', '.nbi', '.nbc'}}
    assert len(expected) > 11
    assert installation.answers['page'].rstrip().endswith('</html>')
    where = Path(installation.answers['module']).parent
    assert all((where / 'cli' / path).is_file() for path in expected)


def test_dask_comes_with_its_extra_alone(installation):
    asked = [text for text in installation.answers['requires']
             if text.startswith(('dask', 'distributed', 'pyarrow', 'bokeh', 'fsspec'))]
    assert len(asked) == 3
    assert all(text.endswith('extra == "fleet"') for text in asked)


def test_version_is_the_same_everywhere():
    manifest = ElementTree.parse(TREE / 'package.xml').getroot()
    answer = run(sys.executable, 'setup.py', '--version', env=base_environment(), cwd=TREE)
    assert manifest.findtext('version') == pose_graph_ros.__version__
    assert answer.split()[-1] == pose_graph_ros.__version__
