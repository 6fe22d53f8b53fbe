"""The kinds of faults: how each is drawn, done and undone, and in words when it is visible and who must say what."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.nodes.messages import message_pose

from . import wire
from .record import LINKS, Happened
from .rig import Rig
from .visible import COMMAND_TIMEOUT, DRIVE_TIMEOUT, FEEDBACK_TIMEOUT, FOLLOWING_LIMIT, following_error

STOPPED_FOR = 2.0
"""SIGSTOP lasts this long, s."""

RESTARTED_AFTER = 0.2
"""A supervisor starts a dead process again after this long, s."""

UNHEARD_FOR = 0.2
"""After a start or a reset under a stream the drive is not heard for this long, s."""

MOVES = 2e-4
"""Struts that were told to go so far within 80 ms, m, are in motion, whoever looks and when."""

CERTAINLY = 8e-3
"""At their largest speed for so long, s, and more, struts are too fast for their stamps: more than any jitter."""

OLDEST_COMMAND = 0.5
"""Commands older than this are refused, s: the compensator's default max_command_age."""


@dataclass(frozen=True)
class Meaning:
    """When a fault is visible and to whom, and what that node must say."""

    visible: str
    said: str


SILENT = {
    "pose": Meaning(f"no pose command has been delivered for {COMMAND_TIMEOUT:g} s", "compensator: no new command"),
    "command": Meaning(f"no strut command has been delivered for {DRIVE_TIMEOUT:g} s", "strut_drive: no new command"),
    "feedback": Meaning(f"no reading has been delivered for {FEEDBACK_TIMEOUT:g} s", "compensator: feedback lost"),
}


class Fault(ABC):
    """One fault of an episode: drawn at once, done and undone when it is its turn.

    Parameters
    ----------
    rng : Generator
        Of this fault alone.
    """

    kind: str
    meaning: Meaning
    touches: frozenset[str]
    """What it needs for itself: two faults that touch the same are not drawn together."""

    shortest, longest = 0.4, 1.0
    """How long it lasts, s."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.duration = float(rng.uniform(self.shortest, self.longest))
        self.detail = ""

    @abstractmethod
    def begin(self, rig: Rig, happened: Happened) -> None:
        """Do it."""

    @abstractmethod
    def end(self, rig: Rig, happened: Happened) -> None:
        """Undo it."""

    def over(self, rig: Rig) -> bool:
        """Return whether it is over after :meth:`end`: a process takes a while to start."""
        return True


class Kill(Fault):
    """``kill -9`` of a process; a supervisor starts it again. It ends when the new process says that it is ready."""

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
    """`kill -9` of the compensator, while the controller streams on; the drive is heard 0.2 s after it is ready."""

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
    """`~/reset` while the controller streams on, after 0.4 s in which neither it nor the drive was heard."""

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
    """`~/reload_model`, again and again, while the controller streams on: the changes ramp in."""

    kind, touches = "reload_under_stream", frozenset({"compensator", "pose"})
    meaning = Meaning("never: the model is good", "nobody has anything to say")

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
    """`~/reset` while the machine moves, three times; one that comes while the path turns may be granted."""

    kind, touches = "reset_in_motion", frozenset({"compensator", *LINKS})
    meaning = Meaning("the first that is refused is answered", "compensator: reset refused while the machine moves")

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
    """A strut is knocked away and pulled back; nobody resets for a while: until then the machine must stand."""

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
    meaning = Meaning("never: it is refused, and nothing changes", "nobody has anything to say")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Ask for it."""

        def answered(taken: bool) -> None:
            if taken:
                happened.breaches.append("use_sim_time was taken by a running node")

        rig.simulate_time(answered)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Nothing."""


class StreamsOn(Fault):
    """The controller streams on, and is held again a while after the fault."""

    touches = frozenset({"compensator", *LINKS})

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Let it."""
        rig.controller.heedless = True

    def end(self, rig: Rig, happened: Happened) -> None:
        """Let it stream for a while yet."""
        self._held_at = time.monotonic() + UNHEARD_FOR

    def over(self, rig: Rig) -> bool:
        """Return whether it is held again."""
        rig.controller.heedless = time.monotonic() < self._held_at
        return not rig.controller.heedless


