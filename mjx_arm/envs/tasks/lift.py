"""The task of James & Johns 2016: grasp the cube and lift it by 30 cm."""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation
from pydantic import Field

from mjx_arm.envs.arm import Arm
from mjx_arm.envs.collision import Obstacle
from mjx_arm.envs.state import EnvState, Snapshot
from mjx_arm.envs.tasks.base import Reward, TaskConfig, rectangle
from mjx_arm.envs.tasks.rest import check_rests
from mjx_arm.kinematics import Poses, make_kinematics
from mjx_arm.options import Positive, Share, options
from mjx_arm.scene import Scene
from mjx_arm.varies import Params, Varies

_CUBE = "cube"
_SQUEEZE = 0.0005
# Contacts are soft, so a pressing pad is slightly inside the cube; this much is rounding, m.
_TOUCH = 1e-5
# How far a pad may be from where its finger's joint says, m.
_PAD_OFF = 1e-3


@options
class LiftConfig(TaskConfig):
    """Options of the task `lift`. Where the paper names no unit, the unit is our choice.

    The reward `paper` is Algorithm 1 of James & Johns 2016: `success_reward` once, else
    `1 + height` while grasped, else `exp(-0.25 * distance)`. The reward `completion` keeps that
    shape, but bounds what a step without success can pay, so that finishing is worth more than
    holding the cube just below the goal: at discount 0.99 the paper's reward pays 130 for holding
    it there for ever, and 100 for success. The reward `shaped` is `completion` with potential-based
    shaping (Ng, Harada & Russell 1999): it also pays what a step adds to the potential, which is
    what `completion` would pay for staying there for ever. The best policy is the same, but a step
    pays at once what it is worth later. The Q-values are lower by the potential.

    Attributes:
      lift: height that the cube must be lifted to, above its rest, m.
      start: `home`, or `in_grasp` with the cube in the closed gripper.
      in_grasp_share: share of the episodes that start with the cube in the closed gripper, if
        `start` is `home`. The arm starts where it would without the cube. A curriculum: the learner
        finds out what a lift pays before it can grasp.
      rectangle_scale: factor on the edges of the rectangle in which the cube's places are sampled.
        An agent that trains with more than 1 has seen the places to which a cube is knocked.
      success_reward: paid once, on success.
      distance_decay: per `distance_unit`, reward `paper`; the paper's 0.25.
      distance_unit: m; the paper names none, ours is a decimetre.
      height_unit: m; the unit of the cube's height in the paper's `1 + height`.
      completion_decay: per `distance_unit`, reward `completion`.
      completion_reach: most that a step without a grasp pays, reward `completion`.
      completion_grasp: paid for a grasp at height 0, reward `completion`.
      completion_lift: most that is paid on top for the height, with its square root. In proportion
        to the height, the first step of a lift would change the Q-value by only 2 %, and would not
        be learnt.
      shaping_discount: discount of the potential, reward `shaped`. Give the learner's `gamma`: with
        another one the best policy may differ.
    """

    lift: Positive = 0.3
    start: Literal["home", "in_grasp"] = "home"
    in_grasp_share: Share = 0.0
    rectangle_scale: Positive = 1.0
    success_reward: float = 100.0
    distance_decay: Positive = 0.25
    distance_unit: Positive = 0.1
    height_unit: Positive = 1.0
    completion_decay: Positive = 1.0
    completion_reach: float = 0.2
    completion_grasp: float = 0.25
    completion_lift: float = 0.5
    shaping_discount: Annotated[float, Field(ge=0, lt=1)] = 0.99

    def check(self) -> None:
        """Rejects a share of starts in the grasp where all of them are."""
        if self.start == "in_grasp" and self.in_grasp_share > 0.0:
            raise ValueError(
                f"in_grasp_share must be 0 with start 'in_grasp', got {self.in_grasp_share}: "
                "every episode starts with the cube in the gripper"
            )


