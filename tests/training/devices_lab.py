"""What several devices of one process compute, as JSON; `test_devices.py` starts it and judges.

XLA_FLAGS=--xla_force_host_platform_device_count=4 python tests/training/devices_lab.py CHECK ...
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import PartitionSpec as P

from mjx_arm.algos import distill
from mjx_arm.algos.dqn import DQN, QLearning
from mjx_arm.algos.frames import Frames
from mjx_arm.algos.replay import Batch, Step, init_replay
from mjx_arm.config import DistillConfig, DQNConfig, set_train_options, train_config
from mjx_arm.networks import FeatureQNetwork
from mjx_arm.presets import PRESETS
from mjx_arm.shard import Shard
from mjx_arm.training.evaluate import make_evaluator
from mjx_arm.training.loop import make_train, make_trainer, run_keys
from mjx_arm.training.memory import memory_plan
from mjx_arm.training.mesh import fetch, make_mesh, shard_of, sharded

jax.config.update("jax_numpy_dtype_promotion", "strict")

CONFIG = train_config(
    env="B",
    observation="state",
    physics="native",
    num_envs=8,
    replay_size=800,
    batch_size=8,
    learning_starts=40,
    chunk_steps=160,
    max_steps=15,
    hidden=16,
)
# The default preset, from pixels. The student learns from the second chunk on.
DISTILL = set_train_options(
    PRESETS["fast"],
    {
        "env": "B",
        "physics": "native",
        "size": (16, 16),
        "num_envs": 8,
        "replay_size": 800,
        "learning_starts": 40,
        "chunk_steps": 160,
        "max_steps": 15,
        "widths": (4, 4, 4),
        "hidden": 16,
        "teacher_hidden": 16,
        "teacher_batch_size": 16,
        "student_batch_size": 8,
        "student_starts": 160,
        # 24 images in each of the 20 steps of a chunk: the student drives from the third chunk on.
        "student_warm_up": 480,
    },
)


def bits(tree) -> list[np.ndarray]:
    """The whole arrays of a tree, keys as the words behind them."""
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]


def same(one, other) -> bool:
    """Whether two trees are equal to the bit."""
    return all(np.array_equal(a, b) for a, b in zip(bits(one), bits(other), strict=True))


def gap(one, other) -> float:
    """The largest difference of two trees."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return max(float(np.abs(np.asarray(a) - np.asarray(b)).max()) for a, b in pairs)


def copies_agree(tree) -> bool:
    """Whether each device has the same copy of every array of a tree."""
    return all(
        np.array_equal(x.addressable_shards[0].data, shard.data)
        for x in jax.tree.leaves(tree)
        for shard in x.addressable_shards
    )


def run_chunks(trainer, chunks: int):
    state, rows = trainer.start(), []
    for _ in range(chunks):
        state, counts = trainer.run_chunk(state)
        rows.append({name: float(x) for name, x in fetch(counts).items()})
    return state, rows


class Plain(distill.Distill):
    """Without Adam, which divides small gradients by their own size and so enlarges rounding."""

    _optimizer = optax.sgd(0.01)


def training() -> dict:
    """A short training on all devices, and what is made of its agent."""
    mesh = make_mesh(jax.device_count())
    trainer, alone = make_trainer(CONFIG, mesh=mesh), make_trainer(CONFIG)
    state, rows = run_chunks(trainer, 1)
    compilations = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration, **rest: compilations.append(event)
    )
    for _ in range(2):
        state, counts = trainer.run_chunk(state)
        rows.append({name: float(x) for name, x in fetch(counts).items()})
    again = [event for event in compilations if "backend_compile" in event]
    starts = np.asarray(state.replay.steps.frame["features"])[0]
    policy = fetch(trainer.algorithm.policy(state.learner))
    results = [
        make_evaluator(trainer.env, trainer.algorithm.apply, episodes=10, epsilon=0.3, mesh=m)(
            policy, jax.random.key(5)
        )
        for m in (None, mesh)
    ]
    return {
        "counts": rows,
        "compiled_again": again,
        "spread": [str(x.sharding.spec) for x in (state.envs.ended, state.replay.steps.reward)],
        "copies_agree": copies_agree(state.learner),
        "different_starts": len(np.unique(starts, axis=0)),
        "plan": memory_plan(trainer.shapes()),
        "plan_alone": memory_plan(alone.shapes()),
        "evaluations": [dataclasses.asdict(result) for result in results],
    }


