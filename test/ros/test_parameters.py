"""Parameters of the nodes: what may change when, what is said where it may not, and that it takes effect."""

from __future__ import annotations

import runpy
from typing import Any

import numpy as np
import pytest
import yaml
from launch_stand_in import LaunchFile
from node_helpers import CONFIG, HOME, closed_form_lengths, model_file
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters
from std_msgs.msg import UInt64

from hexapod_comp.ros.adapter import AdapterNode
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.instrument import InstrumentNode
from hexapod_comp.ros.mover import MoverNode
from hexapod_comp.ros.parameters import Taken
from hexapod_comp.ros.strut_drive import StrutDriveNode

MAKER = runpy.run_path(str(CONFIG.parent / "tools" / "make_parameter_files.py"))
TABLES = MAKER["TABLES"]
KINDS = {
    "compensator": CompensatorNode,
    "strut_drive": StrutDriveNode,
    "mover": MoverNode,
    "instrument": InstrumentNode,
    "adapter": AdapterNode,
}

COMPENSATOR = "compensator"


def test_what_is_taken_at_configure_is_refused_until_a_cleanup(rig):
    rig.compensator()
    refused = rig.set_parameter(COMPENSATOR, "work_frame", "table")
    assert not refused.successful
    said = "parameter work_frame: is taken at configure, and the node is active; set it after a cleanup"
    assert refused.reason == said
    assert rig.set_parameter(COMPENSATOR, "work_frame", "work").successful, "it is so already"
    assert rig.change("deactivate")
    assert "the node is inactive" in rig.set_parameter(COMPENSATOR, "work_frame", "table").reason
    assert rig.change("cleanup")
    assert rig.set_parameter(COMPENSATOR, "work_frame", "table").successful
    assert rig.change("configure")
    assert rig.change("activate")
    rig.until(rig.matched, "discovery")
    rig.ask(HOME, "table")


def test_frames_are_held_against_each_other_whichever_is_set(rig):
    rig.compensator(start=False)
    for name, value in (("base_frame", "work"), ("work_frame", "base")):
        result = rig.set_parameter(COMPENSATOR, name, value)
        assert not result.successful
        assert "work_frame: must differ from base_frame" in result.reason


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("ramp_rate", 2.0, "Min: 1e-06, Max: 1.0, value: 2.0"),
        ("ramp_rate", 2, "must lie in 1e-06 to 1 m/s, not 2"),
        ("ramp_rate", "fast", "must be float, not 'fast'"),
        ("ramp_rate", None, "must be float, not None"),
        ("autostart", False, "read-only"),
    ],
)
def test_a_value_that_is_not_allowed_is_refused_and_changes_nothing(rig, name, value, reason):
    """None is how ``ros2 param delete`` asks."""
    node = rig.compensator(start=False)
    before = node.get_parameter(name).value
    result = rig.set_parameter(COMPENSATOR, name, value)
    assert not result.successful
    assert reason in result.reason
    assert node.get_parameter(name).value == before


def test_rates_and_timeouts_change_at_once(rig):
    rig.compensator(heartbeat_rate=0.0, command_timeout=0.0)
    beats: list[UInt64] = []
    rig.witness.create_subscription(UInt64, "compensator/heartbeat", beats.append, 10)
    rig.until(rig.matched, "discovery")
    rig.ask(HOME)
    rig.barrier()
    assert not beats
    assert rig.set_parameter(COMPENSATOR, "heartbeat_rate", 200.0).successful
    rig.until(lambda: len(beats) > 5, "heartbeats")
    assert rig.set_parameter(COMPENSATOR, "command_timeout", 0.01).successful
    rig.until(lambda: "no new command" in rig.message(), "the command to be stale")


def test_a_ramp_goes_on_at_the_rate_that_is_set(rig):
    """164 µm at 1 µm/s would take minutes; stamps 20 ms apart may ramp 0.2 µm each at 10 µm/s."""
    rig.compensator(ramp_rate=1e-6, enable_compensation=False)
    rig.feed(closed_form_lengths(HOME))
    rig.settle(HOME)
    rig.enable(True)
    slow = rig.ask(HOME).corrections
    assert rig.set_parameter(COMPENSATOR, "ramp_rate", 1.0).successful
    rig.settle(HOME)
    assert np.abs(slow).max() < 1e-6 < 100e-6 < np.abs(rig.ask(HOME).corrections).max()


