"""Distillation: a student that sees pixels learns from a teacher that sees the simulator's state.

Both learn in the same scan and from the same replay. The teacher learns by deep Q-learning from
state features. The student's target in a state is the teacher's Q-values there: all of them, not
only that of the action taken. What is judged and saved is the student, which never sees the state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import chex
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from mjx_arm.algos.dqn import Learner, QLearning, first_update, num_microbatches, update_when
from mjx_arm.algos.frames import Frame, Frames, Obs
from mjx_arm.algos.replay import Replay, sample, sample_frames
from mjx_arm.config import DistillConfig
from mjx_arm.shard import Shard

Params = Any

_TEACHER_METRICS: dict[str, str] = dict.fromkeys(("loss", "q_mean", "target_max"), "updates")
_STUDENT_METRICS: dict[str, str] = dict.fromkeys(
    ("student_loss", "student_agreement"), "student_updates"
)

# The spread of the teacher's advantages is averaged over about this number of updates.
_SPREAD_UPDATES = 1_000
# Share of the student's learning rate that is left at the end of its decay.
_LAST_RATE = 0.05
# Least spread of a state's advantages, as a share of that over all states.
_LEAST_SPREAD = 0.1
# Weight of the squared error of the mean Q-value beside the cross-entropy.
_VALUE_WEIGHT = 0.1


@flax.struct.dataclass
class Student:
    """What the student's learning changes.

    Attributes:
      params: of its network.
      opt_state: of the optimizer.
      averaged: parameters averaged over the updates, which act and are judged.
      spread: `[] float32`, running root mean square of the teacher's advantages.
    """

    params: Params
    opt_state: optax.OptState
    averaged: Params
    spread: jax.Array


@flax.struct.dataclass
class Pair:
    """Teacher and student."""

    teacher: Learner
    student: Student


@dataclasses.dataclass(frozen=True, eq=False)
class Distill:
    """A privileged teacher and its student as an `Algorithm`.

    Attributes:
      config: the options.
      frames: what the student sees, and what the replay stores: with the state features.
      teacher: Q-learning from the state features.
      network: the student's Flax module, `pixels [B, ...] -> Q-values [B, A]`.
      num_envs: environments that run side by side.
    """

    config: DistillConfig
    frames: Frames
    teacher: QLearning
    network: Any
    num_envs: int
    metrics: Mapping[str, str] = dataclasses.field(
        default_factory=lambda: _TEACHER_METRICS | _STUDENT_METRICS
    )

    def init(self, key: jax.Array, obs: Obs, frame: Frame) -> Pair:
        """Fresh networks; see `Algorithm`."""
        teacher_key, student_key = jax.random.split(key)
        params = self.init_policy(student_key, obs)
        student = Student(
            params=params,
            opt_state=self._optimizer.init(params),
            averaged=jax.tree.map(jnp.copy, params),
            # Before the first target is seen; about that of rewards below 1.
            spread=jnp.full((), 0.05, jnp.float32),
        )
        return Pair(self.teacher.init(teacher_key, self.frames.features(frame)), student)

    def init_policy(self, key: jax.Array, obs: Obs) -> Params:
        """Fresh parameters of the student. Consumes the key."""
        params: Params = self.network.init(key, obs)
        return params

    @property
    def shard(self) -> Shard:
        """The part of each batch that `learn` samples."""
        return self.teacher.shard

    @property
    def _optimizer(self) -> optax.GradientTransformation:
        config = self.config
        if not config.student_decay_steps:
            return optax.adam(config.student_learning_rate)
        steps = max(1, config.student_decay_steps // self.num_envs)
        updates = steps * config.student_updates_per_step
        rate = optax.cosine_decay_schedule(config.student_learning_rate, updates, _LAST_RATE)
        return optax.adam(rate)

    def acts_on_obs(self, env_steps: jax.Array) -> jax.Array:
        """Whether the student drives its share of the environments already."""
        config = self.config
        images = config.student_batch_size * config.student_updates_per_step
        warm_up = -(-config.student_warm_up // images) * self.num_envs
        # The largest number of an int32 stands for never.
        return env_steps >= min(config.student_starts + warm_up, np.iinfo(np.int32).max)

    def q_values(self, pair: Pair, obs: Obs, frame: Frame, env_steps: jax.Array) -> jax.Array:
        """The student's Q-values where it drives, the teacher's in the other environments."""
        features = self.frames.features(frame)
        of_teacher = self.teacher.apply(pair.teacher.params, features)
        driven = round(self.config.student_share * self.num_envs)

        def mixed() -> jax.Array:
            of_student = self.apply(pair.student.averaged, obs)
            # Evenly among the environments, whose shares of random actions rise.
            index = self.shard.own(jnp.arange(self.num_envs))
            mask = (index + 1) * driven // self.num_envs > index * driven // self.num_envs
            return jnp.where(mask[:, None], of_student, of_teacher)

        return jax.lax.cond(self.acts_on_obs(env_steps), mixed, lambda: of_teacher)

    def policy(self, pair: Pair) -> Params:
        """The student's averaged parameters."""
        return pair.student.averaged

    def with_policy(self, pair: Pair, params: Params) -> Pair:
        """The pair with these parameters of the student; the teacher is as it was."""
        averaged = jax.tree.map(jnp.copy, params)
        student = dataclasses.replace(pair.student, params=params, averaged=averaged)
        return dataclasses.replace(pair, student=student)

    def apply(self, params: Params, obs: Obs) -> jax.Array:
        """Q-values of the student, `[N, A] float32`."""
        q: jax.Array = self.network.apply(params, obs)
        return q

    def learn(
        self, key: jax.Array, pair: Pair, replay: Replay, env_steps: jax.Array
    ) -> tuple[Pair, dict[str, jax.Array]]:
        """The updates of the teacher and those of the student, each from its start on."""
        config, shard = self.config, self.shard
        teacher_key, student_key = jax.random.split(key)

        def teach(learner: Learner, key: jax.Array) -> tuple[Learner, dict[str, jax.Array]]:
            size = shard.part(config.teacher_batch_size)
            batch = sample(replay, shard.fold(key), size, config.n_step, config.gamma)
            features = self.frames.features
            return self.teacher.update(
                learner, batch, features(batch.frame), features(batch.next_frame)
            )

        ready = replay.count > first_update(config, self.num_envs)
        teacher, taught = update_when(
            ready,
            teach,
            teacher_key,
            pair.teacher,
            config.teacher_updates_per_step,
            _TEACHER_METRICS,
        )

        def imitate(student: Student, key: jax.Array) -> tuple[Student, dict[str, jax.Array]]:
            size = shard.part(config.student_batch_size)
            frame = sample_frames(replay, shard.fold(key), size)
            target = self.teacher.apply(teacher.target_params, self.frames.features(frame))
            return self.imitate(student, self.frames.decode(frame), target)

        student, learned = update_when(
            ready & (env_steps >= config.student_starts),
            imitate,
            student_key,
            pair.student,
            config.student_updates_per_step,
            _STUDENT_METRICS,
        )
        return Pair(teacher, student), taught | learned

    def imitate(
        self, student: Student, obs: Obs, target: jax.Array
    ) -> tuple[Student, dict[str, jax.Array]]:
        """One update of the student.

        Args:
          student: before.
          obs: `[B, ...]`, the part of a shard; the gradients are those of the whole batch.
          target: `[B, A] float32`, the teacher's Q-values.

        Returns:
          The student after, its loss, and the share of the states in which both prefer the same
          action.
        """
        power = self.shard.mean(jnp.mean(jnp.var(target, axis=-1)))
        rate = 1.0 / _SPREAD_UPDATES
        spread = (1 - rate) * student.spread + rate * jnp.sqrt(power + 1e-10)
        parts = num_microbatches(len(target))
        rows = jax.tree.map(lambda x: x.reshape(parts, -1, *x.shape[1:]), (obs, target))

        def loss_of(params: Params, obs: Obs, target: jax.Array) -> tuple[jax.Array, jax.Array]:
            q = self.apply(params, obs)
            temperature = self.config.student_temperature * advantage_spread(target, spread)
            losses = jax.vmap(imitation_loss)(q, target, temperature)
            agree = jnp.argmax(q, axis=-1) == jnp.argmax(target, axis=-1)
            return jnp.mean(losses), jnp.mean(agree.astype(jnp.float32))

        def add(grads: Params, row: tuple[Obs, jax.Array]) -> tuple[Params, Any]:
            values, own = jax.value_and_grad(loss_of, has_aux=True)(student.params, *row)
            return jax.tree.map(jnp.add, grads, own), values

        zeros = jax.tree.map(jnp.zeros_like, student.params)
        grads, (losses, agreements) = jax.lax.scan(add, zeros, rows)
        metrics = {"student_loss": jnp.mean(losses), "student_agreement": jnp.mean(agreements)}
        grads = jax.tree.map(lambda x: x / parts, grads)
        grads, metrics = self.shard.mean((grads, metrics))
        # Adam's bias correction raises a float to an integer power; strict promotion is for ours.
        with jax.numpy_dtype_promotion("standard"):
            changes, opt_state = self._optimizer.update(grads, student.opt_state, student.params)
        params = optax.apply_updates(student.params, changes)
        averaged = optax.incremental_update(params, student.averaged, self.config.student_polyak)
        return Student(params, opt_state, averaged, spread), metrics


