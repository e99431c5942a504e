"""Several processes that train one run together: how they meet, who writes, what they agree on.

They meet by `jax.distributed`. Each process calls the functions of this module in the same order.
With one process each function does without the others.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import os
import pathlib
import socket
import sys
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from mjx_arm.training import meeting

# The processes meet so often, and one that does not come for so long is lost, seconds.
_PERIOD, _SILENCE = 5, 30
# jax ends a process with a page of its own when another is silent for so long, seconds.
_HEARTBEAT = 100
# The others wait for so long until a process has started, and until it ends, seconds.
_START, _END = 300, 30
# Process 0 evaluates, renders and writes while the others wait, ms.
_PATIENCE = 24 * 60 * 60 * 1000
# Where a pod finds its namespace.
_NAMESPACE = pathlib.Path("/var/run/secrets/kubernetes.io/serviceaccount/namespace")
# Words of the errors of jax, gloo and NCCL about a process that is not there any more.
_LOST = (
    *("gloo", "nccl", "barrier", "heartbeat", "coordination", "connection", "peer", "socket"),
    *("unavailable", "deadline", "timed out", "preempt", "disconnect"),
)
_barriers = itertools.count()
_watches = itertools.count()


def join_processes(
    coordinator: str | None = None, num_processes: int | None = None, process_id: int | None = None
) -> None:
    """Makes this process one of several, as the options or the environment say.

    Without options that is where Slurm, Open MPI or Kubernetes report more than one process, which
    jax detects. Must come before anything that asks jax for its devices.

    Args:
      coordinator: `HOST:PORT` of process 0, the same in every process.
      num_processes: number of processes; 1 for this one alone, whatever the environment says.
      process_id: number of this process, from 0.

    Raises:
      ValueError: the options are incomplete or invalid, or the processes did not meet.
    """
    if num_processes == 1 or jax.distributed.is_initialized():
        return
    given = (coordinator, num_processes, process_id)
    if all(value is None for value in given):
        if detects_processes(os.environ):
            _initialize()
        return
    if coordinator is None or num_processes is None or process_id is None:
        raise ValueError(
            "--coordinator, --num-processes and --process-id go together: give all three or none"
        )
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ValueError(f"--coordinator must be HOST:PORT, got {coordinator!r}")
    if num_processes < 1:
        raise ValueError(f"--num-processes must be at least 1, got {num_processes}")
    if not 0 <= process_id < num_processes:
        raise ValueError(f"--process-id must be from 0 to {num_processes - 1}, got {process_id}")
    _initialize(
        coordinator_address=coordinator,
        num_processes=num_processes,
        process_id=process_id,
        cluster_detection_method="deactivate",
    )


def detects_processes(environ: Mapping[str, str]) -> bool:
    """Whether a launcher that jax knows reports more than one process.

    A shell inside of a job is one process: Slurm then says that its step has one task.

    Args:
      environ: the environment variables.
    """
    if {"SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_PROCID", "SLURM_LOCALID"} <= set(environ):
        tasks = environ.get("SLURM_STEP_NUM_TASKS", environ.get("SLURM_NTASKS", "1"))
        return int(tasks) > 1
    if "OMPI_MCA_orte_hnp_uri" in environ:
        return int(environ.get("OMPI_COMM_WORLD_SIZE", "1")) > 1
    indexed = {"KUBERNETES_SERVICE_HOST", "JOB_COMPLETION_INDEX"} <= set(environ)
    return indexed and _pods_at_once(environ) != 1


def _pods_at_once(environ: Mapping[str, str]) -> int | None:
    """Pods of an indexed job that run at the same time; None where Kubernetes does not say."""
    try:
        # Only Kubernetes itself knows this; jax asks it through the same package.
        from kubernetes import client, config
    except ImportError:
        return 1
    # The host name of a pod is that of its job, with its index.
    name = environ.get("HOSTNAME", "").removesuffix(f"-{environ['JOB_COMPLETION_INDEX']}")
    try:
        config.load_incluster_config()
        namespace = _NAMESPACE.read_text(encoding="utf-8").strip()
        spec = client.BatchV1Api().read_namespaced_job(name, namespace).spec
    except Exception:
        # Whatever is wrong, jax meets it next, and its error is shown.
        return None
    return min(int(spec.parallelism), int(spec.completions))


def _initialize(**options: Any) -> None:
    # Its handler of SIGTERM would take the place of ours, which saves at the end of a chunk.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        with meeting.apart():
            jax.distributed.initialize(
                **options,
                initialization_timeout=_START,
                heartbeat_timeout_seconds=_HEARTBEAT,
                shutdown_timeout_seconds=_END,
            )
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(
            f"the processes did not meet: {reason}; check --coordinator, or give --num-processes 1 "
            "to train in this process alone"
        ) from error


def is_writer() -> bool:
    """Whether this process writes the files and the progress of the run."""
    return alone() or jax.process_index() == 0


def alone() -> bool:
    """Whether this process trains its runs alone. Does not ask jax for its devices."""
    return not jax.distributed.is_initialized() or jax.process_count() == 1


def any_says(flag: bool) -> bool:
    """Whether the flag is set in any process; the same answer in all of them."""
    return bool(flag) if alone() else bool(_gather(np.array(flag)).any())


def on_writer(function: Callable[[], str | None]) -> str:
    """Runs a function in process 0 alone, while the others wait.

    Args:
      function: returns a text, or None for an empty one.

    Returns:
      The text, in every process.

    Raises:
      ValueError: the function raised it; the same sentence in every process.
    """
    if alone():
        return function() or ""
    text, failed = "", False
    if is_writer():
        try:
            text = function() or ""
        except ValueError as error:
            text, failed = str(error), True
    wait_for_all()
    content = np.frombuffer(text.encode(), np.uint8)
    about = multihost_utils.broadcast_one_to_all(np.array([len(content), failed], np.uint32))
    size, failed = np.asarray(about).tolist()
    if size > 0:
        own = content if is_writer() else np.zeros(size, np.uint8)
        text = np.asarray(multihost_utils.broadcast_one_to_all(own)).tobytes().decode()
    if failed:
        raise ValueError(text)
    return text


def check_same(options: Mapping[str, str]) -> None:
    """Rejects processes that were started with different options.

    They would train different networks and average their gradients, or wait for one another for
    ever.

    Args:
      options: by name, the same names in every process.

    Raises:
      ValueError: in every process, where the value of some option is not that of process 0.
    """
    if alone():
        return
    first = json.loads(on_writer(lambda: json.dumps(dict(options))))
    names = list(first)
    other = [names.index(name) for name in names if options.get(name) != first[name]]
    found = _gather(np.array(other[0] if other else -1))
    if (found >= 0).any():
        process = int(np.argmax(found >= 0))
        raise ValueError(
            f"process {process} was given another {names[found[process]]} than process 0: start "
            "every process with the same options"
        )


@functools.cache
def processes_here() -> int:
    """Number of processes of the run on this machine. All of them must call it."""
    if alone():
        return 1
    own = np.array(zlib.crc32(socket.gethostname().encode()), np.uint32)
    return int((_gather(own) == own).sum())


def _gather(value: np.ndarray) -> np.ndarray:
    """The value of every process, `[processes, ...]`."""
    # A collective gives up after half a minute; a barrier waits.
    wait_for_all()
    return np.asarray(multihost_utils.process_allgather(value))


def wait_for_all() -> None:
    """Waits until every process has come here."""
    if alone():
        return
    # orbax has the barrier of jax's coordination service, which jax itself does not export.
    from orbax.checkpoint import multihost

    name = f"mjx_arm_{next(_barriers)}"
    multihost.get_barrier_sync_fn()(key=name, timeout_ms=_PATIENCE)


@contextlib.contextmanager
def watching_others() -> Iterator[None]:
    """Within it, this process ends with one sentence where another one is lost.

    A collective waits for a lost process for ever.
    """
    if alone():
        yield
        return
    from orbax.checkpoint import multihost

    # Else one that comes later, from a program of its own, would be called lost.
    wait_for_all()
    meet, over, own = multihost.get_barrier_sync_fn(), threading.Event(), next(_watches)

    def watch() -> None:
        for number in itertools.count():
            if over.wait(_PERIOD):
                return
            try:
                meet(key=f"mjx_arm_alive_{own}_{number}", timeout_ms=1_000 * _SILENCE)
            except Exception as error:
                if over.is_set():
                    return
                os.write(2, f"error: {lost_sentence(error)}\n".encode())
                os._exit(2)

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
        # Else one that is done would be missed by one that is not.
        wait_for_all()
    finally:
        over.set()


def is_loss(error: Exception) -> bool:
    """Whether an error of jax says that another process is not there any more."""
    said = str(error).lower()
    return any(word in said for word in _LOST)


def lost_sentence(error: Exception) -> str:
    """What to say of an error of jax that ends one of several processes."""
    reason = " ".join(str(error).split())[:120]
    return (
        f"the processes of the run have lost one another ({reason}): "
        "after a minute start all of them again with --resume and the run folder"
    )


def end_together(status: int) -> None:
    """Ends this process with the others, or at once where it has failed.

    Args:
      status: exit status of the process.
    """
    if not jax.distributed.is_initialized():
        return
    if status in (0, 130):
        wait_for_all()
        jax.distributed.shutdown()
        return
    # At exit jax would wait for processes that may be lost.
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)
