"""A run from Python: a user's own parts in it, callbacks, early ends, and fine-tuning."""

from __future__ import annotations

import dataclasses
import io
import itertools
import pathlib

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import mjx_arm
from mjx_arm.algos.dqn import DQN, make_q_learning
from mjx_arm.algos.frames import make_frames
from mjx_arm.config import set_train_options, train_config
from mjx_arm.report.metrics import read_metrics
from mjx_arm.training import runner
from mjx_arm.training.checkpoint import RunCheckpoints
from mjx_arm.training.evaluate import Evaluation, evaluate
from mjx_arm.training.loop import make_trainer
from mjx_arm.training.objects import Objects
from mjx_arm.training.run_folder import load_run

CONFIG = train_config(
    observation="state",
    physics="native",
    num_envs=4,
    replay_size=400,
    batch_size=8,
    learning_starts=40,
    chunk_steps=80,
    total_steps=240,
    max_steps=15,
    hidden=16,
    select_every=0,
)


def pay_seven(before, after, action):
    """A reward of one's own: 7 for each step."""
    del before, action
    return {"seven": jnp.full_like(after.measured["height"], 7.0)}


def pay_eight(before, after, action):
    del before, action
    return {"eight": jnp.full_like(after.measured["height"], 8.0)}


class Own(nn.Module):
    """A network of one's own."""

    num_actions: int = 14

    @nn.compact
    def __call__(self, obs):
        return nn.Dense(self.num_actions, name="own")(obs)


class OwnDQN(DQN):
    """An algorithm of one's own, with metrics of its own."""

    def learn(self, key, learner, replay, env_steps):
        usual = DQN(self.config, self.frames, self.q_learning, self.num_envs)
        learner, sums = usual.learn(key, learner, replay, env_steps)
        return learner, {"own": sums["loss"], "own_updates": sums["updates"]}


def make_own(config, env) -> OwnDQN:
    learning = make_q_learning(config.algo, Own(), pixels=False)
    made = OwnDQN(config.algo, make_frames(env, "states"), learning, config.num_envs)
    return dataclasses.replace(made, metrics={"own": "own_updates"})


class Nothing(list):
    """An episode without frames."""

    success = False


def record_nothing(env, apply, params, **options):
    """Instead of an episode for the video: one act, in the environment and by the network."""
    del options
    obs, _ = jax.jit(env.reset)(jax.random.key(0))
    assert apply(params, obs[None]).shape == (1, env.num_actions)
    return Nothing()


def evaluate_nothing(env, apply, params, *, episodes, **options):
    """Instead of the evaluation at the end, which compiles a program of its own."""
    del env, apply, params, options
    return Evaluation(episodes, 0, 0.0, (0.0, 1.0), 0.0, {})


