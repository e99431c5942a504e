"""What several processes agree on, as JSON; `test_processes.py` starts it and judges.

python tests/training/processes_lab.py [HOST:PORT NUM_PROCESSES PROCESS_ID]
"""

from __future__ import annotations

import json
import sys

import jax

from mjx_arm.training import processes
from mjx_arm.training.mesh import fetch, make_mesh, replicate


def fail() -> str:
    raise ValueError("only process 0 can say this")


def main(
    coordinator: str | None = None, num_processes: str | None = None, process_id: str | None = None
) -> None:
    place = [None if x is None else int(x) for x in (num_processes, process_id)]
    processes.join_processes(coordinator, *place)
    found = {
        "writer": processes.is_writer(),
        "alone": processes.alone(),
        "said": processes.on_writer(lambda: f"process {jax.process_index()} wrote"),
        "one": processes.any_says(jax.process_index() == 1),
        "none": processes.any_says(False),
    }
    try:
        processes.on_writer(fail)
    except ValueError as error:
        found["failed"] = str(error)
    # Longer than one message was once allowed to be.
    found["length"] = len(processes.on_writer(lambda: "ä" * 70_000))
    processes.check_same({"seed": "1", "steps": "2"})
    try:
        processes.check_same({"seed": "1", "steps": str(jax.process_index())})
    except ValueError as error:
        found["other"] = str(error)
    found["here"] = processes.processes_here()
    with processes.watching_others():
        pass
    mesh = make_mesh(jax.local_device_count())
    assert mesh is not None
    found["devices"] = mesh.size
    found["key"] = fetch(jax.random.key_data(replicate(jax.random.key(3), mesh))).tolist()
    print(json.dumps(found))
    processes.end_together(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
