"""The training loop: collect, store, learn and count in one body, a chunk of it in one scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from mjx_arm.auto_reset import AutoReset, AutoResetState
from mjx_arm.config import TrainConfig
from mjx_arm.dqn import DQN, Learner, epsilon_greedy
from mjx_arm.env import Env, Transition, make_env
from mjx_arm.kinematics import make_kinematics
from mjx_arm.networks import FeatureQNetwork, PixelQNetwork
from mjx_arm.parts import in_parts, overwrite_in_parts
from mjx_arm.physics import compiler_options
from mjx_arm.replay import Replay, Step, add, init_replay, sample

Obs = Any
Counts = dict[str, jax.Array]


@flax.struct.dataclass
class LoopState:
    """Everything that training changes; the carry of the scan.

    Attributes:
      learner: networks and optimiser.
      envs: `[N]` environments.
      obs: `[N, ...]`, what the agent sees of them. Carried, so that it is drawn once: on CPU XLA
        casts the rays again for every consumer that it can fuse with.
      replay: the ring.
      key: PRNG key.
      vector_step: `[] int32`, steps of all environments so far.
      episode: running sums of the episodes under way, `[N]` each.
      counts: sums over the steps of this chunk, `[] float32` and `[] int32`.
    """

    learner: Learner
    envs: AutoResetState
    obs: Obs
    replay: Replay
    key: jax.Array
    vector_step: jax.Array
    episode: dict[str, jax.Array]
    counts: Counts


@dataclasses.dataclass(frozen=True, eq=False)
class Trainer:
    """A training run's pure functions.

    Attributes:
      config: the options.
      env: the environment that it trains in.
      dqn: the algorithm.
      init: `key -> LoopState`.
      run_chunk: `LoopState -> (LoopState, Counts)`, compiled; donates its argument. The counts are
        those of the chunk.

    With `num_seeds` above 1 keys, states and counts have a leading axis of seeds.
    """

    config: TrainConfig
    env: Env
    dqn: DQN
    init: jax.stages.Wrapped
    run_chunk: jax.stages.Wrapped


def make_trainer(config: TrainConfig) -> Trainer:
    """Makes the functions of a training run.

    Raises:
      ValueError: the environment cannot be made.
    """
    body = make_body(config)
    init, run_chunk = body.init, body.run_chunk
    if config.num_seeds > 1:
        init, run_chunk = jax.vmap(init), jax.vmap(run_chunk)
    env = body.env.env
    return Trainer(
        config=config,
        env=env,
        dqn=body.dqn,
        init=jax.jit(init),
        run_chunk=jax.jit(
            run_chunk, donate_argnums=0, compiler_options=compiler_options(env.physics)
        ),
    )


def make_train(config: TrainConfig) -> Callable[[jax.Array], tuple[LoopState, Counts]]:
    """Makes a whole training run as one function, for use from Python.

    It writes no files and never looks at the clock; `mjx_arm.train` does.

    Args:
      config: the options; `seed` and `num_seeds` have no meaning here.

    Returns:
      `train(key) -> (state, counts)`: the state after the last step, and the counts of each chunk,
      `[chunks]` each. Pure; may be jitted, and vmapped over keys.

    Raises:
      ValueError: the environment cannot be made.
    """
    body = make_body(config)

    def train(key: jax.Array) -> tuple[LoopState, Counts]:
        return jax.lax.scan(
            lambda state, _: body.run_chunk(state), body.init(key), None, length=config.num_chunks
        )

    return train


def run_keys(config: TrainConfig) -> jax.Array:
    """The key that a run starts from, or with several seeds those of all, `[S]`."""
    if config.num_seeds == 1:
        return jax.random.key(config.seed)
    return jax.vmap(jax.random.key)(config.seed + jnp.arange(config.num_seeds))


def make_dqn(config: TrainConfig, env: Env) -> DQN:
    """Makes the algorithm with the network that fits the observation."""
    if config.observation == "state":
        network: Any = FeatureQNetwork(env.num_actions, config.hidden, config.dueling)
    else:
        network = PixelQNetwork(
            num_actions=env.num_actions,
            widths=config.widths,
            kernels=config.kernels,
            strides=config.strides,
            pool=config.pool,
            hidden=config.hidden,
            dueling=config.dueling,
        )
    clip = optax.clip_by_global_norm(config.max_grad_norm) if config.max_grad_norm > 0 else None
    adam = optax.adam(config.learning_rate)
    return DQN(
        apply=lambda params, obs: in_parts(lambda part: network.apply(params, part))(obs),
        init_params=network.init,
        optimizer=adam if clip is None else optax.chain(clip, adam),
        double=config.double,
        huber=config.huber,
        polyak=config.polyak,
        target_period=config.target_period,
        parts=_update_parts(config),
    )


def _update_parts(config: TrainConfig) -> int:
    """Parts of a batch for an update: on CPU of 16 images, whose patches fit the cache of a core.

    Four parts of 16 take three quarters of the time of 64 at once (see benchmarks/PROFILE.md).
    """
    pixels = config.observation != "state"
    if pixels and jax.default_backend() == "cpu" and config.batch_size % 16 == 0:
        return config.batch_size // 16
    return 1


def epsilon_at(config: TrainConfig, env_steps: jax.Array) -> jax.Array:
    """Share of random actions after so many environment steps, `[] float32`."""
    done = jnp.clip(env_steps.astype(jnp.float32) / config.epsilon_steps, 0.0, 1.0)
    return config.epsilon_start + (config.epsilon_end - config.epsilon_start) * done


def spread_epsilon(config: TrainConfig, epsilon: jax.Array) -> jax.Array:
    """The share of each environment, `[N] float32`; see `TrainConfig.epsilon_spread`."""
    # The middle of the ratios, where there is but one environment.
    spread = config.epsilon_spread if config.num_envs > 1 else 1.0
    ratios = np.geomspace(1 / spread, spread, config.num_envs)
    return jnp.minimum(epsilon * jnp.asarray(ratios, jnp.float32), 1.0)


@dataclasses.dataclass(frozen=True)
class _Storage:
    """What the replay keeps of a frame, and how the observation comes back from it."""

    store: Callable[[AutoResetState, Obs], Any]
    restore: Callable[[Any], Obs]


def _make_storage(config: TrainConfig, env: Env) -> _Storage:
    if config.storage == "pixels" or config.observation == "state":
        return _Storage(store=lambda envs, obs: obs, restore=lambda frame: frame)
    kinematics = make_kinematics(env.scene.mj_model)

    def draw(qpos: jax.Array) -> jax.Array:
        return env.draw(kinematics(qpos))

    return _Storage(store=lambda envs, obs: envs.env.physics.qpos, restore=jax.vmap(draw))


def make_body(config: TrainConfig) -> Body:
    """Makes what one seed's training run is made of."""
    env = make_env(config.env_config())
    return Body(config, AutoReset(env), make_dqn(config, env), _make_storage(config, env))


