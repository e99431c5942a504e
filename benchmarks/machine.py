"""What a figure was taken on; every file in `benchmarks/results` says it."""

from __future__ import annotations

from mjx_arm.report.machine import machine

__all__ = ["machine"]
