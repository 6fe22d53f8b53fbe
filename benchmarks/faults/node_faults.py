"""Faults of the nodes' processes, of what an operator asks them for, and of the files and disks under them."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from hexapod_comp.machine.geometry import STRUT_NAMES

from . import wire
from .fault import Fault, Meaning
from .record import LINKS, Happened
from .rig import Rig
from .visible import FOLLOWING_LIMIT, following_error

STOPPED_FOR = 2.0
"""SIGSTOP lasts this long, s."""

RESTARTED_AFTER = 0.2
"""A supervisor starts a dead process again after this long, s."""

UNHEARD_FOR = 0.2
"""After a start or a reset under a stream the drive is not heard for this long, s."""

MOVES = 2e-4
"""Struts that were told to go so far within 80 ms, m, are in motion, whoever looks and when."""


class Kill(Fault):
    """``kill -9`` of a process; a supervisor starts it again. It ends when the new process reports that it is ready."""

    name: str
    shortest = longest = RESTARTED_AFTER

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Kill it."""
        rig.kill(self.name)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Start it again."""
        rig.start(self.name)

    def over(self, rig: Rig) -> bool:
        """Return whether it is ready; the controller then starts from where a new drive stands."""
        if rig.is_starting(self.name):
            return False
        if self.name == "drive":
            rig.controller.start_over()
        return True


class Restart(Kill):
    """`kill -9` of the compensator, while the controller continues to stream; the drive's readings arrive from 0.2 s
    after it is ready."""

    name = "compensator"

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Kill it."""
        super().begin(rig, happened)
        rig.controller.heedless = True
        rig.wires["feedback"].rule = wire.Drop(self.rng, 1.0)
        self._heard_at = math.inf

    def over(self, rig: Rig) -> bool:
        """Return whether the stream has gone on for a while with and without the drive; it then is held again."""
        now = time.monotonic()
        if rig.is_starting(self.name):
            return False
        if self._heard_at == math.inf:
            self._heard_at = now + UNHEARD_FOR
        if now >= self._heard_at:
            rig.wires["feedback"].mend(now)
        rig.controller.heedless = now < self._heard_at + UNHEARD_FOR
        return not rig.controller.heedless


class Reset(Fault):
    """`~/reset` while the controller continues to stream, after 0.4 s without a message from it or the drive."""

    shortest = longest = 0.4

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Cut both off."""
        rig.controller.heedless = True
        for link in ("pose", "feedback"):
            rig.wires[link].rule = wire.Drop(self.rng, 1.0)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Reset, and let the controller be heard again."""
        rig.reset()
        rig.wires["pose"].mend(time.monotonic())
        self._heard_at = time.monotonic() + UNHEARD_FOR

    def over(self, rig: Rig) -> bool:
        """Return whether the stream has gone on for a while; then the drive is heard again."""
        now = time.monotonic()
        if now < self._heard_at:
            return False
        rig.wires["feedback"].mend(now)
        rig.controller.heedless = False
        return True


class ReloadUnderStream(Fault):
    """`~/reload_model`, again and again, while the controller continues to stream: the changes ramp in."""

    kind, touches = "reload_under_stream", frozenset({"compensator", "pose"})
    meaning = Meaning("never: the model is good", "nothing need be reported")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Let it stream, and reload."""
        rig.controller.heedless = True
        self._left = 3
        self._reload(rig, happened)

    def _reload(self, rig: Rig, happened: Happened) -> None:
        def answered(taken: bool) -> None:
            self._left -= 1
            if not taken:
                happened.breaches.append("a good model was not taken")
            if self._left:
                self._reload(rig, happened)

        rig.reload_model(answered)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Wait: see :meth:`over`."""

    def over(self, rig: Rig) -> bool:
        """Hold the controller again once all have been answered."""
        rig.controller.heedless = self._left > 0
        return not self._left


