"""An agent in the simulator and in the stand-in for reality: the paper's questions.

James & Johns 2016, section 5: the trained network moved the real arm to the cube, but hardly ever
closed the gripper; with the cube in its grasp from the start it lifted it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjx_arm.algos.exploration import check_epsilon, epsilon_greedy
from mjx_arm.envs.env import Env, make_env
from mjx_arm.envs.randomisation import RandomisationConfig
from mjx_arm.export import export_policy
from mjx_arm.options import Count, check_value
from mjx_arm.physics import compiler_options
from mjx_arm.report.video import write_video
from mjx_arm.standin.episodes import Film, Job, Moment, Start, Trace, run_episodes
from mjx_arm.standin.levels import Offsets
from mjx_arm.standin.world import Cameras, StandIn, check_env
from mjx_arm.training.agent import Agent
from mjx_arm.training.evaluate import wilson_interval
from mjx_arm.training.loop import EVALUATION, role_key

ITERATIONS = 400
# The gripper is at the cube if its grasp site is within this distance of the cube's centre, m.
NEAR_CUBE = 0.03
# A cube that is lost below this height was not lifted, m.
_LIFTED = 0.01
# Of each half of a video, pixels.
_EDGE = 384
_FONT_SIZE = 15


@dataclasses.dataclass(frozen=True)
class Outcomes:
    """Summary of a number of episodes. Shares are from 0 to 1.

    Attributes:
      episodes: number of episodes.
      successes: those that ended in success.
      rate: their share.
      ci95: Wilson's 95 % interval of the share.
      reached: share of the episodes in which the gripper came within 3 cm of the cube, or grasped
        it: a cube that is grasped off its middle is up to that far away.
      close_rate: of the iterations with the open gripper within 3 cm of the cube, the share in
        which it was closed; None where there were none.
      closed: share of the episodes that reached the cube with the gripper open, in which it was
        closed there at least once; None where there were none.
      close_distance: median distance between the grasp site and the cube's centre, m, where the
        gripper closed and then grasped the cube; None where it never did. An agent that closes
        further out than 3 cm can succeed with a `close_rate` of 0.
      grasped: share of the episodes in which the cube was grasped at some time.
      dropped: share of the episodes in which the cube was lost at a height of 1 cm or more.
      mean_length: iterations of an episode, failures included.
    """

    episodes: int
    successes: int
    rate: float
    ci95: tuple[float, float]
    reached: float
    close_rate: float | None
    closed: float | None
    close_distance: float | None
    grasped: float
    dropped: float
    mean_length: float


def summarise(traces: Sequence[Trace], env: Env) -> Outcomes:
    """Summarises episodes, with the same measures for simulator and stand-in.

    Args:
      traces: at least one.
      env: the environment of the actions.
    """
    is_open = [_is_open(trace, env) for trace in traces]
    near = [x & (t.distance[:-1] <= NEAR_CUBE) for x, t in zip(is_open, traces, strict=True)]
    closes = [x & (t.action == env.arm.close_action) for x, t in zip(near, traces, strict=True)]
    close_distance = [
        float(t.distance[i]) for x, t in zip(is_open, traces, strict=True) for i in _grasps(x, t)
    ]
    open_there = sum(int(x.sum()) for x in near)
    reached_open = sum(bool(x.any()) for x in near)
    episodes, successes = len(traces), sum(trace.success for trace in traces)

    def share(happened: Callable[[Trace], Any]) -> float:
        return float(np.mean([bool(happened(trace)) for trace in traces]))

    return Outcomes(
        episodes=episodes,
        successes=successes,
        rate=successes / episodes,
        ci95=wilson_interval(successes, episodes),
        reached=share(lambda t: ((t.distance <= NEAR_CUBE) | t.grasped).any()),
        close_rate=sum(int(x.sum()) for x in closes) / open_there if open_there else None,
        closed=sum(bool(x.any()) for x in closes) / reached_open if reached_open else None,
        close_distance=float(np.median(close_distance)) if close_distance else None,
        grasped=share(lambda t: t.grasped.any()),
        dropped=share(_dropped),
        mean_length=float(np.mean([len(trace.action) for trace in traces])),
    )


def _is_open(trace: Trace, env: Env) -> np.ndarray:
    """Iterations that begin with the open gripper, `[L] bool`.

    The gripper is open at the start unless the cube is grasped there; see `LiftConfig.start`.
    """
    arm, is_open = env.arm, not trace.grasped[0]
    opened = np.zeros(len(trace.action), bool)
    for i, action in enumerate(trace.action):
        opened[i] = is_open
        is_open = (is_open or action == arm.open_action) and action != arm.close_action
    return opened


def _grasps(is_open: np.ndarray, trace: Trace) -> list[int]:
    """Numbers of the iterations that closed the gripper and led to a grasp before it opened.

    Args:
      is_open: of `_is_open`, `[L] bool`.
      trace: of the same episode.
    """
    grasps = []
    for i in np.nonzero(is_open[:-1] & ~is_open[1:])[0]:
        opened = np.nonzero(is_open[i + 1 :])[0]
        end = i + 1 + opened[0] if len(opened) else len(trace.grasped)
        if trace.grasped[i + 1 : end].any():
            grasps.append(int(i))
    return grasps


def _dropped(trace: Trace) -> bool:
    lost = trace.grasped[:-1] & ~trace.grasped[1:]
    return bool((lost & (trace.height[:-1] >= _LIFTED)).any())


def without_randomisation(env: Env) -> Env:
    """The same environment in which nothing varies but what its task varies."""
    if not env.randomiser:
        return env
    config = dataclasses.replace(env.config, randomise=RandomisationConfig())
    return make_env(config, reward=env.reward, scene=env.scene)


def start_keys(seed: int, episodes: int) -> jax.Array:
    """Keys `[episodes]` of starts that neither training nor the selection of an agent has seen."""
    start_key, _ = jax.random.split(role_key(seed, EVALUATION))
    return jax.random.split(start_key, episodes)


def sample_starts(env: Env, seed: int, episodes: int) -> list[Start]:
    """Starts that neither training nor the selection of an agent has seen.

    They are those of the environment without randomisation: the stand-in's cube has the size that
    the scene says.

    Args:
      env: the environment.
      seed: of the starts.
      episodes: number of starts.
    """
    qpos, ctrl = jax.device_get(_starter(env)(start_keys(seed, episodes)))
    return [Start(*each) for each in zip(qpos, ctrl, strict=True)]


@functools.lru_cache(maxsize=4)
def _starter(env: Env) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """`keys [N] -> qpos [N, nq], ctrl [N, nu]` of starts, compiled once for an environment."""
    env = without_randomisation(env)

    def start(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        _, state = env.reset(key)
        return state.physics.qpos, state.ctrl

    return jax.jit(jax.vmap(start))


def in_standin(
    agent: Agent,
    offsets: Offsets,
    starts: Sequence[Start],
    *,
    epsilon: float = 0.1,
    iterations: int = ITERATIONS,
    seed: int = 0,
    shadows: bool = True,
    processes: int | None = None,
    video: pathlib.Path | None = None,
    on_episode: Callable[[Trace], None] | None = None,
) -> list[Trace]:
    """Runs an agent in the stand-in from each start; see `run_episodes`.

    Args:
      agent: that sees pixels.
      offsets: of the level.
      starts: of the episodes.
      epsilon: share of random actions.
      iterations: an episode without success ends after this number.
      seed: of the random actions.
      shadows: render shadows.
      processes: see `run_episodes`.
      video: file for a video of the first episode, which ends in `.mp4` or `.gif`.
      on_episode: see `run_episodes`.

    Raises:
      ValueError: an invalid argument, or see `run_episodes`.
    """
    check_epsilon(epsilon)
    check_value("iterations", Count, iterations)
    check_env(agent.env)
    job = Job(agent.env, offsets, export_policy(agent), iterations, epsilon, seed, shadows)
    film: Film | None = None if video is None else VideoFilm(video)
    return run_episodes(job, starts, processes=processes, film=film, on_episode=on_episode)


def in_simulation(
    agent: Agent, seed: int, episodes: int, *, epsilon: float = 0.1, iterations: int = ITERATIONS
) -> list[Trace]:
    """Runs an agent in its simulator, from the starts that `sample_starts` gives for the seed.

    An agent that was trained with randomisation is tried with it. Where the cube's size varies, the
    starts differ by what that changes: the height of the cube, or how far the gripper is closed.

    Args:
      agent: with the task `lift`.
      seed: of the starts and of the random actions.
      episodes: number of episodes, which run side by side.
      epsilon: share of random actions.
      iterations: an episode without success ends after this number.

    Raises:
      ValueError: an invalid argument.
    """
    check_epsilon(epsilon)
    check_value("iterations", Count, iterations)
    check_value("episodes", Count, episodes)
    check_env(agent.env)
    env = agent.env
    run = jax.jit(
        lambda params, key: _simulate(agent, params, key, episodes, epsilon, iterations),
        compiler_options=compiler_options(env.physics),
    )
    before, last, actions, ended, success = jax.device_get(
        run(agent.params, role_key(seed, EVALUATION))
    )
    return [_trace(i, before, last, actions, ended, success) for i in range(episodes)]


def _simulate(
    agent: Agent, params: Any, key: jax.Array, episodes: int, epsilon: float, iterations: int
) -> tuple[Any, ...]:
    """States `[T, N]`, the last ones `[N]`, and actions, ends and successes `[T, N]`."""
    env = agent.env

    def measure(states: Any) -> dict[str, jax.Array]:
        measured = jax.vmap(env.task.measure)(states)
        return {name: measured[name] for name in ("distance", "height", "grasped")}

    def step(states: Any, key: jax.Array) -> tuple[Any, tuple[Any, ...]]:
        obs: Any = jax.vmap(env.observe)(states)
        q = agent.apply(params, obs)
        action = epsilon_greedy(key, q, jnp.float32(epsilon))
        after, transition = jax.vmap(env.transition)(states, action)
        ended = transition.terminated | transition.truncated
        return after, (measure(states), action, ended, transition.terminated)

    start_key, act_key = jax.random.split(key)
    states = jax.vmap(lambda key: env.reset(key)[1])(jax.random.split(start_key, episodes))
    keys = jax.random.split(act_key, iterations)
    last, (before, actions, ended, success) = jax.lax.scan(step, states, keys)
    return before, measure(last), actions, ended, success


def _trace(
    i: int, before: Any, last: Any, actions: np.ndarray, ended: np.ndarray, success: np.ndarray
) -> Trace:
    """The episode of environment `i`, cut where it ended."""
    ends = np.flatnonzero(ended[:, i])
    length = int(ends[0]) + 1 if len(ends) else len(actions)
    states = {name: np.append(before[name][:, i], last[name][i]) for name in before}
    return Trace(
        distance=states["distance"][: length + 1].astype(np.float64),
        height=states["height"][: length + 1].astype(np.float64),
        grasped=states["grasped"][: length + 1].astype(bool),
        action=actions[:length, i].astype(np.int64),
        success=bool(success[length - 1, i]),
    )


@dataclasses.dataclass(frozen=True)
class VideoFilm:
    """Writes an episode as a video: the stand-in from its camera, and what the agent sees.

    Attributes:
      path: of the video, which ends in `.mp4` or `.gif`.
    """

    path: pathlib.Path

    def __call__(self, world: StandIn, moments: Sequence[Moment], trace: Trace) -> None:
        """Renders the frames and writes the video."""
        write_video(self.path, self._frames(world, moments, trace))

    def _frames(
        self, world: StandIn, moments: Sequence[Moment], trace: Trace
    ) -> Iterator[np.ndarray]:
        rows, columns = (np.arange(_EDGE) * edge // _EDGE for edge in world.env.config.size)
        names, size = world.env.config.cameras[:1], (_EDGE, _EDGE)
        with contextlib.closing(Cameras(world.model, names, size, scale=1)) as camera:
            for step, moment in enumerate(moments):
                world.data.qpos[:] = moment.qpos
                world.update()
                seen = moment.image if moment.image.ndim == 3 else moment.image[0]
                frame = np.concatenate([camera.image(world.data), seen[rows][:, columns]], axis=1)
                status = f"step {step}   max Q {moment.max_q:.2f}"
                if step == len(moments) - 1:
                    status += "   success" if trace.success else "   failed"
                yield _label(frame, world.env.config.size, status)


def _label(frame: np.ndarray, size: tuple[int, int], status: str) -> np.ndarray:
    image = Image.fromarray(frame)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(_FONT_SIZE)
    labels = (
        ((6, 4), "stand-in for reality"),
        ((_EDGE + 6, 4), f"what the agent sees, {size[1]} by {size[0]} pixels"),
        ((6, _EDGE - _FONT_SIZE - 8), status),
    )
    for place, text in labels:
        draw.text(place, text, fill="white", stroke_width=2, stroke_fill="black", font=font)
    return np.asarray(image)