def distillation() -> dict:
    """A training from pixels, until the student has driven its environments for two chunks."""
    mesh = make_mesh(jax.device_count())
    trainer, alone = make_trainer(DISTILL, mesh=mesh), make_trainer(DISTILL)
    state, rows = trainer.start(), []
    images = [fetch(state.obs)]
    for _ in range(4):
        state, counts = trainer.run_chunk(state)
        rows.append({name: float(x) for name, x in fetch(counts).items()})
        images.append(fetch(state.obs))

    def q_values(trainer):
        def both(learner, envs, obs):
            algorithm = trainer.algorithm
            frame = algorithm.frames.encode(envs, obs)
            return [
                algorithm.q_values(learner, obs, frame, jnp.int32(steps)) for steps in (0, 10_000)
            ]

        return both

    spec = P(shard_of(mesh).axis)
    spread = sharded(q_values(trainer), mesh, (P(), spec, spec), spec)
    own = jax.jit(spread)(state.learner, state.envs, state.obs)
    whole = jax.device_put((state.learner, state.envs, state.obs), jax.devices()[0])
    of_teacher, mixed = jax.jit(q_values(alone))(*whole)
    shown = np.asarray(jax.jit(alone.algorithm.frames.observe)(whole[1]))
    return {
        "counts": rows,
        "spread": [str(x.sharding.spec) for x in (state.obs, state.replay.steps.reward)],
        "copies_agree": copies_agree(state.learner),
        "rendered": [not np.array_equal(x, y) for x, y in itertools.pairwise(images)],
        "different_images": len(np.unique(shown.reshape(len(shown), -1), axis=0)),
        "share_of_other_pixels": float(np.mean(shown != images[-1])),
        "gap": gap((of_teacher, mixed), own),
        "driven": np.flatnonzero(np.any(np.asarray(of_teacher != mixed), axis=1)).tolist(),
    }


def exchange() -> dict:
    """A tree of two types, averaged and added up over the devices: as one array of each type."""
    mesh = make_mesh(4)
    shard = shard_of(mesh)

    def reduce(x):
        tree = {"a": x, "b": {"c": 10.0 * x[0, 0], "d": jnp.ones((2, 3, 1)) + x[0, 0]}}
        return shard.mean(tree), shard.total({"n": jnp.int32(2), "s": x[0]})

    spread = jax.shard_map(
        reduce, mesh=mesh, in_specs=P(shard.axis), out_specs=P(), check_vma=False
    )
    compiled = jax.jit(spread).lower(jnp.arange(8.0).reshape(4, 2)).compile()
    mean, total = compiled(jnp.arange(8.0).reshape(4, 2))
    return {
        "mean": jax.tree.map(lambda x: x.tolist(), mean),
        "total": jax.tree.map(lambda x: x.tolist(), total),
        # XLA may join them further, to one operation on several arrays.
        "arrays": sum(
            line.split(" all-reduce(")[0].count("[")
            for line in compiled.as_text().splitlines()
            if " all-reduce(" in line
        ),
    }


def stirred(tree):
    """A new learner whose Q-values differ.

    Those of a new network are 0, and the imitation of equal ones enlarges rounding.
    """

    def fill(x):
        if x.ndim != 2 or not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        wave = jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape) / np.sqrt(len(x))
        return jnp.where(jnp.any(x != 0), x, wave.astype(x.dtype))

    return jax.tree.map(fill, tree)


