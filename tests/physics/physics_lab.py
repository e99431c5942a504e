"""One compiled step a backend, and the long runs that several tests look at."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scene_ids import TaskIds, resolve_task

from mjx_arm.physics import Physics, PhysicsState, compiler_options, make_physics
from mjx_arm.scene import Scene, load_scene

# Compiling MJX takes half a minute on two busy cores: every test steps as many environments.
NUM_ENVS = 12
BACKENDS = ("native", "mjx")

# The gripper around a cube on the table, 0.36 m from the axis of the waist.
GRASP_JOINTS = np.deg2rad([0.0, 15.5, 26.64, 0.0, 47.86, 0.0])
GRASP_RADIUS = 0.36

HOLDING = slice(0, 8)
RESTING = slice(8, NUM_ENVS)


@dataclasses.dataclass(frozen=True)
class Lab:
    """A backend and its compiled functions over `NUM_ENVS` environments."""

    scene: Scene
    ids: TaskIds
    physics: Physics
    init: Callable[[np.ndarray, np.ndarray], PhysicsState]
    step: Callable[[PhysicsState, np.ndarray], PhysicsState]

    def home(self) -> tuple[np.ndarray, np.ndarray]:
        """`qpos [N, nq]` and `ctrl [N, nu]` at home."""
        return (
            np.tile(self.ids.home_qpos, (NUM_ENVS, 1)),
            np.tile(self.ids.home_ctrl, (NUM_ENVS, 1)),
        )

    def run(self, state: PhysicsState, ctrl: np.ndarray, iterations: int) -> PhysicsState:
        for _ in range(iterations):
            state = self.step(state, ctrl)
        return state

    def cube_in_gripper(self, state: PhysicsState) -> np.ndarray:
        """Place of the cube in the gripper's frame: `[N, 3]`, m."""
        poses, ids = state.poses, self.ids
        offset = np.asarray(poses.geom_xpos[:, ids.cube_geom] - poses.site_xpos[:, ids.grasp_site])
        # The pads are spheres without a rotation of their own, so theirs is the gripper's.
        rotation = np.asarray(poses.geom_xmat[:, ids.pad_geoms[0, 0]])
        return np.einsum("nji,nj->ni", rotation, offset)


@functools.cache
def make_lab(backend: str) -> Lab:
    scene = load_scene("arm_cube")
    ids = resolve_task(scene)
    physics = make_physics(
        scene.mj_model, backend, substeps=ids.substeps, mjx_iterations=ids.mjx_iterations
    )
    qpos = jnp.asarray(np.tile(ids.home_qpos, (NUM_ENVS, 1)))
    ctrl = jnp.asarray(np.tile(ids.home_ctrl, (NUM_ENVS, 1)))
    init = jax.jit(jax.vmap(physics.init))
    step = jax.jit(jax.vmap(physics.step), compiler_options=compiler_options(physics))
    step(init(qpos, ctrl), ctrl)
    # Copies, since jax takes numpy's memory as it is, and the tests go on writing to theirs.
    return Lab(
        scene,
        ids,
        physics,
        lambda qpos, ctrl: init(np.array(qpos, np.float32), np.array(ctrl, np.float32)),
        lambda state, ctrl: step(state, np.array(ctrl, np.float32)),
    )


def scan_of(physics: Physics) -> Callable:
    """`(state, controls [L, N, nu]) -> (state, diverged [L, N])`, compiled."""

    def run(state, controls):
        def body(state, ctrl):
            state = jax.vmap(physics.step)(state, ctrl)
            return state, state.diverged

        return jax.lax.scan(body, state, controls)

    return jax.jit(run)


def grasp_starts(lab: Lab) -> tuple[np.ndarray, np.ndarray]:
    """Half of a millimetre to 8 mm and 6 degrees off: grippers around cubes; the rest at home."""
    qpos, ctrl = lab.home()
    random = np.random.default_rng(0)
    cube = lab.ids.cube_qpos
    for row in range(NUM_ENVS):
        waist = random.uniform(-0.25, 0.25)
        radius, yaw = GRASP_RADIUS, waist
        if row > 0:
            radius, yaw = radius + random.uniform(-0.008, 0.008), yaw + random.uniform(-0.1, 0.1)
        place = radius * np.cos(waist), radius * np.sin(waist)
        qpos[row, cube : cube + 2] = place
        qpos[row, cube + 3 : cube + 7] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        if row < HOLDING.stop:
            joints = GRASP_JOINTS + np.asarray([waist, 0, 0, 0, 0, 0])
            qpos[row, lab.ids.arm_qpos] = ctrl[row, lab.ids.arm_ctrl] = joints
    return qpos, ctrl


@dataclasses.dataclass(frozen=True)
class LongRun:
    """Eight cubes lifted and held, four at rest on the table, for 20 s; then one open."""

    lab: Lab
    at_start: PhysicsState
    lifted: PhysicsState
    after: PhysicsState
    opened: PhysicsState
    diverged: np.ndarray


HOLD_SECONDS = 20.0


@functools.cache
def make_long_run(backend: str) -> LongRun:
    lab = make_lab(backend)
    low, high = lab.ids.ctrl_range[lab.ids.gripper_ctrl]
    qpos, ctrl = grasp_starts(lab)
    start = lab.run(lab.init(qpos, ctrl), ctrl, 5)
    ctrl[HOLDING, lab.ids.gripper_ctrl] = low
    state = lab.run(start, ctrl, 8)
    for _ in range(30):
        ctrl[HOLDING, lab.ids.arm_ctrl[1]] -= np.deg2rad(1.0)
        state = lab.step(state, ctrl)
    lifted = lab.run(state, ctrl, 10)
    state, diverged = lifted, np.zeros(NUM_ENVS, bool)
    for _ in range(round(HOLD_SECONDS / (lab.physics.substeps * lab.physics.timestep))):
        state = lab.step(state, ctrl)
        diverged |= np.asarray(state.diverged)
    ctrl[:, lab.ids.gripper_ctrl] = high
    opened = lab.run(state, ctrl, 30)
    return LongRun(lab, start, lifted, state, opened, diverged)
