"""The launch file, run without ROS's package launch, which PyPI lacks: its arguments and the nodes it would start."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

LAUNCH_FILE = Path(__file__).resolve().parents[1] / "launch" / "machine.launch.py"


class LaunchFile:
    """The shipped launch file, run with stand-ins for launch and launch_ros."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        parts: dict[str, dict[str, Any]] = {
            "launch": {"LaunchContext": dict, "LaunchDescription": list},
            "launch.actions": {"DeclareLaunchArgument": _argument, "OpaqueFunction": SimpleNamespace},
            "launch.substitutions": {
                "EnvironmentVariable": lambda _, default_value: default_value,
                "LaunchConfiguration": lambda name: SimpleNamespace(perform=lambda context: context.values[name]),
            },
            "launch_ros": {},
            "launch_ros.actions": {"Node": lambda **options: options},
        }
        for name, content in parts.items():
            module = ModuleType(name)
            module.__dict__.update(content)
            patch.setitem(sys.modules, name, module)
        self._patch = patch
        self._actions = runpy.run_path(str(LAUNCH_FILE))["generate_launch_description"]()
        self.defaults = {action.name: action.default for action in self._actions if hasattr(action, "name")}

    def start(self, *words: str, by: str = str(LAUNCH_FILE)) -> dict[str, dict[str, Any]]:
        """Return the start options of each executable for ``name:=value`` arguments of a command line."""
        self._patch.setattr(sys, "argv", ["ros2", "launch", by, *words])
        given = dict(word.split(":=", 1) for word in words)
        context = SimpleNamespace(argv=list(words), values={**self.defaults, **given})
        nodes: list[dict[str, Any]] = []
        for action in self._actions:
            if hasattr(action, "function"):
                nodes += action.function(context, *getattr(action, "args", [])) or []
        return {node["executable"]: node for node in nodes}


def _argument(name: str, default_value: str, **_: object) -> SimpleNamespace:
    return SimpleNamespace(name=name, default=default_value)
