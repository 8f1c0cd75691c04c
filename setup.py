"""Package imu_calib for pip and for colcon (ament_python)."""

import os
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = 'imu_calib'
# With `colcon build --symlink-install` this file is a link, beside which there is nothing else.
FOLDER = Path(__file__).resolve().parent


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """List the files below a folder for installation under share/imu_calib."""
    files = [p for p in sorted(Path(folder).rglob('*')) if p.is_file() and p.suffix != '.pyc']
    targets = sorted({p.parent for p in files})
    return [(f'share/{NAME}/{t}', [str(p) for p in files if p.parent == t]) for t in targets]


def messages_are_missing() -> bool:
    """Tell whether colcon installs this package where its nodes will find no messages."""
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    installs = {'install', 'develop'} & set(sys.argv)
    packages = 'share/ament_index/resource_index/packages'
    return bool(installs and any(prefixes)) and not any(
        Path(prefix, packages, f'{NAME}_msgs').is_file() for prefix in prefixes
    )


# As `ros2 run imu_calib` and the launch files call them.
NODES = (
    'ascii_table_node',
    'calibrator_node',
    'compensator_node',
    'hand_node',
    'imu_node',
    'stand_node',
    'turntable_node',
    'web_node',
)

# Its wheels (11.0.1): Linux on x86_64, Python 3.10 to 3.13. Elsewhere DDS needs ROS 2.
DDS = (
    "cyclonedds>=11; platform_machine == 'x86_64' and sys_platform == 'linux' "
    "and python_version < '3.14'"
)

PLOT = 'matplotlib>=3.6'
DATA_FRAME = 'pandas>=2'
# Scenes that survive a lost WebGL context, with frames a second of our choice; its assets come
# with the wheel.
WEB = 'nicegui>=3.2'
# The first that refuses bytes which end within a string or a sequence.
ROSBAGS = 'rosbags>=0.11.6'
# Recordings behind URLs: S3, HTTP; other protocols by their own packages of fsspec.
REMOTE = ['fsspec>=2024.2', 's3fs>=2024.2', 'aiohttp>=3.9']
# The first whose wheel has what is plotted with in the browser.
BOKEH = 'bokeh>=3.2'
FLEET = ['distributed>=2024.8', BOKEH, 'pyarrow>=15', 'duckdb>=1', *REMOTE]
# As docs/interoperability.md tells what they made of our files; together some 900 MB.
READERS = [
    'dask==2026.8.0',
    'dcc-json-toolkit==1.2.5',
    'dsiunits==3.1.3',
    'duckdb==2.0.1',
    'foxglove-sdk==0.30.3',
    'imucal==2.6.0',
    'lxml==6.1.3',
    'mcap==1.6.0',
    'mcap-ros2-support==0.6.0',
    'opencv-python-headless==5.0.0.93',
    'pandas==3.1.1',
    'polars==2.1.0',
    'pydcc==0.2.33',
    'rerun-sdk==0.41.0',
    'rosbags==0.11.9',
]
DOCS = ['sphinx>=7', 'myst-nb>=1.1', 'furo>=2024.1.29']

setup(
    name=NAME,
    version=ElementTree.parse(FOLDER / 'package.xml').findtext('version'),
    description='Calibration of strapdown IMUs on a turntable: 24 parameters, no north reference',
    long_description=(FOLDER / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    author='The imu_calib developers',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'fleet/page.*s', 'live/web/page.*s', 'reports/*.css']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *shared('config'),
        *shared('launch'),
        *shared('urdf'),
        *shared('msg_defs/action'),
        *shared('msg_defs/msg'),
    ],
    python_requires='>=3.10',
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'pyyaml>=6',
        'rich>=13',
        'lz4>=4',
        'pyserial>=3.5',
        # Definitions and bytes of the messages that nodes exchange; ROS 1 bags.
        ROSBAGS,
        'threadpoolctl>=3.1',
        # Loaded only where a shell asks for completions.
        'argcomplete>=3',
        # Part of Python from 3.14 on.
        "backports.zstd>=1; python_version < '3.14'",
    ],
    extras_require={
        'dds': [DDS],
        'ros1': [ROSBAGS],
        'plot': [PLOT],
        'dataframe': [DATA_FRAME],
        'pdf': ['weasyprint>=62'],
        'fleet': FLEET,
        'remote': REMOTE,
        'web': [WEB],
        'docs': DOCS,
        'readers': READERS,
        'test': [
            'pytest>=7.4.4',
            'pytest-timeout>=2.2',
            'pytest-xdist>=3.4',
            'hypothesis>=6.98.15',
            # Oracles.
            'allantools>=2024.6',
            'dsiunits>=3.1',
            'dcc-json-toolkit>=1.2',
            'fastcrc>=0.5',
            # Its latest (2.6.0) refuses Python 3.14.
            "imucal>=2.6; python_version < '3.14'",
            'jsonschema>=4.10',
            'lxml>=5',
            # Another reader and writer of mcap in ROS 2.
            'mcap-ros2-support>=0.5.7',
            'nbclient>=0.10',
            'ipykernel>=6.29',
            # Looks at pages in the Chromium that is installed; brings none itself.
            'playwright>=1.40',
            # Reads printed pages.
            'pypdfium2>=4',
            DDS,
            PLOT,
            DATA_FRAME,
            *FLEET,
            # Recordings in buckets, from a server on this machine.
            # moto's extra for a server brings what all services need, sympy too.
            'moto[s3]>=5',
            'flask-cors',
            WEB,
        ],
        'dev': [
            *DOCS,
            PLOT,
            DATA_FRAME,
            WEB,
            'pandas-stubs',
            'import-linter>=2.1',
            'mypy>=1.11',
            'ruff>=0.9',
            'types-PyYAML',
            'types-pyserial',
        ],
    },
    entry_points={
        'console_scripts': [
            'imu-calib = imu_calib.cli.main:main',
            *(f'{node} = {NAME}.live.nodes.programs:{node}' for node in NODES),
        ]
    },
    zip_safe=False,
)

# At the end, where it is read: colcon looks for no package below another, and says nothing of it.
if messages_are_missing():
    folder = FOLDER / 'msg_defs'
    print(  # noqa: T201
        f'{NAME}_msgs, the messages of {NAME}, is not built, and nodes will not start without it. '
        'Its package lies below this one, where colcon does not look. In the workspace:\n'
        f'    ln -s {folder} src/{NAME}_msgs\nand colcon build again.',
        file=sys.stderr,
    )
