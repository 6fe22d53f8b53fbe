"""A machine that calibrates itself: plan, collect, fit, check, reload; check again; name what has changed, repair it.

The loop is a state machine whose memory is the journal: :meth:`State.after` folds its events into a state,
:func:`next_step` says what is to be done in it, and each step ends with an event. A process that was killed goes on
with the step that has no event yet; readings that it had collected are in their file.

A model is adopted only when check readings that were not used in its fit confirm it. A check that contradicts a model
counts when a second one, read anew, repeats it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..calibration.candidates import MeasuringBox
from ..calibration.changes import DATUM, FAMILIES, PAYLOAD, READING, STRUT, TEMPERATURE
from ..calibration.check import (
    NAMED,
    UNDECIDED,
    VALID,
    Verification,
    refusal,
    update_model,
    verification_report,
    verify_model,
)
from ..calibration.design import Goal, Proposal, Times, propose, remarks
from ..calibration.fit import fit_model
from ..calibration.parameters import FitSettings
from ..calibration.posterior import FittedParameters
from ..calibration.posterior_file import load_posterior, save_with_posterior
from ..calibration.report import fit_report
from ..errors import CalibrationError, CommandError, HexapodError, InputFileError
from ..formats.outputs import write_text
from ..machine.geometry import HexapodGeometry
from ..machine.model_file import load_model
from ..measurements.campaign import Campaign, campaign_text, load_campaign
from ..measurements.collect import MeasuredMachine, SetUpError, collect
from ..measurements.files import read_measurements
from ..measurements.readings import UNKNOWN, MeasurementSet
from .careful import Careful
from .checks import LEAST_READ, Whole, check_run, judge
from .journal import ENDED, IN_USE, JOURNAL, Event, Journal

GIVEN = "given"  # in place of the name of a planned campaign
PROPOSED = "proposed.yaml"  # a later one, until somebody permits that it is run

CAMPAIGNS = 3  # of a calibration, each planned where the fits before have not reached the goal; then it is refused
PASSES = 3  # over a campaign, for stops at which the instrument read nothing
PLANNED_SHARE = 0.7  # of the goal is planned for: a plan expects the RMS error, and the goal is the end of its interval
FURTHER = 0.5  # of what was planned for before, where the readings have not been enough
POSES, LONGEST = "6-D", 4 * 3600.0  # What a tracker's poses are to a plan, and how long a planned campaign may be, s
STOP = 5.0  # A stop takes it, s: a move, its settling and three looks; whatever it reads, nothing is put up for it
CHECKS_OF_A_READING = 3  # checks in a row that a single wrong reading spoils: then the instrument is to be looked after

# Changes that count though the promise is kept: something has happened. What else readings show (ageing, a bend,
# scatter) an imperfect fit has as well: that counts when the promise is broken.
EVENTS = (DATUM, STRUT, TEMPERATURE, PAYLOAD)

PLAN, COLLECT, FIT, CHECK, GIVE_UP, ADOPT, RELOAD, GUARD, REPAIR, END = (
    "plan", "collect", "fit", "check", "give up", "adopt", "reload", "guard", "repair", "end"
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """What the loop has to do."""

    box: np.ndarray  # (2, 3): where the tool works, m in the work frame
    level: np.ndarray  # (3, 3): the tool's attitude there, in the work frame
    goal: float | None = None  # the promised RMS tool error may reach this at most, with 95 %, m; None: any promise
    campaign: Campaign | None = None  # to begin with, in place of a planned one; with neither it can only be checked
    settings: FitSettings = field(default_factory=FitSettings)
    every: float = 600.0  # time from one check of the model in use to the next, s

    def __post_init__(self) -> None:
        if self.goal is not None and self.campaign is not None:
            raise CommandError("usage", "give a goal to plan for, or a campaign, and not both")
        if self.goal is not None and not 0.0 < self.goal < np.inf:
            raise CalibrationError("goal", f"must be finite and above zero, m, not {self.goal:g}")

    @property
    def measurable(self) -> bool:
        """Whether there is something to calibrate with."""
        return self.goal is not None or self.campaign is not None


@dataclass(frozen=True)
class State:
    """Where the loop stands; files by their names in its folder."""

    number: int = 0  # of the newest file
    calibrating: bool = False  # a calibration was begun, and no model has come of it yet
    rounds: int = 0  # campaigns that were planned for this calibration
    planned: str = ""  # a campaign that is not collected yet
    readings: tuple[str, ...] = ()  # of this calibration's campaigns
    fitted: bool = False  # all of them are in a fit
    candidate: str = ""  # a model that is not adopted yet
    repairs: str = ""  # the changed model that the candidate repairs; empty: it is a new calibration
    proven: bool = False  # check readings have borne the candidate out
    promised: float = np.nan  # of the candidate's calibration, m
    in_use: str = ""  # the model that was adopted last
    kept: float = np.nan  # what it has promised, m
    reloaded: bool = False  # the compensator runs it
    doubts: tuple[str, ...] = ()  # check readings that contradict the candidate, or else the model in use
    spoilt: int = 0  # checks in a row of which a single reading is wrong
    changed: bool = False  # the machine, as two checks say
    stuck: str = ""  # a change that the loop may not repair by itself
    checks: int = 0  # of the model in use that have borne it out, or were repaired
    refused: str = ""  # why the loop has ended without a model

    def after(self, event: Event) -> State:
        """Return the state after an event."""
        e, one = event, replace(self, number=max(self.number, event.get("number", 0)))
        kept = {name: getattr(one, name) for name in ("number", "in_use", "kept", "reloaded", "checks")}
        match event["event"]:
            case "begun":
                return State(**kept, calibrating=True)
            case "planned":
                return replace(one, planned=e["campaign"], rounds=self.rounds + 1)
            case "collected":
                return replace(one, planned="", readings=(*self.readings, e["readings"]), fitted=False)
            case "fitted":
                promised = np.nan if e["promised_m"] is None else e["promised_m"]
                return replace(one, fitted=True, candidate=e["model"] if e["enough"] else "", promised=promised)
            case "checked":
                return one._checked(e)
            case "adopted":
                kept |= {"in_use": self.candidate, "kept": self.promised, "reloaded": False}
                return State(**{**kept, "checks": self.checks + bool(self.repairs)})
            case "reloaded":
                return replace(one, reloaded=True)
            case "restarted":
                return replace(one, reloaded=False)
            case "repaired":
                return State(**kept, candidate=e["model"], repairs=self.in_use, promised=self.kept)
            case "beyond repair":
                return State(**kept, stuck=f"{e['text']}: {e['reason']}")
            case "refused":
                return replace(one, refused=e["reason"])
        return one  # a run that has ended changes nothing

    def _checked(self, e: Event) -> State:
        """Return the state after a check: one that is good, spoilt by one reading, or contradicts the model."""
        if e["good"]:
            cleared = replace(self, doubts=(), spoilt=0)
            return replace(cleared, proven=True) if self.candidate else replace(cleared, checks=self.checks + 1)
        if e["spoilt"]:
            return replace(self, spoilt=self.spoilt + 1)
        doubts = (*self.doubts, e["readings"])
        return replace(self, doubts=doubts, spoilt=0, changed=not self.candidate and len(doubts) > 1)


def next_step(state: State, checks: int | None, may_reload: bool) -> str:
    """Return what is to be done in a state; the model in use is to be checked `checks` times, None: without end."""
    if state.refused or state.stuck:
        return END
    if state.spoilt >= CHECKS_OF_A_READING or (state.candidate and len(state.doubts) > 1):
        return GIVE_UP
    if state.candidate:
        return ADOPT if state.proven else CHECK
    if state.changed:
        return REPAIR
    if state.planned:
        return COLLECT
    if state.readings:
        return PLAN if state.fitted else FIT
    if not state.in_use or state.calibrating:
        return PLAN
    if may_reload and not state.reloaded:
        return RELOAD
    if state.doubts or state.spoilt:
        return CHECK
    return END if checks is not None and state.checks >= checks else GUARD


def begun_with(folder: str | Path) -> Event:
    """Return the inputs of the newest calibration in a folder: machine, goal_m, box_m, level; empty without one."""
    events = Journal.read(Path(folder) / JOURNAL)
    return next((e for e in reversed(events) if e["event"] == "begun"), {})


class Outcome(NamedTuple):
    """How a run of the loop ended."""

    state: str  # in use, proposed, changed, refused, stopped; in the journal also failed
    text: str
    model: Path | None  # the model in use, or the one that is proposed

    @property
    def good(self) -> bool:
        """Whether there is a model that its checks confirm."""
        return self.state in ("in use", "proposed")


class Stopped(Exception):  # no HexapodError: a fit tries other ways after one of these
    """A person has stopped the loop."""


class Adaptation:
    """Calibrates a machine and keeps its model true; everything that it makes is in its folder."""

    def __init__(
        self,
        geometry: HexapodGeometry,  # with the tool that carries the target
        machine: MeasuredMachine,  # moves and watches
        task: Task,
        folder: str | Path,  # of the journal, which is continued if it exists
        reload: Callable[[Path], object] | None = None,  # has the machine run a file's model; None: it is only proposed
        going_on: Callable[[], bool] = lambda: True,  # False stops the loop: at the next stop, or while it waits
        say: Callable[[str], object] = lambda text: None,  # told what goes on
        wait: Callable[[float], object] = time.sleep,  # lets some time pass, s
        # whether the machine runs a file's model: one that was switched off and on runs what it was started with
        runs: Callable[[Path], bool] = lambda path: True,
    ) -> None:
        self._geometry, self._machine, self._task = geometry, Careful(machine), task
        self._reload, self._runs, self._going_on, self._say, self._wait = reload, runs, going_on, say, wait
        self._folder = Path(folder)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputFileError(folder, "", f"cannot be made a folder: {error.strerror}") from error
        self._journal, self.state = Journal(self._folder / JOURNAL), State()
        for event in self._journal.events:
            try:
                self.state = self.state.after(event)
            except KeyError as error:
                raise InputFileError(self._journal.path, event["event"], f"lacks {error}") from error
        machines = {e["machine"] for e in self._journal.events if e["event"] == "begun"}
        if machines - {geometry.name}:
            known = ", ".join(sorted(machines))
            raise InputFileError(self._journal.path, "machine", f"is of machine {known}; give another folder")

    @property
    def events(self) -> list[Event]:
        """What was done so far."""
        return self._journal.events

    def calibrate(self, anew: bool = False) -> Outcome:
        """Calibrate until a model is adopted or refused, continuing what the journal has begun unless `anew`."""
        if not self._task.measurable:
            raise CommandError("usage", "give a goal to plan for, or a campaign")
        state = self.state
        if not anew:
            self._same_place()
        if anew or not (state.calibrating or state.candidate or state.in_use) or state.refused or state.stuck:
            self._begin()
        return self._run(0)

    def guard(self, checks: int | None) -> Outcome:
        """Check the model in use this number of times (None: until stopped), the first time at once, and repair it."""
        state = self.state
        if not state.in_use and not state.candidate:
            raise CommandError("not_calibrated", f"{self._folder} has no model in use: calibrate first")
        self._same_place()
        return self._run(None if checks is None else state.checks + checks)

    def _run(self, checks: int | None) -> Outcome:
        """Run the steps in their order until none is due."""
        waits, may_reload = False, self._reload is not None
        steps = {
            PLAN: self._plan,
            COLLECT: self._collect,
            FIT: self._fit,
            CHECK: self._check,
            GIVE_UP: self._give_up,
            ADOPT: self._adopt,
            RELOAD: self._bring_in,
            GUARD: self._check,
            REPAIR: self._repair,
        }
        try:
            while True:
                # A check holds whatever model runs, by its strut lengths: it does not show that it is another
                if may_reload and self.state.reloaded and not self._runs(self._folder / IN_USE):
                    self._note("restarted", reason="the compensator did not run the model in use")
                if (step := next_step(self.state, checks, may_reload)) == END:
                    break
                self._stop_if_asked("stopped")
                if step == GUARD and waits:
                    self._pause()
                waits |= step == GUARD
                steps[step]()
        except (Stopped, HexapodError) as error:
            if not isinstance(error, Stopped) and error.reason != "person":  # as of a move that a person has stopped
                self._ended("failed", str(error))
                raise
            return self._ended("stopped", f"{error}; the same command goes on from there")
        return self._outcome()

    def _ended(self, state: str, text: str) -> Outcome:
        """Write how a run of the loop has ended, and return it."""
        name = (PROPOSED if self._has(PROPOSED) else IN_USE) if self.state.in_use else None
        self._note(ENDED, state=state, text=text, model=name)
        return Outcome(state, text, None if name is None else self._folder / name)

    def _outcome(self) -> Outcome:
        state = self.state
        if state.refused:
            return self._ended("refused", state.refused)
        if state.stuck:
            return self._ended("changed", state.stuck)
        name = "in use" if state.reloaded else "proposed"
        kept = f"tool error up to {state.kept * 1e6:.2f} µm RMS (95 %), datum aligned"
        promise = f"{'no promise' if np.isnan(state.kept) else kept}; borne out by {state.checks} later checks"
        last = next((e for e in reversed(self.events) if e["event"] == "checked"), {})
        return self._ended(name, promise + moved_text(last))

    def _note(self, event: str, **content: Any) -> None:
        self.state = self.state.after(self._journal.add(event, **content))

    def _begin(self) -> None:
        goal = self._task.goal
        box, level = self._task.box.tolist(), self._task.level.tolist()
        self._note("begun", machine=self._geometry.name, goal_m=goal, box_m=box, level=level)

    def _same_place(self) -> None:
        """Refuse to go on in another box than the one that was calibrated: outside of it the model promises nothing."""
        boxes = (e.get("box_m", self._task.box) for e in reversed(self.events) if e["event"] == "begun")
        begun = np.array(next(boxes, self._task.box))
        if not np.allclose(begun, self._task.box, rtol=0.0, atol=1e-6):
            was, now = (", ".join(f"{x * 1e3:g}" for x in box.ravel()) for box in (begun, self._task.box))
            raise InputFileError(
                self._journal.path, "box_m", f"is {was} mm, not {now} mm: give that box, or begin anew"
            )

    def _name(self, what: str, suffix: str) -> tuple[int, str]:
        """Return number and name of the next file: the same after a restart, so that the file is continued."""
        number = self.state.number + 1
        return number, f"{number:03d}_{what}{suffix}"

    def _stop_if_asked(self, where: str) -> None:
        if not self._going_on():
            raise Stopped(where)

    def _say_or_stop(self, text: str) -> None:
        """Report the progress of a long calculation, and end it on request; its step is then repeated later."""
        self._say(text)
        self._stop_if_asked(f"stopped in a calculation ({text})")

    # ---- the steps ----

    def _plan(self) -> None:
        """Write the campaign that the goal needs, or a further one where the fit so far has not been enough."""
        task, state = self._task, self.state
        most = CAMPAIGNS if task.campaign is None else 1
        if state.rounds >= most:
            short = next(e["short"] for e in reversed(self.events) if e["event"] == "fitted")
            self._note("refused", reason=f"after {state.rounds} campaign{'s' * (state.rounds > 1)} {short}")
            return
        number, name = self._name("campaign", ".yaml")
        if task.campaign is not None:
            self._note("planned", number=number, campaign=GIVEN, expected_m=None)
            return
        self._say("planning a campaign")
        plan = self._proposal(PLANNED_SHARE * FURTHER**state.rounds)
        # At poses like a check's the fit learns where the machine stands, and what struts do on any way
        poses = check_run(self._geometry, task.box, task.level, number, f"{len(plan.campaign.runs) + 1}: poses")
        campaign = replace(plan.campaign, runs=(*plan.campaign.runs, poses))
        write_text(self._folder / name, campaign_text(campaign, remarks(plan)))
        self._note("planned", number=number, campaign=name, expected_m=plan.worst)

    def _proposal(self, share: float) -> Proposal:
        """Return the plan for a share of the goal."""
        task = self._task
        times = {POSES: Times(0.0, 0.0, STOP)}
        goal = Goal(share * (task.goal or 0.0), seconds=LONGEST, instruments=(POSES,), times=times)
        place = MeasuringBox(self._geometry, task.box, task.level, 0.0)
        return propose(place, goal, task.settings, progress=self._say_or_stop)

    def _collect(self) -> None:
        """Measure the planned campaign."""
        number, name = self._name("readings", ".csv")
        planned, given = self.state.planned, self._task.campaign
        if (planned == GIVEN) != (given is not None):
            problem = "was begun with a campaign" if planned == GIVEN else "was begun with a goal"
            raise InputFileError(self._journal.path, "", f"{problem}: go on with it, or begin anew")
        campaign = load_campaign(self._folder / planned) if given is None else given
        readings, missing = self._measured(campaign, name)
        self._note("collected", number=number, readings=name, count=len(readings), missing=list(missing))

    def _measured(self, campaign: Campaign, name: str) -> tuple[MeasurementSet, tuple[str, ...]]:
        """Return a campaign's readings, which are in a file then, and the stops at which nothing was read."""
        path = self._folder / name
        for _ in range(PASSES):
            try:
                done = collect(
                    campaign,
                    self._geometry,
                    self._machine,
                    path,
                    progress=lambda done, of, where: self._say(f"{name}: stop {done + 1} of {of}: {where}"),
                    going_on=self._going_on,
                )
            except SetUpError:
                if path.exists():
                    os.replace(path, path.with_suffix(".rejected"))  # readings of a wrong set-up are no beginning
                raise
            self._stop_if_asked(f"stopped while {name} was measured")
            if not done.missing:
                break
        return done.measurements, done.missing

    def _fit(self) -> None:
        """Fit a model to all campaigns of this calibration."""
        state, task = self.state, self._task
        number, name = self._name("model", ".yaml")
        measured = self._readings(state.readings)
        promised, short, report = None, "", ""
        try:
            fit = fit_model(measured, task.settings, self._say_or_stop)
        except CalibrationError as error:
            short = f"no model can be fitted: {error}"
        else:
            promised = fit.level.high if fit.level is not None else None
            report = fit_report(fit)
            short = f"the fit is not to be trusted: {fit.misfit}" if fit.misfit else ""
            if not short and task.goal is not None and not (promised is not None and promised <= task.goal):
                had = "nothing" if promised is None else f"{promised * 1e6:.2f} µm"
                short = f"the fit promises {had} (95 %), and the goal is {task.goal * 1e6:.2f} µm"
            if short and fit.lead is not None and fit.lead.used is None:
                short += "; the screws' lead is not known (--lead-mm), so that their periodic error is not fitted"
            save_with_posterior(fit.model, fit.parameters, self._folder / name)
        write_text(self._folder / f"{name}.report.txt", report or short)
        self._note("fitted", number=number, model=name, promised_m=promised, enough=not short, short=short)

    def _check(self) -> None:
        """Take check readings, and weigh them against the candidate, or else against the model in use."""
        state = self.state
        model = state.candidate or state.in_use
        promised = state.promised if state.candidate else state.kept
        number, name = self._name("check", ".csv")
        # A check that was stopped begins anew: whatever stopped it may have changed the machine
        (self._folder / name).unlink(missing_ok=True)
        self._say(f"checking {model}")
        task = self._task
        side = float(np.ptp(task.box, axis=0).min())
        run = check_run(self._geometry, task.box, task.level, number, f"check {number}")
        campaign = Campaign(task.box, side, side, instrument=None, diagonals=0, level=task.level, runs=(run,))
        _, missing = self._measured(campaign, name)
        measured = self._readings([name])
        if (usable := len(np.unique(measured.station))) < LEAST_READ:
            problem = f"{usable} of {len(run.positions)} readings of {name} are usable, and a check needs {LEAST_READ}"
            raise CommandError("instrument", f"{problem}: at {len(missing)} places the instrument read nothing")
        verification, fitted = self._verified(model, measured)
        judged = judge(fitted, measured, promised)
        kept = verification.verdict == VALID if np.isnan(promised) else judged.excess <= 1.0
        spoilt = not kept and verification.verdict != VALID and verification.candidates[0].family == READING
        good = kept and not (verification.verdict == NAMED and verification.candidates[0].family in EVENTS)
        first = next((e for e in self.events if e["event"] == "checked" and e["model"] == model), None)
        before = judged.whole if first is None else Whole(np.array(first["stands_m"]), first["stands_error_m"])
        write_text(self._folder / f"{name}.report.txt", verification_report(verification))
        self._note(
            "checked",
            stands_m=judged.whole.motion.tolist(),
            stands_error_m=judged.whole.error,
            moved_m=judged.whole.moved(before),
            number=number,
            readings=name,
            model=model,
            good=good,
            spoilt=spoilt,
            found_m=None if np.isnan(promised) else judged.found,
            promised_m=None if np.isnan(promised) else promised,
            missing=list(missing),
            verdict=verification.verdict,
            usual=verification.usual,
            changes=[
                {"kind": c.family, "name": c.name, "probability": verification.families[c.family], "sizes": c.sizes}
                for c in verification.candidates[: 0 if verification.verdict == VALID else 2]
            ],
            text=happened(verification),
        )

    def _give_up(self) -> None:
        """End with a candidate that two checks contradict, or where an instrument spoils check after check."""
        state = self.state
        if state.spoilt >= CHECKS_OF_A_READING:
            reason = f"{state.spoilt} checks in a row have a single wrong reading: look after the instrument"
            self._note("refused", reason=reason)
            return
        last = next(e for e in reversed(self.events) if e["event"] == "checked")
        why = last["text"]
        if last["verdict"] == VALID:
            found, promised = (last[name] * 1e6 for name in ("found_m", "promised_m"))
            why = f"they show {found:.2f} µm RMS, and {promised:.2f} µm were promised"
        if state.repairs:
            self._beyond_repair("the repaired model is contradicted by its check readings", why)
        else:
            reason = f"two sets of check readings that the fit has not seen contradict its model: {why}"
            self._note("refused", reason=reason)

    def _readings(self, names: Sequence[str]) -> MeasurementSet:
        """Return the readings of files, without stops that were reached from an unknown side: a run's first pose."""
        measured = read_measurements([self._folder / name for name in names], self._geometry)
        return measured.select(measured.direction != UNKNOWN)

    def _verified(self, model: str, readings: MeasurementSet) -> tuple[Verification, FittedParameters]:
        """Return what readings say of a model, and what its fit knows."""
        path = self._folder / model
        machine_model = load_model(path, self._geometry)
        fitted, unknown = load_posterior(machine_model, self._geometry, path)
        if fitted is None:
            raise CalibrationError("model", f"{path} cannot be checked: {unknown}")
        return verify_model(machine_model, fitted, readings), fitted

    def _adopt(self) -> None:
        """Name the candidate as the model in use; where one is there already it is only proposed without permission."""
        first = not self._has(IN_USE)
        self._copy(self.state.candidate, IN_USE if first or self._reload is not None else PROPOSED)
        promised = None if np.isnan(self.state.promised) else self.state.promised
        self._note("adopted", model=self.state.candidate, promised_m=promised)

    def _bring_in(self) -> None:
        """Have the compensator run the model in use."""
        assert self._reload is not None
        self._say("reloading")
        if self._has(PROPOSED):
            self._copy(self.state.in_use, IN_USE)
            (self._folder / PROPOSED).unlink()
        self._reload(self._folder / IN_USE)
        self._note("reloaded", model=self.state.in_use)

    def _has(self, name: str) -> bool:
        return (self._folder / name).exists()

    def _copy(self, name: str, to: str) -> None:
        """Write a model and its posterior under another name."""
        path = self._folder / name
        model = load_model(path, self._geometry)
        save_with_posterior(model, load_posterior(model, self._geometry, path)[0], self._folder / to)

    def _repair(self) -> None:
        """Renew the model in use from the checks that contradict it, or begin a calibration where they cannot."""
        state = self.state
        number, name = self._name("model", ".yaml")
        # Both checks together; where a wild reading spoils that, the newest alone
        tried = []
        for names in (state.doubts, state.doubts[-1:]):
            verification, fitted = self._verified(state.in_use, self._readings(names))
            reason = refusal(verification)
            if verification.verdict == VALID:
                reason = "both checks together do not show what has changed, but break the promise"
            tried.append((happened(verification), reason))
            if not reason:
                break
        else:
            self._beyond_repair(*tried[0])
            return
        model = load_model(self._folder / state.in_use, self._geometry)
        update = update_model(model, fitted, verification.measurements, verification)
        save_with_posterior(update.model, update.fitted, self._folder / name)
        text = happened(verification)
        self._note("repaired", number=number, model=name, of=state.in_use, text=text, chi_square=update.chi_square)

    def _beyond_repair(self, text: str, reason: str) -> None:
        """Calibrate anew if the loop may reload the new model; otherwise propose the campaign and end."""
        number, name = self._name("proposed_campaign", ".yaml")
        if self._reload is None and self._task.goal is not None:
            plan = self._proposal(PLANNED_SHARE)
            write_text(self._folder / name, campaign_text(plan.campaign, remarks(plan)))
            reason += f"; proposed campaign: {self._folder / name}"
        self._note("beyond repair", number=number, text=text, reason=reason)
        if self._reload is not None and self._task.measurable:
            self._begin()

    def _pause(self) -> None:
        """Wait for the next check."""
        end = time.monotonic() + self._task.every
        while (left := end - time.monotonic()) > 0.0:
            self._say(f"next check in {left:.0f} s")
            self._stop_if_asked("stopped between two checks")
            self._wait(min(left, 0.2))


def moved_text(check: Event) -> str:
    """Return what a check shows about base, workpiece and instrument, after its other results, as text or empty."""
    if not check.get("moved_m") or not check["good"]:  # a changed strut moves everything too
        return ""
    size = f"{check['moved_m'] * 1e6:.1f} µm"
    return f"; everything stands elsewhere as a whole, by {size}: base, workpiece or instrument has moved"


def happened(verification: Verification) -> str:
    """Return what check readings say has happened to the machine."""
    if verification.verdict == VALID:
        return "nothing has changed"
    best = verification.candidates[0]
    if verification.verdict == UNDECIDED:
        return "either " + ", or ".join(FAMILIES[c.family] for c in verification.candidates[:2])
    sizes = ", ".join(f"{s['name']} {s['value']:+.3g} ± {s['standard_error']:.2g} {s['unit']}" for s in best.sizes)
    return f"{FAMILIES[best.family]}: {best.name}" + (f" ({sizes})" if sizes else "")