class ResetInMotion(Fault):
    """`~/reset` while the machine moves, three times; one that arrives at a reversal of the path may be granted."""

    kind, touches = "reset_in_motion", frozenset({"compensator", *LINKS})
    meaning = Meaning("the first refusal is answered", "compensator: reset refused while the machine moves")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Ask."""
        self._ask(rig, happened, 3)

    def _ask(self, rig: Rig, happened: Happened, times: int) -> None:
        began = time.monotonic()

        def answered(done: bool) -> None:
            told = [c.lengths for c in rig.record.commands if began - 0.08 < c.time < began]
            way = float(np.ptp(told, axis=0).max()) if told else 0.0
            if done and way > MOVES:
                happened.breaches.append(f"reset granted though the struts moved by {way * 1e3:.2f} mm in 80 ms")
            elif not done:
                happened.marks.append(time.monotonic())
            if times > 1:
                self._ask(rig, happened, times - 1)

        rig.reset(answered)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Nothing: it is over when it is answered."""


class Latched(Fault):
    """A strut is displaced and pulled back, and the controller delays the reset: until then the machine must stand."""

    kind, touches = "latched_following_error", frozenset({"drive", "feedback", "compensator", "pose"})
    meaning = Meaning(
        f"the first reading more than {FOLLOWING_LIMIT * 1e3:g} mm from all commands of the last 0.1 s",
        "compensator: following_error",
    )
    shortest = longest = 0.6

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Knock it, far enough that it is seen."""
        strut = int(self.rng.integers(1, 7))
        rig.controller.may_reset = False
        happened.detail = STRUT_NAMES[strut - 1]
        rig.set_drive(fault_jump_strut=strut, fault_jump=float(self.rng.choice([-8e-3, 8e-3])))

    def end(self, rig: Rig, happened: Happened) -> None:
        """Let the controller reset; until now the machine had to stand, from when it was seen."""
        rig.controller.may_reset = True
        expected = following_error(rig.record, replace(happened, ended=time.monotonic()))
        happened.standing += [(since, time.monotonic()) for _, _, since in expected]


class SimTime(Fault):
    """`use_sim_time` is set in the running compensator."""

    kind, touches = "use_sim_time_set", frozenset({"compensator"})
    meaning = Meaning("never: it is refused, and nothing changes", "nothing need be reported")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Ask for it."""

        def answered(taken: bool) -> None:
            if taken:
                happened.breaches.append("use_sim_time was taken by a running node")

        rig.simulate_time(answered)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Nothing."""


class Stop(Fault):
    """SIGSTOP of a process, and SIGCONT."""

    name: str
    shortest = longest = STOPPED_FOR

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Stop it."""
        rig.freeze(self.name)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Let it go on."""
        rig.thaw(self.name)


class FullDisk(Fault):
    """The disk of the logs is full."""

    kind, touches = "log_disk_full", frozenset({"disk"})
    meaning = Meaning("the last byte is written", "compensator and strut_drive: log disk full")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Fill it."""
        rig.log_disk.fill()
        happened.marks.append(time.monotonic())

    def end(self, rig: Rig, happened: Happened) -> None:
        """Make room."""
        rig.log_disk.clear()


class HalfModel(Fault):
    """The model file is half written when the compensator is asked to reload it."""

    kind, touches = "half_written_model", frozenset({"compensator"})
    shortest = longest = 0.5
    meaning = Meaning("the service reload_model has answered", "compensator: the old model stays")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Write half a file and have it read."""
        self._whole = rig.model.read_text(encoding="utf-8")
        part = int(len(self._whole) * self.rng.uniform(0.02, 0.98))
        happened.detail = f"{part} of {len(self._whole)} characters"
        rig.model.write_text(self._whole[:part], encoding="utf-8")
        self._answers: list[bool] = []

        def answered(taken: bool) -> None:
            self._answers.append(taken)
            happened.detail += ", taken as a whole one" if taken else ""
            happened.marks.append(time.monotonic())

        rig.reload_model(answered)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Wait: see :meth:`over`."""

    def over(self, rig: Rig) -> bool:
        """Write the whole file and have it read, once the half has been answered."""
        if self._answers:
            rig.model.write_text(self._whole, encoding="utf-8")
            rig.reload_model(lambda _: None)
        return bool(self._answers)
