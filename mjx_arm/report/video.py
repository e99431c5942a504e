"""A video of a policy: the scene drawn large, and beside it what the agent sees."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.dqn import check_epsilon, epsilon_greedy
from mjx_arm.env import Env
from mjx_arm.physics import compiler_options
from mjx_arm.render import make_renderer, rgb

_EDGE = 384
_FRAMES_PER_SECOND = 30
# Frames drawn in one call.
_AT_ONCE = 50


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
    """Runs an epsilon-greedy policy for one episode.

    Raises:
      ValueError: `epsilon` outside 0 to 1.
    """
    check_epsilon(epsilon)

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


def draw_episode(env: Env, episode: Episode) -> Iterator[np.ndarray]:
    """Draws an episode: the scene with shadows, and the agent's own image, side by side.

    Yields:
      Each of its frames, `[384, 768, 3] uint8`; drawn some at a time, for 1,000 are a gigabyte.
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

    draw_some = jax.jit(lambda q: jax.lax.map(draw, q))
    rows, columns = (np.arange(_EDGE) * edge // _EDGE for edge in config.size)
    for start in range(0, len(episode.qpos), _AT_ONCE):
        qpos = episode.qpos[start : start + _AT_ONCE]
        # Of one length, or the last ones would compile again.
        padded = np.concatenate([qpos, np.repeat(qpos[-1:], _AT_ONCE - len(qpos), axis=0)])
        scenes, views = jax.device_get(draw_some(padded))
        for scene, view in zip(scenes[: len(qpos)], views, strict=False):
            yield np.concatenate([scene, view[rows][:, columns]], axis=1)


def check_video_path(path: pathlib.Path) -> None:
    """Refuses a path that `write_video` could not write to.

    Raises:
      ValueError: its ending is neither `.mp4` nor `.gif`, or its folder is not there.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"{path} ends in {path.suffix!r}: give a path ending in .mp4 or .gif")
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ValueError(f"{path} cannot be written: give a file in a folder that exists")


def write_video(path: pathlib.Path, frames: Iterable[np.ndarray]) -> None:
    """Writes frames `[H, W, 3] uint8` as MP4 or GIF, by the ending of `path`: whole, or not at all.

    Raises:
      ValueError: another ending, or it could not be written.
    """
    check_video_path(path)
    # Without it the encoder is forked from a process full of threads, which may deadlock.
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    import imageio.v2 as imageio

    options: dict[str, Any] = {"fps": _FRAMES_PER_SECOND, "macro_block_size": 16}
    if path.suffix == ".gif":
        options = {"duration": 1000 / _FRAMES_PER_SECOND, "loop": 0}
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        writer: Any
        with imageio.get_writer(part, **options) as writer:
            for frame in frames:
                writer.append_data(frame)
        part.replace(path)
    except OSError as error:
        # What imageio says of its encoder goes on for many lines.
        reason = str(error.strerror or error).splitlines()[0]
        raise ValueError(f"{path} could not be written: {reason}") from error
    finally:
        part.unlink(missing_ok=True)
