"""The kinds of faults: what each does and undoes, and what it touches. doc/faults.md says what must be reported."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.ros.messages import message_pose

from . import wire
from .judge import following_error
from .record import LINKS, Happened
from .rig import Rig

RESTARTED_AFTER = 0.2  # A supervisor starts a dead process again after this long, s
UNHEARD_FOR = 0.2  # After a start or a reset under a stream the drive is not heard for this long, s
CERTAINLY = 8e-3  # At their largest speed for so long, s, struts are too fast for their stamps: more than any jitter
OLDEST_COMMAND = 0.5  # Commands older than this are refused, s: the compensator's default max_command_age
MOVES = 2e-4  # Struts that were told to go so far within 80 ms, m, are in motion


class Fault:
    """One fault of an episode, drawn by a generator of its own: done by `begin`, undone by `end` after its duration."""

    kind: str
    touches: frozenset[str] = frozenset()  # two faults that touch the same are not drawn together
    shortest, longest = 0.4, 1.0  # s

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.duration = float(rng.uniform(self.shortest, self.longest))

    def begin(self, rig: Rig, happened: Happened) -> None:
        raise NotImplementedError

    def end(self, rig: Rig, happened: Happened) -> None:
        pass

    def over(self, rig: Rig) -> bool:
        """Return whether it is over after `end`: a process takes a while to start."""
        return True


# ---- processes ----


class Kill(Fault):
    """`kill -9` of a process; a supervisor restarts it. It ends when the new process reports that it is ready."""

    name: str
    shortest = longest = RESTARTED_AFTER

    def begin(self, rig: Rig, happened: Happened) -> None:
        rig.kill(self.name)

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.start(self.name)

    def over(self, rig: Rig) -> bool:
        if rig.is_starting(self.name):
            return False
        if self.name == "drive":  # the controller starts from where a new drive stands
            rig.controller.start_over()
        return True


class Stop(Fault):
    """SIGSTOP of a process, and SIGCONT."""

    name: str
    shortest = longest = 2.0

    def begin(self, rig: Rig, happened: Happened) -> None:
        rig.freeze(self.name)

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.thaw(self.name)


class Restart(Kill):
    """`kill -9` of the compensator, while the controller continues to stream; the drive's readings arrive from 0.2 s
    after it is ready."""

    name = "compensator"

    def begin(self, rig: Rig, happened: Happened) -> None:
        super().begin(rig, happened)
        rig.controller.heedless = True
        rig.wires["feedback"].rule = wire.drop(self.rng, 1.0)
        self._heard_at = math.inf

    def over(self, rig: Rig) -> bool:
        now = time.monotonic()
        if rig.is_starting(self.name):
            return False
        if self._heard_at == math.inf:
            self._heard_at = now + UNHEARD_FOR
        if now >= self._heard_at:
            rig.wires["feedback"].mend(now)
        rig.controller.heedless = now < self._heard_at + UNHEARD_FOR
        return not rig.controller.heedless


# ---- what an operator asks for, files and disks ----


class Reset(Fault):
    """`~/reset` while the controller continues to stream, after 0.4 s without a message from it or the drive."""

    shortest = longest = 0.4

    def begin(self, rig: Rig, happened: Happened) -> None:
        rig.controller.heedless = True
        for link in ("pose", "feedback"):
            rig.wires[link].rule = wire.drop(self.rng, 1.0)

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.reset()
        rig.wires["pose"].mend(time.monotonic())
        self._heard_at = time.monotonic() + UNHEARD_FOR

    def over(self, rig: Rig) -> bool:
        now = time.monotonic()
        if now < self._heard_at:
            return False
        rig.wires["feedback"].mend(now)
        rig.controller.heedless = False
        return True


class ReloadUnderStream(Fault):
    """`~/reload_model`, again and again, while the controller continues to stream: the changes ramp in."""

    def begin(self, rig: Rig, happened: Happened) -> None:
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

    def over(self, rig: Rig) -> bool:
        rig.controller.heedless = self._left > 0
        return not self._left


class ResetInMotion(Fault):
    """`~/reset` while the machine moves, three times; one that arrives at a reversal of the path may be granted."""

    def begin(self, rig: Rig, happened: Happened) -> None:
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


class SimTime(Fault):
    """`use_sim_time` is set in the running compensator."""

    def begin(self, rig: Rig, happened: Happened) -> None:
        def answered(taken: bool) -> None:
            if taken:
                happened.breaches.append("use_sim_time was taken by a running node")

        rig.simulate_time(answered)


class FullDisk(Fault):
    """The disk of the logs is full."""

    def begin(self, rig: Rig, happened: Happened) -> None:
        rig.log_disk.fill()
        happened.marks.append(time.monotonic())

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.log_disk.clear()


class HalfModel(Fault):
    """The model file is half written when the compensator is asked to reload it."""

    shortest = longest = 0.5

    def begin(self, rig: Rig, happened: Happened) -> None:
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

    def over(self, rig: Rig) -> bool:
        if self._answers:
            rig.model.write_text(self._whole, encoding="utf-8")
            rig.reload_model(lambda _: None)
        return bool(self._answers)


# ---- struts and encoders ----


class Stuck(Fault):
    """A strut's motor does not move."""

    shortest, longest = 0.6, 1.2

    def begin(self, rig: Rig, happened: Happened) -> None:
        strut = int(self.rng.integers(1, 7))
        happened.detail = STRUT_NAMES[strut - 1]
        rig.set_drive(fault_stuck_strut=strut)

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.set_drive(fault_stuck_strut=0)


