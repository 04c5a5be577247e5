# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Installation by `pip install .`, `pip install -e .` and `colcon build`.

colcon obeys setup.cfg, which sends the executables to lib/pose_graph_ros, where `ros2 run` looks
for them; a launcher there gives `pose-graph` the name `pose_graph` as well. pip puts executables
into bin; there the two classes below add the launcher of the node, so that the package works alike
after each of the three.
"""

from glob import glob
from pathlib import Path

from setuptools import Distribution, find_packages, setup

from distutils.command.install_data import install_data  # isort: skip  (setuptools provides it)

PACKAGE = 'pose_graph_ros'
LAUNCHER = 'dev/pose_graph'
LIBEXEC = Path('lib', PACKAGE)
HERE = Path(__file__).resolve().parent


class DataDistribution(Distribution):
    """A distribution whose data files (share/) are installed by `pip install -e .`, too."""

    def has_data(self) -> bool:
        """Answer what setuptools' editable_wheel asks before it runs install_data."""
        return self.has_data_files()


class InstallData(install_data):
    """Install the data files and, where scripts do not go to lib/pose_graph_ros, a launcher."""

    def run(self) -> None:
        super().run()
        if Path(self.get_finalized_command('install').install_scripts).parts[-2:] == LIBEXEC.parts:
            return
        folder = Path(self.install_dir) / LIBEXEC
        folder.mkdir(parents=True, exist_ok=True)
        node = folder / 'pose_graph_node'
        self.copy_file(str(HERE / LAUNCHER), str(node))
        node.chmod(0o755)
        self.outfiles.append(str(node))


setup(
    name=PACKAGE,
    version='0.1.0',
    description='Online back end of pose-graph SLAM: fuses odometry, global poses and GNSS.',
    license='Apache-2.0',
    maintainer='pose_graph_ros maintainers',
    maintainer_email='maintainers@example.com',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={
        f'{PACKAGE}.cli': [f'page/{name}' for name in ('*.html', '*.css', '*.js', 'vendor/*')],
        f'{PACKAGE}.cli.migration': ['rules.yaml']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (str(LIBEXEC), [LAUNCHER]),
        (f'share/{PACKAGE}/config', sorted(glob('config/*'))),
        (f'share/{PACKAGE}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    entry_points={
        'console_scripts': [
            'pose_graph_node = pose_graph_ros.ros.main:main',
            'pose-graph = pose_graph_ros.cli.main:main',
        ],
    },
    cmdclass={'install_data': InstallData},
    distclass=DataDistribution,
    zip_safe=True,
    python_requires='>=3.11',
    # The lower bounds are what Ubuntu 24.04 has. rclpy and the messages come with ROS.
    # Of Numba it has none; 0.60 is the first with math.log2, and takes its Python and NumPy.
    # Tested with 0.60.0 and 0.68.1 on NumPy 1.26, 0.61.2 on NumPy 2.2, 0.68.1 on NumPy 2.4.
    # The upper bound is that of core/compiled/numba_internals.py, which says why.
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'numba>=0.60,<0.69',
        'pyproj>=3.6',
        'matplotlib>=3.6',
        'networkx>=2.8',
        'rosbags>=0.11',
        'tqdm>=4.66',
        'PyYAML>=6.0',
    ],
    extras_require={
        # for `pose-graph fleet` alone; bokeh draws the dashboard of Dask
        'fleet': ['dask[distributed]>=2024.8', 'pyarrow>=14', 'bokeh>=3.1'],
        'test': ['pytest>=7.4', 'pytest-timeout>=2.2', 'pytest-xdist>=3.4', 'coverage>=7.4',
                 'hypothesis>=6.98', 'evo>=1.38', 'playwright>=1.40'],
        'dev': ['ruff', 'mypy', 'scipy-stubs'],
    },
)
