"""What the LinuxCNC bridge counts, and what it says of itself in diagnostics."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..ros.health import ERROR, OK, WARN, Flow, Refusals, seconds
from .guard import CorrectionGuard, GuardStatus

TEXTS = {
    GuardStatus.OFF: (OK, "off"),
    GuardStatus.RAMPING: (OK, "running, corrections are ramping in"),
    GuardStatus.COMPENSATING: (OK, "running"),
    GuardStatus.HOLDING: (ERROR, "compensator lost, corrections hold"),
    GuardStatus.RETURNING: (OK, "off, corrections are ramping out"),
    GuardStatus.WAITING: (WARN, "waiting for the first correction"),
}


@dataclass
class BridgeStatus:
    """Counters of a bridge, and the status made of them."""

    guard: CorrectionGuard  # between the compensator and the controller
    # cycles of the loop, commands and measured struts published, corrections that came
    cycles: Flow = field(default_factory=Flow)
    # cycles of the loop, commands and measured struts published, corrections that came
    sent: Flow = field(default_factory=Flow)
    # cycles of the loop, commands and measured struts published, corrections that came
    states: Flow = field(default_factory=Flow)
    # cycles of the loop, commands and measured struts published, corrections that came
    heard: Flow = field(default_factory=Flow)
    refusals: Refusals = field(default_factory=Refusals)  # corrections and pins that were not used
    bad_pins: Refusals = field(default_factory=Refusals)  # corrections and pins that were not used
    machine_on: bool = False  # the controller's switches
    enabled: bool = False  # the controller's switches
    resets: int = 0  # how often the compensator was asked to start anew
    latency: float = 0.0  # age of the last correction's command when it came, s

    def judged(self, active: bool, now: float) -> tuple[bytes, str]:
        """Return level and message of the diagnostics."""
        status = self.guard.status
        if not active:
            return WARN, "not active"
        if self.bad_pins.recent(now):
            return ERROR, f"unusable pins: {self.bad_pins.last_reason}"
        if self.refusals.recent(now):
            return ERROR, f"refusing corrections: {self.refusals.last_reason}"
        if not self.machine_on:
            return OK, "machine off"
        if self.enabled and self.guard.accepted and status is GuardStatus.WAITING:
            return ERROR, "compensator lost, corrections are zero"
        if self.enabled and status is GuardStatus.RETURNING:
            return ERROR, "compensator lost, corrections are ramping out"
        return TEXTS[status]

    def values(self, compensated_by: str, now: float) -> dict[str, str]:
        """Return everything else as key and value."""
        return {
            "status": self.guard.status.name.lower(),
            "machine_on": str(self.machine_on).lower(),
            "enabled": str(self.enabled).lower(),
            "cycle_rate_hz": f"{self.cycles.rate(now):.1f}",
            "command_rate_hz": f"{self.sent.rate(now):.1f}",
            "correction_rate_hz": f"{self.heard.rate(now):.1f}",
            "correction_age_s": seconds(self.guard.age(now)),
            "latency_s": f"{self.latency:.6f}",
            "largest_correction_m": f"{max(map(abs, self.guard.output)):.9f}",
            "accepted": str(self.guard.accepted),
            "resets": str(self.resets),
            "compensated_by": compensated_by,
            "last_refusal": self.refusals.last_text,
            "last_bad_pins": self.bad_pins.last_text,
            **self.refusals.values(),
        }
