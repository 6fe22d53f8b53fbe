"""Faults of messages: what a controller sends, what happens on the way, and what encoders say."""

from __future__ import annotations

import time
from abc import abstractmethod
from typing import Any

import numpy as np

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.ros.messages import message_pose

from . import wire
from .fault import SILENT, Fault, Meaning
from .record import LINKS, Happened
from .rig import Rig
from .visible import FOLLOWING_LIMIT

UNHEARD_FOR = 0.2
"""After a start or a reset under a stream the drive is not heard for this long, s."""

CERTAINLY = 8e-3
"""At their largest speed for so long, s, and more, struts are too fast for their stamps: more than any jitter."""

OLDEST_COMMAND = 0.5
"""Commands older than this are refused, s: the compensator's default max_command_age."""


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
    """SIGSTOP of the compensator for 0.4 s while the controller continues to stream: the messages of that time arrive
    in a burst."""

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
    """Poses are delayed while the controller continues to stream, and arrive all at once: few enough to accept, or too
    many."""

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
    """Stamps are constant, or a microsecond apart, while the controller continues to stream."""

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
    """The controller skips poses: at 640 mm/s it asks for more than the machine can do."""

    kind = "too_fast"
    meaning = Meaning("never for certain: it may be at a reversal of its path", "nobody must")

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Hurry."""
        super().begin(rig, happened)
        rig.controller.stride = 8

    def end(self, rig: Rig, happened: Happened) -> None:
        """Take time."""
        rig.controller.stride = 1
        super().end(rig, happened)


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
    """Messages arrive later: within the timeouts, beyond them, or too old to be accepted."""

    def rule(self) -> wire.Rule:
        """Return the delay."""
        delay = float(self.rng.choice([0.03, 0.3, 0.7]))
        self.detail = f"{delay:g} s, reason stamp_past"
        return wire.Delay(self.rng, delay, self.link == "pose" and delay > OLDEST_COMMAND)


class Duplicated(Wired):
    """Half of the messages arrive twice."""

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
    """A fifth of the messages is corrupted, all in the same way."""

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
    """A strut's motor is displaced by some millimetres; the drive pulls it back."""

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
        """Find it again, and note when a NaN was delivered."""
        rig.set_drive(fault_encoder_lost=0)
        spoilt = [m.time for m in rig.record.measured if m.time > happened.began and not np.isfinite(m.lengths).all()]
        happened.marks += spoilt