class Apart(Shard):
    """Averages nothing, so that each device shows what it has learnt by itself."""

    def mean(self, tree):
        return tree

    def largest(self, tree):
        return tree


def of_features(*stored):
    return stored[-1]["features"]


FRAMES = Frames(of_features, of_features, of_features, of_features)


def samples() -> dict:
    """What each device learns by itself, from shards that all hold the same and with one key."""
    mesh = make_mesh(jax.device_count())
    shard = Apart(shard_of(mesh).axis, mesh.size)
    nothing = jnp.zeros((2,), jnp.bool_)
    zero = nothing.astype(jnp.float32)
    frame = {"features": jnp.zeros((2, 5))}
    replay = init_replay(Step(frame, nothing.astype(jnp.uint8), zero, *[nothing] * 3), 1000)
    frame_key, reward_key = jax.random.split(jax.random.key(2))
    steps = dataclasses.replace(
        replay.steps,
        frame={"features": jax.random.normal(frame_key, (1000, 2, 5))},
        reward=jax.random.normal(reward_key, (1000, 2)),
    )
    replay = dataclasses.replace(replay, steps=steps, count=jnp.int32(1000))
    network = FeatureQNetwork(3, 8, dueling=True, scales=(1.0,) * 5, layer_norm=True)
    learning = QLearning(
        apply=network.apply,
        init_params=network.init,
        optimizer=optax.sgd(0.1),
        double=True,
        huber=True,
        polyak=0.1,
        target_period=1,
        shard=shard,
    )
    dqn = DQN(DQNConfig(batch_size=16, learning_starts=0), FRAMES, learning, 2)
    config = DistillConfig(
        teacher_batch_size=16, student_batch_size=16, student_starts=0, learning_starts=0
    )
    pair = Plain(config, FRAMES, learning, network, 2)

    def learn(key: jax.Array) -> list:
        obs = steps.frame["features"][0]
        learner = dqn.init(key, obs, None)
        both = pair.init(key, obs, {"features": obs})
        own = dqn.learn(key, learner, replay, jnp.int32(0))[0].params
        taught = pair.learn(key, both, replay, jnp.int32(0))[0]
        return jax.tree.map(lambda x: x[None], [own, taught.teacher.params, taught.student.params])

    found = jax.jit(sharded(learn, mesh, P(), P(shard.axis)))(jax.random.key(0))
    pairs = list(itertools.combinations(range(mesh.size), 2))

    def of(tree, device: int):
        return jax.tree.map(lambda x: x[device], tree)

    return {
        "nearest": [
            min(gap(of(tree, one), of(tree, other)) for one, other in pairs) for tree in found
        ]
    }


def updates() -> dict:
    """Three updates of each learner from the same samples, on 1, 2 and 4 devices."""

    network = FeatureQNetwork(3, 8, dueling=True, scales=(1.0,) * 5, layer_norm=True)
    keys = jax.random.split(jax.random.key(1), 6)
    rows = (3, 16)
    obs, next_obs = (jax.random.normal(key, (*rows, 5)) for key in keys[:2])
    batch = Batch(
        frame=obs,
        next_frame=next_obs,
        action=jax.random.randint(keys[2], rows, 0, 3),
        reward=jax.random.normal(keys[3], rows),
        discount=jnp.full(rows, 0.9),
        # Unequal numbers of masked transitions on the devices.
        weight=jnp.tile((jnp.arange(16) > 4).astype(jnp.float32), (3, 1)),
    )
    # Each device shows its own loss, so that the learners are compared by what they become.
    parameters = {}
    for devices in (1, 2, 4):
        mesh = make_mesh(devices)
        shard = shard_of(mesh)
        learning = QLearning(
            apply=network.apply,
            init_params=network.init,
            optimizer=optax.chain(optax.clip_by_global_norm(0.5), optax.sgd(0.1, momentum=0.9)),
            double=True,
            huber=True,
            polyak=0.1,
            target_period=1,
            shard=shard,
        )
        pair = Plain(DistillConfig(student_polyak=0.1), FRAMES, learning, network, 4)

        def learn(batch, obs, next_obs, learning=learning, pair=pair):
            learner = stirred(learning.init(keys[4], obs[0]))
            student = stirred(pair.init(keys[5], obs[0], {"features": obs[0]}).student)

            def once(carry, row):
                learner, student = carry
                learner, metrics = learning.update(learner, *row)
                student, other = pair.imitate(
                    student, row[1], learning.apply(learner.params, row[2])
                )
                return (learner, student), metrics | other

            carry, metrics = jax.lax.scan(once, (learner, student), (batch, obs, next_obs))
            return carry[0].params, carry[1].averaged, carry[1].spread, metrics

        spec = P(None, shard.axis)
        run = jax.jit(sharded(learn, mesh, (spec, spec, spec), P()))
        parameters[devices] = jax.device_get(run(batch, obs, next_obs))
    return {
        "gaps": [gap(parameters[1], parameters[devices]) for devices in (2, 4)],
        "learnt": gap(parameters[1][0], stirred(learning.init(keys[4], obs[0])).params),
    }