def advantage_spread(target: jax.Array, overall: jax.Array) -> jax.Array:
    """Standard deviation of each state's advantages, `[B] float32`, kept within two bounds.

    Far from success all actions are worth nearly the same: the median state has a fifth of the root
    mean square over all states. With one temperature for all of them the student would hardly learn
    which action is the best there.

    Args:
      target: `[B, A] float32`, Q-values.
      overall: `[] float32`, root mean square of the advantages over all states: the upper bound,
        since near success too the student must learn which action is the best. A tenth of it is
        the lower bound: smaller differences are the teacher's own errors.
    """
    return jnp.clip(jnp.std(target, axis=-1), _LEAST_SPREAD * overall, overall)


def imitation_loss(q: jax.Array, target: jax.Array, temperature: jax.Array) -> jax.Array:
    """Loss of one state, `[] float32`.

    Cross-entropy between the softmax of both networks' advantages, plus a tenth of the squared
    error of the mean Q-value, which the softmax does not see: so Q-values stay Q-values.

    Args:
      q: `[A] float32`, of the student.
      target: `[A] float32`, of the teacher.
      temperature: `[] float32`, in units of a Q-value.
    """
    chex.assert_rank([q, target, temperature], [1, 1, 0])
    value, target_value = jnp.mean(q), jnp.mean(target)
    logits, target_logits = (q - value) / temperature, (target - target_value) / temperature
    entropy = optax.losses.softmax_cross_entropy(logits, jax.nn.softmax(target_logits))
    return entropy + _VALUE_WEIGHT * jnp.square(value - target_value)
