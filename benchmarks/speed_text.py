"""doc/speed.md from what :mod:`benchmarks.speed` has measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .batches import BAR
from .batches import Row as Batch
from .convergence import Honesty, worth_rows
from .loop import BAR_MEDIAN, BAR_P99, BAR_RATE, Row

if TYPE_CHECKING:
    from .speed import Speed

OPENING = """# Speed, side by side

For whoever compares: kinematics, model blocks and the nodes' latency beside other programs, in one run.

```
pip install '.[bench]'                  # MuJoCo and Pinocchio
apt-get install linuxcnc-uspace gcc     # LinuxCNC's kinematics; or go without
python -m benchmarks.speed --doc        # measures everything in one run, and writes this page and its picture
```

{where}.

![Time per pose, convergence, cost of model blocks, latency](pictures/speed.png)

{verdict}

"""

KERNELS = """## Kinematics

The paper's machine; everybody gets the same poses and starts from home. `forward`, `inverse`: ±50 mm and ±30°
about home; `forward, near`: ±1 mm and ±1°, as from one command to the next. `batch`: one call for 20,000 poses on
one thread; `single`: one call from Python per pose. Processor time, medians of {rounds} rounds in turn; `× ours` is
the median of the rounds' ratios.

"""

GENHEXKINS = """
LinuxCNC's kinematics are its own compiled module as Debian installs it (`genhexkins.so`), with a stand-in of ours
for its HAL. Batches run in a loop in C that takes the time itself; single calls go through `ctypes` with all
addresses looked up before. It ends when every strut is right to its default, 1e-9 mm, or, in the rows `to 1e-8 m`,
to the size of our last step. `kinematicsForward` solves twice, the second time for the pins of a display; the row
`second solve` tells what that takes, so that it can be taken off. Bars: batches ≥ 4 ×, single forward calls ≥ 1.3 ×
faster, whichever way it ends.
"""

BATCHES = """
## Batches on all cores

One call for N poses, as users make it, with all its checks: on one thread, and the default, all cores. ns per pose by
the clock, best and median of up to 201 rounds in turn; beside it the processor time of all threads. The ratio is the
median of the rounds' ratios by the clock; bar: the default is never slower ({bar} × allows for chance). The calling
thread begins alone; others help when it has worked for 10 ms and as much is left.

| task | poses | best: one | default | median: one | default | processor: one | default | ratio |
|---|---:|---:|---:|---:|---:|---:|---:|---:|
"""

CONVERGENCE = """
## Where forward kinematics converges

{count} poses at each yaw, started 1 mm and 1 mrad away. genhexkins takes a small rotation for a change of roll,
pitch and yaw; at a yaw ψ each step then leaves 2·sin(ψ/2) of the error, and from 60° on no guess is near enough.

"""

HONESTY = """
Answers to {count:,} far guesses (±200 mm, ±90°), checked by other formulas:

| | hexapod_comp | genhexkins |
|---|---:|---:|
"""

TRAPS = """
Poses without a regular answer, with the true pose as the guess. In its source the module's solver returns success
with a pose of NaN here, since no comparison with NaN is true. Debian's build then solves a second time from that
pose, which fails; so it says −1, but the pose, from which LinuxCNC starts the next time, is NaN already.

| | hexapod_comp | genhexkins |
|---|---|---|
"""

LOOP = """
## The compensator beside a do-nothing relay

[`relay.py`](../benchmarks/relay.py) has the compensator's topics, message types and QoS, its spin loop, as many
messages of the same size, and nothing in between. Both are processes of their own; rounds of 0.4 s alternate.
Latency is from just before a pose is published to the callback with its strut commands. Ratios: medians over the
bouts, quartiles in brackets. Bars: rate ≥ {rate} ×, median latency ≤ {median} ×, 99th percentile ≤ {p99} ×. A ratio
below 1 does not mean that thinking takes no time: the relay handles messages as rclpy does it, the compensator
[reads and writes their bytes](../hexapod_comp/ros/messages.py), which saves more than a compensation takes.

"""

FLOOR = """
Beside a relay that takes and sends bytes unseen, which no node can be faster than:

"""

BLOCKS = """
## What a model's blocks cost

Called from Python, one command or one estimate, processor time, the least of {rounds} rounds; `ideal` is the whole
of it without errors, the other rows are what a block adds.

