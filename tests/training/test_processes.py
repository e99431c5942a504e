"""Several processes that train one run, on this machine."""

from __future__ import annotations

import json
import math
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time
import types
from collections.abc import Iterator, Sequence

import jax
import numpy as np
import pytest

from mjx_arm.cli import main
from mjx_arm.report.metrics import read_metrics
from mjx_arm.training import processes
from mjx_arm.training.checkpoint import RunCheckpoints
from mjx_arm.training.loop import make_trainer, run_keys
from mjx_arm.training.processes import detects_processes, is_loss, join_processes
from mjx_arm.training.run_folder import load_config

LAB = pathlib.Path(__file__).with_name("processes_lab.py")
ROOT = LAB.parents[2]
OPTIONS = [
    *("--preset", "pixels", "--observation", "state", "--physics", "native", "--num-envs", "8"),
    *("--replay-size", "800", "--batch-size", "8", "--learning-starts", "40", "--hidden", "16"),
    *("--chunk-steps", "160", "--max-steps", "15", "--size", "16", "16", "--eval-episodes", "4"),
    *("--select-every", "3200", "--select-episodes", "4", "--no-video"),
]
# A run of 40 chunks, with a checkpoint after every tenth.
TOTAL = ["--total-steps", "6400"]
# A run that no test waits for.
LONG = ["--total-steps", "100000000"]
# The default preset, from pixels. The student learns from the second chunk on.
DISTILL = [
    *("--preset", "fast", "--env", "B", "--physics", "native", "--num-envs", "8"),
    *("--replay-size", "800", "--learning-starts", "40", "--hidden", "16"),
    *("--chunk-steps", "160", "--max-steps", "15", "--size", "16", "16"),
    *("--widths", "4", "4", "4", "--teacher-hidden", "16", "--teacher-batch-size", "16"),
    *("--student-batch-size", "8", "--student-starts", "160", "--select-every", "0"),
    "--no-video",
]
# Most of the time of a process here is compiling.
OWN = {"PYTHONPATH": str(ROOT), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
_started: list[subprocess.Popen] = []


@pytest.fixture(autouse=True)
def no_process_outlives_its_test() -> Iterator[None]:
    yield
    for process in _started:
        process.kill()
        process.communicate()
    _started.clear()


def spawn(command: Sequence[str], devices: int, **environment: str) -> subprocess.Popen:
    """Starts one process of a program."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    process = subprocess.Popen(
        [sys.executable, *command],
        env=os.environ | OWN | {"XLA_FLAGS": flags} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    _started.append(process)
    return process


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def start(*command: str, number: int = 2, devices: int = 2) -> list[subprocess.Popen]:
    """Starts the processes of one program, which takes its place among them as options."""
    place = [f"localhost:{free_port()}", str(number)]
    if command[0] == "-m":
        place = ["--coordinator", place[0], "--num-processes", place[1], "--process-id"]
    return [spawn([*command, *place, str(i)], devices) for i in range(number)]


def finish(started: list[subprocess.Popen], timeout: float = 900) -> list[tuple[int, str, str]]:
    """Exit status, output and errors of each process."""
    deadline = time.monotonic() + timeout
    ended = [x.communicate(timeout=max(1.0, deadline - time.monotonic())) for x in started]
    return [(x.returncode, *texts) for x, texts in zip(started, ended, strict=True)]


def train(*arguments: str) -> list[subprocess.Popen]:
    return start("-m", "mjx_arm", "train", *arguments)


def wait_for_checkpoint(
    folder: pathlib.Path, started: list[subprocess.Popen], after: int = 0
) -> None:
    """Waits for a checkpoint of a later vector step."""
    deadline = time.monotonic() + 600
    while max(RunCheckpoints(folder).steps(), default=0) <= after:
        assert time.monotonic() < deadline
        ended = [process.communicate() for process in started if process.poll() is not None]
        assert not ended, ended
        time.sleep(0.1)


def final_state(folder: pathlib.Path) -> list[np.ndarray]:
    """The newest checkpoint, read on one device."""
    like = jax.eval_shape(make_trainer(load_config(folder)).init, run_keys(load_config(folder)))
    checkpoints = RunCheckpoints(folder)
    state = checkpoints.load(checkpoints.find_newest(like), like)
    return [
        np.asarray(
            jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        )
        for x in jax.tree.leaves(state)
    ]


def same(one: pathlib.Path, other: pathlib.Path) -> bool:
    return all(
        np.array_equal(a, b) for a, b in zip(final_state(one), final_state(other), strict=True)
    )


def assert_agreed(started: list[subprocess.Popen]) -> None:
    """Asserts what the lab's processes have agreed on."""
    ended = finish(started, timeout=300)
    assert [status for status, *_ in ended] == [0, 0], ended
    # Before it gloo reports its connections.
    first, second = (json.loads(output.splitlines()[-1]) for _, output, _ in ended)
    assert (first.pop("writer"), second.pop("writer")) == (True, False)
    assert first == second
    assert first == {
        "alone": False,
        "said": "process 0 wrote",
        "one": True,
        "none": False,
        "failed": "only process 0 can say this",
        "length": 70_000,
        "other": "process 1 was given another steps than process 0: start every process with the "
        "same options",
        "here": 2,
        "devices": 4,
        "key": [0, 3],
    }


def test_processes_agree():
    assert_agreed(start(str(LAB)))


@pytest.mark.slow
def test_processes_that_open_mpi_starts_find_one_another():
    """With its variables alone, on loopback."""
    # jax takes the port from the number of the job.
    first = 2**16 - 2**12
    port = next(port for port in range(first, 2**16) if is_free(port))
    uri = f"{(port - first) * 2**12}.0;tcp://127.0.0.1:1"
    common = {"OMPI_MCA_orte_hnp_uri": uri, "OMPI_COMM_WORLD_SIZE": "2"}
    started = []
    for process in ("0", "1"):
        own = {"OMPI_COMM_WORLD_RANK": process, "OMPI_COMM_WORLD_LOCAL_RANK": process}
        started.append(spawn([str(LAB)], 2, **common, **own))
    assert_agreed(started)


def is_free(port: int) -> bool:
    with socket.socket() as tried:
        try:
            tried.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


SLURM = {
    "SLURM_JOB_ID": "7",
    "SLURM_STEP_NODELIST": "node[1-2]",
    "SLURM_PROCID": "0",
    "SLURM_LOCALID": "0",
    "SLURM_NTASKS": "4",
}


@pytest.mark.parametrize(
    ("environ", "several"),
    [
        ({}, False),
        (SLURM, True),
        (SLURM | {"SLURM_NTASKS": "1"}, False),
        # A shell in an allocation for four tasks is a step of one.
        (SLURM | {"SLURM_STEP_NUM_TASKS": "1"}, False),
        # A batch script without srun is no step.
        ({name: x for name, x in SLURM.items() if name != "SLURM_STEP_NODELIST"}, False),
        ({"OMPI_MCA_orte_hnp_uri": "1.0;tcp://10.0.0.1:1", "OMPI_COMM_WORLD_SIZE": "2"}, True),
        ({"OMPI_MCA_orte_hnp_uri": "1.0;tcp://10.0.0.1:1", "OMPI_COMM_WORLD_SIZE": "1"}, False),
        # A pod that is no part of an indexed job.
        ({"KUBERNETES_SERVICE_HOST": "10.0.0.1"}, False),
    ],
)
def test_several_processes_are_those_that_a_launcher_reports(environ, several):
    assert detects_processes(environ) is several


POD = {
    "KUBERNETES_SERVICE_HOST": "10.0.0.1",
    "HOSTNAME": "training-job-1",
    "JOB_COMPLETION_INDEX": "1",
}


@pytest.mark.parametrize(
    ("parallelism", "completions", "several"),
    [
        (1, 1, False),
        (2, 2, True),
        # Kubernetes starts no more pods than are to complete.
        (4, 1, False),
        # Four pods one after another.
        (1, 4, False),
        # Kubernetes does not answer: jax says why.
        (None, None, True),
    ],
)
def test_pods_of_an_indexed_job_are_several_if_they_run_at_once(
    parallelism, completions, several, monkeypatch, tmp_path
):
    def read_job(name, namespace):
        assert (name, namespace) == ("training-job", "robots")
        if parallelism is None:
            raise PermissionError
        spec = types.SimpleNamespace(parallelism=parallelism, completions=completions)
        return types.SimpleNamespace(spec=spec)

    package = types.ModuleType("kubernetes")
    api = types.SimpleNamespace(read_namespaced_job=read_job)
    package.config = types.SimpleNamespace(load_incluster_config=lambda: None)
    package.client = types.SimpleNamespace(BatchV1Api=lambda: api)
    monkeypatch.setitem(sys.modules, "kubernetes", package)
    (tmp_path / "namespace").write_text("robots\n")
    monkeypatch.setattr(processes, "_NAMESPACE", tmp_path / "namespace")
    assert detects_processes(POD) is several


def test_a_pod_without_the_client_of_kubernetes_is_one_process(monkeypatch):
    monkeypatch.setitem(sys.modules, "kubernetes", None)
    assert not detects_processes(POD)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--num-processes", "2"], "go together"),
        (["--coordinator", "host", "--num-processes", "2", "--process-id", "0"], "HOST:PORT"),
        (
            ["--coordinator", "h:1", "--num-processes", "0", "--process-id", "0"],
            "at least 1, got 0",
        ),
        (
            ["--coordinator", "h:1", "--num-processes", "2", "--process-id", "2"],
            "from 0 to 1, got 2",
        ),
        (["--process-id", "one"], "--process-id must be"),
    ],
)
def test_invalid_options_are_one_sentence(options, message, capsys):
    assert main(["train", "--preset", "pixels", *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_processes_with_different_options_end_with_one_sentence(tmp_path):
    folder = tmp_path / "run"
    place = ["--coordinator", f"localhost:{free_port()}", "--num-processes", "2", "--process-id"]
    command = ["-m", "mjx_arm", "train", *OPTIONS, *TOTAL, "--out", str(folder)]
    ended = finish([spawn([*command, "--seed", i, *place, i], 2) for i in ("0", "1")])
    for status, _, error in ended:
        assert status == 2
        assert error == (
            "error: process 1 was given another seed than process 0: start every process with the "
            "same options\n"
        )
    assert not folder.exists()


@pytest.mark.parametrize(
    ("said", "lost"),
    [
        ("UNKNOWN: Gloo all-reduce failed: Connection closed by peer [127.0.0.1]:4000", True),
        ("DEADLINE_EXCEEDED: Barrier timed out. Id: mjx_arm_alive_0_3", True),
        ("NCCL operation ncclAllReduce failed: remote process exited", True),
        ("INTERNAL: CpuCallback error: ValueError: the scene is gone", False),
        ("INVALID_ARGUMENT: Mosaic failed to compile", False),
    ],
)
def test_only_a_lost_process_is_called_lost(said, lost):
    assert is_loss(jax.errors.JaxRuntimeError(said)) is lost


def test_one_process_is_no_meeting():
    join_processes("host:1", 1, 0)
    assert not jax.distributed.is_initialized()


@pytest.mark.long
def test_a_run_of_two_processes_is_stopped_and_resumed_to_the_bit(tmp_path):
    whole, again, cut = (tmp_path / name for name in ("whole", "again", "cut"))
    for folder in (whole, again):
        ended = finish(train(*OPTIONS, *TOTAL, "--out", str(folder)))
        assert [status for status, *_ in ended] == [0, 0], ended
        # Process 0 alone reports.
        assert "evaluation: " in ended[0][1]
        assert all(line.startswith("[Gloo]") for line in ended[1][1].splitlines())
    started = train(*OPTIONS, *TOTAL, "--out", str(cut))
    wait_for_checkpoint(cut, started)
    started[1].send_signal(signal.SIGTERM)
    ended = finish(started)
    assert [status for status, *_ in ended] == [130, 130], ended
    assert "saved; continue with" in ended[0][2]
    rows = read_metrics(cut)
    assert len(rows) < len(read_metrics(whole)) == 40
    ended = finish(train("--resume", str(cut), "--no-video", "--eval-episodes", "4"))
    assert [status for status, *_ in ended] == [0, 0], ended
    assert same(whole, again)
    assert same(whole, cut)
    names = sorted(path.name for path in whole.iterdir())
    assert {"config.json", "metrics.jsonl", "last.safetensors", "evaluation.json"} <= set(names)
    assert names == sorted(path.name for path in cut.iterdir())


@pytest.mark.slow
def test_a_signal_to_one_of_two_processes_stops_both_and_two_resume(tmp_path, capsys):
    folder = tmp_path / "run"
    started = train(*OPTIONS, *LONG, "--out", str(folder))
    wait_for_checkpoint(folder, started)
    # The folder of a run of two processes is not for a third one.
    assert main(["train", "--resume", str(folder)]) == 2
    assert "is in use by another process" in capsys.readouterr().err
    assert main(["train", *OPTIONS, "--out", str(folder)]) == 2
    assert "is not empty" in capsys.readouterr().err
    started[1].send_signal(signal.SIGTERM)
    ended = finish(started)
    assert [status for status, *_ in ended] == [130, 130], ended
    assert "saved; continue with" in ended[0][2]
    done = RunCheckpoints(folder).steps()[-1] * 8
    arguments = ["--total-steps", str(done + 320), "--eval-episodes", "4"]
    arguments += ["--no-video"]
    ended = finish(train("--resume", str(folder), *arguments))
    assert [status for status, *_ in ended] == [0, 0], ended
    assert f"resuming after {done:,} steps" in ended[0][1]
    assert [row["env_steps"] for row in read_metrics(folder)] == list(range(160, done + 321, 160))


@pytest.mark.slow
def test_two_killed_processes_are_resumed_by_two(tmp_path):
    """With the default preset, whose student sees pixels."""
    folder = tmp_path / "run"
    started = train(*DISTILL, *LONG, "--out", str(folder))
    wait_for_checkpoint(folder, started)
    for process in started:
        process.kill()
    ended = finish(started)
    assert [status for status, *_ in ended] == [-signal.SIGKILL] * 2, ended
    done = RunCheckpoints(folder).steps()[-1]
    # Stopped again: an evaluation at the end would compile for longer than all of this.
    resumed = train("--resume", str(folder))
    wait_for_checkpoint(folder, resumed, after=done)
    resumed[0].send_signal(signal.SIGTERM)
    ended = finish(resumed)
    assert [status for status, *_ in ended] == [130, 130], ended
    assert f"resuming after {8 * done:,} steps" in ended[0][1]
    rows = read_metrics(folder)
    last = RunCheckpoints(folder).steps()[-1] * 8
    assert [row["env_steps"] for row in rows] == list(range(160, last + 1, 160))
    assert rows[0]["student_updates"] == 0
    assert all(row["student_updates"] == 60 for row in rows[1:])
    assert all(math.isfinite(row["student_loss"]) for row in rows[1:])


@pytest.mark.parametrize(
    "lost", [pytest.param(0, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.long)]
)
def test_when_a_process_is_lost_the_others_end_and_the_run_resumes_with_one(lost, tmp_path):
    folder = tmp_path / "run"
    started = train(*OPTIONS, *LONG, "--out", str(folder))
    wait_for_checkpoint(folder, started)
    started[lost].kill()
    left = started[1 - lost]
    _, error = left.communicate(timeout=60)
    assert left.returncode == 2
    assert "have lost one another" in error
    assert error.count("\n") == 1
    finish([started[lost]])
    done = RunCheckpoints(folder).steps()[-1] * 8
    arguments = ["--resume", str(folder), "--total-steps", str(done + 320), "--eval-episodes", "4"]
    arguments += ["--no-video"]
    assert main(["train", *arguments]) == 0
    assert [row["env_steps"] for row in read_metrics(folder)] == list(range(160, done + 321, 160))


@pytest.mark.long
def test_a_run_of_four_devices_is_resumed_to_the_bit_and_on_fewer(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"

    def run(*arguments: str) -> str:
        command = ("-m", "mjx_arm", "train", *arguments)
        ((status, output, error),) = finish(start(*command, number=1, devices=4))
        assert status == 0, error
        return output

    said = run(*OPTIONS, "--total-steps", "3200", "--out", str(whole))
    assert "devices: 4, each with a part of the environments" in said
    run(*OPTIONS, "--total-steps", "1600", "--out", str(cut))
    more = ["--resume", str(cut), "--no-video", "--eval-episodes", "4", "--total-steps"]
    run(*more, "3200")
    assert same(whole, cut)
    said = run(*more, "3520", "--devices", "2")
    assert "devices: 2, each with a part of the environments" in said
    assert [row["env_steps"] for row in read_metrics(cut)] == list(range(160, 3521, 160))
