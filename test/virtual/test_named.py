"""Models by name: what a word stands for, and that it stands for the same machine wherever it is used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import general_machine
from strategies import paper_geometry

from hexapod_comp.errors import HexapodError
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.machine.model_file import save_model
from hexapod_comp.virtual.named import find_model, imagine, truth_name, usual_bounds


def same(one: MachineModel, other: MachineModel) -> bool:
    """Return whether two models have the same structure and struts, to the rounding of a unit in a file."""
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("base_deviation", "platform_deviation")]
    pairs += [(value, vars(other.struts)[name]) for name, value in vars(one.struts).items()]
    return all(a.shape == b.shape and np.allclose(a, b, rtol=1e-15, atol=0.0) for a, b in pairs)


def test_words_and_files(tmp_path) -> None:
    geometry = general_machine()
    assert same(find_model("ideal", geometry), MachineModel(geometry.name))
    assert same(find_model("random:7", geometry), imagine(geometry, 7))
    assert same(find_model("random", geometry), find_model("random:1", geometry))
    assert not same(find_model("random", geometry), find_model("random:2", geometry))
    file = tmp_path / "truth.yaml"
    save_model(imagine(geometry, 7), file)
    assert same(find_model(file, geometry), find_model("random:7", geometry))


def test_a_truth_without_a_name_is_the_shipped_one_or_drawn() -> None:
    assert truth_name(None, paper_geometry()) == "paper_machine.yaml"
    assert truth_name(None, general_machine()) == "random"
    assert truth_name("ideal", paper_geometry()) == "ideal"


@pytest.mark.parametrize("name", ["random:", "random:x", "random:-1", "random:1.5", "random:１", "random:1:2"])
def test_seeds_that_are_none_are_refused(name: str) -> None:
    with pytest.raises(HexapodError, match="random:SEED with a whole number"):
        find_model(name, general_machine())


def test_a_model_of_another_machine_is_refused_by_either_way(tmp_path) -> None:
    file = tmp_path / "truth.yaml"
    save_model(imagine(general_machine(), 1), file)
    with pytest.raises(HexapodError, match="machine"):
        find_model(file, paper_geometry())


def test_one_bound_leaves_the_other_errors_alone() -> None:
    """A seed names one machine: a part of it may be made larger, and errors be added, without another draw."""
    geometry = general_machine()
    plain, wider = (imagine(geometry, 3, usual_bounds(geometry, **given)) for given in ({}, {"joint": 1e-4}))
    np.testing.assert_allclose(wider.base_deviation, 2.0 * plain.base_deviation, rtol=1e-15)
    assert same(plain, replace(wider, base_deviation=plain.base_deviation, platform_deviation=plain.platform_deviation))
    warm = imagine(geometry, 3, usual_bounds(geometry, strut_expansion=(1e-5, 2e-5), body_expansion=(3e-6, 4e-6)))
    assert ((warm.struts.expansion >= 1e-5) & (warm.struts.expansion <= 2e-5)).all()
    assert len(set(warm.struts.expansion)) == 6
    assert 3e-6 <= warm.base_expansion <= 4e-6
    assert warm.base_expansion != warm.platform_expansion
    assert same(plain, replace(warm, struts=replace(warm.struts, expansion=np.zeros(6))))


def test_a_smooth_length_error_has_the_size_and_waves_of_the_stroke() -> None:
    """RMS as asked on each strut; waves of 60 to 200 mm change sign several times along 550 mm."""
    geometry = paper_geometry()
    model = imagine(geometry, 5, usual_bounds(geometry, length_map=2e-6))
    knots, values = model.struts.map_knots, model.struts.map_values
    assert [knots[0], knots[-1]] == pytest.approx([0.33, 0.88])
    np.testing.assert_allclose(np.sqrt((values**2).mean(axis=1)), 2e-6, rtol=1e-12)
    crossings = (np.diff(np.sign(values), axis=1) != 0).sum(axis=1)
    assert (crossings >= 4).all()
    assert (crossings <= 22).all()


def test_waves_have_the_lead_that_the_geometry_gives() -> None:
    geometry = paper_geometry()
    axes = np.tile([1.0, 0.0, 0.0], (6, 1))
    screwed = replace(geometry, base_axes=axes, platform_axes=axes, screw_lead=np.full(6, -0.002))
    assert imagine(geometry, 1).struts.period.tolist() == [0.01] * 6
    assert imagine(screwed, 1).struts.period.tolist() == [0.002] * 6
