"""A session: running nodes move the tool to poses without and with compensation, and the tool's poses are recorded."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import date
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from ..compensation.checks import check
from ..errors import HexapodError, InputFileError, NoAnswerError
from ..formats.csv import Row
from ..formats.paths import config_file
from ..formats.texts import CODES, own_terminal
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel
from ..machine.model_file import save_model
from ..machine.trajectory import commanded_in_base, move
from ..pose import Pose
from .processes import NodeProcess, PrivateDomain
from .report import PoseRecord, SessionResult, busy_text

if TYPE_CHECKING:
    from ..ros.client import LoopClient, Sent

CONNECT_TIMEOUT = 60.0  # Longest wait until both nodes answer, s: 3 s are usual, and 20 s on a busy computer
SETTLE_TIMEOUT = 5.0  # Longest wait until the tool rests at a pose, s
MOVE_FEED = 0.25  # Largest tool speed between poses, m/s; on most machines the struts' speed limit allows less


def _latencies(sent: Iterable[Sent]) -> np.ndarray:
    values = np.array([entry.answered_at - entry.sent_at for entry in sent])
    return values[np.isfinite(values)]


def connect(client: LoopClient, nodes: Sequence[NodeProcess] = ()) -> None:
    """Wait until the nodes answer; raise a HexapodError with the log of a node that has ended."""

    def ready() -> bool:
        for node in nodes:
            if node.exit_code() is not None:
                output = node.output()
                raise HexapodError(f"{node.name} ended with code {node.exit_code()}:").with_lines(output)
        return client.connected() and (client.has_true_pose or not nodes)

    client.wait(ready, CONNECT_TIMEOUT, "compensator and strut drive to answer")


def run_session(
    client: LoopClient,
    geometry: HexapodGeometry,
    targets: Sequence[Pose],
    rate: float,
    compare: bool,
    progress: Callable[[int], object] = lambda commands: None,
    announce: Callable[[str], None] = lambda _: None,
) -> SessionResult:
    """Move the tool to all targets with a rest at each: if `compare`, once without compensation; then once with it."""
    base, at, result = commanded_in_base(geometry), client.estimate, SessionResult()
    result.poses = [PoseRecord(target) for target in targets]

    def enable(enabled: bool) -> None:
        """Switch compensation on or off, and wait until the corrections have ramped in or out."""
        client.enable(enabled)
        before, wanted = dict(client.diagnostics), "on" if enabled else "off"

        def through() -> bool:
            seen = client.diagnostics
            return seen != before and seen["compensation"] == wanted and seen["ramping"] == "false"

        client.hold(at, rate, through, 10.0, "compensation to ramp")

    def visit(compensated: bool) -> list[Sent]:
        """Move to every pose, wait until the tool rests, and record the tool's pose; return all sent commands."""
        nonlocal at
        sent = []
        for record in result.poses:
            sent += client.stream(move(base, at, record.target, rate, MOVE_FEED), progress)
            at = record.target
            quiet = client.settled() if client.has_true_pose else (lambda: True)
            last = client.hold(at, rate, quiet, SETTLE_TIMEOUT, "the machine to come to rest")
            true = client.true_pose if client.has_true_pose else None
            if compensated:
                record.command, record.correction = last.command, last.correction
                record.estimate, record.true_with = client.estimate, true
            else:
                record.true_without = true
        return sent

    if compare:
        announce("pass without compensation …")
        enable(False)
        visit(compensated=False)
        enable(True)
    announce("pass with compensation …")
    result.latencies, every = _latencies(visit(compensated=True)), _latencies(client.sent.values())
    result.late, result.longest = int((every > 1.0 / rate).sum()), float(every.max(initial=0.0))
    result.busy = busy_text(every, rate)
    accepted, result.refused = client.counted()
    result.sent = len(client.sent)
    result.lost = max(0, result.sent - accepted - result.refused)
    result.model, refused = client.diagnostics["model"], "refused."
    result.refusals = {
        key.removeprefix(refused): int(value) for key, value in client.diagnostics.items() if key.startswith(refused)
    }
    return result


RATES = (1.0, 1000.0)  # Allowed command rates, Hz: over DDS, Python sends at most about 1000 commands per second

