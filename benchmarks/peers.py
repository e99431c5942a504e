"""Our speed beside that of others, in turns within one run, so that ratios hold on a busy machine.

    make peers
    .venv-peers/bin/python benchmarks/peers.py --json benchmarks/results/peers.json

- environment steps: a gymnasium environment with `mujoco.Renderer` at its default and its cheapest
  quality, a bare `mujoco.batch` loop without images, and ours with images
- acting and one update: the same network, batch and threads in PyTorch and in ours
- training: Stable-Baselines3's DQN, with its defaults, on that gymnasium environment and on ours;
  ours at its defaults, and at Stable-Baselines3's own ratio of updates to steps and its own network
"""

from __future__ import annotations

import os

os.environ.setdefault("MUJOCO_GL", "egl")

import argparse
import copy
import gc
import json
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import torch
from machine import machine
from mujoco import batch as mj_batch
from stable_baselines3 import DQN
from torch import nn

import mjx_arm
from mjx_arm.algos.replay import Batch
from mjx_arm.config import TrainConfig, set_train_options, train_config
from mjx_arm.cores import usable_cores
from mjx_arm.interop import ArmCubeEnv
from mjx_arm.physics import compiler_options
from mjx_arm.training.loop import make_body, make_trainer

_NUM_ENVS = 64
_ENV = mjx_arm.make("A", physics="native")
_SCENE, _ARM = _ENV.scene, _ENV.arm
_CUBE = _SCENE.find("geom", "cube")
# Physics substeps in one iteration, as in our environment.
_SUBSTEPS = _SCENE.substeps