@pytest.fixture(autouse=True, scope="module")
def quick_runs():
    """Without what the tests of the command line look at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "record_episode", record_nothing)
        patch.setattr(runner, "render_episode", lambda env, episode: iter(()))
        patch.setattr(runner, "write_video", lambda path, frames: None)
        patch.setattr(runner, "evaluate", evaluate_nothing)
        yield


def train(folder: pathlib.Path, config=CONFIG, **options):
    console = Console(file=io.StringIO())
    result = mjx_arm.train(config, folder, eval_episodes=2, console=console, **options)
    return result, console.file.getvalue()


def resume(folder: pathlib.Path, **options):
    return mjx_arm.resume(folder, eval_episodes=2, console=Console(file=io.StringIO()), **options)


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("runner") / "plain"
    _, output = train(folder)
    (folder.parent / "output.txt").write_text(output)
    return folder


def mean_rewards(folder: pathlib.Path) -> list[float]:
    rows = read_metrics(folder)
    return [row["mean_reward"] for row in rows if row["episodes"]]


def test_an_own_reward_and_network_reach_training(tmp_path):
    folder = tmp_path / "run"
    (result,), _ = train(folder, reward=pay_seven, network=Own())
    assert result.episodes == 2
    # Its terms are scaled as those of any reward.
    assert mean_rewards(folder) == pytest.approx([1.4] * len(mean_rewards(folder)))
    assert len(mean_rewards(folder)) > 0
    run = load_run(folder)
    assert run.objects["reward"]["given"].endswith("test_runner:pay_seven")
    assert set(run.objects) == {"reward", "network"}
    # Its options name them too, and so does its page.
    assert run.config.env.reward == run.objects["reward"]["given"]
    assert run.config.network.network == run.objects["network"]["given"]
    page = (folder / "report.html").read_text()
    assert "test_runner:pay_seven" in page
    assert "completion<" not in page
    with pytest.raises(ValueError, match=r"made with .*: pass it again as network="):
        mjx_arm.load_agent(folder, reward=pay_seven)
    with pytest.raises(ValueError, match=r"pay_seven, got .*pay_eight"):
        mjx_arm.load_agent(folder, reward=pay_eight, network=Own())
    agent = mjx_arm.load_agent(folder, reward=pay_seven, network=Own())
    assert set(agent.params["params"]) == {"own"}
    with pytest.raises(ValueError, match="pass it again as reward="):
        resume(folder, network=Own(), total_steps=320)
    resume(folder, reward=pay_seven, network=Own(), total_steps=320)
    assert [row["env_steps"] for row in read_metrics(folder)] == [80, 160, 240, 320]


def test_an_own_environment_and_algorithm_reach_training(tmp_path, monkeypatch):
    """As well as the selection, and the evaluation at the end."""
    monkeypatch.setattr(runner, "evaluate", evaluate)
    config = set_train_options(CONFIG, {"select_every": 80, "select_episodes": 2})
    folder = tmp_path / "run"
    options = {"physics": "native", "observation": "state", "max_steps": 9, "start": "in_grasp"}
    env = mjx_arm.make("B", reward=pay_seven, lift=0.25, **options)
    (result,), _ = train(folder, config, env=env, algorithm=make_own)
    assert all(np.isfinite(row["own"]) for row in read_metrics(folder)[1:])
    assert "loss" not in read_metrics(folder)[0]
    # It is the one that judges, too: nothing takes 1,000 steps.
    assert result.mean_length <= 9
    assert mean_rewards(folder) == pytest.approx([7.0] * len(mean_rewards(folder)))
    saved = load_run(folder)
    assert saved.config.env == env.config
    assert set(saved.objects) == {"env", "algorithm", "reward"}
    agent = mjx_arm.load_agent(folder, env=env, algorithm=make_own)
    assert agent.env is env
    assert isinstance(agent.algorithm, OwnDQN)
    with pytest.raises(ValueError, match="pass it again as algorithm="):
        mjx_arm.load_agent(folder, env=env)
    with pytest.raises(ValueError, match="make env= with scene, max_steps, which it has options"):
        mjx_arm.load_agent(folder, env=env, algorithm=make_own, scene="arm_cube", max_steps=20)
    with pytest.raises(ValueError, match="pass it again as env="):
        resume(folder, algorithm=make_own, total_steps=320)
    other = mjx_arm.make("B", reward=pay_seven, lift=0.2, **options)
    with pytest.raises(ValueError, match=r"an env= of lift = 0\.25, got 0\.2"):
        resume(folder, env=other, algorithm=make_own, total_steps=320)
    resume(folder, env=env, algorithm=make_own, total_steps=320)
    assert [row["env_steps"] for row in read_metrics(folder)] == [80, 160, 240, 320]


def test_the_folder_is_named_first_and_then_each_phase(plain):
    lines = (plain.parent / "output.txt").read_text().splitlines()
    assert lines[0] == f"run folder: {plain}"
    assert lines[1].startswith("device: ")
    phases = [
        *("compiling: about a minute", "starting the environments", "training: 240 "),
        *("drawing the curves", "evaluating: 2 episodes", "rendering a video"),
        "writing the report",
    ]
    found = [next(i for i, line in enumerate(lines) if line.startswith(phase)) for phase in phases]
    assert found == sorted(found)


def test_a_program_that_forbids_rank_promotion_can_train(tmp_path):
    """As by `JAX_NUMPY_RANK_PROMOTION=raise`, which is meant for the program's own arrays."""
    with jax.numpy_rank_promotion("raise"):
        train(tmp_path / "run")
        resume(tmp_path / "run", total_steps=320)
        with pytest.raises(ValueError, match="rank_promotion"):
            jnp.ones((2, 3)) + jnp.ones(3)
    assert [row["env_steps"] for row in read_metrics(tmp_path / "run")] == [80, 160, 240, 320]


def test_own_parts_reach_a_trainer():
    def reward(before, after, action):
        return {"one": jnp.ones_like(after.measured["height"])}

    trainer = make_trainer(CONFIG, reward=reward, network=Own())
    state, counts = trainer.run_chunk(trainer.init(jax.random.key(0)))
    assert set(state.learner.params["params"]) == {"own"}
    steps = ~np.asarray(state.replay.steps.masked)[: CONFIG.chunk_length]
    paid = np.asarray(state.replay.steps.reward)[: CONFIG.chunk_length]
    np.testing.assert_allclose(paid[steps], 0.2)
    assert counts["updates"] > 0
    env = mjx_arm.make("A", physics="native", observation="state", max_steps=9)
    trainer = make_trainer(CONFIG, env=env, algorithm=make_own)
    assert trainer.env is env
    assert trainer.config.env == env.config
    assert isinstance(trainer.algorithm, OwnDQN)
    _, counts = trainer.run_chunk(trainer.init(jax.random.key(0)))
    assert counts["own_updates"] > 0
    with pytest.raises(ValueError, match="env= and reward= exclude each other"):
        make_trainer(CONFIG, env=env, reward=reward)


