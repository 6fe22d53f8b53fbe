"""The demonstration: a virtual machine is calibrated, then warmed, then knocked, and its model is repaired twice."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.evaluation import held_out
from ..errors import CalibrationError
from ..formats.texts import aligned, number
from ..machine.arrays import rms
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths
from ..machine.model import MachineModel, RealMachine
from ..machine.model_file import load_model
from ..machine.temperatures import STEEL
from ..pose import Pose, best_motion
from ..upkeep.loop import STOP, Adaptation, Task
from ..virtual.watched import Instrument, VirtualMachine
from ..workspace.reach import machine_box

LONGEST_SIDE = 0.2  # Longest side of the box in which the demonstration measures, m
PROPORTIONS = np.array([1.0, 1.0, 0.5])  # Proportions of this box along x, y and z of the work frame

GOAL = 3e-6  # Allowed RMS tool error after best-fit alignment, m
WARMTH = 5.0  # Temperature rise of the struts, K
KNOCK = 20e-6  # Permanent lengthening of a strut by an accident, m
WILD, BROKEN = 0.01, 0.02  # Share of readings that are outliers of 0.2 mm; share of readings with a broken beam


@dataclass(frozen=True)
class Place:
    """The box in which the demonstration measures, and the tool's attitude there."""

    box: np.ndarray  # (2, 3): lowest and highest tool position, m in ``work``
    attitude: np.ndarray  # (3, 3): rotation of the tool in ``work``: level, or as at home if level is impossible


def demo_place(geometry: HexapodGeometry) -> Place:
    """Return a box near the home position, with sides of at most LONGEST_SIDE, within the machine's largest box."""
    largest = machine_box(geometry)
    low, high = largest.box
    half = np.minimum(0.5 * LONGEST_SIDE * PROPORTIONS, 0.49 * (high - low)).round(4)
    centre = np.clip(geometry.tool_pose(geometry.home).position, low + half, high - half)
    return Place(np.array([centre - half, centre + half]).round(9), largest.rotation)


@dataclass
class Chapter:
    """The machine's stops between two events, such as a knock, with the tool's true position at each stop."""

    title: str
    times: list[float] = field(default_factory=list)  # times of the stops, s
    targets: list[np.ndarray] = field(default_factory=list)  # commanded tool positions in ``base``, m
    actual: list[np.ndarray] = field(default_factory=list)  # true tool positions in ``base``, m

    def errors(self) -> np.ndarray:
        """Return the tool error in m at each of the n stops, after best-fit alignment of all n stops; shape (n,)."""
        targets, actual = np.array(self.targets), np.array(self.actual)
        datum = best_motion(actual, targets) or Pose.identity()
        return np.linalg.norm(datum.transform(actual) - targets, axis=1)


class RecordedMachine(VirtualMachine):
    """A virtual machine that records the tool's true position at each stop."""

    chapters: list[Chapter]
    time = 0.0  # s

    def begin(self, title: str) -> None:
        self.chapters.append(Chapter(title))

    def move(self, pose: Pose) -> None:
        super().move(pose)
        self.time, chapter = self.time + STOP, self.chapters[-1]
        chapter.times.append(self.time)
        chapter.targets.append((self.geometry.work @ pose).position)
        chapter.actual.append(self.tool.position)


