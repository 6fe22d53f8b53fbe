"""The house: which room may import which. The picture is in doc/architecture.md."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "hexapod_comp"
ROOMS = (
    "errors", "core", "pose", "formats", "machine", "compensation", "measurements", "virtual", "workspace",
    "calibration", "export", "replay", "ros", "nodes", "linuxcnc", "loop", "cli", "testing", "__main__",
)  # fmt: skip
"""From the ground up: a room imports from itself and from those before it."""

MODULES = sorted(PACKAGE.rglob("*.py"))
ROS_ROOMS = ("ros", "linuxcnc", "testing")
PICTURE_MODULES = ("pictures", "page", "figures")
PICTURE_LIBRARIES = {"matplotlib", "mpl_toolkits", "plotly", "viser"}


def loaded(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line and dotted name, as a list, of all that a module may load, inside functions too."""
    here = list(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    nodes = [ast.parse(path.read_text(encoding="utf-8"))]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            nodes += node.orelse
            continue
        nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = here[: len(here) - node.level] if node.level else []
            start += node.module.split(".") if node.module else []
            yield from ((node.lineno, [*start, alias.name]) for alias in node.names)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    here = path.relative_to(PACKAGE).with_suffix("").parts[0]
    for line, name in loaded(path):
        where = f"{path.name}, line {line}: {here} loads {'.'.join(name)}"
        if name[0] == PACKAGE.name and here != "__init__":
            assert ROOMS.index(name[1]) <= ROOMS.index(here), where
        assert name[0] != "rclpy" or here in ROS_ROOMS, where
        assert name[0] not in PICTURE_LIBRARIES or path.stem in PICTURE_MODULES, where


def test_no_two_classes_share_a_name():
    """A name in a message, an import or a talk at the machine means one thing."""
    places: dict[str, list[str]] = {}
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(f"{path.relative_to(PACKAGE)}:{node.lineno}")
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


def test_the_old_name_of_the_ros_room_finds_its_modules():
    from hexapod_comp.nodes.messages import message_pose

    from hexapod_comp.nodes import start
    from hexapod_comp.ros import start as same

    assert start is same
    assert callable(message_pose)