@pytest.mark.parametrize("inside", [False, True], ids=["as it is", "in an environment"])
def test_a_lambda_trains_and_the_run_says_that_it_cannot_be_resumed(inside, tmp_path):
    folder = tmp_path / "run"
    reward = lambda before, after, action: {"height": after.measured["height"]}  # noqa: E731
    parts = {"reward": reward}
    if inside:
        options = {"physics": "native", "observation": "state", "max_steps": 15}
        parts = {"env": mjx_arm.make("A", reward=reward, **options)}
    results, output = train(folder, **parts)
    assert [result.episodes for result in results] == [2]
    assert "warning: reward is " in output
    assert "which no other process can have: this run cannot be resumed" in output
    assert load_run(folder).config.env.reward.endswith("<lambda>")
    made = "reward=.*, which only the process that" if not inside else "env=.*: pass it again"
    with pytest.raises(ValueError, match=f"was made with {made}"):
        resume(folder, total_steps=800)
    if inside:
        parts = {"env": mjx_arm.make("A", reward=lambda *step: reward(*step), **options)}
        with pytest.raises(ValueError, match=r"was made with reward=.*, which only the process"):
            resume(folder, total_steps=800, **parts)


def test_a_network_with_other_actions_or_none_at_all_is_rejected():
    trainer = make_trainer(CONFIG, network=Own(num_actions=13))
    with pytest.raises(ValueError, match=r"Q-values of shape \[4, 14\].*, got \[4, 13\]"):
        trainer.shapes()
    for network in ("os:path", "json:dumps", "builtins:dict"):
        with pytest.raises(ValueError, match=f"network '{network}' must be a Flax module"):
            make_trainer(set_train_options(CONFIG, {"network": network}))
    with pytest.raises(ValueError, match=r"network '.*test_runner:Own' must be a Flax module, got"):
        make_trainer(CONFIG, network=Own)


def test_on_chunk_sees_metrics_and_state_of_every_chunk(plain, tmp_path):
    seen = []

    def on_chunk(rows, state):
        assert len(rows) == 1
        seen.append((rows[0], int(state.vector_step), jax.device_get(state.learner.params)))

    folder = tmp_path / "run"
    train(folder, on_chunk=on_chunk)
    assert [step for _, step, _ in seen] == [20, 40, 60]
    for (metrics, _, _), row in zip(seen, read_metrics(folder), strict=True):
        assert repr(metrics) == repr(row)
    # A look changes nothing.
    timeless = [
        [{**row, "steps_per_s": 0, "wall_s": 0} for row in read_metrics(x)] for x in (folder, plain)
    ]
    assert repr(timeless[0]) == repr(timeless[1])
    last = mjx_arm.load_agent(folder / "last.safetensors")
    assert jax.tree.structure(last.params) == jax.tree.structure(seen[-1][2])
    for before, after in itertools.pairwise(params for _, _, params in seen):
        pairs = zip(*map(jax.tree.leaves, (before, after)), strict=True)
        assert all((a != b).any() for a, b in pairs)


def test_an_error_of_on_chunk_ends_the_run(tmp_path):
    def on_chunk(rows, state):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        train(tmp_path / "run", on_chunk=on_chunk)


def test_stop_at_ends_the_run_when_a_selection_reaches_it(tmp_path, monkeypatch):
    rates = iter([0.5, 0.8, 0.9])

    class Judged:
        def __init__(self, rate):
            self.rate = rate

    monkeypatch.setattr(
        runner, "make_evaluator", lambda *a, **o: lambda params, key: Judged(next(rates))
    )
    folder = tmp_path / "run"
    config = set_train_options(CONFIG, {"select_every": 80})
    _, said = train(folder, config, stop_at=0.75)
    assert "stopped: every seed has reached 0.75" in said
    assert [row["selection_rate"] for row in read_metrics(folder)] == [0.5, 0.8]
    # It ended as any other run does, and can be resumed.
    assert RunCheckpoints(folder).steps() == [40]
    assert mjx_arm.load_agent(folder).selection_rate == 0.8
    assert mjx_arm.load_agent(folder / "last.safetensors").env_steps == 160


