"""Speed side by side in one run: kernels, batches, convergence, model blocks, the compensator beside a relay.

``python -m benchmarks.speed`` measures (six minutes), prints, and exits 1 when a bar is missed. With ``--doc`` it
also writes doc/speed.md and its picture, doc/pictures/speed.png. ``--save FILE`` keeps the figures,
``--load FILE`` makes text and picture from kept ones.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from hexapod_comp.formats.figures import save
from hexapod_comp.formats.outputs import write_text

from . import batches, blocks, convergence, genhexkins, kernels, loop
from .speed_picture import speed_picture
from .speed_text import page

DOC = Path(__file__).resolve().parents[1] / "doc"
PACKAGES = ("numpy", "scipy", "mujoco", "mujoco-core", "pin", "ros-jazzy-rclpy")


@dataclass
class Speed:
    """Everything that was measured."""

    where: dict[str, str]  # Processor, versions, load of the machine before the run
    kernels: list[kernels.Result]
    convergence: list[convergence.Convergence]
    honesty: convergence.Honesty | None
    traps: list[convergence.Trap]
    blocks: list[blocks.Block]
    parts: list[blocks.Part]
    loop: list[loop.Row]
    floor: list[loop.Row]
    batches: list[batches.Row]
    missing: list[str] = field(default_factory=list)  # Who did not take part, and why
    problems: list[str] = field(default_factory=list)  # Bars that were missed


def surroundings() -> dict[str, str]:
    """Return what the figures depend on."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
    found = {"processor": f"{os.cpu_count()} × {model}", "Python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    found["load before the run"] = f"{os.getloadavg()[0]:.1f}"
    return found


def measure(quick: bool) -> Speed:
    """Measure everything; `quick`: a tenth of the time, for trying."""
    where = surroundings()
    everybody, missing = kernels.contenders(500, 20_000)
    results = kernels.measure(everybody, 3 if quick else 25)
    rows, worth, caught = _convergence()
    size = {"bouts": 1 if quick else 10, "rounds": 4 if quick else 6, "seconds": 0.4}
    speed = Speed(
        where,
        results,
        rows,
        worth,
        caught,
        blocks.measure(3 if quick else 25),
        blocks.parts(3 if quick else 25),
        loop.measure(**size),
        loop.measure(**{**size, "bouts": max(1, size["bouts"] // 3)}, floor=True),
        batches.measure(1_000_000, 0.4) if quick else batches.measure(),
        missing,
    )
    speed.problems = _problems(speed)
    return speed


def _convergence() -> tuple[list[convergence.Convergence], convergence.Honesty | None, list[convergence.Trap]]:
    try:
        return convergence.convergence(convergence.YAWS), convergence.honesty(), convergence.traps()
    except genhexkins.NotHere:
        return [], None, []


def _problems(speed: Speed) -> list[str]:
    """Return which bars were missed."""
    found = kernels.problems(speed.kernels) + batches.problems(speed.batches)
    if speed.honesty is not None and not convergence.bars_kept(speed.convergence, speed.honesty):
        found.append("forward kinematics: fails at a yaw of 60–80°, or calls something solved that is not")
    for row in speed.loop:
        if not row.kept:
            ratios = f"{row.rate_ratio[1]:.3f} / {row.median_ratio[1]:.3f} / {row.p99_ratio[1]:.3f}"
            found.append(f"compensator at {row.name}: rate / median / 99 % of the relay's {ratios}")
    return found


def load(text: str) -> Speed:
    """Return kept figures."""
    told = json.loads(text)

    def rows(kind: type, name: str) -> list:
        return [kind(**row) for row in told[name]]

    def loops(name: str) -> list[loop.Row]:
        told_rows = [{k: tuple(v) if isinstance(v, list) else v for k, v in row.items()} for row in told[name]]
        figures = ("ours", "relay")
        return [loop.Row(**{k: loop.Figures(**v) if k in figures else v for k, v in row.items()}) for row in told_rows]

    return Speed(
        told["where"],
        rows(kernels.Result, "kernels"),
        rows(convergence.Convergence, "convergence"),
        convergence.Honesty(**told["honesty"]) if told["honesty"] else None,
        rows(convergence.Trap, "traps"),
        rows(blocks.Block, "blocks"),
        rows(blocks.Part, "parts"),
        loops("loop"),
        loops("floor"),
        rows(batches.Row, "batches"),
        told["missing"],
        told["problems"],
    )


def report(speed: Speed) -> str:
    """Return all tables for a person."""
    texts = [kernels.report(speed.kernels, speed.missing), batches.report(speed.batches)]
    if speed.honesty is not None:
        texts.append(convergence.report(speed.convergence, speed.honesty, speed.traps))
    texts += [blocks.report(speed.blocks, speed.parts), loop.report(speed.loop)]
    texts.append("beside a relay that does not even look at messages\n" + loop.report(speed.floor))
    return "\n\n".join([*texts, "\n".join(speed.problems) or "bars kept"])


def main() -> int:
    """Measure, print, and write what was asked for; exit 1 when a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--doc", action="store_true", help="write doc/speed.md and its picture")
    parser.add_argument("--save", metavar="FILE", help="keep the figures (JSON)")
    parser.add_argument("--load", metavar="FILE", help="use kept figures and measure nothing")
    parser.add_argument("--quick", action="store_true", help="a tenth of the time, for trying")
    options = parser.parse_args()
    speed = load(Path(options.load).read_text(encoding="utf-8")) if options.load else measure(options.quick)
    print(report(speed))
    if options.save:
        write_text(Path(options.save), json.dumps(asdict(speed), indent=1) + "\n")
    if options.doc:
        write_text(DOC / "speed.md", page(speed))
        save(speed_picture(speed), DOC / "pictures" / "speed.png")
    return 1 if speed.problems else 0


if __name__ == "__main__":
    sys.exit(main())
