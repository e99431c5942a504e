"""The commands that train: `train` and `sweep`."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Annotated

import tyro
from rich.console import Console

from mjx_arm.config import TrainConfig
from mjx_arm.devices import check_device
from mjx_arm.options import flat_names, get_option
from mjx_arm.report.progress import make_console
from mjx_arm.tools.search_space import parse_space
from mjx_arm.tools.sweep import describe_sweep, sweep
from mjx_arm.tools.wandb_log import WandbLog, import_wandb
from mjx_arm.training.processes import alone, is_writer
from mjx_arm.training.run_folder import load_config, new_run_folder
from mjx_arm.training.runner import resume, train

# Options that say which process of a run this is.
PROCESSES = ("coordinator", "num_processes", "process_id")
# Options that may change when a run is resumed.
_CHANGEABLE = frozenset(
    {"resume", "total_steps", "eval_episodes", "video", "stop_at", "wandb", "devices", *PROCESSES}
)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an arm from pixels to grasp a cube and lift it.

    Attributes:
      preset: starting point of all other options. `fast`: the default on a CPU; a teacher that
        sees the simulator's state learns, and an agent that sees pixels alone learns from it.
        `pixels`: no network ever sees the state. `state`: the agent sees the state, no image.
        `smoke`: everything once, within 3 minutes. `paper`: the values of James & Johns 2016.
        `gpu`: the default on an accelerator, `fast` with thousands of environments.
      config: a JSON file with options to start from instead of a preset, such as the `config.json`
        of a run.
      options: options of the run.
      out: folder for everything the run leaves; by default `runs/` and the time.
      resume: folder of a run to continue; only `--total-steps`, `--eval-episodes`, `--no-video`,
        `--stop-at`, `--wandb` and the number of devices and processes may then be given.
      init_from: an agent or a run folder whose network the run starts from.
      stop_at: end the run when an evaluation that selects has reached this success rate.
      eval_episodes: episodes of the evaluation at the end, by the best agent, at epsilon 0.1 and on
        starts and random numbers that neither training nor the selection has seen.
      video: record an episode of the best agent at the end.
      wandb: also log the run to Weights & Biases; `WANDB_MODE=offline` keeps it in the run folder.
      devices: number of local devices that share the work; by default as many as divide it.
      coordinator: `HOST:PORT` of process 0, where several processes train one run; each gets the
        same command with its own number. Under Slurm, Open MPI and Kubernetes leave all three out.
      num_processes: number of processes of the run.
      process_id: number of this process, from 0.
    """

    options: Annotated[TrainConfig, tyro.conf.arg(name="")]
    preset: str = "fast"
    config: pathlib.Path | None = None
    out: pathlib.Path | None = None
    resume: pathlib.Path | None = None
    init_from: pathlib.Path | None = None
    stop_at: float | None = None
    eval_episodes: int = 200
    video: bool = True
    wandb: bool = False
    devices: int | None = None
    coordinator: str | None = None
    num_processes: int | None = None
    process_id: int | None = None

    def run(self, given: frozenset[str]) -> None:
        """Runs the command; `given` are the names of the options on the command line."""
        console = make_console()
        check_device()
        if self.resume is not None:
            self._resume(self.resume, given, console)
            return
        with self._folder() as out, self._log(out) as on_chunk:
            train(
                self.options,
                out,
                preset=self.preset if self.config is None else None,
                eval_episodes=self.eval_episodes,
                video=self.video,
                stop_at=self.stop_at,
                init_from=self.init_from,
                on_chunk=on_chunk,
                devices=self.devices,
                console=console,
            )

    @contextlib.contextmanager
    def _folder(self) -> Iterator[pathlib.Path | None]:
        """The run folder: as given, or for Weights & Biases, which must know it, a new one."""
        if self.out is not None or not self.wandb:
            yield self.out
            return
        if not alone():
            raise ValueError("--wandb with several processes needs --out FOLDER")
        import_wandb()
        folder = new_run_folder(self.options.env.env)
        try:
            yield folder
        finally:
            # A run that is rejected leaves nothing behind; one that has started is not empty.
            with contextlib.suppress(OSError):
                folder.rmdir()

    def _log(
        self, folder: pathlib.Path | None
    ) -> contextlib.AbstractContextManager[WandbLog | None]:
        if not self.wandb or folder is None or not is_writer():
            return contextlib.nullcontext()
        return WandbLog(folder)

    def _resume(self, folder: pathlib.Path, given: frozenset[str], console: Console) -> None:
        saved = load_config(folder)
        names = flat_names(saved)
        for name in sorted(given - _CHANGEABLE):
            value = get_option(self.options, name) if name in names else self
            if name == "physics" and value == "auto":
                continue
            if name not in names or value != get_option(saved, name):
                option = name.replace("_", "-")
                raise ValueError(f"--{option} cannot change when a run is resumed; leave it out")
        with self._log(folder) as on_chunk:
            resume(
                folder,
                total_steps=self.options.total_steps if "total_steps" in given else None,
                eval_episodes=self.eval_episodes,
                video=self.video,
                stop_at=self.stop_at,
                on_chunk=on_chunk,
                devices=self.devices,
                console=console,
            )


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Search for options of a training by many short runs; hopeless ones are ended early.

    Every trial is a run folder. A sweep that was stopped continues with the same `--out`.

    Attributes:
      options: of all trials.
      search: options to vary: `learning-rate=1e-4..1e-2:log`, `n-step=1..5`, `hidden=128,256`.
      preset: starting point of all other options; see `train`.
      config: a JSON file with options to start from instead of a preset.
      out: folder of the sweep.
      trials: number of trials.
      minutes: start no trial after this time.
      eval_episodes: episodes of the evaluation at the end of a trial.
    """

    options: Annotated[TrainConfig, tyro.conf.arg(name="")]
    search: tuple[str, ...] = ()
    preset: str = "fast"
    config: pathlib.Path | None = None
    out: pathlib.Path = pathlib.Path("runs/sweep")
    trials: int = 20
    minutes: float | None = None
    eval_episodes: int = 100

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        space = parse_space(self.search, self.options)
        console = make_console()
        found = sweep(
            self.options,
            space,
            self.out,
            trials=self.trials,
            minutes=self.minutes,
            eval_episodes=self.eval_episodes,
            console=console,
        )
        print(describe_sweep(found, space))
        print(self.out / "sweep.html")