class Lift:
    """Grasp the cube and lift it.

    The scene needs a cube: a box `cube` of equal edges on a free joint `cube`, which lies on the
    ground in the keyframe `home`; fingers on slides whose position is the distance of their pads
    from the grasp site; the pads, spheres `left_pad_0`, ... and `right_pad_0`, ... on the fingers;
    and a numeric `cube_rectangle`: centre x, y and half extents x, y of the cube's places, m.

    It measures `grasped` and `success` (bool), `height` of the cube above its rest and `distance`
    between the grasp site and the cube's centre (m).

    Raises:
      ValueError: the scene lacks one of these, or it is of another kind.
    """

    def __init__(self, config: LiftConfig, scene: Scene, arm: Arm):
        model = scene.mj_model
        self.config, self.arm = config, arm
        self._model = model
        self.cube_geom = scene.find("geom", _CUBE)
        self.cube_qpos = int(model.jnt_qposadr[scene.find("joint", _CUBE)])
        self.pad_geoms = _find_pads(scene)
        self.half_size = _check_cube(scene, self.cube_geom, arm)
        _check_fingers(scene, arm, self.pad_geoms)
        # Half the cube's edge in this episode, m.
        self._half: float | jax.Array = self.half_size
        self._centre, extent = rectangle(scene, "cube_rectangle")
        self._extent = extent * np.float32(config.rectangle_scale)
        self._home = arm.home_qpos[self.cube_qpos : self.cube_qpos + 2]
        self._kinematics = make_kinematics(model)
        self.varies: Varies = {}
        self.rewards: Mapping[str, Reward] = {
            "paper": functools.partial(paper_reward, config, self.cube_geom),
            "completion": functools.partial(completion_reward, config),
            "shaped": functools.partial(shaped_reward, config),
        }
        self.feature_scales = (*[5.0] * 3, *[1.0] * 4, *[10.0] * 3)

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The cube by its bounding sphere; none where it starts in the gripper."""
        if self.config.start == "in_grasp":
            return ()
        return (Obstacle(self.cube_geom, self.half_size * float(np.sqrt(3))),)

    def with_params(self, varies: Varies, params: Params) -> Lift:
        """The same task with the cube's size in an episode, where that varies."""
        rows = varies.get("geom_size", ())
        if self.cube_geom not in rows:
            return self
        task = copy.copy(self)
        task._half = params["geom_size"][rows.index(self.cube_geom), 0]
        return task

    def fixed_placement(self) -> jax.Array:
        """The cube's place in the keyframe `home`, `[2] float32`, m."""
        return jnp.asarray(self._home)

    def sample_placement(self, key: jax.Array) -> jax.Array:
        """A place for the cube, uniform in its rectangle, `[2] float32`, m. Consumes the key."""
        low, high = self._centre - self._extent, self._centre + self._extent
        return jax.random.uniform(key, (2,), jnp.float32, jnp.asarray(low), jnp.asarray(high))

    def start(
        self, qpos: jax.Array, ctrl: jax.Array, placement: jax.Array
    ) -> tuple[jax.Array, jax.Array, Params]:
        """Puts the cube on its place, or into the gripper, which is closed then."""
        if self.config.start == "in_grasp":
            return *self._grasp(qpos, ctrl), {}
        qpos = qpos.at[self.cube_qpos : self.cube_qpos + 2].set(placement)
        if isinstance(self._half, jax.Array):
            # A larger cube lies higher, by the difference of the half edges.
            qpos = qpos.at[self.cube_qpos + 2].add(self._half - self.half_size)
        return qpos, ctrl, {}

    def ease(self, key: jax.Array, qpos: jax.Array, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Puts the cube into the gripper in some episodes; see `LiftConfig.in_grasp_share`."""
        if self.config.in_grasp_share == 0.0:
            return qpos, ctrl
        eased = jax.random.bernoulli(key, self.config.in_grasp_share)
        grasping = self._grasp(qpos, ctrl)
        return jnp.where(eased, grasping[0], qpos), jnp.where(eased, grasping[1], ctrl)

    def _grasp(self, qpos: jax.Array, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
        arm, cube = self.arm, slice(self.cube_qpos, self.cube_qpos + 7)
        qpos = qpos.at[arm.finger_qpos].set(_f32(self._half - _SQUEEZE))
        ctrl = ctrl.at[arm.gripper_ctrl].set(arm.ctrl_range[arm.gripper_ctrl, 0])
        poses = self._kinematics(qpos)
        # The pads have no rotation of their own, so theirs is the finger's; see `_check_fingers`.
        gripper = Rotation.from_matrix(poses.geom_xmat[self.pad_geoms[0, 0]])
        pose = [poses.site_xpos[arm.grasp_site], gripper.as_quat(scalar_first=True)]
        return qpos.at[cube].set(jnp.concatenate(pose)), ctrl

    def accepts(self, poses: Poses, placement: jax.Array) -> jax.Array:
        """Every start with a free arm fits."""
        del poses, placement
        return jnp.ones((), jnp.bool_)

    def measure(self, state: EnvState) -> dict[str, jax.Array]:
        """`grasped`, `height`, `distance` and `success` of a state; see the class."""
        poses = state.physics.poses
        cube = poses.geom_xpos[self.cube_geom]
        offset = poses.site_xpos[self.arm.grasp_site] - cube
        height = cube[2] - _f32(self._half)
        is_grasped = grasped(self, poses, state.ctrl) & ~state.physics.diverged
        return {
            "grasped": is_grasped,
            "height": height,
            "distance": jnp.sqrt(jnp.sum(jnp.square(offset))),
            "success": is_grasped & (height >= self.config.lift),
        }

    def features(self, state: EnvState) -> jax.Array:
        """The cube's position (m) and quaternion, and the way to it from the grasp site (m)."""
        cube = state.physics.qpos[self.cube_qpos : self.cube_qpos + 7]
        site = state.physics.poses.site_xpos[self.arm.grasp_site]
        return jnp.concatenate([cube, cube[:3] - site])


def grasped(task: Lift, poses: Poses, ctrl: jax.Array) -> jax.Array:
    """Whether the gripper, commanded to close, holds the cube between its fingers.

    True where a pad of each finger touches the cube and the two touched faces are opposite ones.
    A pure function of the state; the tests compare it with the contact forces.

    Args:
      task: with the ids of pads and cube.
      poses: of the geoms.
      ctrl: `[nu] float32`.

    Returns:
      `[] bool`.
    """
    radius = task._model.geom_size[task.pad_geoms, 0].astype(np.float32)
    half = _f32(task._half)
    offset = poses.geom_xpos[task.pad_geoms] - poses.geom_xpos[task.cube_geom]
    rotation = poses.geom_xmat[task.cube_geom]
    local = jnp.sum(offset[..., :, None] * rotation, axis=-2)
    beyond = jnp.abs(local) - half
    outside = jnp.sqrt(jnp.sum(jnp.square(jnp.maximum(beyond, 0.0)), axis=-1))
    distance = outside + jnp.minimum(jnp.max(beyond, axis=-1), 0.0) - radius
    touching = distance < _TOUCH
    # [finger, pad, face]: which of the six faces a touching pad is on.
    axis = jax.nn.one_hot(jnp.argmax(beyond, axis=-1), 3, dtype=jnp.bool_) & touching[..., None]
    positive = jnp.any(axis & (local > 0), axis=1)
    negative = jnp.any(axis & (local < 0), axis=1)
    opposed = (positive[0] & negative[1]) | (negative[0] & positive[1])
    closing = ctrl[task.arm.gripper_ctrl] < half
    return closing & jnp.any(opposed)


def paper_reward(
    config: LiftConfig, cube_geom: int, before: Snapshot, after: Snapshot, action: jax.Array
) -> dict[str, jax.Array]:
    """Algorithm 1 of James & Johns 2016; see `LiftConfig`. Its height is the cube's centre's."""
    del before, action
    return paper_terms(config, after, after.state.physics.poses.geom_xpos[cube_geom, 2])


def paper_terms(config: LiftConfig, after: Snapshot, height: jax.Array) -> dict[str, jax.Array]:
    """The terms of `paper_reward`, each `[] float32`.

    Args:
      config: of the task.
      after: the situation after the step.
      height: of the cube's centre above the ground, `[] float32`, m.
    """
    distance = after.measured["distance"] / config.distance_unit
    return _terms(
        config,
        after,
        reach=jnp.exp(-config.distance_decay * distance),
        grasp=jnp.ones_like(height),
        lift=height / config.height_unit,
    )


def completion_reward(
    config: LiftConfig, before: Snapshot, after: Snapshot, action: jax.Array
) -> dict[str, jax.Array]:
    """The paper's reward, bounded so that success is worth more than waiting; see `LiftConfig`."""
    del before, action
    height = after.measured["height"]
    distance = after.measured["distance"] / config.distance_unit
    share = jnp.clip(height / config.lift, 0.0, 1.0)
    return _terms(
        config,
        after,
        reach=config.completion_reach * jnp.exp(-config.completion_decay * distance),
        grasp=jnp.full_like(height, config.completion_grasp),
        lift=config.completion_lift * jnp.sqrt(share),
    )


def shaped_reward(
    config: LiftConfig, before: Snapshot, after: Snapshot, action: jax.Array
) -> dict[str, jax.Array]:
    """The terms of `completion` with potential-based shaping, each `[] float32`; see `LiftConfig`.

    With the discount g, the potential `completion / (1 - g)`, and the rewards r after the step and
    r' before it, this is r + g r / (1 - g) - r' / (1 - g) = (r - r') / (1 - g). After a success
    there is no potential.
    """
    was = completion_reward(config, before, before, action)
    now = completion_reward(config, before, after, action)
    horizon = np.float32(1.0 / (1.0 - config.shaping_discount))
    gains = {name: horizon * (now[name] - was[name]) for name in now}
    return gains | {"success": now["success"]}


def _terms(
    config: LiftConfig, after: Snapshot, *, reach: jax.Array, grasp: jax.Array, lift: jax.Array
) -> dict[str, jax.Array]:
    """`reach` without a grasp, `grasp` and `lift` with one, and on success `success` alone."""
    is_grasped, success = after.measured["grasped"], after.measured["success"]
    zero = jnp.zeros_like(reach)
    in_grasp = is_grasped & ~success
    return {
        "reach": jnp.where(is_grasped | success, zero, reach),
        "grasp": jnp.where(in_grasp, grasp, zero),
        "lift": jnp.where(in_grasp, lift, zero),
        "success": jnp.where(success, jnp.full_like(zero, config.success_reward), zero),
    }


def _f32(value: float | jax.Array) -> np.float32 | jax.Array:
    return value if isinstance(value, jax.Array) else np.float32(value)


def _find_pads(scene: Scene) -> np.ndarray:
    """Geom ids of the pads of the left and of the right finger, `[2, P] int`."""
    model = scene.mj_model
    names = [model.geom(i).name for i in range(model.ngeom)]
    counts = [sum(name.startswith(f"{side}_pad_") for name in names) for side in ("left", "right")]
    if counts[0] == 0 or counts[0] != counts[1]:
        raise ValueError(
            f"scene {scene.name!r} has {counts[0]} geoms 'left_pad_...' and {counts[1]} geoms "
            "'right_pad_...'; the task needs an equal number of both, at least one"
        )
    pads = np.asarray(
        [
            [scene.find("geom", f"{side}_pad_{i}") for i in range(counts[0])]
            for side in ("left", "right")
        ]
    )
    for pad in pads.ravel().tolist():
        if model.geom_type[pad] != mujoco.mjtGeom.mjGEOM_SPHERE:
            raise ValueError(f"scene {scene.name!r}: geom {names[pad]!r} must be a sphere")
    return pads


def _check_fingers(scene: Scene, arm: Arm, pads: np.ndarray) -> None:
    """Rejects fingers whose joints do not say how far their pads are from the grasp site."""
    model, name = scene.mj_model, scene.name
    joints = [int(np.flatnonzero(model.jnt_qposadr == place)[0]) for place in arm.finger_qpos]
    data = mujoco.MjData(model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_kinematics(model, data)
    for joint, own in zip(joints, pads.tolist(), strict=True):
        finger = model.joint(joint).name
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_SLIDE:
            raise ValueError(
                f"scene {name!r}: joint {finger!r} must be a slide, whose position is how far its "
                "pads are from the site 'grasp', m"
            )
        if np.abs(model.jnt_axis[joint]).max() < 1 - 1e-6:
            raise ValueError(
                f"scene {name!r}: joint {finger!r} must slide along x, y or z of its body"
            )
        for pad in own:
            geom = f"scene {name!r}: geom {model.geom(pad).name!r}"
            if model.geom_bodyid[pad] != model.jnt_bodyid[joint]:
                raise ValueError(f"{geom} must be on the body of joint {finger!r}")
            if abs(model.geom_quat[pad][0]) < 1 - 1e-9:
                raise ValueError(f"{geom} must have no rotation of its own")
            offset = data.geom_xpos[pad] - data.site_xpos[arm.grasp_site]
            inner = offset @ data.xaxis[joint] - model.geom_size[pad, 0]
            position = arm.home_qpos[model.jnt_qposadr[joint]]
            if abs(inner - position) > _PAD_OFF:
                raise ValueError(
                    f"{geom} must be as far from the site 'grasp' as joint {finger!r} says: at "
                    f"home {position:.4f} m along its axis, got {inner:.4f} m"
                )


def _check_cube(scene: Scene, geom: int, arm: Arm) -> float:
    """Half the edge of the cube, m; rejects anything but a level cube on the ground."""
    model, name = scene.mj_model, scene.name
    joint = scene.find("joint", _CUBE)
    size = model.geom_size[geom]
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_BOX or np.ptp(size) > 1e-6:
        raise ValueError(f"scene {name!r}: geom 'cube' must be a box of three equal edges")
    if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(f"scene {name!r}: joint 'cube' must be a free joint")
    if model.jnt_bodyid[joint] != model.geom_bodyid[geom]:
        raise ValueError(f"scene {name!r}: joint 'cube' must move the body of geom 'cube'")
    if model.geom_pos[geom].any() or abs(model.geom_quat[geom][0]) < 1 - 1e-9:
        raise ValueError(f"scene {name!r}: geom 'cube' must be at the origin of its body")
    half = float(size[0])
    start = int(model.jnt_qposadr[joint])
    rest, turn = arm.home_qpos[start + 2], arm.home_qpos[start + 3 : start + 7]
    if abs(rest - half) > 1e-3:
        raise ValueError(
            f"scene {name!r}: in the keyframe 'home' the cube must lie on the ground at height 0, "
            f"its centre {half} m above it, got {rest}"
        )
    if np.abs(turn[1:3]).max() > 1e-3:
        raise ValueError(
            f"scene {name!r}: in the keyframe 'home' the cube must be level, turned about the "
            f"vertical only, got the quaternion {turn.tolist()}"
        )
    check_rests(scene, arm, start + 2, "cube")
    low, high = arm.ctrl_range[arm.gripper_ctrl]
    if not low < half < high:
        raise ValueError(
            f"scene {name!r}: the range of the actuator 'gripper', {low} to {high} m, must "
            f"contain half the cube's edge, {half} m"
        )
    return half
