"""Every shipped machine, in the campaigns that it reaches, through ``simulate`` and ``fit`` with each scheme.

A scheme writes a model that removes most of what the virtual machine does, or refuses in words that say what to change.
Truth is the virtual machine itself: ``fit --truth`` sends it to places where nothing was read.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers import long_test

from hexapod_comp import cli

REACHED: list = [("paper", "campaign", "lines")]
REACHED += [pytest.param("paper", name, "lines", marks=long_test) for name in ("campaign_5d", "campaign_full")]
REACHED += [("paper", "campaign_1d", "lines joint")]
REACHED += [(name, "campaign", "lines joint") for name in ("example_6_6", "jugglebot", "positioning_unit")]

# By a work frame at 15° to the base; and by lines of 164 mm that are read every 41 mm
REFUSED = {
    ("example_6_6", "lines"): ("turned against those of base by 15°", "scheme joint does not"),
    ("jugglebot", "lines"): ("has 5 points in a direction", "one every 32.8 mm or closer (step_mm of a campaign)"),
}

# Scheme lines leaves what lines do not show, such as squareness; a joint fit of two blocks the screws' waves
LEAST_REMOVED = {"lines": 0.25, "joint": 0.5}


@pytest.mark.usefixtures("unsuspected")
@pytest.mark.parametrize(("machine", "campaign", "schemes"), REACHED)
def test_each_scheme_models_a_shipped_machine_or_says_why_not(
    machine: str, campaign: str, schemes: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    readings, model = str(tmp_path / "readings.csv"), str(tmp_path / "model.yaml")
    truth = "paper_machine" if machine == "paper" else "random:1"
    told = ["--machine", machine, "--campaign", campaign, "--truth", truth, "--seed", "1", "--out", readings]
    assert cli.main(["simulate", *told]) == 0
    for scheme in schemes.split():
        options = ["--blocks", "pitch,backlash"] if scheme == "joint" else []
        capsys.readouterr()
        told = ["--machine", machine, "--scheme", scheme, *options, "--truth", truth, "--out", model, "--force"]
        code = cli.main(["fit", readings, *told, "--json"])
        out, err = capsys.readouterr()
        if (machine, scheme) in REFUSED:
            assert code == 2
            assert all(words in err for words in REFUSED[machine, scheme]), err
            continue
        assert code == 0, err
        worth = json.loads(out)["worth"]
        before, after = (worth[key]["aligned_rms_m"] for key in ("error_without", "error_with"))
        assert after < (1.0 - LEAST_REMOVED[scheme]) * before
