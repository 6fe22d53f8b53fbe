"""A machine and its model as ``hc_model`` holds them, by name: for a struct in memory and for a C header alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.single import rotate
from .late import MOST_TIME_CONSTANTS, PARTS

if TYPE_CHECKING:
    from ..pose import Pose
    from .geometry import HexapodGeometry
    from .model import MachineModel


def members(geometry: HexapodGeometry, model: MachineModel, hashes: tuple[str, str] = ("", "")) -> dict[str, Any]:
    """Return what ``hc_model`` holds."""
    model_texts = {"machine": model.machine, "model": model.name, "date": model.origin.date or ""}
    tool = geometry.tool
    return {
        **model_texts,
        "geometry_sha256": hashes[0],
        "model_sha256": hashes[1],
        "base": _body(geometry, model, 0),
        "platform": _body(geometry, model, 1),
        "home": _pose(geometry.home),
        "work": _pose(geometry.work),
        "tool": _pose(tool),
        "tool_inverse": _pose(tool.inverse()),
        "limits": geometry.limit_numbers.view,
        "struts": model.struts.members(geometry),
        "map": {
            "knot_count": len(model.struts.map_knots),
            "knots": model.struts.map_knots,
            "pieces": model.struts.spline_coefficients(),
        },
        "field": model.field.members(),
        "late": _late(model),
        "axis_threshold": model.field.reversal_threshold,
        "strut_threshold": model.reversal_threshold,
    }


def _body(geometry: HexapodGeometry, model: MachineModel, index: int) -> dict[str, Any]:
    name, axes = ("base", "platform")[index], geometry.kernel_axes[index]
    if name == "base" and model.base_axes_turn.any():
        turn = np.eye(3)
        rotate(turn, *model.base_axes_turn.tolist())
        axes = axes @ turn.T
    return {
        "joints": geometry.kernel_joints[index],
        "deviation": getattr(model, f"{name}_deviation"),
        "axes": axes,
        "expansion": getattr(model, f"{name}_expansion"),
    }


def _pose(pose: Pose) -> dict[str, Any]:
    return {"position": pose.position, "rotation": pose.rotation}


def _late(model: MachineModel) -> dict[str, Any]:
    late = model.late_growth
    count = len(late.time_constants)
    constants, expansion = np.zeros(MOST_TIME_CONSTANTS), np.zeros((len(PARTS), MOST_TIME_CONSTANTS))
    constants[:count], expansion[:, :count] = late.time_constants, late.expansion
    sensors = [late.sensor_of(part) for part in range(len(PARTS))]
    return {"count": count, "time_constants": constants, "expansion": expansion, "sensors": sensors}