| block | command, µs | estimate, µs | |
|---|---:|---:|---|
"""


def page(speed: Speed) -> str:
    """Return the page."""
    where = ", ".join(f"{name} {value}" for name, value in speed.where.items())
    verdict = "All bars are kept." if not speed.problems else _listed("Bars missed in this run:", speed.problems)
    if speed.missing:
        verdict += "\n\n" + _listed("Not here:", speed.missing)
    parts = [OPENING.format(where="Measured on: " + where, verdict=verdict), KERNELS.format(rounds=25)]
    parts.append(_kernel_table(speed))
    if speed.honesty is not None:
        parts.append(GENHEXKINS)
    parts += [BATCHES.format(bar=BAR), batch_table(speed.batches)]
    if speed.honesty is not None:
        parts += [_convergence(speed, speed.honesty)]
    parts += [BLOCKS.format(rounds=25), _blocks(speed)]
    parts += [LOOP.format(rate=BAR_RATE, median=BAR_MEDIAN, p99=BAR_P99), _loop_table(speed.loop)]
    parts += [FLOOR, _loop_table(speed.floor)]
    return "".join(parts)


def _listed(title: str, items: list[str]) -> str:
    return "\n".join([title, "", *(f"- {item}" for item in items)])


def _kernel_table(speed: Speed) -> str:
    lines = ["| task | shape | who | µs/pose | × ours | max difference |", "|---|---|---|---:|---:|---:|"]
    for r in speed.kernels:
        difference = f"{r.max_difference:.1e}" if r.max_difference else "0"
        lines.append(f"| {r.task} | {r.shape} | {r.name} | {r.us_per_pose:.3f} | {r.times_ours:.2f} | {difference} |")
    return "\n".join(lines) + "\n"


def batch_table(rows: list[Batch]) -> str:
    """Return the table of the batches, without its head."""
    lines = []
    for r in rows:
        pairs = (f"{value:.1f}" for pair in (r.best, r.median, r.processor) for value in pair)
        lines.append(f"| {r.task} | {r.poses:,} | " + " | ".join(pairs) + f" | {r.ratio:.2f} |")
    return "\n".join(lines) + "\n"


def _convergence(speed: Speed, worth: Honesty) -> str:
    """Return the tables on genhexkins' and our convergence."""
    rows = [row for row in speed.convergence if row.yaw_deg % 10.0 == 0.0 or row.yaw_deg > 50.0]
    text = CONVERGENCE.format(count=rows[0].poses)
    text += "| yaw | " + " | ".join(f"{row.yaw_deg:.0f}°" for row in rows) + " |\n"
    text += "|---|" + "---:|" * len(rows) + "\n"
    for name, which in (("hexapod_comp", "ours"), ("genhexkins", "theirs")):
        shares = (f"{100.0 * getattr(row, which) / row.poses:.0f} %" for row in rows)
        text += f"| {name} | " + " | ".join(shares) + " |\n"
    text += HONESTY.format(count=worth.poses)
    text += "".join(f"| {title} | {ours} | {theirs} |\n" for title, (ours, theirs) in worth_rows(worth))
    text += TRAPS + "".join(f"| {trap.title} | {trap.ours} | {trap.theirs} |\n" for trap in speed.traps)
    return text


def _blocks(speed: Speed) -> str:
    lines = []
    for block in speed.blocks:
        sign = "" if block.name == "ideal" else "+"
        lines.append(f"| {block.name} | {block.command_us:{sign}.2f} | {block.estimate_us:{sign}.2f} | {block.what} |")
    pieces = ["", "Of a command's time, and beside it:", "", "| part | µs |", "|---|---:|"]
    pieces += [f"| {part.name} | {part.us:.3f} |" for part in speed.parts]
    return "\n".join([*lines, *pieces]) + "\n"


def _loop_table(rows: list[Row]) -> str:
    columns = ["rate, Hz"]
    for figure in ("answers/s", "median, µs", "99 %, µs"):
        columns += [f"{figure}: relay", "ours", "ratio"]
    lines = ["| " + " | ".join(columns) + " |", "|---|" + "---:|" * 9]
    for r in rows:
        middle, tail = (f"{q[1]:.3f} ({q[0]:.2f}–{q[2]:.2f})" for q in (r.median_ratio, r.p99_ratio))
        lines.append(
            f"| {r.name} | {r.relay.rate:.0f} | {r.ours.rate:.0f} | {r.rate_ratio[1]:.3f} "
            f"| {r.relay.median:.0f} | {r.ours.median:.0f} | {middle} "
            f"| {r.relay.p99:.0f} | {r.ours.p99:.0f} | {tail} |"
        )
    return "\n".join(lines) + "\n"