def test_another_model_is_taken_by_reload(rig, tmp_path):
    """Within the folder that was fixed at the start: a parameter must not open the rest of the disk."""
    node = rig.compensator(model_file=model_file(tmp_path))
    other = tmp_path / "other.yaml"
    other.write_text((tmp_path / "model.yaml").read_text().replace("written by a test", "the other"))
    assert rig.set_parameter(COMPENSATOR, "model_file", str(other)).successful
    assert node.compensator.model.name == "written by a test"
    assert rig.trigger("reload_model").success
    assert node.compensator.model.name == "the other"
    secret = model_file(tmp_path.parent, "secret.yaml")
    assert rig.set_parameter(COMPENSATOR, "model_file", secret).successful
    answer = rig.trigger("reload_model")
    assert not answer.success
    assert "files are only read from" in answer.message
    assert node.compensator.model.name == "the other"


def test_descriptors_say_range_and_when(rig):
    rig.compensator(start=False)
    rig.drive(start=False)
    rig.add(MoverNode, False, {})
    rig.add(InstrumentNode, False, {})
    rig.add(AdapterNode, False, {})
    for name in KINDS:
        table = TABLES[name]
        request = DescribeParameters.Request(names=[p.name for p in table])
        told = rig.call(DescribeParameters, f"{name}/describe_parameters", request).descriptors
        for parameter, descriptor in zip(table, told, strict=True):
            assert descriptor.description
            assert descriptor.additional_constraints.endswith(f"taken {parameter.taken.value}")
            assert descriptor.read_only == (parameter.taken is Taken.START)
            ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
            number = descriptor.type in (ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER)
            assert len(ranges) == number
            assert all(r.from_value <= parameter.default <= r.to_value for r in ranges)


def test_page_and_file_are_those_of_the_tables():
    """``python tools/make_parameter_files.py`` makes them so."""
    for path, made in ((MAKER["PAGE"], MAKER["page"](MAKER["PAGE"].read_text())), (MAKER["FILE"], MAKER["file"]())):
        assert path.read_text(encoding="utf-8") == made, path


def in_force(node: Any) -> dict[str, Any]:
    """Return a node's parameters as ROS has them."""
    return {p.name: node.get_parameter(p.name).value for p in TABLES[node.get_name()]}


@pytest.mark.parametrize("name", KINDS)
def test_the_shipped_file_gives_the_defaults_in_any_namespace(rig, name):
    rig.namespace = "/left/cell"
    node = rig.add(KINDS[name], False, {}, cli_args=["--ros-args", "--params-file", str(MAKER["FILE"])])
    assert in_force(node) == {p.name: p.default for p in TABLES[name]}
    assert not rig.logged("there is no parameter")


def other_value(parameter: Any) -> Any:
    """Return an allowed value that is not the default."""
    if isinstance(parameter.default, list) and isinstance(parameter.default[0], float):
        return [0.1 * parameter.range[1]] * len(parameter.default)
    if parameter.range:
        low, high = (type(parameter.default)(end) for end in parameter.range)
        return high if parameter.default != high else low
    if parameter.choices:
        return parameter.choices[-1]
    if isinstance(parameter.default, list):
        return parameter.default[::-1]
    return not parameter.default if isinstance(parameter.default, bool) else f"{parameter.default}x"


@pytest.mark.parametrize("name", KINDS)
def test_a_file_of_other_values_is_loaded_also_through_the_launch_file(rig, monkeypatch, tmp_path, name):
    """The launch file gives its own arguments after the file; launch_ros writes them into files, as here."""
    others = {p.name: other_value(p) for p in TABLES[name] if p.name != "model_folder"}
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({f"/**/{name}": {"ros__parameters": others}}))
    node = rig.add(KINDS[name], False, {}, cli_args=["--ros-args", "--params-file", str(path)])
    assert {key: value for key, value in in_force(node).items() if key in others} == others
    arguments = f"params_file:={path}", "model:=table.yaml", "mover:=true", "instrument:=laser", "adapter:=true"
    given = LaunchFile(monkeypatch).start(*arguments)[name]
    arguments, given = ["--ros-args"], given["parameters"]
    for number, part in enumerate(given):
        if isinstance(part, dict):
            (tmp_path / f"{number}.yaml").write_text(yaml.safe_dump({"/**": {"ros__parameters": part}}))
            part = str(tmp_path / f"{number}.yaml")
        arguments += ["--params-file", part]
    values = in_force(rig.add(KINDS[name], False, {}, cli_args=arguments))
    assert values == in_force(node) | {k: v for k, v in given[-1].items() if k in others}
    assert values.get("command_timeout", 3600.0) == 3600.0
    assert values.get("model_file", "table.yaml") == "table.yaml"