class Jumping(Fault):
    """A strut's motor is displaced by some millimetres; the drive pulls it back."""

    shortest, longest = 0.2, 0.4

    def begin(self, rig: Rig, happened: Happened) -> None:
        strut = int(self.rng.integers(1, 7))
        distance = float(self.rng.choice([-1.0, 1.0]) * self.rng.uniform(2e-3, 8e-3))
        happened.detail = f"{STRUT_NAMES[strut - 1]} by {distance * 1e3:.1f} mm"
        rig.set_drive(fault_jump_strut=strut, fault_jump=distance)


class Latched(Fault):
    """A strut is displaced and pulled back, and the controller delays the reset: until then the machine must stand."""

    shortest = longest = 0.6

    def begin(self, rig: Rig, happened: Happened) -> None:
        strut = int(self.rng.integers(1, 7))
        rig.controller.may_reset = False
        happened.detail = STRUT_NAMES[strut - 1]
        rig.set_drive(fault_jump_strut=strut, fault_jump=float(self.rng.choice([-8e-3, 8e-3])))

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.controller.may_reset = True
        expected = following_error(rig.record, replace(happened, ended=time.monotonic()))
        happened.standing += [(since, time.monotonic()) for _, _, since in expected]


class LostEncoder(Fault):
    """A strut's encoder reads NaN."""

    def begin(self, rig: Rig, happened: Happened) -> None:
        strut = int(self.rng.integers(1, 7))
        happened.detail = STRUT_NAMES[strut - 1]
        rig.set_drive(fault_encoder_lost=strut)

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.set_drive(fault_encoder_lost=0)
        spoilt = [m.time for m in rig.record.measured if m.time > happened.began and not np.isfinite(m.lengths).all()]
        happened.marks += spoilt


# ---- messages ----


class StreamsOn(Fault):
    """The controller streams on, and is held again a while after the fault."""

    def begin(self, rig: Rig, happened: Happened) -> None:
        rig.controller.heedless = True

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.wires["pose"].mend(time.monotonic())
        self._held_at = time.monotonic() + UNHEARD_FOR

    def over(self, rig: Rig) -> bool:
        rig.controller.heedless = time.monotonic() < self._held_at
        return not rig.controller.heedless


class StopUnderStream(StreamsOn):
    """SIGSTOP of the compensator for 0.4 s while the controller continues to stream: the messages of that time arrive
    in a burst."""

    shortest = longest = 0.4

    def begin(self, rig: Rig, happened: Happened) -> None:
        super().begin(rig, happened)
        rig.freeze("compensator")

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.thaw("compensator")
        super().end(rig, happened)


class Bunched(StreamsOn):
    """Poses are delayed while the controller continues to stream, and arrive all at once: few enough to accept, or too
    many."""

    def begin(self, rig: Rig, happened: Happened) -> None:
        super().begin(rig, happened)
        self.duration = float(self.rng.choice([0.05, 0.3]))
        happened.detail = f"{self.duration:g} s"
        rig.wires["pose"].rule = wire.delay(math.inf)


class Restamped(StreamsOn):
    """Stamps are constant, or a microsecond apart, while the controller continues to stream."""

    def begin(self, rig: Rig, happened: Happened) -> None:
        super().begin(rig, happened)
        apart = int(self.rng.choice([0, 1000]))
        happened.detail = f"{apart} ns, reason speed|step"
        structure, speed = Structure.of(rig.geometry), rig.geometry.limits.speed

        def lengths(message: Any) -> np.ndarray:
            return strut_lengths(structure, message_pose(message) @ rig.geometry.tool.inverse())

        link = rig.wires["pose"]
        link.marks = happened.marks
        link.rule = wire.restamp(apart, lengths, lambda seconds: speed * (seconds + CERTAINLY))


class Hurried(StreamsOn):
    """The controller skips poses: at 640 mm/s it asks for more than the machine can do."""

    def begin(self, rig: Rig, happened: Happened) -> None:
        super().begin(rig, happened)
        rig.controller.stride = 8

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.controller.stride = 1
        super().end(rig, happened)


