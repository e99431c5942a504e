"""What the viewer shows, without the viewer: one environment, who acts in it, and hands on it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.envs.env import Env
from mjx_arm.envs.state import EnvState
from mjx_arm.physics import compiler_options
from mjx_arm.render import rgb
from mjx_arm.training.loop import EVALUATION, role_key

Apply = Callable[[Any, jax.Array], jax.Array]

# Who chooses the actions.
ACTORS = ("agent", "random", "nobody")


@flax.struct.dataclass
class Look:
    """What there is to see in a state.

    Attributes:
      image: `[H, W, 3] uint8`, what the cameras see, side by side.
      q: `[A] float32`, Q-values; `[0]` without an agent.
      geom_xpos: `[G, 3] float32`, m.
      geom_xmat: `[G, 3, 3] float32`.
      measured: what the task measures, each `[]`.
    """

    image: jax.Array
    q: jax.Array
    geom_xpos: jax.Array
    geom_xmat: jax.Array
    measured: dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What the last step led to.

    Attributes:
      action: that was carried out.
      terms: of the reward.
      success: it ended the episode in success.
      ended: it ended the episode.
      blocked: the arm would have touched itself, its base or the ground.
    """

    action: int
    terms: dict[str, float]
    success: bool
    ended: bool
    blocked: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Simulation:
    """Compiled functions of one environment.

    Attributes:
      env: the environment.
      has_agent: there are Q-values.
      start: a state from a key.
      advance: `(state, action)` -> the state after, and the transition.
      look: `(params of the network, state)` -> what there is to see.
      put: `(state, qpos [nq] float32)` -> the same state at rest at another `qpos`.
    """

    env: Env
    has_agent: bool
    start: Callable[[jax.Array], EnvState]
    advance: Callable[[EnvState, jax.Array], tuple[EnvState, Any]]
    look: Callable[[Any, EnvState], Look]
    put: Callable[[EnvState, jax.Array], EnvState]


def make_simulation(env: Env, apply: Apply | None = None) -> Simulation:
    """Compiles what the viewer needs; each function compiles when it is first called.

    Args:
      env: with the observation that the network wants.
      apply: `(params, obs [1, ...]) -> Q-values [1, A]`; None without an agent.
    """
    compile_ = functools.partial(jax.jit, compiler_options=compiler_options(env.physics))

    def look(params: Any, state: EnvState) -> Look:
        image = rgb(env.image(state)[0])
        if len(env.cameras) > 1:
            image = jnp.concatenate(list(image), axis=1)
        q = jnp.zeros((0,), jnp.float32)
        if apply is not None:
            obs: Any = env.observe(state)
            q = apply(params, jax.tree.map(lambda x: x[None], obs))[0]
        poses = state.physics.poses
        return Look(image, q, poses.geom_xpos, poses.geom_xmat, env.task.measure(state))

    def put(state: EnvState, qpos: jax.Array) -> EnvState:
        physics = env.physics.init(qpos, state.ctrl, state.params)
        return dataclasses.replace(state, physics=physics)

    return Simulation(
        env=env,
        has_agent=apply is not None,
        start=compile_(lambda key: env.reset(key)[1]),
        advance=compile_(env.transition),
        look=compile_(look),
        put=compile_(put),
    )