class StopUnderStream(StreamsOn):
    """SIGSTOP of the compensator for 0.4 s while the controller streams on: what has come meanwhile is a burst."""

    kind, meaning = "stop_under_stream", SILENT["command"]
    shortest = longest = 0.4

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Stop it."""
        super().begin(rig, happened)
        rig.freeze("compensator")

    def end(self, rig: Rig, happened: Happened) -> None:
        """Let it go on."""
        rig.thaw("compensator")
        super().end(rig, happened)


class Bunched(StreamsOn):
    """Poses are held up on the way while the controller streams on, and come all at once: unnoticed, or too many."""

    kind, meaning = "bunched_pose", SILENT["pose"]

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Hold them up."""
        super().begin(rig, happened)
        self.duration = float(self.rng.choice([0.05, 0.3]))
        happened.detail = f"{self.duration:g} s"
        rig.wires["pose"].rule = wire.Bunch(self.rng, 1.0)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Let them come."""
        rig.wires["pose"].mend(time.monotonic())
        super().end(rig, happened)


class Restamped(StreamsOn):
    """Stamps stand, or are a microsecond apart, while the controller streams on."""

    kind = "stamps_stand"
    meaning = Meaning("the first command that is too fast by its stamp is delivered", "compensator: speed, or step")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Spoil the stamps."""
        super().begin(rig, happened)
        apart = int(self.rng.choice([0, 1000]))
        happened.detail = f"{apart} ns, reason speed|step"
        structure, speed = Structure.of(rig.geometry), rig.geometry.limits.speed

        def lengths(message: Any) -> np.ndarray:
            return strut_lengths(structure, message_pose(message) @ rig.geometry.tool.inverse())

        link = rig.wires["pose"]
        link.marks = happened.marks
        link.rule = wire.Restamp(self.rng, apart, lengths, lambda seconds: speed * (seconds + CERTAINLY))

    def end(self, rig: Rig, happened: Happened) -> None:
        """Stamp well again."""
        rig.wires["pose"].mend(time.monotonic())
        super().end(rig, happened)


class Hurried(StreamsOn):
    """The controller leaves out poses: at 640 mm/s it asks for more than the machine can do."""

    kind = "too_fast"
    meaning = Meaning("never certainly: it may be where its path turns", "nobody must")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Hurry."""
        super().begin(rig, happened)
        rig.controller.stride = 8

    def end(self, rig: Rig, happened: Happened) -> None:
        """Take time."""
        rig.controller.stride = 1
        super().end(rig, happened)


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


class Wired(Fault):
    """Something is wrong on one of the links."""

    link: str

    @abstractmethod
    def rule(self) -> wire.Rule:
        """Return what the link does."""

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Let the link do it."""
        rule = self.rule()
        happened.detail = self.detail
        link = rig.wires[self.link]
        link.marks, link.rule = happened.marks, rule

    def end(self, rig: Rig, happened: Happened) -> None:
        """Mend the link."""
        rig.wires[self.link].mend(time.monotonic())


class Dropped(Wired):
    """Messages are lost: all of them, or a third."""

    def rule(self) -> wire.Rule:
        """Return the loss."""
        share = float(self.rng.choice([1.0, 1.0, 0.3]))
        self.detail = f"{share:.0%}"
        return wire.Drop(self.rng, share)


class Delayed(Wired):
    """Messages come later: unnoticed, beyond the timeouts, or too old to be obeyed."""

    def rule(self) -> wire.Rule:
        """Return the delay."""
        delay = float(self.rng.choice([0.03, 0.3, 0.7]))
        self.detail = f"{delay:g} s, reason stamp_past"
        return wire.Delay(self.rng, delay, self.link == "pose" and delay > OLDEST_COMMAND)


class Duplicated(Wired):
    """Half of the messages come twice."""

    def rule(self) -> wire.Rule:
        """Return the doubling."""
        return wire.Duplicate(self.rng, 0.5)


class Reordered(Wired):
    """A fifth of the messages is overtaken."""

    def rule(self) -> wire.Rule:
        """Return the change of order."""
        self.detail = "reason stamp_order"
        return wire.Reorder(self.rng, 0.2)


class Corrupted(Wired):
    """A fifth of the messages is spoilt, all in one way."""

    def rule(self) -> wire.Rule:
        """Return the spoiling."""
        ways = wire.SPOILS[self.link]
        way = str(self.rng.choice(sorted(ways)))
        spoil, reason = ways[way]
        self.detail = f"{way}, reason {reason}"
        return wire.Corrupt(self.rng, 0.2, spoil)


class Stuck(Fault):
    """A strut's motor does not move."""

    kind, touches = "stuck_strut", frozenset({"drive", "feedback"})
    meaning = Meaning(
        f"the first reading more than {FOLLOWING_LIMIT * 1e3:g} mm from all commands of the last 0.1 s",
        "compensator: following_error",
    )

    shortest, longest = 0.6, 1.2

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Hold it."""
        strut = int(self.rng.integers(1, 7))
        happened.detail = STRUT_NAMES[strut - 1]
        rig.set_drive(fault_stuck_strut=strut)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Let it go."""
        rig.set_drive(fault_stuck_strut=0)


