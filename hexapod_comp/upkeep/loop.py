"""The loop of ``adapt``: plan a campaign, collect readings, fit, check, reload the model; later check and repair it.

The loop is a state machine whose memory is the journal: events give the state (:meth:`State.after`), the state gives
the :func:`next_step`, each step ends with an event. If the process is killed, a new one repeats the unfinished step.
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
from ..calibration.changes import DATUM, PAYLOAD, READING, STRUT, TEMPERATURE
from ..calibration.check import (
    NAMED,
    VALID,
    Verification,
    change_text,
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
from ..errors import CalibrationError, CommandError, HexapodError, InputFileError, TooFewReadingsError
from ..formats.adapt_journal import ENDED, IN_USE, JOURNAL, Event, Journal
from ..formats.outputs import make_folder, write_text
from ..machine.geometry import HexapodGeometry
from ..machine.model_file import load_model
from ..measurements.campaign import Campaign, campaign_text, load_campaign
from ..measurements.collect import MeasuredMachine, SetUpError, collect
from ..measurements.files import read_measurements
from ..measurements.readings import UNKNOWN, MeasurementSet
from .checks import LEAST_READ, RigidMotion, check_run, compare
from .observer import MedianObserver

GIVEN = "given"  # in the journal, in place of a campaign's file name: the campaign that the user has given
PROPOSED = "proposed.yaml"  # file of an adopted model if the loop may not reload models

CAMPAIGNS = 3  # if the goal is missed after this number of campaigns, the calibration is refused
PASSES = 3  # largest number of passes over a campaign; later passes visit stops where the instrument read nothing
PLANNED_SHARE = 0.7  # a plan's expected tool error / goal; below 1, since the fit's 95 % limit must meet the goal
FURTHER = 0.5  # each further campaign multiplies PLANNED_SHARE by this factor
POSES, LONGEST = "6-D", 4 * 3600.0  # instrument and longest duration, s, of a planned campaign
STOP = 5.0  # planned duration of a stop, s: move, settling and three observations
SPOILT_CHECKS = 3  # the loop ends after this number of checks in a row with a single wrong reading

# Changes that contradict a model even if the tool error is within its limit; others also appear after a poor fit
SUDDEN_CHANGES = (DATUM, STRUT, TEMPERATURE, PAYLOAD)

PLAN, COLLECT, FIT, CHECK, GIVE_UP, ADOPT, RELOAD, GUARD, REPAIR, END = (
    "plan", "collect", "fit", "check", "give up", "adopt", "reload", "guard", "repair", "end"
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """The task of the loop: with a goal or a campaign it calibrates, without them it only checks models."""

    box: np.ndarray  # (2, 3): lowest and highest corner of the tool's positions, m in the work frame
    level: np.ndarray  # (3, 3): attitude of the level tool in the work frame
    goal: float | None = None  # largest allowed 95 % limit of the RMS tool error, m; None: any
    campaign: Campaign | None = None  # measured in place of planned campaigns
    settings: FitSettings = field(default_factory=FitSettings)
    every: float = 600.0  # time between two checks of the model in use, s

    def __post_init__(self) -> None:
        if self.goal is not None and self.campaign is not None:
            raise CommandError("usage", "give either a goal or a campaign, and not both")
        if self.goal is not None and not 0.0 < self.goal < np.inf:
            raise CalibrationError("goal", f"must be finite and above zero, m, not {self.goal:g}")

    @property
    def measurable(self) -> bool:
        """Whether the task has a goal or a campaign, so that the loop can calibrate."""
        return self.goal is not None or self.campaign is not None


@dataclass(frozen=True)
class State:
    """State of the loop; files are stated by their names in the loop's folder."""

    number: int = 0  # number of the newest file
    calibrating: bool = False  # whether a calibration has begun and not ended
    rounds: int = 0  # number of campaigns planned for this calibration
    planned: str = ""  # file of a campaign that is not collected yet
    readings: tuple[str, ...] = ()  # files with readings of this calibration
    fitted: bool = False  # whether a model was fitted to all `readings`
    candidate: str = ""  # file of a model that is not adopted yet
    repairs: str = ""  # file of the model of which the candidate is a repair
    confirmed: bool = False  # whether a check has confirmed the candidate
    promised: float = np.nan  # 95 % limit of the RMS tool error by the fit of the candidate, m; NaN: not known
    in_use: str = ""  # file of the newest adopted model
    promised_in_use: float = np.nan  # `promised` of the model in use, m
    reloaded: bool = False  # whether the compensator runs the model in use
    doubts: tuple[str, ...] = ()  # files of checks that contradict the candidate or, if none, the model in use
    spoilt: int = 0  # number of checks in a row with a single wrong reading
    changed: bool = False  # whether two checks in a row contradict the model in use
    beyond_repair: str = ""  # change of the machine that the loop cannot repair
    checks: int = 0  # number of checks that have confirmed the model in use or led to its repair
    refused: str = ""  # reason why the loop has ended

    def after(self, event: Event) -> State:
        e, one = event, replace(self, number=max(self.number, event.get("number", 0)))
        kept = {name: getattr(one, name) for name in ("number", "in_use", "promised_in_use", "reloaded", "checks")}
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
                kept |= {"in_use": self.candidate, "promised_in_use": self.promised, "reloaded": False}
                return State(**{**kept, "checks": self.checks + bool(self.repairs)})
            case "reloaded":
                return replace(one, reloaded=True)
            case "restarted":
                return replace(one, reloaded=False)
            case "repaired":
                return State(**kept, candidate=e["model"], repairs=self.in_use, promised=self.promised_in_use)
            case "beyond repair":
                return State(**kept, beyond_repair=f"{e['text']}: {e['reason']}")
            case "refused":
                return replace(one, refused=e["reason"])
        return one  # ENDED

    def _checked(self, e: Event) -> State:
        """Return the state after a check; a check confirms the model, contradicts it, or has a single wrong reading."""
        if e["good"]:
            cleared = replace(self, doubts=(), spoilt=0)
            return replace(cleared, confirmed=True) if self.candidate else replace(cleared, checks=self.checks + 1)
        if e["spoilt"]:
            return replace(self, spoilt=self.spoilt + 1)
        doubts = (*self.doubts, e["readings"])
        return replace(self, doubts=doubts, spoilt=0, changed=not self.candidate and len(doubts) > 1)


