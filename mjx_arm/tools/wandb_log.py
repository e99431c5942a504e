"""A run in Weights & Biases, beside its files: `mjx-arm train --wandb`."""

from __future__ import annotations

import importlib
import json
import math
import os
import pathlib
from types import TracebackType
from typing import Any, Self

from mjx_arm.config import dump_config
from mjx_arm.report.run_page import read_evaluation
from mjx_arm.training.run_folder import load_run, seed_configs, seed_folders

_PROJECT = "mjx-arm"
_PICTURES = ("figure3.png", "learning.png")
_VIDEO = "policy.mp4"


class WandbLog:
    """Logs each chunk of a run to Weights & Biases; pass it to `train` as `on_chunk`.

    Each seed is a run there, of one group. A run that is resumed continues there. The environment
    variables of wandb hold: `WANDB_MODE=offline` keeps all in the run folder, `WANDB_PROJECT`
    names the project.

    Args:
      folder: the run folder, which may be empty until the first chunk.

    Raises:
      ValueError: the extra `wandb` is missing.
    """

    def __init__(self, folder: pathlib.Path):
        self._folder = folder
        self._wandb = import_wandb()
        self._runs: list[Any] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for run, folder in zip(self._runs, self._folders(), strict=True) if self._runs else ():
            if error is None:
                self._add_results(run, folder)
            run.finish(exit_code=0 if error is None else 1)

    def __call__(self, rows: list[dict[str, float]], state: Any) -> None:
        """Logs the metrics of a chunk, one row for each seed; NaN is left out."""
        del state
        if not self._runs:
            self._runs = self._start()
        for run, row in zip(self._runs, rows, strict=True):
            run.log({name: x for name, x in row.items() if math.isfinite(x)})

    def _folders(self) -> list[pathlib.Path]:
        return seed_folders(self._folder, load_run(self._folder).config)

    def _start(self) -> list[Any]:
        saved = load_run(self._folder)
        name = self._folder.resolve().name
        runs = []
        for config, folder in zip(seed_configs(saved.config), self._folders(), strict=True):
            several = saved.config.num_seeds > 1
            run = self._wandb.init(
                project=os.environ.get("WANDB_PROJECT", _PROJECT),
                dir=str(folder),
                id=f"{saved.run_id}-{config.seed}",
                name=f"{name}/seed-{config.seed}" if several else name,
                group=name if several else None,
                config=dump_config(config),
                resume="allow",
                reinit="create_new",
                settings=self._wandb.Settings(silent=True, console="off", save_code=False),
            )
            # Not wandb's own counter: after a resume some steps come again.
            run.define_metric("env_steps")
            run.define_metric("*", step_metric="env_steps")
            runs.append(run)
        return runs

    def _add_results(self, run: Any, folder: pathlib.Path) -> None:
        evaluation = read_evaluation(folder)
        if evaluation is not None:
            run.summary.update({"evaluation": json.loads(json.dumps(evaluation))})
        media: dict[str, Any] = {}
        for name in _PICTURES:
            if (folder / name).is_file():
                media[pathlib.Path(name).stem] = self._wandb.Image(str(folder / name))
        if (folder / _VIDEO).is_file():
            media["policy"] = self._wandb.Video(str(folder / _VIDEO), format="mp4")
        if media:
            run.log(media)


def import_wandb() -> Any:
    """The module `wandb`.

    Raises:
      ValueError: the extra `wandb` is missing.
    """
    try:
        return importlib.import_module("wandb")
    except ImportError:
        raise ValueError("--wandb needs the extra 'wandb': pip install 'mjx-arm[wandb]'") from None
