"""The kinds of faults: how each is injected and removed, and which parts it affects (reports: doc/faults.md)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.ros.messages import message_pose

from . import wire
from .judge import following_error
from .record import LINKS, Happened
from .rig import Rig

UNHEARD_FOR = 0.2  # s without messages of the drive after a start or reset under a stream of commands
CERTAINLY = 8e-3  # s; a travel that is too long even for the stamps' time plus this must be refused
OLDEST_COMMAND = 0.5  # s; older commands are refused: the compensator's default max_command_age
MOVES = 2e-4  # a strut whose commands change by more than this in 80 ms, m, moves


@dataclass
class Fault:
    """A fault of an episode, with its own random generator."""

    kind: str
    touches: frozenset[str]
    rng: np.random.Generator
    duration: float  # s
    run: Callable[[Fault, Rig, Happened], Iterator[None]]  # injects, yields, removes, yields to the end


@dataclass(frozen=True)
class Kind:
    """A kind of fault; a call with a random generator draws a :class:`Fault` of this kind."""

    kind: str
    touches: frozenset[str]  # affected parts; two faults of an episode share none
    run: Callable[[Fault, Rig, Happened], Iterator[None]]
    shortest: float = 0.4  # duration, s
    longest: float = 1.0  # duration, s

    def __call__(self, rng: np.random.Generator) -> Fault:
        return Fault(self.kind, self.touches, rng, float(rng.uniform(self.shortest, self.longest)), self.run)


def waiting(seconds: float) -> Iterator[None]:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        yield


# ---- processes ----


def kill(name: str, fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Kill a process with SIGKILL, then start it again; the fault ends when the new process is ready."""
    rig.kill(name)
    yield
    rig.start(name)
    while rig.is_starting(name):
        yield
    if name == "drive":  # the controller returns to its path from the new drive's measured pose
        rig.controller.start_over()