class Wired(Fault):
    """Something is wrong on one of the links."""

    link: str
    rule: Callable[[np.random.Generator, str], tuple[wire.Rule, str]]  # from the link, and how it was drawn

    def begin(self, rig: Rig, happened: Happened) -> None:
        link = rig.wires[self.link]
        rule, happened.detail = type(self).rule(self.rng, self.link)
        link.marks, link.rule = happened.marks, rule

    def end(self, rig: Rig, happened: Happened) -> None:
        rig.wires[self.link].mend(time.monotonic())


def dropped(rng: np.random.Generator, link: str) -> tuple[wire.Rule, str]:
    """Messages are lost: all of them, or a third."""
    share = float(rng.choice([1.0, 1.0, 0.3]))
    return wire.drop(rng, share), f"{share:.0%}"


def delayed(rng: np.random.Generator, link: str) -> tuple[wire.Rule, str]:
    """Messages arrive later: within the timeouts, beyond them, or too old to be accepted."""
    delay = float(rng.choice([0.03, 0.3, 0.7]))
    return wire.delay(delay, link == "pose" and delay > OLDEST_COMMAND), f"{delay:g} s, reason stamp_past"


def duplicated(rng: np.random.Generator, link: str) -> tuple[wire.Rule, str]:
    """Half of the messages arrive twice."""
    return wire.duplicate(rng, 0.5), ""


def reordered(rng: np.random.Generator, link: str) -> tuple[wire.Rule, str]:
    """A fifth of the messages is overtaken."""
    return wire.reorder(rng, 0.2), "reason stamp_order"


def corrupted(rng: np.random.Generator, link: str) -> tuple[wire.Rule, str]:
    """A fifth of the messages is corrupted, all in the same way."""
    way = str(rng.choice(sorted(wire.SPOILS[link])))
    spoil, reason = wire.SPOILS[link][way]
    return wire.corrupt(rng, 0.2, spoil), f"{way}, reason {reason}"


# ---- all of them ----


def _kind(base: type[Fault], kind: str, touches: set[str], **more: Any) -> type[Fault]:
    return type(kind, (base,), {"kind": kind, "touches": frozenset(touches), **more})


WIRED = {"drop": dropped, "delay": delayed, "duplicate": duplicated, "reorder": reordered, "corrupt": corrupted}
STREAM, DRIVE = {"compensator", *LINKS}, {"drive", "feedback"}

KINDS: dict[str, type[Fault]] = {
    kind.kind: kind
    for kind in (
        _kind(Kill, "kill_compensator", {"compensator", "command"}, name="compensator"),
        _kind(Stop, "stop_compensator", {"compensator", "command"}, name="compensator"),
        _kind(Kill, "kill_drive", DRIVE, name="drive"),
        _kind(Stop, "stop_drive", DRIVE, name="drive"),
        _kind(Kill, "kill_mover", {"mover", "pose"}, name="mover"),
        _kind(Stop, "stop_mover", {"mover", "pose"}, name="mover"),
        *(
            _kind(Wired, f"{verb}_{link}", {link}, link=link, rule=staticmethod(rule))
            for link in LINKS
            for verb, rule in WIRED.items()
        ),
        _kind(Restart, "restart_under_stream", STREAM),
        _kind(Reset, "reset_under_stream", STREAM),
        _kind(ReloadUnderStream, "reload_under_stream", {"compensator", "pose"}),
        _kind(StopUnderStream, "stop_under_stream", STREAM),
        _kind(Bunched, "bunched_pose", STREAM),
        _kind(Restamped, "stamps_stand", STREAM),
        _kind(Hurried, "too_fast", STREAM),
        _kind(ResetInMotion, "reset_in_motion", STREAM),
        _kind(SimTime, "use_sim_time_set", {"compensator"}),
        _kind(Stuck, "stuck_strut", DRIVE),
        _kind(Jumping, "jumping_strut", DRIVE),
        _kind(Latched, "latched_following_error", {*DRIVE, "compensator", "pose"}),
        _kind(LostEncoder, "encoder_nan", DRIVE),
        _kind(FullDisk, "log_disk_full", {"disk"}),
        _kind(HalfModel, "half_written_model", {"compensator"}),
    )
}

# Kinds of a machine whose poses come from the mover, and of one whose poses come from the harness, alone
MOVERS, CONTROLLERS = ("kill_mover", "stop_mover"), ("too_fast",)


def kinds_of(mover: bool) -> tuple[str, ...]:
    """Return the names of the kinds of faults that a machine with, or without, a mover can have."""
    return tuple(kind for kind in KINDS if kind not in (CONTROLLERS if mover else MOVERS))