@dataclass(frozen=True)
class Demonstration:
    chapters: list[Chapter]
    events: list[dict[str, Any]]  # events in the journal of `adapt`
    promised: float  # with 95 % probability, the RMS tool error in the box is at most this large after a calibration, m
    left: dict[str, float]  # by chapter: RMS tool error at unmeasured points in the box after best-fit alignment, m
    complaints: list[str]  # why the demonstration FAILED; empty: PASSED

    def text(self) -> str:
        rows = [
            [c.title, str(len(c.times)), number(rms(c.errors()) * 1e6, 3), number(self.left[c.title] * 1e6, 3)]
            for c in self.chapters
        ]
        title = "tool error, µm RMS, after best-fit alignment"
        table = aligned([title, "stops", "at the stops", "in the whole box"], rows)
        promised = f"promised by the calibration for the whole box: at most {self.promised * 1e6:.3f} µm RMS (95 %)"
        verdict = (
            "\n".join(f"FAILED: {text}" for text in self.complaints)
            or "PASSED: both changes were named and repaired; no RMS error in the box is above the promised error"
        )
        return f"{table}\n{promised}\n{verdict}"

    def as_json(self) -> dict[str, Any]:
        chapters = [
            {"title": c.title, "stops": len(c.times), "rms_m": rms(c.errors()), "box_rms_m": self.left[c.title]}
            for c in self.chapters
        ]
        return {
            "promised_m": self.promised, "chapters": chapters, "events": self.events, "complaints": self.complaints,
        }  # fmt: skip


def warmed(geometry: HexapodGeometry, truth: MachineModel, kelvins: float) -> MachineModel:
    """Return `truth` with steel struts that are warmer by `kelvins`, which no thermometer measures."""
    growth, struts = kelvins * STEEL, truth.struts
    home = strut_lengths(Structure.of(geometry), geometry.home)
    return replace(truth, struts=replace(struts, offset=struts.offset + growth * home, pitch=struts.pitch + growth))


def demonstrate(
    geometry: HexapodGeometry, truth: MachineModel, seed: int, say: Callable[[str], object] = lambda text: None
) -> Demonstration:
    """Calibrate a machine with the errors `truth`; warm its struts, then lengthen one; let checks find both changes."""
    place, strut = demo_place(geometry), int(np.random.default_rng(seed).integers(6))
    machine = RecordedMachine(geometry, truth, Instrument(wild=WILD, broken=BROKEN), seed)
    machine.chapters, left = [], dict[str, float]()
    task = Task(place.box, place.attitude, goal=GOAL, every=0.0)
    with tempfile.TemporaryDirectory(prefix="hexapod_comp_") as folder:
        model = [MachineModel(geometry.name)]

        def begin(title: str) -> None:
            machine.begin(title)
            error = held_out(RealMachine(geometry, machine.truth), model[0], place.box, level=place.attitude)
            left[title] = error.aligned.rms

        def reload(path: Path) -> None:
            model[0] = load_model(path, geometry)
            machine.reload(model[0])
            begin(("calibrated", "renewed", "repaired")[min(len(machine.chapters) // 2, 2)])

        loop = Adaptation(geometry, machine, task, folder, reload, say=say)
        begin("as built")
        outcome = loop.calibrate()
        if not outcome.good:
            raise CalibrationError("demo", f"{outcome.state}: {outcome.text}")
        promised = loop.state.promised_in_use
        loop.guard(1)
        machine.become(warmed(geometry, truth, WARMTH))
        begin(f"warmer by {WARMTH:g} K")
        loop.guard(1)
        loop.guard(1)
        machine.knock(strut, KNOCK)
        begin(f"{STRUT_NAMES[strut]} knocked")
        loop.guard(1)
        loop.guard(1)
    complaints = list(_complaints(loop.events, promised, left, strut))
    return Demonstration(machine.chapters, loop.events, promised, left, complaints)


def _complaints(events: list[dict[str, Any]], promised: float, left: dict[str, float], strut: int) -> Iterator[str]:
    """Yield a complaint for each change of the machine that no repair in the journal names, and for each model whose
    RMS tool error in the box is above `promised`, m.
    """
    repairs = [e["text"] for e in events if e["event"] == "repaired"]
    for wanted in ("a temperature has changed", f"a strut's offset has changed: {STRUT_NAMES[strut]}"):
        if not any(text.startswith(wanted) for text in repairs):
            yield f"no repair names this change: {wanted}"
    for title in ("calibrated", "renewed", "repaired"):
        if not left.get(title, np.inf) <= promised:
            error = left.get(title, np.nan) * 1e6
            yield f"{title}: the tool error is {error:.3f} µm RMS, more than the promised {promised * 1e6:.3f} µm"
