"""A node as :mod:`benchmarks.soak` runs it: the same node, which also notes what could hold up its loop.

Usage: python -m benchmarks.soak_node EVENTS.jsonl compensator|strut_drive --ros-args …
"""

from __future__ import annotations

import gc
import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any


class Notes:
    """Writes collections of the garbage collector, with CLOCK_MONOTONIC, as JSON lines."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", buffering=1)
        self._began = 0.0
        gc.callbacks.append(self._on_collection)

    def write(self, **values: Any) -> None:
        """Write one line."""
        self._file.write(json.dumps(values) + "\n")

    def _on_collection(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self._began = time.monotonic()
            return
        now = time.monotonic()
        self.write(kind="gc", at=now, seconds=now - self._began, generation=info["generation"])


def main() -> int:
    """Run the node until SIGTERM."""
    events, name, *arguments = sys.argv[1:]
    Notes(Path(events))
    module = importlib.import_module(f"hexapod_comp.ros.{name}")
    return module.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