def stop(name: str, fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    rig.freeze(name)
    yield
    rig.thaw(name)


def restart(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Kill and restart the compensator under a stream of commands; feedback arrives some time after it is ready."""
    rig.controller.heedless = True
    rig.wires["feedback"].rule = wire.drop(fault.rng, 1.0)
    yield from kill("compensator", fault, rig, happened)
    yield from waiting(UNHEARD_FOR)
    rig.wires["feedback"].mend(time.monotonic())
    yield from waiting(UNHEARD_FOR)
    rig.controller.heedless = False


# ---- requests of an operator, files and disks ----


def reset(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Call `~/reset` under a stream of commands, after a time without messages from controller and drive."""
    rig.controller.heedless = True
    for link in ("pose", "feedback"):
        rig.wires[link].rule = wire.drop(fault.rng, 1.0)
    yield
    rig.reset()
    rig.wires["pose"].mend(time.monotonic())
    yield from waiting(UNHEARD_FOR)
    rig.wires["feedback"].mend(time.monotonic())
    rig.controller.heedless = False


def reload_under_stream(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Call `~/reload_model` three times under a stream of commands."""
    rig.controller.heedless = True
    answers: list[bool] = []

    def answered(accepted: bool) -> None:
        answers.append(accepted)
        if not accepted:
            happened.breaches.append("a good model was refused")
        if len(answers) < 3:
            rig.reload_model(answered)

    rig.reload_model(answered)
    yield
    while len(answers) < 3:
        yield
    rig.controller.heedless = False


def reset_in_motion(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Call `~/reset` three times in motion; a reset may be granted only where the path reverses."""

    def ask(times: int) -> None:
        began = time.monotonic()

        def answered(done: bool) -> None:
            commands = [c.lengths for c in rig.record.commands if began - 0.08 < c.time < began]
            travel = float(np.ptp(commands, axis=0).max()) if commands else 0.0
            if done and travel > MOVES:
                happened.breaches.append(f"reset granted though the struts moved by {travel * 1e3:.2f} mm in 80 ms")
            elif not done:
                happened.marks.append(time.monotonic())
            if times > 1:
                ask(times - 1)

        rig.reset(answered)

    ask(3)
    yield


def sim_time(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    def answered(accepted: bool) -> None:
        if accepted:
            happened.breaches.append("use_sim_time was accepted by a running node")

    rig.simulate_time(answered)
    yield


def full_disk(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    rig.log_disk.fill()
    happened.marks.append(time.monotonic())
    yield
    rig.log_disk.clear()


def half_model(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Request a reload of a partly written model file, later of the complete file."""
    whole, answers = rig.model.read_text(encoding="utf-8"), list[bool]()
    part = int(len(whole) * fault.rng.uniform(0.02, 0.98))
    happened.detail = f"{part} of {len(whole)} characters"
    rig.model.write_text(whole[:part], encoding="utf-8")

    def answered(accepted: bool) -> None:
        answers.append(accepted)
        happened.detail += ", accepted as complete" if accepted else ""
        happened.marks.append(time.monotonic())

    rig.reload_model(answered)
    yield
    while not answers:
        yield
    rig.model.write_text(whole, encoding="utf-8")
    rig.reload_model(lambda _: None)


# ---- struts and encoders ----


def on_strut(parameter: str, fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Set a drive's fault `parameter` for one strut: its motor is blocked, or its encoder reads NaN (marked)."""
    strut = int(fault.rng.integers(1, 7))
    happened.detail = STRUT_NAMES[strut - 1]
    rig.set_drive(**{parameter: strut})
    yield
    rig.set_drive(**{parameter: 0})
    spoilt = [m.time for m in rig.record.measured if m.time > happened.began and not np.isfinite(m.lengths).all()]
    happened.marks += spoilt


def jump(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Displace a strut's motor by some millimetres; the drive moves it back."""
    strut = int(fault.rng.integers(1, 7))
    distance = float(fault.rng.choice([-1.0, 1.0]) * fault.rng.uniform(2e-3, 8e-3))
    happened.detail = f"{STRUT_NAMES[strut - 1]} by {distance * 1e3:.1f} mm"
    rig.set_drive(fault_jump_strut=strut, fault_jump=distance)
    yield


def latched(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Displace a strut briefly and delay the controller's reset, until which the machine must not move."""
    strut = int(fault.rng.integers(1, 7))
    rig.controller.may_reset = False
    happened.detail = STRUT_NAMES[strut - 1]
    rig.set_drive(fault_jump_strut=strut, fault_jump=float(fault.rng.choice([-8e-3, 8e-3])))
    yield
    rig.controller.may_reset = True
    expected = following_error(rig.record, replace(happened, ended=time.monotonic()))
    happened.halts += [(since, time.monotonic()) for _, _, since in expected]


# ---- messages ----


def streams_on(fault: Fault, rig: Rig) -> Iterator[None]:
    """Stream commands without waiting for answers until some time after the fault."""
    rig.controller.heedless = True
    yield
    rig.wires["pose"].mend(time.monotonic())
    yield from waiting(UNHEARD_FOR)
    rig.controller.heedless = False


def stop_under_stream(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Stop the compensator (SIGSTOP) under a stream of commands, which then arrive in a burst."""
    stream = streams_on(fault, rig)
    next(stream)
    yield from stop("compensator", fault, rig, happened)
    yield from stream


def bunched(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Delay a stream of poses, so that they arrive all at once."""
    fault.duration = float(fault.rng.choice([0.05, 0.3]))
    happened.detail = f"{fault.duration:g} s"
    rig.wires["pose"].rule = wire.delay(float("inf"))
    yield from streams_on(fault, rig)


def restamped(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Give a stream of poses equal stamps, or stamps 1 µs apart."""
    apart = int(fault.rng.choice([0, 1000]))
    happened.detail = f"{apart} ns, reason speed|step"
    structure, speed = Structure.of(rig.geometry), rig.geometry.limits.speed

    def lengths(message: Any) -> np.ndarray:
        return strut_lengths(structure, message_pose(message) @ rig.geometry.tool.inverse())

    link = rig.wires["pose"]
    link.marks = happened.marks
    link.rule = wire.restamp(apart, lengths, lambda seconds: speed * (seconds + CERTAINLY))
    yield from streams_on(fault, rig)


def hurried(fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    """Skip poses, so that the stream commands 640 mm/s, more than the machine's largest speed."""
    rig.controller.stride = 8
    stream = streams_on(fault, rig)
    yield next(stream)
    rig.controller.stride = 1
    yield from stream


def on_link(
    link: str,
    draw: Callable[[np.random.Generator, str], tuple[wire.Rule, str]],
    fault: Fault,
    rig: Rig,
    happened: Happened,
) -> Iterator[None]:
    rule, happened.detail = draw(fault.rng, link)
    rig.wires[link].marks, rig.wires[link].rule = happened.marks, rule
    yield
    rig.wires[link].mend(time.monotonic())


def dropped(rng: np.random.Generator, link: str) -> tuple[wire.Rule, str]:
    share = float(rng.choice([1.0, 1.0, 0.3]))
    return wire.drop(rng, share), f"{share:.0%}"


def delayed(rng: np.random.Generator, link: str) -> tuple[wire.Rule, str]:
    delay = float(rng.choice([0.03, 0.3, 0.7]))
    return wire.delay(delay, link == "pose" and delay > OLDEST_COMMAND), f"{delay:g} s, reason stamp_past"


def corrupted(rng: np.random.Generator, link: str) -> tuple[wire.Rule, str]:
    way = str(rng.choice(sorted(wire.SPOILS[link])))
    spoil, reason = wire.SPOILS[link][way]
    return wire.corrupt(rng, 0.2, spoil), f"{way}, reason {reason}"


ON_LINKS: dict[str, Callable[[np.random.Generator, str], tuple[wire.Rule, str]]] = {
    "drop": dropped,
    "delay": delayed,
    "duplicate": lambda rng, link: (wire.duplicate(rng, 0.5), ""),
    "reorder": lambda rng, link: (wire.reorder(rng, 0.2), "reason stamp_order"),
    "corrupt": corrupted,
}

# ---- table of all kinds ----

# Process, and the link that is silent without it
PROCESSES = {"compensator": "command", "drive": "feedback", "mover": "pose"}
STREAM, DRIVE = {"compensator", *LINKS}, {"drive", "feedback"}

KINDS: dict[str, Kind] = {
    name: Kind(name, frozenset(touches), run, *duration)
    for name, touches, run, *duration in (
        *(
            (f"{verb}_{name}", {name, link}, partial(run, name), seconds, seconds)
            for name, link in PROCESSES.items()
            for verb, run, seconds in (("kill", kill, 0.2), ("stop", stop, 2.0))
        ),
        *(
            (f"{verb}_{link}", {link}, partial(on_link, link, draw))
            for link in LINKS
            for verb, draw in ON_LINKS.items()
        ),
        ("restart_under_stream", STREAM, restart, 0.2, 0.2),
        ("reset_under_stream", STREAM, reset, 0.4, 0.4),
        ("reload_under_stream", {"compensator", "pose"}, reload_under_stream),
        ("stop_under_stream", STREAM, stop_under_stream, 0.4, 0.4),
        ("bunched_pose", STREAM, bunched),
        ("stamps_stand", STREAM, restamped),
        ("too_fast", STREAM, hurried),
        ("reset_in_motion", STREAM, reset_in_motion),
        ("use_sim_time_set", {"compensator"}, sim_time),
        ("stuck_strut", DRIVE, partial(on_strut, "fault_stuck_strut"), 0.6, 1.2),
        ("jumping_strut", DRIVE, jump, 0.2, 0.4),
        ("latched_following_error", {*DRIVE, "compensator", "pose"}, latched, 0.6, 0.6),
        ("encoder_nan", DRIVE, partial(on_strut, "fault_encoder_lost")),
        ("log_disk_full", {"disk"}, full_disk),
        ("half_written_model", {"compensator"}, half_model, 0.5, 0.5),
    )
}

# Kinds that need the mover; kinds that need the harness' own stream of poses
MOVERS, CONTROLLERS = ("kill_mover", "stop_mover"), ("too_fast",)


def kinds_of(mover: bool) -> tuple[str, ...]:
    return tuple(kind for kind in KINDS if kind not in (CONTROLLERS if mover else MOVERS))
