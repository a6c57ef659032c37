"""The verb doctor: versions, device and a self-test."""

from __future__ import annotations

from densify.doctor import examine


def doctor() -> int:
    """Versions, device and a fused-plane self-test; what is missing and how to get it."""
    findings = examine()
    for finding in findings:
        print(f"{'ok  ' if finding.ok else 'FAIL'}  {finding.what:<24} {finding.detail}")
    return 0 if all(f.ok for f in findings) else 4
