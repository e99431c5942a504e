"""MJX follows MuJoCo C in states that are rich in contacts."""

from __future__ import annotations

import mujoco
import numpy as np
from physics_lab import NUM_ENVS, grasp_starts

# Of `qpos` after one iteration, m and rad.
TOLERANCE = 5e-3
MOST_DISAGREEING = 0.02
# Of a cube at rest on the table.
RESTING_CONTACTS = 4
LEAST_STATES = 100


def tumbling_starts(lab, random) -> tuple[np.ndarray, np.ndarray]:
    """Cubes turned and thrown at the table, or in a gripper that turns."""
    qpos, ctrl = grasp_starts(lab)
    cube = lab.ids.cube_qpos
    for row in range(NUM_ENVS // 2):
        quat = random.normal(size=4)
        qpos[row, cube + 2] = random.uniform(0.028, 0.05)
        qpos[row, cube + 3 : cube + 7] = quat / np.linalg.norm(quat)
        qpos[row, lab.ids.arm_qpos] = ctrl[row, lab.ids.arm_ctrl] = lab.ids.home_qpos[
            lab.ids.arm_qpos
        ]
    return qpos, ctrl


def touching(model: mujoco.MjModel, qpos: np.ndarray) -> int:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    return data.ncon


def differences(labs, seed: int) -> tuple[list[float], list[float]]:
    """Of rich states, and of tilted cubes on the table, after one iteration each."""
    native, mjx = labs["native"], labs["mjx"]
    model, ids = native.scene.mj_model, native.ids
    random = np.random.default_rng(seed)
    qpos, ctrl = tumbling_starts(native, random)
    state = native.init(qpos, ctrl)
    rich, tilted = [], []
    for step in range(40):
        if step == 4:
            ctrl[:, ids.gripper_ctrl] = ids.ctrl_range[ids.gripper_ctrl, 0]
        joint = ids.arm_ctrl[random.integers(0, 6, NUM_ENVS)]
        ctrl[np.arange(NUM_ENVS), joint] += np.deg2rad(random.choice([-1.0, 1.0], NUM_ENVS))
        words = np.asarray(state.integration)
        warmstart = np.ascontiguousarray(words).view(np.float64)[:, 1 + model.nq + model.nv :]
        start = mjx.init(np.asarray(state.qpos), ctrl)
        start = start.replace(qvel=state.qvel, integration=warmstart.astype(np.float32))
        before, state, after = state, native.step(state, ctrl), mjx.step(start, ctrl)
        difference = np.abs(np.asarray(state.qpos) - np.asarray(after.qpos)).max(axis=1)
        for row in range(NUM_ENVS):
            count = touching(model, np.asarray(before.qpos[row]))
            if count > RESTING_CONTACTS:
                rich.append(difference[row])
            elif 0 < count < RESTING_CONTACTS and row < NUM_ENVS // 2:
                tilted.append(difference[row])
    return rich, tilted


def test_mjx_follows_mujoco_in_contact(labs):
    found = [differences(labs, seed) for seed in range(3)]
    rich, tilted = (np.concatenate(parts) for parts in zip(*found, strict=True))
    print(f"rich: {np.mean(rich > TOLERANCE):.4f} of {len(rich)}")
    print(f"tilted: {np.mean(tilted > TOLERANCE):.4f} of {len(tilted)}")
    assert len(rich) >= LEAST_STATES
    assert len(tilted) >= LEAST_STATES
    assert np.mean(rich > TOLERANCE) < MOST_DISAGREEING
    assert np.mean(tilted > TOLERANCE) < MOST_DISAGREEING


def test_mjx_drops_no_contact(scene):
    # MJX keeps the nearest so many contacts: those of a cube flat on the table, in all six pads.
    data = scene.mj_model.numeric("max_contact_points").data
    assert data[0] >= 4 + 6