# Limits of the compensator, m and s, for simulated drives, which may wait for a processor of the computer: 0.1 m allows
# a delay of 0.4 s at 250 mm/s, while the default following_error_limit, 2 mm, allows only 8 ms.
SIMULATION_LIMITS = {"following_error_limit": 0.1, "max_command_age": 5.0}


def refuse_broken_limits(
    path: str, geometry: HexapodGeometry, model: MachineModel, rows: list[Row], poses: list[Pose]
) -> None:
    """Raise an InputFileError if a pose or a move between two poses breaks a limit of the machine."""
    breaches = check(geometry, model, poses).breaches
    if breaches:
        row = rows[breaches[0].row]
        problem = f"pose {row.label}: {breaches[0].error}; `hexapod_comp check` lists all {len(breaches)} breaches"
        raise InputFileError(path, f"line {row.line}", problem)


@contextmanager
def simulated(machine: str, model: MachineModel, truth: MachineModel) -> Iterator[Sequence[NodeProcess]]:
    """Run a compensator with `model` and a strut drive with the errors `truth`, in a private ROS domain."""
    geometry = {"geometry_file": str(config_file(machine, "geometry", beside=True).resolve())}
    with tempfile.TemporaryDirectory(prefix="hexapod_comp_") as folder, PrivateDomain():
        files = {"model": f"{folder}/model.yaml", "truth": f"{folder}/truth.yaml"}
        for one, file in zip((model, truth), files.values(), strict=True):
            # a model file must have a date, and must not name a posterior file that is not in its folder
            origin = replace(one.origin, date=one.origin.date or date.today().isoformat(), posterior=None)
            save_model(replace(one, origin=origin), file)
        nodes = (
            NodeProcess("compensator", {**geometry, "model_file": files["model"], **SIMULATION_LIMITS}),
            NodeProcess("strut_drive", {**geometry, "truth_file": files["truth"]}),
        )
        try:
            yield nodes
        except BaseException as error:
            output = "\n".join(f"{node.name}:\n{node.stop()[1]}" for node in nodes)
            if isinstance(error, NoAnswerError):
                raise NoAnswerError(f"{error}; output of the nodes:").with_lines(output) from error
            raise
        for node in nodes:
            code, output = node.stop()
            if code != 0:
                raise HexapodError(f"{node.name} ended with code {code}:").with_lines(output)


def run_poses(
    geometry: HexapodGeometry,
    nodes: Sequence[NodeProcess],
    poses: list[Pose],
    rate: float,
    compare: bool,
    namespace: str = "",
) -> SessionResult:
    """Run a session with tool poses in ``work``, and show a progress bar if stderr is a terminal."""

    def announce(text: str) -> None:  # tqdm prints the text above the progress bar
        tqdm.write(CODES.sub("", text), file=own_terminal())

    client = loop_client(namespace)
    try:
        connect(client, nodes)
        client.refuse_other(geometry.name)
        targets = [geometry.work @ pose for pose in poses]  # in ``base``, as the nodes' poses
        with tqdm(unit=" commands", disable=None, leave=False, mininterval=0.5) as bar:
            try:
                result = run_session(client, geometry, targets, rate, compare, bar.update, announce)
            except NoAnswerError as error:
                busy = busy_text(_latencies(client.sent.values()), rate)
                raise NoAnswerError(f"{error}; {busy}" if busy else str(error)) from error
        in_work = geometry.work.inverse()
        for record, pose in zip(result.poses, poses, strict=True):
            record.target = pose
            for name in ("estimate", "true_without", "true_with"):
                if (seen := getattr(record, name)) is not None:
                    setattr(record, name, in_work @ seen)
        return result
    finally:
        client.close()


def loop_client(namespace: str) -> LoopClient:
    """Return a client of the nodes, or raise a HexapodError with advice if ROS is not installed."""
    try:
        from ..ros.client import LoopClient
    except ImportError as error:
        raise HexapodError(
            f"this verb needs ROS 2 ({error}): source a ROS 2 installation, or if there is none, run "
            "`pip install '.[ros]'` in the source tree (doc/install.md)"
        ) from error
    return LoopClient(namespace=namespace)