def test_minutes_end_a_run_and_count_over_its_starts(tmp_path):
    folder = tmp_path / "run"
    # Any chunk takes longer than this.
    _, said = train(folder, minutes=1e-9)
    assert [row["env_steps"] for row in read_metrics(folder)] == [80]
    assert "stopped: trained for 1e-09 minutes" in said
    assert (folder / "evaluation.json").is_file()
    resume(folder, minutes=1e-9)
    assert [row["env_steps"] for row in read_metrics(folder)] == [80, 160]
    resume(folder, minutes=60.0)
    assert [row["env_steps"] for row in read_metrics(folder)] == [80, 160, 240]


def test_minutes_that_are_none_are_rejected(tmp_path):
    with pytest.raises(ValueError, match="minutes must be a finite number above 0 or None"):
        train(tmp_path / "run", minutes=0.0)


@pytest.mark.parametrize("stop_at", [0.0, 1.5, float("nan")])
def test_a_stop_that_is_no_share_is_rejected(stop_at, tmp_path):
    with pytest.raises(
        ValueError, match="stop_at must be a finite number above 0 and of at most 1 or None, got"
    ):
        train(tmp_path / "run", stop_at=stop_at)


def test_init_from_starts_with_the_network_of_an_agent(plain, tmp_path):
    agent = mjx_arm.load_agent(plain)
    first = []
    folder = tmp_path / "run"
    # Nothing is learnt before the end, so that what it starts from is what it ends with.
    config = set_train_options(CONFIG, {"learning_starts": 10**6, "seed": 5})
    train(
        folder,
        config,
        init_from=plain,
        on_chunk=lambda rows, state: first.append(jax.device_get(state.learner)),
    )
    for one in (first[-1].params, first[-1].target_params):
        for a, b in zip(*map(jax.tree.leaves, (one, agent.params)), strict=True):
            np.testing.assert_array_equal(a, b)
    again = mjx_arm.load_agent(folder)
    for a, b in zip(*map(jax.tree.leaves, (again.params, agent.params)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_init_from_another_network_or_nothing_is_rejected_before_a_folder_is_made(plain, tmp_path):
    other = set_train_options(CONFIG, {"hidden": 17})
    folder = tmp_path / "run"
    with pytest.raises(ValueError, match="holds the parameters of another network than this run"):
        train(folder, other, init_from=plain)
    with pytest.raises(ValueError, match="not a run folder and not an agent"):
        train(folder, init_from=tmp_path / "nothing")
    assert not folder.exists()


def test_a_folder_in_use_is_rejected(plain):
    from mjx_arm.training.run_folder import locked

    with (
        locked(plain),
        pytest.raises(ValueError, match="is in use by another process"),
    ):
        resume(plain, total_steps=320)


def test_config_is_frozen_while_it_trains(plain):
    with pytest.raises(dataclasses.FrozenInstanceError):
        load_run(plain).config.seed = 3


def test_it_is_said_why_devices_are_left_out(monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 3)
    output = io.StringIO()
    console = Console(file=output, width=200)
    config = train_config(num_envs=64, batch_size=64)
    assert runner._num_devices(config, Objects(), None, console) == 2
    assert output.getvalue() == (
        "2 of 3 devices are used: num_envs must be a multiple of the number of devices, 3, got 64\n"
    )
    assert runner._num_devices(config, Objects(), 1, console) == 1


def test_a_run_from_an_agent_that_is_killed_early_goes_on_from_it(plain, tmp_path):
    folder, agent = tmp_path / "run", mjx_arm.load_agent(plain)

    def fail(rows, state):
        raise RuntimeError("killed")

    config = set_train_options(CONFIG, {"learning_starts": 10**6, "seed": 5})
    with pytest.raises(RuntimeError, match="killed"):
        train(folder, config, init_from=plain, on_chunk=fail)
    assert RunCheckpoints(folder).steps() == [0]
    resume(folder)
    again = mjx_arm.load_agent(folder)
    for a, b in zip(*map(jax.tree.leaves, (again.params, agent.params)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_stop_at_needs_selections(tmp_path):
    with pytest.raises(ValueError, match=r"of which there are none: got 0\.5 with select_every 0"):
        train(tmp_path / "run", stop_at=0.5)
    assert not (tmp_path / "run").exists()


def test_the_configuration_of_another_program_beside_a_run_is_left_alone(tmp_path):
    (tmp_path / "config.json").write_text('{"name": "a web page"}')
    runner._check_whole_run(tmp_path / "run")


def test_an_environment_with_other_starts_is_rejected(tmp_path):
    given = set_train_options(CONFIG, {"placement": "after_success"})
    with pytest.raises(ValueError, match="env= of placement = None, got after_success"):
        runner._check_same_env(CONFIG, given, tmp_path)
