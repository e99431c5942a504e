"""Lines and the progress bar that a training run shows."""

from __future__ import annotations

import math
import pathlib
import shutil

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn


def say_device(console: Console) -> None:
    """Says which device runs it, and how to use an NVIDIA card that jax does not see."""
    device = jax.devices()[0]
    console.print(f"device: {device.device_kind} ({device.platform}), jax {jax.__version__}")
    if device.platform == "cpu" and _has_nvidia_card():
        console.print(
            "[yellow]warning: there is an NVIDIA card, but this jax runs on the CPU only; "
            "`make setup GPU=cuda13` installs the one that uses it[/yellow]"
        )


def say_memory(console: Console, plan: dict[str, int]) -> None:
    """Says what the run will hold in memory."""
    parts = ", ".join(f"{name} {size / 1e6:.1f} MB" for name, size in plan.items())
    console.print(f"memory: {parts}; {sum(plan.values()) / 1e6:.1f} MB")


def say_working_memory(console: Console, plan: dict[str, int]) -> None:
    """Says what the run will need beside that, once the compiler knows."""
    working, total = plan["working"] / 1e6, sum(plan.values()) / 1e6
    console.print(f"memory: {working:.1f} MB more to work in; {total:.1f} MB in all")


def make_progress(console: Console) -> Progress:
    """A progress bar over environment steps with room for the metrics of the last chunk."""
    return Progress(
        TextColumn("{task.completed:,.0f}"),
        BarColumn(bar_width=8),
        TextColumn("{task.fields[metrics]}"),
        TimeRemainingColumn(),
        console=console,
    )


def describe(rows: list[dict[str, float]]) -> str:
    """One line of a chunk's metrics, means over the seeds."""
    metrics = {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
    parts = [
        f"{metrics['steps_per_s']:,.0f}/s",
        f"success {_percent(metrics['success_rate'])}",
    ]
    # Not every algorithm has these.
    if "q_mean" in metrics:
        parts.append(f"max Q {metrics['q_mean']:.1f}")
    if "loss" in metrics:
        parts.append(f"loss {metrics['loss']:.3f}")
    parts.append(f"ε {metrics['epsilon']:.2f}")
    return " ".join(parts)


def _percent(share: float) -> str:
    return "  – " if math.isnan(share) else f"{100 * share:3.0f}%"


def _has_nvidia_card() -> bool:
    return pathlib.Path("/proc/driver/nvidia/version").exists() or bool(shutil.which("nvidia-smi"))
