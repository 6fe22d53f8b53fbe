"""``hexapod_comp fit --update``: a model renewed from few readings."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from . import common
from .verify import checked

NOT_FITTED = {
    "scheme": "joint", "lead_mm": None, "blocks": None, "tolerance_um": None, "field_degree": None,
    "expansion_ppm": None, "moisture_ppm": None, "order": None, "every_line": False, "separate_joints": False,
    "not_robust": False, "pictures": None, "truth": None, "datum": None, "certificate": None,
    "details": None,
}  # fmt: skip
"""Options that say something of a whole fit, and what they are when nobody gives them."""


def renew(args: argparse.Namespace) -> int:
    """Write a renewed model; 1 when the readings cannot renew it."""
    from ..calibration.check import refusal, update_model
    from ..calibration.check_report import update_report, verification_json, verification_report
    from ..calibration.posterior_file import SUFFIX, save_with_posterior
    from ..errors import CommandError
    from ..formats.outputs import write_text
    from ..formats.paths import input_file

    for name, unused in NOT_FITTED.items():
        if getattr(args, name) != unused:
            raise CommandError("usage", f"--{name.replace('_', '-')} has no meaning with --update")
    old, new = input_file(args.update), Path(args.out)
    if new.resolve().with_name(new.stem + SUFFIX) == old.resolve().with_name(old.stem + SUFFIX):
        raise CommandError("--out", f"{new} would replace what the fit of {old} knows; write to another name")
    known = checked(args, args.update)
    text, content = verification_report(known.verification), verification_json(known.verification)
    reason = refusal(known.verification)
    if reason and not args.force:
        common.show({**content, "refused": reason, "written": None} if args.json else text)
        print(f"hexapod_comp: error: nothing was written: {reason} (--force renews all the same)", file=sys.stderr)
        return 1
    update = update_model(known.model, known.fitted, known.measured, known.verification)
    model, origin = update.model, update.model.origin
    if reason:
        model = replace(model, origin=replace(origin, note=f"FORCED: {reason}. {origin.note}"))
    if args.name is not None:
        model = replace(model, name=args.name)
    beside = save_with_posterior(model, update.fitted, args.out)
    text = f"{text}\n{update_report(update, args.out)}"
    text += "".join(f"its parameters' covariance, to be kept beside it: {path}\n" for path in beside)
    files = {"written": args.out, "written_beside": beside}
    common.show({**content, "chi_square_after": update.chi_square, **files} if args.json else text)
    if args.report is not None:
        write_text(args.report, text)
    return 0
