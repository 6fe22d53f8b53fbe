"""The kinds of faults by name: what each touches, and in words when it is visible and who must say what."""

from __future__ import annotations

from .fault import SILENT, Fault, Meaning
from .message_faults import (
    Bunched,
    Corrupted,
    Delayed,
    Dropped,
    Duplicated,
    Hurried,
    Jumping,
    LostEncoder,
    Reordered,
    Restamped,
    StopUnderStream,
    Stuck,
)
from .node_faults import (
    FullDisk,
    HalfModel,
    Kill,
    Latched,
    ReloadUnderStream,
    Reset,
    ResetInMotion,
    Restart,
    SimTime,
    Stop,
)
from .record import LINKS


def _make(base: type[Fault], kind: str, touches: set[str], meaning: Meaning, **attributes: object) -> type[Fault]:
    attributes.update(kind=kind, touches=frozenset(touches), meaning=meaning, __doc__=base.__doc__)
    return type(f"{base.__name__}_{kind}", (base,), attributes)


REFUSED = {
    "pose": "compensator: refusing commands: the reason, or following_error while that is latched",
    "command": "strut_drive: refusing commands: the reason",
    "feedback": "compensator: bad feedback: the reason, or following_error",
}

HARMLESS = Meaning("never: a repetition changes nothing", "nothing need be reported")


def _wired_kinds(link: str) -> list[type[Fault]]:
    """Return the kinds of faults of one link."""
    silent, refused = SILENT[link], REFUSED[link]
    too_old = Meaning(f"{silent.visible}, or one too old is delivered", f"{silent.said}, or stamp_past")
    delayed = too_old if link == "pose" else silent
    overtaken = Meaning("the first overtaken message is delivered", refused.replace("the reason", "stamp_order"))
    spoilt = Meaning("the first corrupted message is delivered", refused)
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
        *_process_kinds("mover", "pose", {"mover", "pose"}),
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

MOVERS, CONTROLLERS = ("kill_mover", "stop_mover"), ("too_fast",)
"""Kinds of a machine whose poses come from the mover, and of one whose poses come from the harness, alone."""


def kinds_of(mover: bool) -> tuple[str, ...]:
    """Return the names of the kinds of faults that a machine with, or without, a mover can have."""
    return tuple(kind for kind in KINDS if kind not in (CONTROLLERS if mover else MOVERS))
