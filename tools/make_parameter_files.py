"""Write config/parameters.yaml and the tables of doc/parameters.md from the nodes' tables of parameters.

Run it after a change of such a table: ``python -m tools.make_parameter_files``. A test compares both files.
"""

from __future__ import annotations

import re
import sys
import textwrap
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hexapod_comp.linuxcnc import bridge as linuxcnc_bridge  # noqa: E402
from hexapod_comp.ros import adapter, compensator_state, instrument, mover, strut_drive  # noqa: E402
from hexapod_comp.ros.parameters import Parameter, shown  # noqa: E402

PAGE, FILE = ROOT / "doc" / "parameters.md", ROOT / "config" / "parameters.yaml"

TABLES = {
    "compensator": compensator_state.PARAMETERS,
    "strut_drive": strut_drive.PARAMETERS,
    "mover": mover.PARAMETERS,
    "instrument": instrument.PARAMETERS,
    "adapter": adapter.PARAMETERS,
    "linuxcnc_bridge": linuxcnc_bridge.PARAMETERS,
}

HEAD = """\
# All parameters of the nodes with their defaults. Copy the file, keep what differs on your machine, and start a node
# with --ros-args --params-file mine.yaml, or the launch file with params_file:=mine.yaml.
"""


def table(parameters: tuple[Parameter, ...]) -> str:
    """Return a node's parameters as a Markdown table."""
    rows = [
        f"| `{p.name}` | `{shown(p.default)}` | {_allowed(p)} | {p.taken.name.lower()} | {p.meaning} |"
        for p in parameters
    ]
    return "\n".join(["| parameter | default | allowed | applied | meaning |", "|---|---|---|---|---|", *rows])


def _allowed(parameter: Parameter) -> str:
    return parameter.allowed or {bool: "true, false", str: "text", list: "names"}[type(parameter.default)]


def page(text: str) -> str:
    """Return the text of doc/parameters.md with renewed tables, each below the heading with its node's name."""
    for node, parameters in TABLES.items():
        text = re.sub(rf"(?<=\n## {node}\n)[^#]*", lambda _, p=parameters: f"\n{table(p)}\n\n", text)
    return text.rstrip() + "\n"


def file() -> str:
    """Return the text of config/parameters.yaml, for nodes in any namespace."""
    text = HEAD
    for node, parameters in TABLES.items():
        lines: list[str] = []
        for p in parameters:
            lines += textwrap.wrap(f"# {p.described()}; applied {p.taken.value}", 110, subsequent_indent="# ")
            value = yaml.safe_dump([p.default], default_flow_style=True, width=200).strip()
            lines.append(f"{p.name}: {value[1:-1]}")
        text += f"\n/**/{node}:\n  ros__parameters:\n" + textwrap.indent("\n".join(lines), "    ") + "\n"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    FILE.write_text(file(), encoding="utf-8")
