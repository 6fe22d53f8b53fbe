"""Replace equal files of a folder by hard links, which saves disk space: ``link_twins.py .venv``.

ROS's wheels hold each library under three names, since wheels have no links, and eight of the wheels hold OpenSSL.
"""

from __future__ import annotations

import filecmp
import os
import sys
from collections import defaultdict
from pathlib import Path

SMALLEST = 65536  # bytes; smaller files save nothing


def main(folder: str) -> None:
    """Replace each file that equals an earlier file by a hard link to it."""
    by_size: dict[tuple[int, int], list[Path]] = defaultdict(list)
    for directory, _, names in os.walk(folder):
        for path in (Path(directory, name) for name in sorted(names)):
            status = path.lstat()
            if status.st_size >= SMALLEST and not path.is_symlink():
                by_size[status.st_size, status.st_mode].append(path)
    for paths in by_size.values():
        kept: list[Path] = []
        for path in paths:
            twin = next((other for other in kept if filecmp.cmp(other, path, shallow=False)), None)
            if twin is None:
                kept.append(path)
            elif not twin.samefile(path):
                link = path.with_name(path.name + ".link")
                os.link(twin, link)
                link.replace(path)


if __name__ == "__main__":
    main(sys.argv[1])
