"""The training loop: collect, store, learn and count in one body, a chunk of it in one scan."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from mjx_arm.algos.base import Algorithm
from mjx_arm.algos.collect import Counts, Episodes, act, count_episodes, init_episodes, means
from mjx_arm.algos.exploration import epsilon_at, spread_epsilon
from mjx_arm.algos.replay import Replay, Step, add, init_replay
from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.envs.auto_reset import AutoReset, AutoResetState
from mjx_arm.envs.env import Env, make_env
from mjx_arm.envs.tasks.base import Reward
from mjx_arm.microbatch import microbatched, overwrite_microbatched
from mjx_arm.physics import compiler_options
from mjx_arm.references import reference_to
from mjx_arm.shard import WHOLE, Shard
from mjx_arm.training.algorithm import make_algorithm
from mjx_arm.training.mesh import (
    check_division,
    replicate,
    shard_of,
    sharded,
    shards_seeds,
    with_shardings,
)

# Each use of a run's seed has its own keys, so that training never sees what judges it.
TRAINING, SELECTION, EVALUATION = range(3)


@flax.struct.dataclass
class LoopState:
    """Everything that training changes; the carry of the scan.

    Attributes:
      learner: networks and optimizers.
      envs: `[N]` environments.
      obs: `[N, ...]`, what the agent sees of them. Carried, so that it is rendered once: on CPU
        XLA casts the rays again for every consumer that it can fuse with.
      replay: the ring.
      key: PRNG key.
      vector_step: `[] int32`, steps of all environments so far.
      episodes: running sums of the episodes under way.
      counts: sums over the steps of this chunk, `[] float32`.
    """

    learner: Any
    envs: AutoResetState
    obs: Any
    replay: Replay
    key: jax.Array
    vector_step: jax.Array
    episodes: Episodes
    counts: Counts


@dataclasses.dataclass(frozen=True, eq=False)
class Trainer:
    """A training run's pure functions.

    Attributes:
      config: the options.
      env: the environment that it trains in.
      algorithm: the algorithm.
      init: `key -> LoopState`.
      run_chunk: `LoopState -> (LoopState, Counts)`, compiled; donates its argument. The counts are
        those of the chunk.
      mesh: the devices that share the work, or None for one device.
      specs: how the state is spread over the mesh: a `LoopState` of `PartitionSpec`s, each for
        everything below it.

    With `num_seeds` above 1 keys, states and counts have a leading axis of seeds.
    """

    config: TrainConfig
    env: Env
    algorithm: Algorithm
    init: jax.stages.Wrapped
    run_chunk: jax.stages.Wrapped
    mesh: Mesh | None = None
    specs: Any = None

    def start(self) -> LoopState:
        """The state before the first step of the run of the configuration."""
        state: LoopState = self.init(replicate(run_keys(self.config), self.mesh))
        return state

    def shapes(self) -> LoopState:
        """The shapes of the state, with their shardings where there is a mesh."""
        shapes: LoopState = jax.eval_shape(self.init, run_keys(self.config))
        return with_shardings(shapes, self.mesh, self.specs)


def make_trainer(
    config: TrainConfig,
    *,
    env: Env | None = None,
    network: Any = None,
    reward: Reward | None = None,
    algorithm: Callable[..., Algorithm] | None = None,
    mesh: Mesh | None = None,
) -> Trainer:
    """Makes the functions of a training run.

    Args:
      config: the options.
      env: an environment of one's own, whose options take the place of `config.env`; by default
        that of the configuration.
      network: a Flax module `observations [B, ...] -> Q-values [B, A]`; by default the one that
        the configuration names.
      reward: a function as in `mjx_arm.make`; by default the one that the configuration names.
      algorithm: makes an algorithm of one's own from the configuration and the environment; by
        default that of the configuration. Where several devices share a seed it is also called
        with `shard=`, and its `learn` must average the gradients by `shard.mean`.
      mesh: devices that share the work, along its one axis. They take equal parts of the seeds, or
        where their number does not divide that of the seeds, of the environments, the replay and
        each batch of every seed.

    Raises:
      ValueError: the environment or the network cannot be made, or the work cannot be divided.
    """
    parts = {"env": env, "network": network, "reward": reward, "algorithm": algorithm}
    by_seed = mesh is not None and shards_seeds(config, mesh.size)
    shard = WHOLE if by_seed else shard_of(mesh)
    body = make_body(config, **parts, shard=shard)
    config, init, run_chunk = body.config, body.init, body.run_chunk
    seeds = config.num_seeds > 1
    if seeds:
        init, run_chunk = jax.vmap(init), jax.vmap(run_chunk)
    specs = _seed_specs(mesh) if by_seed else state_specs(shard, seeds=seeds)
    keys = specs.key if by_seed else P()
    own = body.env.env
    return Trainer(
        config=config,
        env=own,
        algorithm=body.algorithm,
        init=jax.jit(sharded(init, mesh, keys, specs)),
        run_chunk=jax.jit(
            sharded(run_chunk, mesh, (specs,), (specs, specs.counts)),
            donate_argnums=0,
            compiler_options=compiler_options(own.physics),
        ),
        mesh=mesh,
        specs=specs,
    )


def state_specs(shard: Shard, *, seeds: bool = False) -> Any:
    """How a `LoopState` is spread where the shards have equal parts of the environments.

    Args:
      shard: the part of one device.
      seeds: whether the state has a leading axis of seeds.
    """
    first = (None,) if seeds else ()
    envs: Any = P(*first, shard.axis)
    slots: Any = P(*first, None, shard.axis)
    everywhere: Any = P()
    return LoopState(
        learner=everywhere,
        envs=envs,
        obs=envs,
        replay=Replay(steps=slots, count=everywhere),
        key=everywhere,
        vector_step=everywhere,
        episodes=envs,
        counts=everywhere,
    )


def _seed_specs(mesh: Mesh | None) -> Any:
    """How a `LoopState` is spread where each device has some of the seeds."""
    spec: Any = P(shard_of(mesh).axis)
    return LoopState(**{field.name: spec for field in dataclasses.fields(LoopState)})


def make_train(
    config: TrainConfig,
    *,
    mesh: Mesh | None = None,
    env: Env | None = None,
    network: Any = None,
    reward: Reward | None = None,
    algorithm: Callable[..., Algorithm] | None = None,
) -> Callable[[jax.Array], tuple[LoopState, Counts]]:
    """Makes a whole training run as one function, for use from Python.

    It writes no files and never looks at the clock; `mjx_arm.train` does.

    Args:
      config: the options; `seed` and `num_seeds` have no meaning here.
      mesh: devices that share the environments, the replay and each batch, along its one axis. To
        give each device some of the seeds instead, leave it out and call `jax.shard_map` with
        `jax.vmap(train)`, keys and results split along the axis, and `check_vma=False`.
      env: as in `make_trainer`.
      network: as in `make_trainer`.
      reward: as in `make_trainer`.
      algorithm: as in `make_trainer`.

    Returns:
      `train(key) -> (state, counts)`: the state after the last step, and the counts of each chunk,
      `[chunks]` each. Pure; may be jitted, and vmapped over keys.

    Raises:
      ValueError: the environment cannot be made, or the mesh does not divide the work.
    """
    config, shard = dataclasses.replace(config, num_seeds=1), shard_of(mesh)
    body = make_body(
        config, env=env, network=network, reward=reward, algorithm=algorithm, shard=shard
    )

    def train(key: jax.Array) -> tuple[LoopState, Counts]:
        return jax.lax.scan(
            lambda state, _: body.run_chunk(state), body.init(key), None, length=config.num_chunks
        )

    return sharded(train, mesh, P(), (state_specs(shard), P()))


def run_keys(config: TrainConfig) -> jax.Array:
    """The key that a run starts from, or with several seeds those of all, `[S]`."""
    if config.num_seeds == 1:
        return role_key(config.seed, TRAINING)
    seeds = config.seed + jnp.arange(config.num_seeds)
    return jax.vmap(lambda seed: role_key(seed, TRAINING))(seeds)


def role_key(seed: int | jax.Array, role: int) -> jax.Array:
    """The key of one use of a seed: `TRAINING`, `SELECTION` or `EVALUATION`."""
    return jax.random.fold_in(jax.random.key(seed), role)


def make_body(
    config: TrainConfig,
    *,
    env: Env | None = None,
    network: Any = None,
    reward: Reward | None = None,
    algorithm: Callable[..., Algorithm] | None = None,
    shard: Shard = WHOLE,
) -> Body:
    """Makes the body of the scan, for one seed and one shard of it; see `make_trainer`."""
    check_division(dataclasses.replace(config, num_seeds=1), shard.count)
    if env is not None and reward is not None:
        raise ValueError("env= and reward= exclude each other: make env with the reward")
    # What was passed as an object has its import path in the options, as `mjx_arm.make` has it.
    passed = {"reward": reward, "network": network}
    paths = {name: reference_to(value) for name, value in passed.items() if value is not None}
    config = set_train_options(config, paths)
    own = make_env(config.env, reward=reward) if env is None else env
    config = dataclasses.replace(config, env=own.config)
    if algorithm is None:
        made = make_algorithm(config, own, network, shard=shard)
    elif shard.count == 1:
        made = algorithm(config, own)
    else:
        check_takes_shard(algorithm, shard.count)
        made = algorithm(config, own, shard=shard)
    return Body(config, AutoReset(own), made, shard)


def check_takes_shard(algorithm: Callable[..., Algorithm], devices: int) -> None:
    """Rejects an algorithm of one's own that would not average its gradients.

    Raises:
      ValueError: the function that makes it has no argument `shard`.
    """
    if "shard" not in inspect.signature(algorithm).parameters:
        raise ValueError(
            f"algorithm must be a function (config, env, *, shard) to share a seed among {devices} "
            "devices: average its gradients by shard.mean, or train on one device"
        )


def _check_q_values(q: jax.Array, num_envs: int, num_actions: int) -> None:
    """Rejects a network that has another number of actions: the wrong ones would be taken."""
    if q.shape != (num_envs, num_actions):
        raise ValueError(
            f"the network must return Q-values of shape {[num_envs, num_actions]}, one for each "
            f"action of each observation, got {list(q.shape)}"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """The body of the scan, for one seed.

    Attributes:
      config: the options.
      env: the environment, which resets itself.
      algorithm: the algorithm.
      shard: the part of the environments that each function sees. Keys and counters are those of
        all shards together.
    """

    config: TrainConfig
    env: AutoReset
    algorithm: Algorithm
    shard: Shard = WHOLE

    @property
    def _num_envs(self) -> int:
        """Environments of this shard."""
        return self.shard.part(self.config.num_envs)

    def init(self, key: jax.Array) -> LoopState:
        """The state before the first step. Consumes the key."""
        config, frames = self.config, self.algorithm.frames
        reset_key, learner_key, key = jax.random.split(key, 3)
        keys = jax.random.split(self.shard.fold(reset_key), self._num_envs)
        # The images that `reset` renders all at once are dropped: 4,096 need 220 MB to work in.
        envs = jax.vmap(self.env.reset)(keys)[1]
        obs = microbatched(frames.observe)(envs)
        frame = frames.encode(envs, obs)
        nothing = jnp.zeros((self._num_envs,), jnp.bool_)
        step = Step(
            frame=frame,
            action=nothing.astype(jnp.uint8),
            reward=nothing.astype(jnp.float32),
            terminated=nothing,
            truncated=nothing,
            masked=nothing,
        )
        first_obs, first_frame = jax.tree.map(lambda x: x[:1], (obs, frame))
        state = LoopState(
            learner=self.algorithm.init(learner_key, first_obs, first_frame),
            envs=envs,
            obs=obs,
            replay=init_replay(step, config.replay_slots),
            key=key,
            vector_step=jnp.zeros((), jnp.int32),
            episodes=init_episodes(self.env, envs),
            counts={},
        )
        # One abstract step says which counts there are.
        counts = jax.eval_shape(lambda s: self.step(s, None)[0].counts, state)
        zeros = {name: jnp.zeros(x.shape, x.dtype) for name, x in counts.items()}
        return dataclasses.replace(state, counts=zeros)

    def run_chunk(self, state: LoopState) -> tuple[LoopState, Counts]:
        """Runs `TrainConfig.chunk_length` steps; the counts are theirs."""
        state = dataclasses.replace(state, counts=jax.tree.map(jnp.zeros_like, state.counts))
        state, _ = jax.lax.scan(self.step, state, None, length=self.config.chunk_length)
        # Those of learning are of all shards already.
        metrics = self.algorithm.metrics
        learned = {*metrics, *metrics.values()}
        counts = {
            name: count if name in learned else self.shard.total(count)
            for name, count in state.counts.items()
        }
        return dataclasses.replace(state, counts=counts), counts

    def step(self, state: LoopState, _: None) -> tuple[LoopState, None]:
        """Collects, stores, learns and counts one step of all environments."""
        config, algorithm = self.config, self.algorithm
        key, act_key, learn_key = jax.random.split(state.key, 3)
        env_steps = state.vector_step * config.num_envs
        epsilon = epsilon_at(config.exploration, env_steps)
        epsilon = self.shard.own(spread_epsilon(config.exploration, epsilon, config.num_envs))
        frame = algorithm.frames.encode(state.envs, state.obs)
        q = algorithm.q_values(state.learner, state.obs, frame, env_steps)
        _check_q_values(q, self._num_envs, self.env.env.num_actions)
        act_key = self.shard.fold(act_key)
        action, envs, transition = act(self.env, act_key, state.envs, q, epsilon)
        replay = add(
            state.replay,
            Step(
                frame=frame,
                action=action.astype(jnp.uint8),
                reward=transition.reward,
                terminated=transition.terminated,
                truncated=transition.truncated,
                masked=transition.info["reset"] | transition.info["diverged"],
            ),
        )
        learner, learned = algorithm.learn(learn_key, state.learner, replay, env_steps)
        episodes, counts = count_episodes(state.episodes, transition, q)
        counts |= learned
        state = LoopState(
            learner=learner,
            envs=envs,
            obs=self._observe(envs, state.obs, env_steps + config.num_envs),
            replay=replay,
            key=key,
            vector_step=state.vector_step + 1,
            episodes=episodes,
            counts={name: state.counts.get(name, 0.0) + count for name, count in counts.items()},
        )
        return state, None

    def _observe(self, envs: AutoResetState, old: Any, env_steps: jax.Array) -> Any:
        """What the environments show, written over `old`; or `old`, where nothing looks at it."""
        algorithm = self.algorithm
        wanted: jax.Array | bool = True
        if self.config.replay.storage == "states":
            wanted = algorithm.acts_on_obs(env_steps)

        def observe(old: Any) -> Any:
            return overwrite_microbatched(algorithm.frames.observe, envs, old)

        if isinstance(wanted, bool):
            return observe(old) if wanted else old
        return jax.lax.cond(wanted, observe, lambda old: old, old)


def summarise(
    config: TrainConfig, algorithm: Algorithm, counts: dict[str, Any], vector_step: int
) -> dict[str, float]:
    """Metrics of a chunk.

    Args:
      config: of the run.
      algorithm: of the run.
      counts: numbers from `run_chunk`.
      vector_step: steps of all environments so far.

    Returns:
      Metrics by name; means over nothing are NaN.
    """
    c = {name: float(value) for name, value in counts.items()}
    env_steps = vector_step * config.num_envs
    epsilon = epsilon_at(config.exploration, jnp.asarray(env_steps))
    learned = {
        name: c[name] / c[count] if c[count] else float("nan")
        for name, count in algorithm.metrics.items()
    }
    return {
        "env_steps": env_steps,
        "episodes": c["episodes"],
        "successes": c["successes"],
        **means(c),
        **learned,
        **{count: c[count] for count in dict.fromkeys(algorithm.metrics.values())},
        "diverged": c["diverged"],
        "epsilon": float(jnp.mean(spread_epsilon(config.exploration, epsilon, config.num_envs))),
    }