class Jumping(Fault):
    """A strut's motor is knocked away by some millimetres; the drive pulls it back."""

    kind, touches, meaning = "jumping_strut", frozenset({"drive", "feedback"}), Stuck.meaning
    shortest, longest = 0.2, 0.4

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Knock it."""
        strut = int(self.rng.integers(1, 7))
        distance = float(self.rng.choice([-1.0, 1.0]) * self.rng.uniform(2e-3, 8e-3))
        happened.detail = f"{STRUT_NAMES[strut - 1]} by {distance * 1e3:.1f} mm"
        rig.set_drive(fault_jump_strut=strut, fault_jump=distance)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Nothing: the drive has pulled it back."""


class LostEncoder(Fault):
    """A strut's encoder reads NaN."""

    kind, touches = "encoder_nan", frozenset({"drive", "feedback"})
    meaning = Meaning("the first reading with NaN is delivered", "compensator: bad feedback: not_finite")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Lose it."""
        strut = int(self.rng.integers(1, 7))
        happened.detail = STRUT_NAMES[strut - 1]
        rig.set_drive(fault_encoder_lost=strut)

    def end(self, rig: Rig, happened: Happened) -> None:
        """Find it again, and note when the first NaN was delivered."""
        rig.set_drive(fault_encoder_lost=0)
        spoilt = [m.time for m in rig.record.measured if m.time > happened.began and not np.isfinite(m.lengths).all()]
        happened.marks += spoilt[:1]


class FullDisk(Fault):
    """The disk of the logs is full."""

    kind, touches = "log_disk_full", frozenset({"disk"})
    meaning = Meaning("the last byte is taken", "compensator and strut_drive: log disk full")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Fill it."""
        rig.log_disk.fill()
        happened.marks.append(time.monotonic())

    def end(self, rig: Rig, happened: Happened) -> None:
        """Make room."""
        rig.log_disk.clear()


class HalfModel(Fault):
    """The model file is half written when the compensator is told to read it again."""

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


def _make(base: type[Fault], kind: str, touches: set[str], meaning: Meaning, **attributes: object) -> type[Fault]:
    attributes.update(kind=kind, touches=frozenset(touches), meaning=meaning, __doc__=base.__doc__)
    return type(f"{base.__name__}_{kind}", (base,), attributes)


REFUSED = {
    "pose": "compensator: refusing commands: the reason",
    "command": "strut_drive: refusing commands: the reason",
    "feedback": "compensator: bad feedback: the reason, or following_error",
}

HARMLESS = Meaning("never: the same once more changes nothing", "nobody has anything to say")


def _wired_kinds(link: str) -> list[type[Fault]]:
    """Return the kinds of faults of one link."""
    silent, refused = SILENT[link], REFUSED[link]
    too_old = Meaning(f"{silent.visible}, or one too old is delivered", f"{silent.said}, or stamp_past")
    delayed = too_old if link == "pose" else silent
    overtaken = Meaning("the first overtaken message is delivered", refused.replace("the reason", "stamp_order"))
    spoilt = Meaning("the first spoilt message is delivered", refused)
    return [
        _make(Dropped, f"drop_{link}", {link}, silent, link=link),
        _make(Delayed, f"delay_{link}", {link}, delayed, link=link),
        _make(Duplicated, f"duplicate_{link}", {link}, HARMLESS, link=link),
        _make(Reordered, f"reorder_{link}", {link}, overtaken, link=link),
        _make(Corrupted, f"corrupt_{link}", {link}, spoilt, link=link),
    ]


def _process_kinds(name: str, link: str, touches: set[str]) -> list[type[Fault]]:
    """Return the kinds of faults of one process, whose end or stop another sees by the silence of a link."""
    return [
        _make(base, f"{verb}_{name}", touches, SILENT[link], name=name)
        for base, verb in ((Kill, "kill"), (Stop, "stop"))
    ]


KINDS: dict[str, type[Fault]] = {
    kind.kind: kind
    for kind in (
        *_process_kinds("compensator", "command", {"compensator", "command"}),
        *_process_kinds("drive", "feedback", {"drive", "feedback"}),
        *(kind for link in LINKS for kind in _wired_kinds(link)),
        _make(Restart, "restart_under_stream", {"compensator", *LINKS}, SILENT["command"]),
        _make(Reset, "reset_under_stream", {"compensator", *LINKS}, SILENT["feedback"]),
        ReloadUnderStream,
        StopUnderStream,
        Bunched,
        Restamped,
        Hurried,
        ResetInMotion,
        SimTime,
        Stuck,
        Jumping,
        Latched,
        LostEncoder,
        FullDisk,
        HalfModel,
    )
}
