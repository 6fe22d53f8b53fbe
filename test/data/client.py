"""A user's program, with public names alone: one test runs it, another checks its types."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import hexapod_comp as hc


def calibrate(machine: str, measured: list[Path], out: Path) -> str:
    """Fit a model to measured files, save it and return the report."""
    geometry = hc.load_geometry(machine)
    found = hc.fit_model(hc.read_measurements(measured, geometry), hc.FitSettings(lead=0.010))
    hc.save_model(found.model, out)
    return found.misfit or hc.fit_report(found)


def error_left(machine: str, model_file: Path | str, poses: list[hc.Pose]) -> float:
    """Return by how much, m, the model's own machine misses some poses when sent compensated commands."""
    geometry = hc.load_geometry(machine)
    model = hc.load_model(model_file, geometry)
    examined: hc.CheckResult = hc.check(geometry, model, poses)
    if not examined.ok:
        raise SystemExit(f"{examined.breaches[0].error}")
    real, largest = hc.RealMachine(geometry, model, hc.Temperatures()), 0.0
    for pose in poses:
        answer: hc.Correction = hc.Compensator(geometry, model).correct(pose)
        actual, _ = real.pose_for(answer.command, answer.sense)
        nominal = hc.solve_pose(geometry, hc.strut_lengths(geometry, answer.platform_pose))
        largest = max(largest, float(np.linalg.norm(actual.position - nominal.position)))
    return largest


def worst_error(machine: str, budget: str) -> str:
    """Return the error of a budget that moves the tool most."""
    study: hc.Study = hc.classify(hc.load_geometry(machine), hc.load_budget(budget))
    return study.rows[0].title


def same_again(bag: Path) -> bool:
    """Return whether the replay of a recorded run gives the same bits."""
    recording: hc.Recording = hc.read_recording(bag)
    return hc.replay_recording(recording).identical