class Session:
    """One environment with its agent, and what hands do to it.

    Attributes:
      simulation: its functions.
      params: of the network, or None.
      seed: of the episode.
      actor: who acts, one of `ACTORS`.
      epsilon: share of random actions of the agent.
      state: of the environment.
      seen: what there is to see in it.
      outcome: of the last step, or None at the start of an episode.
    """

    state: EnvState
    seen: Look
    outcome: Outcome | None

    def __init__(
        self, simulation: Simulation, params: Any, *, seed: int = 0, epsilon: float = 0.0
    ) -> None:
        self.simulation, self.params = simulation, params
        self.actor = "agent" if simulation.has_agent else "nobody"
        self.epsilon = epsilon
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Starts the episode of a seed."""
        self.seed, self.outcome = seed, None
        self._random = np.random.default_rng(seed)
        self.state = self.simulation.start(role_key(seed, EVALUATION))
        self._look()

    def set_params(self, params: Any) -> None:
        """Gives the agent other parameters; the episode continues."""
        self.params = params
        self._look()

    @property
    def step_count(self) -> int:
        """Iterations since the start of the episode."""
        return int(self.state.step)

    @property
    def ended(self) -> bool:
        """The episode has ended."""
        return self.outcome is not None and self.outcome.ended

    def choose(self) -> int:
        """The action that whoever acts would choose now."""
        arm = self.simulation.env.arm
        if self.actor == "nobody":
            return self._still()
        if self.actor == "random" or self._random.random() < self.epsilon:
            return int(self._random.integers(arm.num_actions))
        return int(np.argmax(self.seen.q))

    def _still(self) -> int:
        """The action that changes nothing: the gripper's command once more."""
        arm = self.simulation.env.arm
        low, high = arm.ctrl_range[arm.gripper_ctrl]
        is_open = float(self.state.ctrl[arm.gripper_ctrl]) > (low + high) / 2
        return arm.open_action if is_open else arm.close_action

    def step(self, action: int | None = None) -> None:
        """Advances by one iteration, with an action or with what `choose` gives."""
        action = self.choose() if action is None else action
        self.state, transition = self.simulation.advance(self.state, jnp.int32(action))
        made = jax.device_get(transition)
        self.outcome = Outcome(
            action=action,
            terms={
                name.removeprefix("reward_"): float(x)
                for name, x in made.info.items()
                if name.startswith("reward_")
            },
            success=bool(made.terminated),
            ended=bool(made.terminated | made.truncated),
            blocked=bool(made.info["blocked"]),
        )
        self._look()

    @property
    def objects(self) -> list[str]:
        """Names of what can be pushed: bodies on free joints."""
        return list(_free_bodies(self.simulation.env.scene.mj_model))

    def position(self, name: str) -> np.ndarray:
        """Where an object is, `[3] float32`, m."""
        address = _free_bodies(self.simulation.env.scene.mj_model)[name]
        return np.asarray(self.state.physics.qpos[address : address + 3])

    def push(self, name: str, shift: tuple[float, float, float]) -> None:
        """Moves an object by `shift`, m. Arm and objects are at rest afterwards."""
        self.place(name, self.position(name) + np.asarray(shift, np.float32))

    def place(self, name: str, position: np.ndarray) -> None:
        """Puts an object at a position `[3]`, m. Arm and objects are at rest afterwards."""
        address = _free_bodies(self.simulation.env.scene.mj_model)[name]
        qpos = np.array(self.state.physics.qpos)
        qpos[address : address + 3] = position
        self.state = self.simulation.put(self.state, jnp.asarray(qpos))
        self._look()

    def _look(self) -> None:
        self.seen = jax.device_get(self.simulation.look(self.params, self.state))


def _free_bodies(model: mujoco.MjModel) -> dict[str, int]:
    """Names of the bodies on free joints, and where each position is in `qpos`."""
    joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).tolist()
    bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
    names = [model.body(body).name or str(body) for body in bodies]
    return dict(zip(names, model.jnt_qposadr[joints].tolist(), strict=True))


def action_names(env: Env) -> list[str]:
    """What each action does, in words: `waist -`, `waist +`, ..., `open`, `close`."""
    model = env.scene.mj_model
    joints = [model.actuator(int(i)).name or f"joint {k + 1}" for k, i in enumerate(env.arm.ctrl)]
    return [f"{joint} {sign}" for joint in joints for sign in "−+"] + ["open", "close"]


__all__ = [
    "ACTORS",
    "Look",
    "Outcome",
    "Session",
    "Simulation",
    "action_names",
    "make_simulation",
]
