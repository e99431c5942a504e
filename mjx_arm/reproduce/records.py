"""What became of an episode: why it failed, and what random opens of the gripper did."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjx_arm.envs.arm import Arm
from mjx_arm.reproduce.rollouts import Rollout

# The gripper has reached the cube when its grasp site is this close to the cube's centre, m. A
# grasped cube is up to 3 cm away from it; half of the cube's edge is 2.5 cm.
REACH = 0.04
# A cube that falls by more than this was dropped, m.
FALL = 0.01
# The causes of a failure, in the order in which an episode comes to them.
CAUSES = {
    "never_reached": "the gripper never came within 4 cm of the cube's centre",
    "not_grasped": "it came within 4 cm, and never grasped the cube",
    "dropped_and_lost": "it grasped the cube, and did not hold it at the end",
    "timed_out": "it held the cube at the end, and had not lifted it by 30 cm",
    "diverged": "the simulation diverged",
}
# What a random open of the closed gripper led to.
OPENS = ("on_the_table", "caught", "dropped")


def cause_of(rollout: Rollout) -> str | None:
    """Why an episode failed, one of `CAUSES`; None for a success."""
    if rollout.success:
        return None
    if rollout.diverged:
        return "diverged"
    if rollout.grasped.any():
        return "timed_out" if rollout.grasped[-1] else "dropped_and_lost"
    return "not_grasped" if rollout.distance.min() < REACH else "never_reached"


@dataclasses.dataclass(frozen=True)
class Open:
    """A random open of the gripper while it held the cube.

    Attributes:
      step: index of the action.
      kind: `on_the_table` (the cube was lifted by less than 1 cm), `caught` (it fell by less than
        1 cm before it was grasped again) or `dropped`.
      again: the cube was grasped again in the same episode.
    """

    step: int
    kind: str
    again: bool


def random_opens(rollout: Rollout, open_action: int) -> list[Open]:
    """The random opens while the cube was grasped: the agent itself preferred another action."""
    before = np.concatenate([[False], rollout.grasped[:-1]])
    random = (rollout.action == open_action) & (rollout.greedy != open_action) & before
    return [_open(rollout, int(step)) for step in np.flatnonzero(random)]


def _open(rollout: Rollout, step: int) -> Open:
    height = float(rollout.height[step - 1])
    later = np.flatnonzero(rollout.grasped[step:])
    end = step + int(later[0]) + 1 if later.size else len(rollout)
    lowest = float(rollout.height[step:end].min())
    if height < FALL:
        kind = "on_the_table"
    else:
        kind = "caught" if later.size and height - lowest < FALL else "dropped"
    return Open(step, kind, bool(later.size))


def count_opens(rollouts: Sequence[Rollout], open_action: int) -> dict[str, Any]:
    """How often random opens of a grasped cube happened, and what became of them.

    Returns:
      `random_opens`; for each kind in `OPENS` a dict of `count`, `grasped_again` and `succeeded`
      (the episode did); and `episodes_with_drop` with `episodes_with_drop_succeeded`.
    """
    counts: dict[str, Any] = {
        kind: {"count": 0, "grasped_again": 0, "succeeded": 0} for kind in OPENS
    }
    with_drop = []
    for rollout in rollouts:
        opens = random_opens(rollout, open_action)
        for each in opens:
            counts[each.kind]["count"] += 1
            counts[each.kind]["grasped_again"] += each.again
            counts[each.kind]["succeeded"] += rollout.success
        if any(each.kind == "dropped" for each in opens):
            with_drop.append(rollout.success)
    return {
        "random_opens": sum(row["count"] for row in counts.values()),
        **counts,
        "episodes_with_drop": len(with_drop),
        "episodes_with_drop_succeeded": int(sum(with_drop)),
    }


def summarise(rollouts: Sequence[Rollout], arm: Arm, cube_qpos: int) -> dict[str, Any]:
    """Episodes as columns of a table, in JSON's types.

    Args:
      rollouts: the episodes.
      arm: with the place of its joints in `qpos`.
      cube_qpos: index of the cube's position in `qpos`.

    Returns:
      Columns with one entry for each episode: `success`, `cause`, `length` (steps), `grasps` (how
      often the cube became grasped), `closest` (m), `highest` (of the grasped cube, m), `cube`
      (x and y at the start, m) and `joints` (from home at the start, degrees).
    """
    home = arm.home_qpos[arm.qpos]
    columns: dict[str, list[Any]] = {}
    for rollout in rollouts:
        held = rollout.height[rollout.grasped]
        onsets = rollout.grasped & ~np.concatenate([[False], rollout.grasped[:-1]])
        offset = np.rad2deg(rollout.qpos[0][arm.qpos] - home)
        row = {
            "success": rollout.success,
            "cause": cause_of(rollout),
            "length": len(rollout),
            "grasps": int(onsets.sum()),
            "closest": _rounded(rollout.distance.min(), 4),
            "highest": _rounded(held.max(), 4) if held.size else None,
            "cube": [_rounded(x, 4) for x in rollout.qpos[0][cube_qpos : cube_qpos + 2]],
            "joints": [_rounded(x, 2) for x in offset],
        }
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    return columns


def _rounded(value: Any, digits: int) -> float:
    return round(float(value), digits)


# Bins of the cube's height: 1 cm each, the last one for everything above.
HEIGHT_EDGES = tuple(round(0.01 * i, 2) for i in range(33))


def height_histogram(rollouts: Sequence[Rollout], lift: float) -> dict[str, Any]:
    """Where the cube is while it is grasped, and how long it hovers just below the goal.

    Args:
      rollouts: the episodes.
      lift: the height of success, m.

    Returns:
      `edges` (m), `steps` with a grasp in each bin, `grasped_steps`, `all_steps`, and
      `hovering_steps`: with a grasp in the last third below `lift`, in episodes that failed.
    """
    heights = np.concatenate([rollout.height[rollout.grasped] for rollout in rollouts])
    edges = np.asarray(HEIGHT_EDGES)
    counts, _ = np.histogram(np.clip(heights, edges[0], edges[-1] - 1e-6), edges)
    hovering = sum(
        int(((rollout.height > 2 / 3 * lift) & rollout.grasped).sum())
        for rollout in rollouts
        if not rollout.success
    )
    return {
        "edges": list(HEIGHT_EDGES),
        "steps": counts.tolist(),
        "grasped_steps": len(heights),
        "all_steps": sum(map(len, rollouts)),
        "hovering_steps": hovering,
    }


@dataclasses.dataclass(frozen=True)
class Mark:
    """A chosen frame of an episode: an index into `qpos`, and what it shows."""

    frame: int
    name: str


def marks_of(rollout: Rollout) -> list[Mark]:
    """Five frames of a successful episode, chosen as in Figure 4 of the paper.

    The start; the approach, half of the way to the cube; at the cube, where the gripper is within
    4 cm of its centre for the first time; the start of the last grasp; and the end, lifted.
    """
    # The distance after step i belongs to frame i + 1.
    far = rollout.distance[0]
    approach = int(np.argmax(rollout.distance < far / 2)) + 1
    reached = int(np.argmax(rollout.distance < REACH)) + 1
    loose = np.flatnonzero(~rollout.grasped)
    grasped = (int(loose[-1]) + 1 if loose.size else 0) + 1
    frames = np.maximum.accumulate([0, approach, min(reached, grasped), grasped, len(rollout)])
    names = ("start", "approach", "at the cube", "grasped", "lifted")
    return [Mark(int(frame), name) for frame, name in zip(frames, names, strict=True)]
