"""How nodes begin and end when something around them is wrong: closed streams, topics that cannot be opened."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from rclpy.context import Context

from hexapod_comp.linuxcnc import bridge as bridge_module
from hexapod_comp.ros import base, received_signals
from hexapod_comp.ros import compensator as compensator_module
from hexapod_comp.ros import strut_drive as drive_module


@pytest.mark.parametrize("closed", [(2,), (1, 2), (0, 1, 2)])
def test_closed_streams_are_opened_again(closed: tuple[int, ...]) -> None:
    """rclpy's executor switches faulthandler on, which raises without a stderr: the node ended after "ready"."""
    program = (
        "import os, sys\n"
        "from hexapod_comp.ros import open_streams\n"
        "open_streams()\n"
        "import faulthandler\n"
        "faulthandler.enable()\n"
        "print('lost', file=sys.stderr)\n"
        "pipe = os.pipe()\n"
        "sys.exit(7 if min(pipe) > 2 else 1)\n"
    )
    shell = " ".join(f"{number}>&-" for number in closed)
    done = subprocess.run(["sh", "-c", f'exec "$0" -c "$1" {shell}', sys.executable, program], check=False)
    assert done.returncode == 7


def test_a_hang_up_ends_a_node_as_other_signals_do_unless_it_is_ignored() -> None:
    """As nohup has it."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        heard = received_signals()
        signal.raise_signal(signal.SIGHUP)
        assert heard == [signal.SIGHUP]
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        heard = received_signals()
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGTERM)
        assert heard == [signal.SIGTERM]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize(
    ("module", "part"),
    [(compensator_module, "Requests"), (compensator_module, "JournalTopics"), (base.MachineNode, "sender_of")],
)
def test_a_topic_that_cannot_be_opened_is_said_and_leaves_nothing_open(
    module, part: str, ros_context: Context, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The node's goodbye had hidden the reason behind an AttributeError. It may be configured once more."""
    kind = drive_module.StrutDriveNode if part == "sender_of" else compensator_module.CompensatorNode
    node = kind(context=ros_context)
    before = [len(list(ends)) for ends in (node.publishers, node.subscriptions, node.services, node.timers)]

    def fails(*_: object) -> None:
        raise RuntimeError("no more topics")

    with monkeypatch.context() as patch:
        patch.setattr(module, part, fails)
        node.trigger_configure()
    assert "RuntimeError: no more topics" in capfd.readouterr().err
    assert [len(list(ends)) for ends in (node.publishers, node.subscriptions, node.services, node.timers)] == before
    node.publish_last_status()
    assert node.unconfigured
    node.trigger_configure()
    assert not node.unconfigured
    node.publish_last_status()
    node.destroy_node()


def test_the_bridge_too(ros_context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    from hal_stand_in import StandInHal

    node = bridge_module.LinuxcncBridgeNode(hal=StandInHal(), context=ros_context)

    def fails(*_: object) -> None:
        raise RuntimeError("no more topics")

    before = [len(list(ends)) for ends in (node.publishers, node.subscriptions, node.timers)]
    with monkeypatch.context() as patch:
        patch.setattr(bridge_module, "CompensatorReset", fails)
        node.trigger_configure()
    assert [len(list(ends)) for ends in (node.publishers, node.subscriptions, node.timers)] == before
    node.publish_last_status()
    node.destroy_node()
