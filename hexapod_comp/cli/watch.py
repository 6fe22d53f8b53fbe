"""``hexapod_comp watch``: a local page that shows a running machine."""

from __future__ import annotations

import argparse
import sys

from ..machine.geometry import load_geometry


def run(args: argparse.Namespace) -> int:
    """Run the verb until Ctrl-C."""
    from ..ros import heard_signals
    from ..viewer.page import WatchPage, watch

    geometry = load_geometry(args.machine)
    page = WatchPage(geometry, args.host, args.port)
    heard = heard_signals()
    print(f"hexapod_comp: {geometry.name} is shown on {page.address} until Ctrl-C", file=sys.stderr)
    try:
        watch(geometry, page.show, lambda: not heard, args.namespace)
    finally:
        page.close()
    return 0
