"""One stand-in: an arm in MuJoCo C, seen by a camera in OpenGL."""

from __future__ import annotations

import collections
import copy
import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.envs.env import Env
from mjx_arm.envs.tasks.lift import Lift, grasped
from mjx_arm.kinematics import Poses
from mjx_arm.physics.base import settled_activations
from mjx_arm.silence import mujoco_silence
from mjx_arm.standin.levels import Offsets, colour_matrix, offset_model
from mjx_arm.standin.opengl import NO_OPENGL
from mjx_arm.varies import own_params

# A camera's pixel is the mean of this many rendered pixels in each direction.
_SCALE = 3
# Edge of the shadows' texture, pixels: a few millimetres per texel. At 4096, the value of the
# scenes, rendering the shadows takes longer than all the rest.
_SHADOW_SIZE = 512

_WARNINGS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


@dataclasses.dataclass(frozen=True)
class Measured:
    """What the stand-in measures in a state, as `mjx_arm.envs.tasks.lift.Lift` does.

    Attributes:
      distance: between the grasp site and the cube's centre, m.
      height: of the cube above its rest, m.
      grasped: the closed gripper holds the cube.
      success: grasped, and lifted high enough.
    """

    distance: float
    height: float
    grasped: bool
    success: bool


class Cameras:
    """Cameras of a model, rendered larger by MuJoCo's OpenGL renderer and scaled down.

    An OpenGL context belongs to a thread: make and use the cameras in the same one.

    Args:
      model: with the cameras where they are; its visual settings stay as they are.
      names: of the cameras.
      size: height and width of an image, pixels.
      colour: `[3, 3]`, what colours are multiplied by.
      shadows: render shadows of the lights that cast them.
      scale: rendered pixels to one of the image, in each direction.

    Raises:
      ValueError: there is no OpenGL.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        names: Sequence[str],
        size: tuple[int, int],
        *,
        colour: np.ndarray | None = None,
        shadows: bool = True,
        scale: int = _SCALE,
    ) -> None:
        self._names, self._size, self._scale = tuple(names), size, scale
        self._colour = None if colour is None or np.allclose(colour, np.eye(3)) else colour
        height, width = (scale * edge for edge in size)
        model = copy.copy(model)
        visual = model.vis
        visual.global_.offheight = max(visual.global_.offheight, height)
        visual.global_.offwidth = max(visual.global_.offwidth, width)
        visual.quality.shadowsize = min(visual.quality.shadowsize, _SHADOW_SIZE)
        if scale > 1:
            # Scaling down smooths the edges.
            visual.quality.offsamples = 0
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"MuJoCo finds no OpenGL ({reason}): {NO_OPENGL}") from error
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0

    def image(self, data: mujoco.MjData) -> np.ndarray:
        """What the cameras see: `[H, W, 3] uint8`, of several cameras `[C, H, W, 3]`."""
        images = [self._render(data, name) for name in self._names]
        return images[0] if len(images) == 1 else np.stack(images)

    def _render(self, data: mujoco.MjData, name: str) -> np.ndarray:
        self._renderer.update_scene(data, name, self._option)
        large = self._renderer.render()
        if self._scale == 1 and self._colour is None:
            return large
        (height, width), scale = self._size, self._scale
        blocks = large.reshape(height, scale, width, scale, 3)
        image = blocks.astype(np.uint16).sum(axis=(1, 3)).astype(np.float32) / scale**2
        if self._colour is not None:
            image = image @ self._colour.T
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()


class StandIn:
    """An arm and a cube that are not quite those of the simulator.

    Commands that the simulator blocks, because the arm would touch itself, its base or the table,
    are blocked here too.

    Args:
      env: the simulator's environment, with the task `lift` and images as observations.
      offsets: of the level.
      shadows: render shadows of the lights that cast them.

    Attributes:
      env: the simulator's environment.
      offsets: of the level.
      model: MuJoCo's model with the offsets.
      data: its state.
      ctrl: `[nu] float32`, targets of the servos, rad and m.

    Raises:
      ValueError: the environment has another task, its agent sees no image, or there is no OpenGL.
    """

    def __init__(self, env: Env, offsets: Offsets, *, shadows: bool = True) -> None:
        check_env(env)
        assert isinstance(env.task, Lift)
        self.env, self.offsets, self._task = env, offsets, env.task
        with mujoco_silence:
            self.model = offset_model(env.scene.mj_model, offsets)
        self.data = mujoco.MjData(self.model)
        self.ctrl = env.arm.home_ctrl.copy()
        self._steps = _step_table(env, 1 - offsets.short_step)
        params = own_params(env.scene.mj_model, env.varies)
        self._blocks = jax.jit(functools.partial(env.is_blocked, params=params))
        self._grasps = jax.jit(lambda poses, ctrl: grasped(self._task, poses, ctrl))
        self._cameras = Cameras(
            self.model,
            env.config.cameras,
            env.config.size,
            colour=colour_matrix(offsets, self.model.nbody),
            shadows=shadows,
        )
        self._seen: collections.deque[np.ndarray] = collections.deque(
            maxlen=offsets.image_delay + 1
        )

    def reset(self, qpos: np.ndarray, ctrl: np.ndarray) -> None:
        """Puts everything to a start, at rest: `qpos [nq]` and `ctrl [nu]`, rad and m."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = qpos
        self.ctrl = np.asarray(ctrl, np.float32).copy()
        if self.model.na:
            self.data.act[:] = np.asarray(settled_activations(self.model, jnp.asarray(self.ctrl)))
        self.update()
        self._seen.clear()
        self.look()

    def command(self, action: int) -> bool:
        """Moves the target of one servo, as `mjx_arm.envs.arm.apply_action` does.

        Args:
          action: 0 to `env.num_actions - 1`.

        Returns:
          Whether the command was carried out; otherwise it was blocked.
        """
        arm = self.env.arm
        low, high = arm.ctrl_range.T
        wanted = self.ctrl + self._steps[action]
        if action == arm.open_action:
            wanted[arm.gripper_ctrl] = high[arm.gripper_ctrl]
        elif action == arm.close_action:
            wanted[arm.gripper_ctrl] = low[arm.gripper_ctrl]
        wanted = np.clip(wanted, low, high)
        if self._blocks(self.data.qpos.astype(np.float32), self.ctrl, wanted):
            return False
        self.ctrl = wanted
        return True

    def hold(self) -> None:
        """The arm's servos hold the joints where they are; the gripper keeps its command."""
        arm = self.env.arm
        low, high = arm.ctrl_range[arm.ctrl].T
        self.ctrl[arm.ctrl] = np.clip(self.data.qpos[arm.qpos], low, high).astype(np.float32)

    def advance(self) -> None:
        """Runs the physics of one iteration; the servos hold their targets."""
        self.data.ctrl[:] = self.ctrl
        with mujoco_silence:
            mujoco.mj_step(self.model, self.data, self.env.scene.substeps)
        self.update()

    def look(self) -> np.ndarray:
        """Takes a new image, and returns the one that the agent sees, which may be older."""
        self._seen.append(self._cameras.image(self.data))
        return self._seen[0]

    def step(self, action: int) -> np.ndarray:
        """One iteration: command, physics, image. Returns what the agent sees after it."""
        self.command(action)
        self.advance()
        return self.look()

    @property
    def image(self) -> np.ndarray:
        """What the agent sees, `[H, W, 3] uint8`, or `[C, H, W, 3]` of several cameras."""
        return self._seen[0]

    @property
    def joints(self) -> np.ndarray:
        """Angles of the arm's joints, `[n] float64`, degrees; slides in mm."""
        arm = self.env.arm
        unit = np.where(arm.slides, 1000.0, np.rad2deg(1.0))
        return self.data.qpos[arm.qpos] * unit

    @property
    def diverged(self) -> bool:
        """The simulation has failed."""
        return any(self.data.warning[int(i)].number for i in _WARNINGS)

    def measure(self) -> Measured:
        """What the task measures in the present state."""
        task, poses = self._task, self._poses()
        cube = poses.geom_xpos[task.cube_geom]
        offset = poses.site_xpos[self.env.arm.grasp_site] - cube
        height = float(cube[2] - np.float32(task.half_size))
        is_grasped = bool(self._grasps(poses, self.ctrl)) and not self.diverged
        success = is_grasped and height >= task.config.lift
        return Measured(float(np.linalg.norm(offset)), height, is_grasped, success)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._cameras.close()

    def update(self) -> None:
        """Brings the poses up to the state: `mj_step` leaves them a substep behind."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def _poses(self) -> Poses:
        data = self.data
        arrays = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), data.site_xpos
        xpos, xmat, sites = (np.asarray(x, np.float32) for x in arrays)
        return Poses(geom_xpos=xpos, geom_xmat=xmat, site_xpos=sites)  # type: ignore[arg-type]


def check_env(env: Env) -> None:
    """Checks that the stand-in can run an environment.

    Raises:
      ValueError: it has another task than `lift`, or its observations are no images.
    """
    if not isinstance(env.task, Lift):
        raise ValueError(f"the stand-in is for the task 'lift', got {env.config.task!r}")
    if env.config.observation not in ("packed", "rgb"):
        raise ValueError(
            "the stand-in shows images alone, and the agent observes "
            f"{env.config.observation!r}: give an agent that sees pixels"
        )


def _step_table(env: Env, share: float) -> np.ndarray:
    """What each action adds to the targets, `[A, nu] float32`."""
    arm, config = env.arm, env.config
    table = np.zeros((arm.num_actions, len(arm.home_ctrl)), np.float32)
    for joint, index in enumerate(arm.ctrl):
        hinge = np.deg2rad(config.degrees_per_action)
        step = config.millimetres_per_action / 1000.0 if arm.slides[joint] else hinge
        table[2 * joint, index] = -share * step
        table[2 * joint + 1, index] = share * step
    return table
