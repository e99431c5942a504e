"""Bars of named numbers, as HTML."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence

_ACCENT, _PLAIN, _NEGATIVE = "#0072b2", "rgba(128,128,128,.55)", "#d55e00"


def q_bars(names: Sequence[str], values: Sequence[float], chosen: int | None) -> str:
    """Q-values of all actions, from the least to the largest; the chosen one stands out.

    Args:
      names: of the actions.
      values: their Q-values.
      chosen: the action that would be taken, or None.
    """
    low, high = min(values), max(values)
    span = (high - low) or 1.0
    rows = [
        _row(name, value, 0.04 + 0.96 * (value - low) / span, _ACCENT if i == chosen else _PLAIN)
        for i, (name, value) in enumerate(zip(names, values, strict=True))
    ]
    return _table("Q-values", rows)


def reward_bars(terms: Mapping[str, float], scale: float) -> str:
    """The terms of a reward and their sum.

    Args:
      terms: of the last step.
      scale: value of a whole bar; larger ones are cut off.
    """
    named = {**terms, "sum": math.fsum(terms.values())}
    rows = [
        _row(name, value, min(1.0, abs(value) / scale), _NEGATIVE if value < 0 else _ACCENT)
        for name, value in named.items()
    ]
    return _table("Reward of the last step", rows)


def facts(title: str, values: Mapping[str, float | bool]) -> str:
    """Named values without bars; bools as yes and no."""
    cells = []
    for name, value in values.items():
        shown = ("yes" if value else "no") if isinstance(value, bool) else f"{value:.3f}"
        cells.append(f"<span style='white-space:nowrap'>{_text(name)}: <b>{shown}</b></span> ")
    return f"<div style='{_FONT}' aria-label='{_text(title)}'>{' · '.join(cells)}</div>"


_FONT = "font:12px/1.35 system-ui,sans-serif;font-variant-numeric:tabular-nums;padding:2px 10px"


def _table(title: str, rows: Sequence[str]) -> str:
    body = "".join(rows)
    return (
        f"<div style='{_FONT}' aria-label='{_text(title)}'><b>{_text(title)}</b>"
        f"<table style='width:100%;border-collapse:collapse'>{body}</table></div>"
    )


def _row(name: str, value: float, share: float, colour: str) -> str:
    share = share if math.isfinite(share) else 0.0
    bar = f"<div style='height:9px;width:{100 * share:.1f}%;background:{colour}'></div>"
    return (
        f"<tr><td style='white-space:nowrap;padding-right:6px'>{_text(name)}</td>"
        f"<td style='width:60%'>{bar}</td>"
        f"<td style='text-align:right;padding-left:6px'>{value:.3f}</td></tr>"
    )


def _text(value: str) -> str:
    return html.escape(value.replace("_", " "), quote=True)