@dataclasses.dataclass(frozen=True)
class Body:
    """The body of the scan, for one seed.

    Attributes:
      config: the options.
      env: the environment, which resets itself.
      dqn: the algorithm.
      storage: what the replay keeps of a frame.
    """

    config: TrainConfig
    env: AutoReset
    dqn: DQN
    storage: _Storage

    def init(self, key: jax.Array) -> LoopState:
        """The state before the first step. Consumes the key."""
        config = self.config
        reset_key, learner_key, key = jax.random.split(key, 3)
        keys = jax.random.split(reset_key, config.num_envs)
        # What `reset` has drawn of all at once is dropped: 4,096 images need 220 MB to work in.
        envs = jax.vmap(self.env.reset)(keys)[1]
        obs = in_parts(jax.vmap(self.env.env.observe))(envs.env)
        nothing = jnp.zeros((config.num_envs,), jnp.bool_)
        step = Step(
            frame=self.storage.store(envs, obs),
            action=nothing.astype(jnp.uint8),
            reward=nothing.astype(jnp.float32),
            terminated=nothing,
            truncated=nothing,
            void=nothing,
        )
        zero = jnp.zeros((config.num_envs,), jnp.float32)
        state = LoopState(
            learner=self.dqn.init(learner_key, jax.tree.map(lambda x: x[:1], obs)),
            envs=envs,
            obs=obs,
            replay=init_replay(step, config.replay_slots),
            key=key,
            vector_step=jnp.zeros((), jnp.int32),
            episode=dict.fromkeys(("length", "return", "max_q", "regrasps", "held"), zero),
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
        return state, state.counts

    def step(self, state: LoopState, _: None) -> tuple[LoopState, None]:
        """Collects, stores, learns and counts one step of all environments."""
        key, act_key, env_key, learn_key = jax.random.split(state.key, 4)
        epsilon = epsilon_at(self.config, state.vector_step * self.config.num_envs)
        q = self.dqn.apply(state.learner.params, state.obs)
        action = epsilon_greedy(act_key, q, spread_epsilon(self.config, epsilon))
        keys = jax.random.split(env_key, self.config.num_envs)
        envs, transition = jax.vmap(self.env.transition)(keys, state.envs, action)
        replay = add(state.replay, self._record(state, action, transition))
        learner, learned = self.learn(learn_key, state.learner, replay)
        episode, counts = self._count(state, q, transition)
        counts |= learned
        state = LoopState(
            learner=learner,
            envs=envs,
            obs=overwrite_in_parts(jax.vmap(self.env.env.observe), envs.env, state.obs),
            replay=replay,
            key=key,
            vector_step=state.vector_step + 1,
            episode=episode,
            counts={name: state.counts.get(name, 0) + count for name, count in counts.items()},
        )
        return state, None

    def _record(self, state: LoopState, action: jax.Array, transition: Transition) -> Step:
        return Step(
            frame=self.storage.store(state.envs, state.obs),
            action=action.astype(jnp.uint8),
            reward=transition.reward,
            terminated=transition.terminated,
            truncated=transition.truncated,
            void=transition.info["reset"] | transition.info["diverged"],
        )

    def learn(
        self, key: jax.Array, learner: Learner, replay: Replay
    ) -> tuple[Learner, dict[str, jax.Array]]:
        """The updates of one step, none while the replay holds too little."""
        config = self.config

        def one(learner: Learner, key: jax.Array) -> tuple[Learner, dict[str, jax.Array]]:
            batch = sample(replay, key, config.batch_size, config.n_step, config.gamma)
            obs = self.storage.restore(batch.frame)
            next_obs = self.storage.restore(batch.next_frame)
            learner, metrics = self.dqn.update(learner, batch, obs, next_obs)
            return learner, metrics | {"updates": jnp.ones((), jnp.int32)}

        def learn(learner: Learner) -> tuple[Learner, dict[str, jax.Array]]:
            keys = jax.random.split(key, config.updates_per_step)
            if config.updates_per_step == 1:
                return one(learner, keys[0])
            learner, metrics = jax.lax.scan(one, learner, keys)
            return learner, jax.tree.map(lambda x: jnp.sum(x, axis=0), metrics)

        def wait(learner: Learner) -> tuple[Learner, dict[str, jax.Array]]:
            zero = jnp.zeros((), jnp.float32)
            names = ("loss", "q_mean", "target_max")
            return learner, dict.fromkeys(names, zero) | {"updates": jnp.zeros((), jnp.int32)}

        starts = max(config.learning_starts // config.num_envs, config.n_step + 1)
        return jax.lax.cond(replay.count > starts, learn, wait, learner)

    def _count(
        self, state: LoopState, q: jax.Array, transition: Transition
    ) -> tuple[dict[str, jax.Array], Counts]:
        info = transition.info
        stepped = (~info["reset"]).astype(jnp.float32)
        ended = transition.terminated | transition.truncated
        held = info["grasped"].astype(jnp.float32)
        before = state.episode
        episode = {
            "length": before["length"] + stepped,
            "return": before["return"] + transition.reward,
            "max_q": before["max_q"] + stepped * jnp.max(q, axis=-1),
            "regrasps": before["regrasps"] + held * (1 - before["held"]),
            "held": held,
        }
        finished = {
            f"episode_{name}": jnp.sum(jnp.where(ended, episode[name], 0.0))
            for name in ("length", "return", "max_q")
        }
        counts = {
            "steps": jnp.sum(stepped),
            "episodes": jnp.sum(ended.astype(jnp.int32)),
            "successes": jnp.sum(transition.terminated.astype(jnp.int32)),
            "grasp_steps": jnp.sum(stepped * held),
            "distance": jnp.sum(stepped * info["distance"]),
            "grasp_episodes": jnp.sum((ended & (episode["regrasps"] > 0)).astype(jnp.int32)),
            "diverged": jnp.sum(info["diverged"].astype(jnp.int32)),
            **finished,
        }
        episode = {name: jnp.where(ended, 0.0, total) for name, total in episode.items()}
        return episode, counts


def summarise(config: TrainConfig, counts: dict[str, Any], vector_step: int) -> dict[str, float]:
    """Means of a chunk, from its counts.

    Args:
      config: of the run.
      counts: numbers from `run_chunk`.
      vector_step: steps of all environments so far.

    Returns:
      Metrics by name; means over nothing are NaN.
    """
    c = {name: float(np.asarray(value)) for name, value in counts.items()}

    def ratio(top: str, bottom: str) -> float:
        return c[top] / c[bottom] if c[bottom] else float("nan")

    env_steps = vector_step * config.num_envs
    return {
        "env_steps": env_steps,
        "episodes": c["episodes"],
        "successes": c["successes"],
        "success_rate": ratio("successes", "episodes"),
        "grasp_rate": ratio("grasp_episodes", "episodes"),
        "grasp_share": ratio("grasp_steps", "steps"),
        "mean_distance": ratio("distance", "steps"),
        "mean_length": ratio("episode_length", "episodes"),
        "mean_reward": ratio("episode_return", "episode_length"),
        "mean_max_q": ratio("episode_max_q", "episode_length"),
        "loss": ratio("loss", "updates"),
        "q_mean": ratio("q_mean", "updates"),
        "target_max": ratio("target_max", "updates"),
        "updates": c["updates"],
        "diverged": c["diverged"],
        "epsilon": float(epsilon_at(config, jnp.asarray(env_steps))),
    }