class RendererEnv(gymnasium.Env[Any, Any]):
    """The task as one would write it by hand: plain MuJoCo, its renderer, one environment."""

    def __init__(self, cheap: bool, size: int = 64):
        self._model = copy.copy(_SCENE.mj_model)
        if cheap:
            self._model.vis.quality.offsamples = 0
            self._model.vis.quality.shadowsize = 0
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, size, size)
        self._flags = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)
        self._cheap, self._steps = cheap, 0
        self.observation_space = gymnasium.spaces.Box(0, 255, (size, size, 3), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(14)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        """Starts an episode."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:], self._data.ctrl[:] = _ARM.home_qpos, _ARM.home_ctrl
        mujoco.mj_forward(self._model, self._data)
        self._steps = 0
        return self._image(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict]:
        """Advances by one iteration."""
        joint, sign = divmod(int(action), 2)
        if joint < 6:
            self._data.ctrl[_ARM.ctrl[joint]] += np.deg2rad(2 * sign - 1)
        else:
            self._data.ctrl[_ARM.gripper_ctrl] = _ARM.ctrl_range[_ARM.gripper_ctrl, 1 - sign]
        np.clip(self._data.ctrl, *_ARM.ctrl_range.T, out=self._data.ctrl)
        mujoco.mj_step(self._model, self._data, _SUBSTEPS)
        mujoco.mj_forward(self._model, self._data)
        cube = self._data.geom_xpos[_CUBE]
        distance = np.linalg.norm(self._data.site_xpos[_ARM.grasp_site] - cube)
        self._steps += 1
        return self._image(), float(np.exp(-distance)), False, self._steps >= 1000, {}

    def _image(self) -> np.ndarray:
        self._renderer.update_scene(self._data, "front")
        if self._cheap:
            for flag in self._flags:
                self._renderer.scene.flags[flag] = False
        return self._renderer.render()


class TorchNetwork(nn.Module):
    """Our network in PyTorch: three convolutions, max-pooling, a dueling head."""

    def __init__(self, config: TrainConfig):
        super().__init__()
        layers, channels, edge = [], 3, config.env.size[0]
        shapes = zip(
            config.network.widths, config.network.kernels, config.network.strides, strict=True
        )
        for i, (width, kernel, stride) in enumerate(shapes):
            edge = -(-edge // stride)
            total = max((edge - 1) * stride + kernel - edge * stride, 0)
            pad = total // 2, total - total // 2
            layers += [nn.ZeroPad2d(pad * 2), nn.Conv2d(channels, width, kernel, stride), nn.ReLU()]
            if i < 2:
                layers.append(nn.MaxPool2d(2))
                edge //= 2
            channels = width
        self.body = nn.Sequential(
            *layers, nn.Flatten(), nn.LazyLinear(config.network.hidden), nn.ReLU()
        )
        self.value, self.advantage = (
            nn.Linear(config.network.hidden, 1),
            nn.Linear(config.network.hidden, 14),
        )
        with torch.no_grad():
            self(torch.zeros(1, *config.env.size, 3, dtype=torch.uint8))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Q-values `[B, 14]` of images `[B, H, W, 3] uint8`."""
        # Channels last in memory, which is what PyTorch's convolutions on CPU are fastest with.
        x = self.body(images.permute(0, 3, 1, 2).float() / 255 - 0.5)
        advantage = self.advantage(x)
        return self.value(x) + advantage - advantage.mean(-1, keepdim=True)


def count_per_second(run: Callable[[], Any], count: float) -> Callable[[], float]:
    """A function that runs and says how many of `count` things it did a second."""

    def timed() -> float:
        started = time.perf_counter()
        run()
        return count / (time.perf_counter() - started)

    return timed


def renderer_env(cheap: bool) -> Callable[[], float]:
    """Steps a second of the plain environment."""
    env, steps = RendererEnv(cheap), 200 if cheap else 30
    env.reset(seed=0)
    return count_per_second(lambda: [env.step(i % 14) for i in range(steps)], steps)


def bare_batch() -> Callable[[], float]:
    """Environment steps a second of MuJoCo's thread pool alone."""
    batch = mj_batch.Batch(_SCENE.mj_model, _NUM_ENVS, nthread=usable_cores())
    batch.reset()
    batch.bind("qpos")[:] = _ARM.home_qpos
    batch.ctrl[:] = _ARM.home_ctrl
    return count_per_second(
        lambda: [batch.step(nstep=_SUBSTEPS) for _ in range(300)], 300 * _NUM_ENVS
    )


def our_env() -> Callable[[], float]:
    """Environment steps a second of ours, each with its image."""
    env = mjx_arm.make("A", physics="native", observation="packed")
    auto = mjx_arm.AutoReset(env)
    keys = jax.random.split(jax.random.key(0), _NUM_ENVS)
    start = jax.jit(jax.vmap(auto.reset))(keys)

    def run(carry: Any) -> Any:
        def once(carry: Any, key: jax.Array) -> tuple[Any, None]:
            action = jax.random.randint(key, (_NUM_ENVS,), 0, 14)
            state = jax.vmap(auto.transition)(keys, carry[1], action)[0]
            return (jax.vmap(env.observe)(state.env), state), None

        return jax.lax.scan(once, carry, jax.random.split(jax.random.key(1), 200))[0]

    compiled = jax.jit(run, compiler_options=compiler_options(env.physics))
    return count_per_second(lambda: jax.block_until_ready(compiled(start)), 200 * _NUM_ENVS)


def torch_agent(config: TrainConfig) -> tuple[Callable[[], float], Callable[[], float]]:
    """Decisions and updates a second: double DQN, Huber, Adam, clipping, averaged target."""
    online = TorchNetwork(config).to(memory_format=torch.channels_last)
    target = copy.deepcopy(online)
    adam = torch.optim.Adam(online.parameters(), config.algo.learning_rate)
    generator = torch.Generator().manual_seed(0)
    shape = (config.algo.batch_size, *config.env.size, 3)
    obs, next_obs = (
        torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8) for _ in range(2)
    )
    action = torch.randint(0, 14, (config.algo.batch_size, 1), generator=generator)
    reward = torch.zeros(config.algo.batch_size)

    def act() -> None:
        with torch.inference_mode():
            for _ in range(20):
                online(obs).argmax(-1)

    def update() -> None:
        for _ in range(8):
            with torch.no_grad():
                best = online(next_obs).argmax(-1, keepdim=True)
                goal = reward + config.algo.gamma * target(next_obs).gather(1, best)[:, 0]
            loss = nn.functional.smooth_l1_loss(online(obs).gather(1, action)[:, 0], goal)
            adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(online.parameters(), config.algo.max_grad_norm)
            adam.step()
            with torch.no_grad():
                for a, b in zip(target.parameters(), online.parameters(), strict=True):
                    a.lerp_(b, config.algo.polyak)

    act(), update()
    return count_per_second(act, 20 * config.algo.batch_size), count_per_second(update, 8)


def our_agent(config: TrainConfig) -> tuple[Callable[[], float], Callable[[], float]]:
    """The same of ours, on pictures that are there already; 8 updates in a scan, as in training."""
    body = make_body(config)
    key, size = jax.random.key(0), config.algo.batch_size
    obs, next_obs = jax.random.bits(key, (2, size, *config.env.size), jnp.uint32)
    learner = body.algorithm.q_learning.init(key, obs)
    batch = Batch(
        frame=None,
        next_frame=None,
        action=jax.random.randint(key, (size,), 0, 14),
        reward=jnp.zeros(size),
        discount=jnp.full(size, config.algo.gamma),
        weight=jnp.ones(size),
    )

    @jax.jit
    def act(params: Any, obs: jax.Array) -> jax.Array:
        def once(obs: jax.Array, _: None) -> tuple[jax.Array, None]:
            best = jnp.argmax(body.algorithm.apply(params, obs), axis=-1)
            return obs ^ (best > 99).astype(jnp.uint32)[:, None, None], None

        return jax.lax.scan(once, obs, None, length=20)[0]

    @jax.jit
    def update(learner: Any, obs: jax.Array, next_obs: jax.Array) -> Any:
        # The pictures change places, or their patches would be made once for all updates.
        def once(carry: Any, _: None) -> tuple[Any, None]:
            learner, obs, next_obs = carry
            return (
                body.algorithm.q_learning.update(learner, batch, obs, next_obs)[0],
                next_obs,
                obs,
            ), None

        return jax.lax.scan(once, (learner, obs, next_obs), None, length=8)[0]

    return (
        count_per_second(lambda: jax.block_until_ready(act(learner.params, obs)), 20 * size),
        count_per_second(lambda: jax.block_until_ready(update(learner, obs, next_obs)), 8),
    )


