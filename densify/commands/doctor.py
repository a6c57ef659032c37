"""The verb doctor: versions, device and a self-test."""

from __future__ import annotations

from dataclasses import asdict

from densify.doctor import examine
from lightdepth.command_line.outcome import end, is_quiet, outcome


def doctor() -> int:
    """Versions, device and a fused-plane self-test; what is missing and how to get it."""
    findings = examine()
    for finding in findings:
        if not (finding.ok and is_quiet()):
            outcome().last(f"{'ok  ' if finding.ok else 'FAIL'}  {finding.what:<24} {finding.detail}")
    well = all(finding.ok for finding in findings)
    end(then="lightdepth demo" if well else "lightdepth doctor", result={"checks": [asdict(f) for f in findings]})
    return 0 if well else 4