def seeds() -> dict:
    """Four seeds over the devices, and the same seeds one by one; and five, which they share."""
    config = set_train_options(CONFIG, {"num_seeds": 4})
    state, counts = make_trainer(config, mesh=(mesh := make_mesh(4))).run_chunk(
        make_trainer(config, mesh=mesh).start()
    )
    single = make_trainer(CONFIG)
    gaps, actions = [], []
    for seed in range(4):
        alone, _ = single.run_chunk(single.init(run_keys(dataclasses.replace(CONFIG, seed=seed))))
        own = jax.tree.map(lambda x, seed=seed: np.asarray(x)[seed], state.learner.params)
        gaps.append(gap(own, alone.learner.params))
        actions.append(same(state.replay.steps.action[seed], alone.replay.steps.action))
    five = make_trainer(set_train_options(CONFIG, {"num_seeds": 5}), mesh=mesh)
    shared, _ = five.run_chunk(five.start())
    return {
        "spread": str(state.envs.ended.sharding.spec),
        "updates": np.asarray(counts["updates"]).tolist(),
        "gaps": gaps,
        "same_actions": actions,
        "five": [str(shared.envs.ended.sharding.spec), list(shared.envs.ended.shape)],
    }


def whole_run() -> dict:
    """`make_train` under a mesh, in both ways, with and without `jax.set_mesh`."""
    config = set_train_options(CONFIG, {"total_steps": 320})
    mesh = jax.make_mesh((4,), ("data",))
    shared, own = make_train(config, mesh=mesh), make_train(config)
    found = {}
    with jax.set_mesh(mesh):
        state, counts = jax.jit(shared)(run_keys(config))
        found["updates"] = np.asarray(counts["updates"]).tolist()
        found["spread"] = str(state.envs.ended.sharding.spec)
        by_seed = jax.shard_map(
            jax.vmap(own), in_specs=P("data"), out_specs=P("data"), check_vma=False
        )
        keys = jax.random.split(jax.random.key(0), 4)
        seeds, _ = jax.jit(by_seed)(jax.device_put(keys, P("data")))
        found["seeds"] = list(seeds.envs.ended.shape)
    trainer = make_trainer(config, mesh=mesh)
    found["gap"] = gap(state.learner.params, run_chunks(trainer, 2)[0].learner.params)
    return found


def repeats() -> dict:
    """Native physics on four devices, 200 programs one after another."""
    trainer = make_trainer(CONFIG, mesh=make_mesh(4))
    state = trainer.start()
    for done in range(200):
        state, counts = trainer.run_chunk(state)
        # Some wait for the result, others are handed in while the one before runs.
        if done % 3 == 0:
            jax.block_until_ready(counts)
    return {"steps": int(state.vector_step), "diverged": float(counts["diverged"])}


if __name__ == "__main__":
    print(json.dumps({name: globals()[name]() for name in sys.argv[1:]}))