def sb3(env: gymnasium.Env, steps: int) -> Callable[[], float]:
    """Stable-Baselines3's DQN with its defaults, but for a replay that fits the memory."""
    agent = DQN("CnnPolicy", env, buffer_size=10_000, learning_starts=20, seed=0)
    agent.learn(40)
    return count_per_second(
        lambda: agent.learn(steps, reset_num_timesteps=False, log_interval=10**9), steps
    )


def our_training(config: TrainConfig) -> Callable[[], float]:
    """Environment steps a second of the whole loop."""
    trainer = make_trainer(config)
    # The carry is donated, so each measurement starts from the state that the one before left.
    state = [trainer.run_chunk(trainer.init(jax.random.key(0)))[0]]

    def run() -> None:
        state[0] = jax.block_until_ready(trainer.run_chunk(state[0])[0])

    run()
    return count_per_second(run, config.chunk_length * config.num_envs)


# Stable-Baselines3's defaults: an update of 32 every 4 steps, the network of Mnih et al. 2015.
_LIKE_SB3 = {
    "num_envs": 4,
    "batch_size": 32,
    "widths": (32, 64, 64),
    "kernels": (8, 4, 3),
    "strides": (4, 2, 1),
    "pool": 1,
    "hidden": 512,
    "dueling": False,
    "double": False,
    "n_step": 1,
    "polyak": 0.0,
    "target_period": 2_500,
    "learning_rate": 1e-4,
    "learning_starts": 100,
    "chunk_steps": 1_024,
}


def make_contestants(names: list[str]) -> dict[str, Callable[[], float]]:
    """What is measured, by name; each call is one measurement."""
    config = train_config(physics="native", learning_starts=1_000, chunk_steps=8_192)
    made: dict[str, Callable[[], float]] = {}
    if "env" in names:
        made["env/gymnasium+Renderer"] = renderer_env(cheap=False)
        made["env/gymnasium+Renderer, cheapest"] = renderer_env(cheap=True)
        made["env/mujoco.batch, no images"] = bare_batch()
        made["env/mjx_arm"] = our_env()
    if "agent" in names:
        made["act/torch"], made["update/torch"] = torch_agent(config)
        made["act/mjx_arm"], made["update/mjx_arm"] = our_agent(config)
    if "train" in names:
        made["train/sb3 on gymnasium+Renderer"] = sb3(RendererEnv(cheap=False), 60)
        made["train/sb3 on gymnasium+Renderer, cheapest"] = sb3(RendererEnv(cheap=True), 200)
        made["train/sb3 on mjx_arm"] = sb3(ArmCubeEnv("A", physics="native"), 200)
        made["train/mjx_arm"] = our_training(config)
        made["train/mjx_arm, sb3's ratio and network"] = our_training(
            set_train_options(config, _LIKE_SB3)
        )
    return made


_RATIOS = (
    ("env/mjx_arm", "env/gymnasium+Renderer, cheapest"),
    ("env/mjx_arm", "env/gymnasium+Renderer"),
    ("act/mjx_arm", "act/torch"),
    ("update/mjx_arm", "update/torch"),
    ("train/mjx_arm", "train/sb3 on gymnasium+Renderer"),
    ("train/mjx_arm", "train/sb3 on gymnasium+Renderer, cheapest"),
    ("train/mjx_arm, sb3's ratio and network", "train/sb3 on mjx_arm"),
)


def main() -> None:
    """Measures in turns, prints rates and ratios and, where asked to, writes them to a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    groups = ("env", "agent", "train")
    parser.add_argument("--groups", nargs="+", choices=groups, default=groups)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=pathlib.Path, help="file for the figures")
    options = parser.parse_args()
    contestants = make_contestants(options.groups)
    rates: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(options.rounds + 1):
        for name, measure in contestants.items():
            rate = measure()
            # The first turn compiles and warms up.
            if turn > 0:
                rates[name].append(rate)
    # MuJoCo's renderers complain when they outlive the GL that they were made with.
    contestants.clear()
    gc.collect()
    for name, values in rates.items():
        low, middle, high = min(values), statistics.median(values), max(values)
        print(f"{name:<44}{middle:>12,.1f} a second ({low:,.1f} to {high:,.1f})")
    ratios = {}
    for ours, theirs in _RATIOS:
        if ours in rates and theirs in rates:
            # Of each round, so that a slow moment of the machine counts for both.
            each = [a / b for a, b in zip(rates[ours], rates[theirs], strict=True)]
            ratios[f"{ours} / {theirs}"] = statistics.median(each)
            print(f"{ours} / {theirs}: {statistics.median(each):.2f}")
    if options.json:
        versions = {"torch": torch.__version__, "threads": torch.get_num_threads()}
        report = {"machine": machine() | versions, "per_second": rates, "median_ratios": ratios}
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
