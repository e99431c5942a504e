"""A video of a policy: the scene drawn large, and beside it what the agent sees."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.dqn import epsilon_greedy
from mjx_arm.env import Env
from mjx_arm.physics import compiler_options
from mjx_arm.render import make_renderer, rgb

_EDGE = 384
_FRAMES_PER_SECOND = 30


@dataclasses.dataclass(frozen=True)
class Episode:
    """One recorded episode of length `L`.

    Attributes:
      qpos: `[L, nq] float32`, before each step and after the last.
      success: it ended with the cube lifted.
    """

    qpos: np.ndarray
    success: bool


def record_episode(
    env: Env,
    apply: Callable[[Any, jax.Array], jax.Array],
    params: Any,
    *,
    epsilon: float,
    seed: int,
) -> Episode:
    """Runs an epsilon-greedy policy for one episode."""

    def step(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], tuple[jax.Array, ...]]:
        state, key, running = carry
        key, act_key = jax.random.split(key)
        obs = jax.tree.map(lambda x: x[None], env.observe(state))
        action = epsilon_greedy(act_key, apply(params, obs), jnp.float32(epsilon))[0]
        after, transition = env.transition(state, action)
        record = (state.physics.qpos, running, running & transition.terminated)
        running &= ~(transition.terminated | transition.truncated)
        return (after, key, running), record

    def run(key: jax.Array) -> tuple[jax.Array, ...]:
        reset_key, key = jax.random.split(key)
        _, state = env.reset(reset_key)
        start = (state, key, jnp.ones((), jnp.bool_))
        (last, _, _), records = jax.lax.scan(step, start, None, length=env.config.max_steps)
        return last.physics.qpos, *records

    compiled = jax.jit(run, compiler_options=compiler_options(env.physics))
    last, qpos, running, success = jax.device_get(compiled(jax.random.key(seed)))
    length = int(running.sum())
    after = qpos[length] if length < len(qpos) else last
    return Episode(qpos=np.concatenate([qpos[:length], after[None]]), success=bool(success.any()))


def draw_episode(env: Env, episode: Episode) -> np.ndarray:
    """Draws an episode: the scene with shadows, and the agent's own image, side by side.

    Returns:
      `[L, 384, 768, 3] uint8`.
    """
    from mjx_arm.kinematics import make_kinematics

    kinematics = make_kinematics(env.scene.mj_model)
    config = env.config
    large = make_renderer(env.scene, camera=config.camera, size=(_EDGE, _EDGE), shadows=True)
    small = make_renderer(env.scene, camera=config.camera, size=config.size, shadows=config.shadows)

    def draw(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        poses = kinematics(qpos)
        pixels = large(poses.geom_xpos, poses.geom_xmat), small(poses.geom_xpos, poses.geom_xmat)
        return rgb(pixels[0]), rgb(pixels[1])

    scene, view = jax.device_get(jax.jit(lambda q: jax.lax.map(draw, q))(episode.qpos))
    rows = np.arange(_EDGE) * view.shape[1] // _EDGE
    columns = np.arange(_EDGE) * view.shape[2] // _EDGE
    return np.concatenate([scene, view[:, rows][:, :, columns]], axis=2)


def write_video(path: pathlib.Path, frames: np.ndarray) -> None:
    """Writes frames `[L, H, W, 3] uint8` as MP4 or GIF, by the ending of `path`.

    Raises:
      ValueError: another ending.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"{path} ends in {path.suffix!r}: give a path ending in .mp4 or .gif")
    # Without it the encoder is forked from a process full of threads, which may deadlock.
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    import imageio.v2 as imageio

    options: dict[str, Any] = {"fps": _FRAMES_PER_SECOND, "macro_block_size": 16}
    if path.suffix == ".gif":
        options = {"duration": 1000 / _FRAMES_PER_SECOND, "loop": 0}
    imageio.mimsave(path, list(frames), **options)
