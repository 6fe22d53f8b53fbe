"""The realtime component without LinuxCNC: its pins become members of a struct, and a C compiler its servo thread.

Truth: the compensator in Python, told the same gravity and wrench. What halcompile makes of it, test/linuxcnc has.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hexapod_comp.cli import main
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.machine.load import Load, Loading
from hexapod_comp.machine.model import MachineModel, ModelOrigin, RealMachine
from hexapod_comp.machine.model_file import save_model

TYPES = {"float": "double", "bit": "int", "s32": "int", "u32": "unsigned"}
TILTED, PUSHED = [3.0, 0.0, -9.3], [100.0, -50.0, 20.0, 1.0, 2.0, 3.0]

# Two seconds at 1 kHz each: as the model has it; with gravity and wrench; with no numbers; with zeros again
DRIVER = """
#include <stdio.h>
static state one;
static void run(void)
{
    for (int n = 0; n < 2000; n++) {
        correct(&one, 1000000);
    }
    for (int i = 0; i < 6; i++) {
        printf("%.12f ", one.correction_[i]);
    }
    puts(one.ok_ ? "" : "nan");
}
int main(void)
{
    const double lengths[6] = {LENGTHS}, down[3] = {DOWN}, pushing[6] = {PUSHING};
    one.unit_ = 1e-3, one.gravity_step_ = 0.01, one.wrench_step_ = 1.0, one.temperature_step_ = 0.01;
    one.enable_ = one.machine_on_ = 1;
    for (int i = 0; i < 8; i++) {
        one.temperature_[i] = 20.0;
    }
    for (int i = 0; i < 6; i++) {
        one.joint_pos_cmd_[i] = lengths[i];
    }
    run();
    for (int i = 0; i < 6; i++) {
        one.gravity_[i % 3] = down[i % 3], one.wrench_[i] = pushing[i];
    }
    run();
    one.gravity_[1] = one.wrench_[5] = NAN;
    run();
    for (int i = 0; i < 6; i++) {
        one.gravity_[i % 3] = one.wrench_[i] = 0.0;
    }
    run();
    return 0;
}
"""


def as_c(component: str) -> str:
    """Return a component in plain C: pins, parameters and variables as members of `inst`."""
    head, body = component.split("\n;;\n", 1)
    members, names = [], []
    for kind, name, count in re.findall(r"^(?:pin|param) \w+ (\w+) ([\w-]+?)(?:-#\[(\d+)\])?[ ;]", head, re.MULTILINE):
        own = name.replace("-", "_")
        members.append(f"{TYPES[kind]} {own}_{f'[{count}]' if count else ''};")
        names.append(f"#define {own}{'(i)' if count else ''} inst->{own}_{'[i]' if count else ''}")
    for kind, name, size in re.findall(r"^variable (\w+) (\w+)((?:\[\d+\])?);", head, re.MULTILINE):
        members.append(f"{kind} {name}_{size};")
        names.append(f"#define {name} inst->{name}_")
    function = "#define FUNCTION(name) void name(state *inst, long period)"
    undone = "\n".join(f"#undef {re.split(r'[ (]', name)[1]}" for name in names)
    struct = "typedef struct {\n" + "\n".join(members) + "\n} state;"
    return "\n".join(
        ['#include "hexapod_comp.c"', '#include "hexapod_model.h"', struct, function, *names, body, undone, DRIVER]
    )


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_gravity_and_wrench_are_pins(tmp_path: Path) -> None:
    """Corrections, mm, to 1e-9: those of the machine under each load; what is no number leaves them as they were."""
    geometry = load_geometry("paper")
    origin = ModelOrigin("2026-01-31")
    model = MachineModel("paper", name="soft", origin=origin, load=Load(stiffness=np.full(6, 20e6), mass=30.0))
    save_model(model, tmp_path / "soft.yaml")
    assert main(["export", "--model", str(tmp_path / "soft.yaml"), "--c", str(tmp_path / "c")]) == 0
    lengths = strut_lengths(geometry, geometry.home)
    texts = {"LENGTHS": lengths * 1e3, "DOWN": TILTED, "PUSHING": PUSHED}
    source = as_c((tmp_path / "c" / "hexapod_rt.comp").read_text())
    for name, values in texts.items():
        source = source.replace(f"{{{name}}}", "{" + ", ".join(repr(float(value)) for value in values) + "}")
    (tmp_path / "c" / "rt.c").write_text(source)
    words = ["cc", "-O1", "-ffp-contract=off", "rt.c", "-lm", "-o", "rt"]
    made = subprocess.run(words, cwd=tmp_path / "c", capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    out = subprocess.run([tmp_path / "c" / "rt"], capture_output=True, text=True, check=True).stdout
    found = np.array([line.split() for line in out.splitlines()], dtype=float)
    alone, loaded = (
        (RealMachine(geometry, model, loading=loading).commands_for(geometry.home)[0] - lengths) * 1e3
        for loading in (Loading(), Loading.of(TILTED, PUSHED))
    )
    assert np.abs(loaded - alone).max() > 1e-3
    np.testing.assert_allclose(found, [alone, loaded, loaded, alone], rtol=0.0, atol=1e-9)