def next_step(state: State, checks: int | None, may_reload: bool) -> str:
    """Return the next step; it is END after `checks` checks of the model in use (None: no limit)."""
    if state.refused or state.beyond_repair:
        return END
    if state.spoilt >= SPOILT_CHECKS or (state.candidate and len(state.doubts) > 1):
        return GIVE_UP
    if state.candidate:
        return ADOPT if state.confirmed else CHECK
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
    """Return the event ``begun`` of the newest calibration in a folder; empty if there is none."""
    return newest(Journal.read(Path(folder) / JOURNAL), "begun")


def newest(events: Sequence[Event], *names: str) -> Event:
    """Return the newest event with one of the `names`; empty if there is none."""
    return next((e for e in reversed(events) if e["event"] in names), {})


class Outcome(NamedTuple):
    """How a run of the loop ended."""

    state: str  # "in use", "proposed", "changed", "refused" or "stopped"; in the journal also "failed"
    text: str
    model: Path | None  # file of the proposed model or, if there is none, of the model in use

    @property
    def good(self) -> bool:
        """Whether the newest model was confirmed by a check."""
        return self.state in ("in use", "proposed")


class Stopped(Exception):  # not a HexapodError, because a fit catches these errors and continues
    """A person has stopped the loop."""


class Adaptation:
    """The loop of ``adapt``, which writes all its files into one folder."""

    def __init__(
        self,
        geometry: HexapodGeometry,  # its tool is the one that carries the instrument's target
        machine: MeasuredMachine,  # with its instrument
        task: Task,
        folder: str | Path,  # a journal in it is continued
        reload: Callable[[Path], object]
        | None = None,  # loads a model file into the compensator; None: only propose models
        going_on: Callable[[], bool] = lambda: True,  # returns False if the loop shall end
        say: Callable[[str], object] = lambda text: None,  # shows a progress text
        wait: Callable[[float], object] = time.sleep,  # waits for a time, s
        # returns whether the compensator runs this model file; after a restart it may run another
        runs: Callable[[Path], bool] = lambda path: True,
    ) -> None:
        self._geometry, self._machine, self._task = geometry, MedianObserver(machine), task
        self._reload, self._runs, self._going_on, self._say, self._wait = reload, runs, going_on, say, wait
        self._folder = Path(folder)
        make_folder(self._folder)
        self._journal, self.state = Journal(self._folder / JOURNAL), State()
        for event in self._journal.events:
            self.state = self.state.after(event)
        machines = {e["machine"] for e in self._journal.events if e["event"] == "begun"}
        if machines - {geometry.name}:
            known = ", ".join(sorted(machines))
            raise InputFileError(self._journal.path, "machine", f"is {known}, not {geometry.name}; give another folder")

    @property
    def events(self) -> list[Event]:
        return self._journal.events

    def calibrate(self, anew: bool = False) -> Outcome:
        """Calibrate until a model is adopted or refused; if `anew`, do not continue an unfinished calibration."""
        if not self._task.measurable:
            raise CommandError("usage", "give a goal or a campaign")
        state = self.state
        if not anew:
            self._refuse_other_box()
        if anew or not (state.calibrating or state.candidate or state.in_use) or state.refused or state.beyond_repair:
            self._begin()
        return self._run(0)

    def guard(self, checks: int | None) -> Outcome:
        """Check the model in use every `Task.every` seconds, `checks` times (None: until stopped), and repair it."""
        state = self.state
        if not state.in_use and not state.candidate:
            raise CommandError("not_calibrated", f"{self._folder} has no model in use: calibrate first")
        self._refuse_other_box()
        return self._run(None if checks is None else state.checks + checks)

    def _run(self, checks: int | None) -> Outcome:
        """Run steps until END, until a person stops the loop, or until a step fails."""
        waits, may_reload = False, self._reload is not None
        steps = {
            PLAN: self._plan,
            COLLECT: self._collect,
            FIT: self._fit,
            CHECK: self._check,
            GIVE_UP: self._give_up,
            ADOPT: self._adopt,
            RELOAD: self._reload_model,
            GUARD: self._check,
            REPAIR: self._repair,
        }
        try:
            while True:
                # Ask, because check readings do not show which model the compensator runs
                if may_reload and self.state.reloaded and not self._runs(self._folder / IN_USE):
                    self._record("restarted", reason="the compensator did not run the model in use")
                if (step := next_step(self.state, checks, may_reload)) == END:
                    break
                self._stop_if_asked("stopped")
                if step == GUARD and waits:
                    self._pause()
                waits |= step == GUARD
                steps[step]()
        except (Stopped, HexapodError) as error:
            if not isinstance(error, Stopped) and error.reason != "person":  # a person has stopped a move
                self._ended("failed", str(error))
                raise
            return self._ended("stopped", f"{error}; the same command continues")
        return self._outcome()

    def _ended(self, state: str, text: str, applied: bool | None = None) -> Outcome:
        """Write the end of the run to the journal, and return its outcome."""
        name = (PROPOSED if self._has(PROPOSED) else IN_USE) if self.state.in_use else None
        self._record(ENDED, state=state, text=text, model=name, applied=applied)
        return Outcome(state, text, None if name is None else self._folder / name)

    def _outcome(self) -> Outcome:
        state = self.state
        if state.refused:
            return self._ended("refused", state.refused)
        if state.beyond_repair:
            return self._ended("changed", state.beyond_repair)
        name = "in use" if state.reloaded else "proposed"
        promise = f"tool error up to {state.promised_in_use * 1e6:.2f} µm RMS (95 %) after best-fit alignment"
        promise = "the fit predicted no limit of the tool error" if np.isnan(state.promised_in_use) else promise
        last, since = newest(self.events, "checked"), newest(self.events, "checked", "reloaded")
        text = f"{promise}; later checks passed: {state.checks}{moved_text(last)}{applied_text(since)}"
        return self._ended(name, text, since.get("applied"))

    def _record(self, event: str, **content: Any) -> None:
        self.state = self.state.after(self._journal.add(event, **content))

    def _begin(self) -> None:
        goal = self._task.goal
        box, level = self._task.box.tolist(), self._task.level.tolist()
        # The next file gets a higher number, because `collect` would continue the readings of a journal that was lost
        number = max((int(path.name[:3]) for path in self._folder.glob("[0-9][0-9][0-9]_readings.csv")), default=0)
        self._record("begun", number=number, machine=self._geometry.name, goal_m=goal, box_m=box, level=level)

    def _refuse_other_box(self) -> None:
        """Raise an InputFileError if the task's box is not the calibration's, where the fit's error limit is valid."""
        begun = np.array(newest(self.events, "begun").get("box_m", self._task.box))
        if not np.allclose(begun, self._task.box, rtol=0.0, atol=1e-6):
            was, now = (", ".join(f"{x * 1e3:g}" for x in box.ravel()) for box in (begun, self._task.box))
            problem = f"is {was} mm in the journal, not {now} mm: give the former box, or begin anew (--anew)"
            raise InputFileError(self._journal.path, "box_m", problem)

    def _next_file(self, what: str, suffix: str) -> tuple[int, str]:
        """Return number and name of the next file; a repeated step gets the file that it began, and continues it."""
        number = self.state.number + 1
        return number, f"{number:03d}_{what}{suffix}"

    def _stop_if_asked(self, where: str) -> None:
        if not self._going_on():
            raise Stopped(where)

    def _say_or_stop(self, text: str) -> None:
        self._say(text)
        self._stop_if_asked(f"stopped in a calculation ({text})")

    # ---- the steps ----

    def _plan(self) -> None:
        """Plan a campaign, or a further campaign if the fit has missed the goal."""
        task, state = self._task, self.state
        most = CAMPAIGNS if task.campaign is None else 1
        if state.rounds >= most:
            short = newest(self.events, "fitted")["short"]
            self._record("refused", reason=f"after {state.rounds} campaign{'s' * (state.rounds > 1)} {short}")
            return
        number, name = self._next_file("campaign", ".yaml")
        if task.campaign is not None:
            self._record("planned", number=number, campaign=GIVEN, expected_m=None)
            return
        self._say("planning a campaign")
        plan = self._proposal(PLANNED_SHARE * FURTHER**state.rounds)
        # Random poses, as in a check, determine the datum, and move the struts on other paths than lines do
        poses = check_run(self._geometry, task.box, task.level, number, f"{len(plan.campaign.runs) + 1}: poses")
        campaign = replace(plan.campaign, runs=(*plan.campaign.runs, poses))
        write_text(self._folder / name, campaign_text(campaign, remarks(plan)))
        self._record("planned", number=number, campaign=name, expected_m=plan.worst)

    def _proposal(self, share: float) -> Proposal:
        """Return a plan of a campaign with an expected tool error of at most `share` times the goal."""
        task = self._task
        times = {POSES: Times(0.0, 0.0, STOP)}
        goal = Goal(share * (task.goal or 0.0), seconds=LONGEST, instruments=(POSES,), times=times)
        place = MeasuringBox(self._geometry, task.box, task.level, 0.0)
        return propose(place, goal, task.settings, progress=self._say_or_stop)

    def _collect(self) -> None:
        number, name = self._next_file("readings", ".csv")
        planned, given = self.state.planned, self._task.campaign
        if (planned == GIVEN) != (given is not None):
            began = "a campaign" if planned == GIVEN else "a goal"
            raise InputFileError(self._journal.path, "", f"was begun with {began}: give {began} again, or begin anew")
        campaign = load_campaign(self._folder / planned) if given is None else given
        readings, missing = self._measured(campaign, name)
        self._record("collected", number=number, readings=name, count=len(readings), missing=list(missing))

    def _measured(self, campaign: Campaign, name: str) -> tuple[MeasurementSet, tuple[str, ...]]:
        """Measure a campaign into the file `name`; return the readings, and the names of stops without a reading."""
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
                    os.replace(path, path.with_suffix(".rejected"))  # readings of a wrong set-up must not be continued
                raise
            self._stop_if_asked(f"stopped while {name} was measured")
            if not done.missing:
                break
        return done.measurements, done.missing

    def _fit(self) -> None:
        state, task = self.state, self._task
        number, name = self._next_file("model", ".yaml")
        measured = self._readings(state.readings)
        promised, short, report = None, "", ""
        try:
            fit = fit_model(measured, task.settings, self._say_or_stop)
        except CalibrationError as error:
            short = f"no model can be fitted: {error}"
            if not isinstance(error, TooFewReadingsError):  # a wrong sign or unit, which no further campaign cures
                write_text(self._folder / f"{name}.report.txt", short)
                self._record("refused", number=number, reason=short)
                return
        else:
            promised = fit.level.high if fit.level is not None else None
            report = fit_report(fit)
            short = f"the fit is not to be trusted: {fit.misfit}" if fit.misfit else ""
            if not short and task.goal is not None and not (promised is not None and promised <= task.goal):
                limit = "no limit of the tool error" if promised is None else f"up to {promised * 1e6:.2f} µm (95 %)"
                short = f"the fit predicts {limit}, and the goal is {task.goal * 1e6:.2f} µm"
            if short and fit.lead is not None and fit.lead.used is None:
                short += "; the screws' lead is not known (--lead-mm), so their periodic error is not fitted"
            save_with_posterior(fit.model, fit.parameters, self._folder / name)
        write_text(self._folder / f"{name}.report.txt", report or short)
        self._record("fitted", number=number, model=name, promised_m=promised, enough=not short, short=short)

    def _check(self) -> None:
        """Take new readings, and check the candidate by them or, if there is none, the model in use."""
        state = self.state
        model = state.candidate or state.in_use
        promised = state.promised if state.candidate else state.promised_in_use
        number, name = self._next_file("check", ".csv")
        # An interrupted check begins anew, because the machine may have changed
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
            raise CommandError("instrument", f"{problem}; the instrument read nothing at {len(missing)} places")
        verification, fitted = self._verified(model, measured)
        found, kept, rigid = compare(fitted, measured, promised)
        ran, applied, _ = compare(fitted, measured, promised, as_run=True)
        kept = verification.verdict == VALID if np.isnan(promised) else kept
        spoilt = not kept and verification.verdict != VALID and verification.candidates[0].family == READING
        good = kept and not (verification.verdict == NAMED and verification.candidates[0].family in SUDDEN_CHANGES)
        first = next((e for e in self.events if e["event"] == "checked" and e["model"] == model), None)
        before = rigid if first is None else RigidMotion(np.array(first["stands_m"]), first["stands_error_m"])
        write_text(self._folder / f"{name}.report.txt", verification_report(verification))
        self._record(
            "checked",
            stands_m=rigid.motion.tolist(),
            stands_error_m=rigid.error,
            moved_m=rigid.moved(before),
            number=number,
            readings=name,
            model=model,
            good=good,
            spoilt=spoilt,
            found_m=None if np.isnan(promised) else found,
            promised_m=None if np.isnan(promised) else promised,
            ran_m=ran,
            applied=None if np.isnan(promised) else applied,
            missing=list(missing),
            verdict=verification.verdict,
            usual=verification.p_value,
            changes=[
                {"kind": c.family, "name": c.name, "probability": verification.families[c.family], "sizes": c.sizes}
                for c in verification.candidates[: 0 if verification.verdict == VALID else 2]
            ],
            text=change_text(verification),
        )

    def _give_up(self) -> None:
        """Refuse a candidate that two checks contradict, or end the loop after SPOILT_CHECKS checks with an outlier."""
        state = self.state
        if state.spoilt >= SPOILT_CHECKS:
            reason = f"each of {state.spoilt} checks in a row has a single wrong reading: check the instrument"
            self._record("refused", reason=reason)
            return
        last = newest(self.events, "checked")
        why = last["text"]
        if last["verdict"] == VALID:
            found, promised = (last[name] * 1e6 for name in ("found_m", "promised_m"))
            why = f"the tool error is {found:.2f} µm RMS, and the fit predicted at most {promised:.2f} µm (95 %)"
        if state.repairs:
            self._beyond_repair("check readings contradict the repaired model", why)
        else:
            reason = f"two sets of check readings contradict the model, whose fit did not use them: {why}"
            self._record("refused", reason=reason)

    def _readings(self, names: Sequence[str]) -> MeasurementSet:
        """Return the readings of files, except those with an unknown direction of motion (first pose of a run)."""
        measured = read_measurements([self._folder / name for name in names], self._geometry)
        return measured.select(measured.direction != UNKNOWN)

    def _verified(self, model: str, readings: MeasurementSet) -> tuple[Verification, FittedParameters]:
        """Return the verification of the model in the file `model` by readings, and posterior of the model's fit."""
        path = self._folder / model
        machine_model = load_model(path, self._geometry)
        fitted, unknown = load_posterior(machine_model, self._geometry, path)
        if fitted is None:
            raise CalibrationError("model", f"{path} cannot be checked: {unknown}")
        return verify_model(machine_model, fitted, readings), fitted

    def _adopt(self) -> None:
        """Copy the candidate to IN_USE or, if this file exists and the loop may not reload models, to PROPOSED."""
        first = not self._has(IN_USE)
        self._copy(self.state.candidate, IN_USE if first or self._reload is not None else PROPOSED)
        promised = None if np.isnan(self.state.promised) else self.state.promised
        self._record("adopted", model=self.state.candidate, promised_m=promised)

    def _reload_model(self) -> None:
        assert self._reload is not None
        self._say("reloading")
        if self._has(PROPOSED):
            self._copy(self.state.in_use, IN_USE)
            (self._folder / PROPOSED).unlink()
        self._reload(self._folder / IN_USE)
        self._record("reloaded", model=self.state.in_use)

    def _has(self, name: str) -> bool:
        return (self._folder / name).exists()

    def _copy(self, name: str, to: str) -> None:
        """Copy a model and its posterior file."""
        path = self._folder / name
        model = load_model(path, self._geometry)
        save_with_posterior(model, load_posterior(model, self._geometry, path)[0], self._folder / to)

    def _repair(self) -> None:
        """Update the model in use by the two checks that contradict it; if impossible, call `_beyond_repair`."""
        state = self.state
        number, name = self._next_file("model", ".yaml")
        # By both checks or, if this is impossible, by the newer one
        tried = []
        for names in (state.doubts, state.doubts[-1:]):
            verification, fitted = self._verified(state.in_use, self._readings(names))
            reason = refusal(verification)
            if verification.verdict == VALID:
                reason = "both checks show a larger tool error than predicted, but not which change has happened"
            tried.append((change_text(verification), reason))
            if not reason:
                break
        else:
            self._beyond_repair(*tried[0])
            return
        model = load_model(self._folder / state.in_use, self._geometry)
        update = update_model(model, fitted, verification.measurements, verification)
        save_with_posterior(update.model, update.fitted, self._folder / name)
        text = change_text(verification)
        self._record("repaired", number=number, model=name, of=state.in_use, text=text, chi_square=update.chi_square)

    def _beyond_repair(self, text: str, reason: str) -> None:
        """Begin a new calibration or, if the loop may not reload models, propose a campaign."""
        number, name = self._next_file("proposed_campaign", ".yaml")
        if self._reload is None and self._task.goal is not None:
            plan = self._proposal(PLANNED_SHARE)
            write_text(self._folder / name, campaign_text(plan.campaign, remarks(plan)))
            reason += f"; proposed campaign: {self._folder / name}"
        self._record("beyond repair", number=number, text=text, reason=reason)
        if self._reload is not None and self._task.measurable:
            self._begin()

    def _pause(self) -> None:
        end = time.monotonic() + self._task.every
        while (left := end - time.monotonic()) > 0.0:
            self._say(f"next check in {left:.0f} s")
            self._stop_if_asked("stopped between two checks")
            self._wait(min(left, 0.2))


def moved_text(check: Event) -> str:
    """Return a clause that states a rigid motion of base, workpiece or instrument; empty without such a motion."""
    if not check.get("moved_m") or not check["good"]:  # a changed strut causes a rigid motion too
        return ""
    size = f"{check['moved_m'] * 1e6:.1f} µm"
    return f"; all positions have shifted together, by {size}: base, workpiece or instrument has moved"


def applied_text(event: Event) -> str:
    """Return a clause that states the running machine's tool error at a check if it exceeds the model's limit."""
    if event.get("applied") is not False:
        return ""
    size = f"{event['ran_m'] * 1e6:.2f} µm RMS"
    why = "the compensator did not run this model, or struts did not reach their commands"
    return f"; the running machine's tool error was {size}: {why}"
