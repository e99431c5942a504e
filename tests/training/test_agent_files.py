"""An agent is one file: what is in it is checked, and nothing else decides how it acts."""

from __future__ import annotations

import json
import pathlib
import random

import jax
import numpy as np
import pytest
import safetensors.numpy

from mjx_arm import load_agent, load_scene
from mjx_arm.cli import main
from mjx_arm.config import train_config
from mjx_arm.envs.env import make_env
from mjx_arm.training.agent import (
    _digest,
    add_evaluation,
    find_agent,
    flatten_params,
    read_agent,
    save_agent,
)
from mjx_arm.training.algorithm import make_algorithm

CONFIG = train_config(observation="state", physics="native", hidden=16)


def write_agent(path: pathlib.Path, config=CONFIG) -> None:
    env = make_env(config.env)

    def init():
        obs, _ = env.reset(jax.random.key(0))
        return make_algorithm(config, env).init_policy(jax.random.key(1), obs[None])

    rng = np.random.default_rng(0)
    shapes = flatten_params(jax.eval_shape(init))
    params = {name: rng.normal(size=x.shape).astype(np.float32) for name, x in shapes.items()}
    save_agent(path, config, params, scene=env.scene.source, objects={}, env_steps=7)


@pytest.fixture(scope="module")
def agent_file(tmp_path_factory) -> pathlib.Path:
    path = tmp_path_factory.mktemp("agent") / "some.safetensors"
    write_agent(path)
    return path


def reseal(path: pathlib.Path, tensors=None, **changed: str) -> None:
    """Writes an agent with other contents and a digest that fits."""
    metadata, before = read_agent(path)
    metadata, tensors = metadata | changed, tensors or before
    metadata["sha256"] = _digest(metadata, tensors)
    path.write_bytes(safetensors.numpy.save(tensors, metadata))


@pytest.fixture
def copy(agent_file, tmp_path) -> pathlib.Path:
    path = tmp_path / "copy.safetensors"
    path.write_bytes(agent_file.read_bytes())
    return path


def test_fifty_flipped_bits_are_all_found(agent_file, tmp_path):
    content, rng = agent_file.read_bytes(), random.Random(0)
    header = 8 + int.from_bytes(content[:8], "little")
    # Half of them in the header, which is the smaller part.
    places = [rng.randrange(8 * header) for _ in range(25)]
    places += [rng.randrange(8 * len(content)) for _ in range(25)]
    damaged = tmp_path / "damaged.safetensors"
    for place in places:
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        damaged.write_bytes(flipped)
        with pytest.raises(ValueError, match=r"damaged|is not the file of an agent"):
            load_agent(damaged)


@pytest.mark.parametrize("size", [0, 5, 1000, -1])
def test_a_file_that_was_cut_off_is_rejected(size, agent_file, copy):
    copy.write_bytes(agent_file.read_bytes()[:size])
    with pytest.raises(ValueError, match="is not the file of an agent, or it is damaged"):
        load_agent(copy)


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_parameters_that_are_not_finite_are_rejected_by_name(value, copy):
    tensors = read_agent(copy)[1]
    name = sorted(tensors)[0]
    tensors[name].flat[-1] = value
    reseal(copy, tensors)
    with pytest.raises(ValueError, match=f"'{name}' must hold finite numbers"):
        load_agent(copy)


@pytest.mark.parametrize("dtype", [np.float64, np.int32])
def test_parameters_of_another_type_are_rejected_by_name(dtype, copy):
    tensors = read_agent(copy)[1]
    name = sorted(tensors)[0]
    tensors[name] = tensors[name].astype(dtype)
    reseal(copy, tensors)
    with pytest.raises(ValueError, match=f"'{name}' must be of type float32, got"):
        load_agent(copy)


def test_parameters_of_another_network_are_rejected(copy):
    tensors = read_agent(copy)[1]
    tensors.pop(sorted(tensors)[0])
    reseal(copy, tensors)
    with pytest.raises(ValueError, match="holds the parameters of another network"):
        load_agent(copy)


def test_the_card_of_a_shipped_agent_is_the_file_beside_it(tmp_path):
    shipped = find_agent(pathlib.Path("agent-b"))
    assert load_agent("agent-b").card == shipped.with_suffix(".md").read_text(encoding="utf-8")
    copied = tmp_path / shipped.name
    copied.write_bytes(shipped.read_bytes())
    copied.with_suffix(".md").write_text("Notes of somebody.")
    assert load_agent(copied).card == ""


def test_an_evaluation_and_a_card_are_part_of_the_file(copy):
    reseal(copy, card="Lifts cubes — most of the time.")
    add_evaluation(copy, {"episodes": 10, "successes": 9})
    agent = load_agent(copy)
    assert agent.card == "Lifts cubes — most of the time."
    assert agent.evaluation == {"episodes": 10, "successes": 9}
    assert (agent.env_steps, agent.selection_rate) == (7, None)
    assert json.loads(read_agent(copy)[0]["scene"])["xml"] == load_scene("arm_cube").xml


@pytest.fixture
def own_scene(tmp_path, monkeypatch) -> pathlib.Path:
    """An agent of a scene with a relative path, and the folder that the path is relative to."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "desk.xml").write_text(load_scene("arm_cube").xml)
    write_agent(
        tmp_path / "own.safetensors",
        train_config(observation="state", physics="native", hidden=16, scene="desk.xml"),
    )
    return tmp_path


def test_an_agent_of_a_relative_scene_is_loaded_elsewhere(own_scene, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert load_agent(own_scene / "own.safetensors").env.scene.name == "desk.xml"


def test_a_scene_that_has_changed_needs_a_choice(own_scene, capsys):
    agent = own_scene / "own.safetensors"
    before = (own_scene / "desk.xml").read_text()
    (own_scene / "desk.xml").write_text(before.replace("</mujoco>", "<!-- moved -->\n</mujoco>"))
    for command in ("eval", "play"):
        assert main([command, str(agent)]) == 2
        error = capsys.readouterr().err
        assert error == (
            f"error: the scene 'desk.xml' is not the one that {agent} was trained in: give "
            "--scene stored for the one in the file, or --scene desk.xml for the one here\n"
        )
    assert load_agent(agent, scene="stored").env.scene.xml == before
    assert "moved" in load_agent(agent, scene="desk.xml").env.scene.xml
    other = load_agent(agent, scene="arm_cube")
    assert (other.env.scene.name, other.config.env.scene) == ("arm_cube", "arm_cube")


@pytest.mark.parametrize("path", [None, 5, True])
def test_a_path_that_is_none_is_rejected(path):
    with pytest.raises(ValueError, match="path must be text, got"):
        load_agent(path)


def test_an_agent_of_the_first_version_is_named(tmp_path):
    path = tmp_path / "best.agent"
    path.write_bytes(b"anything")
    with pytest.raises(ValueError, match=r"best\.agent is an agent of mjx_arm 0\.1, which this"):
        load_agent(path)


def test_an_epsilon_that_is_no_share_is_rejected(agent_file):
    agent = load_agent(agent_file)
    for epsilon in (float("nan"), -0.1, 1.1, "0.1", True, None):
        with pytest.raises(ValueError, match="epsilon must be a finite number from 0 to 1, got"):
            agent.act(np.zeros(3, np.float32), jax.random.key(0), epsilon)
