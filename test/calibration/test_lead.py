"""The screws' lead, read off readings. Truth: what the virtual machines were drawn with."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import calibration_helpers as small
import numpy as np
import pytest

from hexapod_comp.calibration.estimator import Estimation
from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.calibration.lead import ScrewLead, detect_lead
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.measurements.readings import MeasurementSet

pytestmark = pytest.mark.usefixtures("unsuspected")

MM = 1e-3
# What machine B has, and its waves' harmonics
FEW = replace(small.SETTINGS, lead=None, blocks=("pitch", "wave", "wave 2", "wave 3", "wave 4", "backlash"))

B = small.BOUNDS


@cache
def readings(seed: int, **changes: object) -> MeasurementSet:
    """Return a small campaign's readings of machine B, changed."""
    return small.measured(small.virtual_machine(seed, replace(B, **changes)), small.campaign(), seed)


def lead_of(measured: MeasurementSet, settings: FitSettings = FEW) -> ScrewLead:
    estimation = Estimation(measured, ParameterSpace(measured, settings))
    problem, _ = estimation.linearise(np.zeros(estimation.space.size), np.ones(len(measured)))
    return detect_lead(estimation, problem)


@pytest.mark.parametrize(("seed", "true"), [(1, 2.0), (2, 3.7), (5, 19.3)])
def test_leads_of_all_sizes_are_read_off(seed: int, true: float):
    """Six standard errors, six decades of odds beyond the threshold's; readings stand 2 inches apart."""
    lead = lead_of(readings(seed, wave_period=true * MM))
    assert lead.shown == pytest.approx(true * MM, abs=6.0 * lead.error)
    assert lead.error < 1e-3 * lead.shown
    assert lead.used == pytest.approx(true * MM, rel=1e-3)


def test_round_leads_are_taken_as_such():
    """10 mm, and 0.5 in: leads are made so. 3.7 mm is taken as it is shown, as is what is not known well enough."""
    shown = [ScrewLead(None, value * MM, 2e-6, 100.0).used for value in (10.0031, 12.6985, 3.7)]
    assert shown == [pytest.approx(10.0 * MM), pytest.approx(12.7 * MM), 3.7 * MM]
    assert ScrewLead(None, 10.03 * MM, 20e-6, 100.0).used == 10.03 * MM


@pytest.mark.parametrize("bounds", [{"wave": (1e-9, 2e-9)}, {"wave": (0.0, 0.0), "length_map": 5e-6}])
def test_what_is_not_there_is_not_shown(bounds: dict):
    """With waves far below the noise, and with smooth errors of length that the space does not have."""
    lead = lead_of(readings(6, **bounds))
    assert (lead.shown, lead.used) == (None, None)


def test_a_wave_twice_a_turn_alone_agrees_with_the_lead():
    """A cardan joint turns its screw unevenly twice a turn: 5 mm are shown, and 10 mm given explain it."""
    lead = lead_of(readings(3, wave_period=5.0 * MM), replace(FEW, lead=10.0 * MM))
    assert lead.shown == pytest.approx(5.0 * MM, rel=1e-3)
    assert lead.agrees
    assert lead.used == 10.0 * MM


def test_the_lead_is_the_fundamental_though_a_harmonic_be_larger():
    """Waves of 1 µm once, 3 to 4 µm two to four times a turn."""
    lead = lead_of(readings(7, wave=(1e-6, 1e-6), harmonics=(3e-6, 4e-6)))
    assert lead.shown == pytest.approx(10.0 * MM, rel=1e-3)


def test_a_given_lead_that_disagrees_is_remarked_on():
    fit = fit_model(readings(1), replace(FEW, lead=9.0 * MM))
    assert not fit.lead.agrees
    assert fit.model.struts.period == pytest.approx(9.0 * MM)
    assert any("repeat every 10 mm by the readings, not with the given lead of 9 mm" in note for note in fit.notes)


def test_harmonics_are_fitted_and_only_those_that_are_there():
    """Second and third of 1 to 2 µm: left are some hundredths of a micrometre, the fourth is left out."""
    truth = small.virtual_machine(8, replace(B, harmonics=(1e-6, 2e-6)))
    struts = replace(truth.model.struts, cosine=truth.model.struts.cosine[:, :3], sine=truth.model.struts.sine[:, :3])
    truth = type(truth)(truth.geometry, replace(truth.model, struts=struts))
    fit = fit_model(small.measured(truth, small.campaign(), 8), FEW)
    assert [b.name for b in fit.space.blocks if "wave" in b.name] == ["wave", "wave 2", "wave 3"]
    assert np.abs(fit.model.struts.cosine - struts.cosine).max() < 0.5e-6
    after, _ = small.tool_error(truth, fit.model)
    assert after < 0.5e-6
