from __future__ import annotations

import dataclasses
import functools
import importlib
import subprocess
import sys

import pytest

from mjx_arm.cli.parse import parse
from mjx_arm.cli.process import main
from mjx_arm.config import train_config
from mjx_arm.envs import tasks
from mjx_arm.references import reference_to
from mjx_arm.scene import load_scene
from mjx_arm.training.objects import Objects, check_record, only_here, parse_record, record
from mjx_arm.training.run_folder import SavedRun, save_run

MODULE = """
import flax.linen as nn


def reward(before, after, action):
    return {"nothing": 0.0 * after.measured["height"]}


def other(before, after, action):
    return {"height": after.measured["height"]}


class Net(nn.Module):
    num_actions: int = 14
    activation: object = nn.relu

    @nn.compact
    def __call__(self, obs):
        return nn.Dense(self.num_actions)(self.activation(obs))


class OwnTask:
    pass


class Pay:
    def __init__(self, much):
        self.much = much

    def __repr__(self):
        return f"Pay({self.much})"

    def reward(self, before, after, action):
        return {"pay": self.much + 0.0 * after.measured["height"]}
"""

SCRIPT = """
if __name__ == "__main__":
    import json
    import pathlib
    import sys

    from mjx_arm.config import train_config
    from mjx_arm.training.objects import Objects, check_record, only_here, record

    file, objects = pathlib.Path(sys.argv[1]), Objects(network=Net())
    if not file.exists():
        file.write_text(json.dumps(record(train_config(), objects)))
    recorded = json.loads(file.read_text())
    assert only_here(recorded) == []
    check_record(recorded, train_config(), objects, str(file))
    print(recorded["network"]["given"])
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A user's module, on the Python path."""
    (tmp_path / "own_parts.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield importlib.import_module("own_parts")
    sys.modules.pop("own_parts", None)


def test_nothing_of_ones_own_leaves_an_empty_record():
    assert record(train_config(), Objects()) == {}
    check_record({}, train_config(), Objects(), "here")


def test_a_record_has_path_and_digest(own):
    found = record(train_config(), Objects(reward=own.reward, network=own.Net()))
    assert set(found) == {"reward", "network"}
    assert found["reward"]["given"] == "own_parts:reward"
    assert found["network"]["given"] == "own_parts:Net"
    assert all(len(entry["sha256"]) == 64 for entry in found.values())
    assert found["reward"] != record(train_config(), Objects(reward=own.other))["reward"]


def test_the_same_objects_pass(own):
    objects = Objects(reward=own.reward, network=own.Net())
    check_record(record(train_config(), objects), train_config(), objects, "here")


def test_a_missing_one_is_asked_for_by_name(own):
    found = record(train_config(), Objects(reward=own.reward))
    with pytest.raises(ValueError, match="made with reward=own_parts:reward: pass it again as"):
        check_record(found, train_config(), Objects(), "here")


def test_a_different_one_is_rejected(own):
    found = record(train_config(), Objects(reward=own.reward))
    with pytest.raises(ValueError, match="made with reward=own_parts:reward, got own_parts:other"):
        check_record(found, train_config(), Objects(reward=own.other), "here")


def test_an_unexpected_one_is_rejected(own):
    with pytest.raises(ValueError, match="made without reward=, got own_parts:reward"):
        check_record({}, train_config(), Objects(reward=own.reward), "here")


def change_source(own, tmp_path, old="0.0 *", new="1.0 *") -> None:
    assert old in MODULE
    (tmp_path / "own_parts.py").write_text(MODULE.replace(old, new))
    import linecache

    linecache.checkcache()
    importlib.reload(own)


def test_changed_source_is_rejected(own, tmp_path):
    found = record(train_config(), Objects(reward=own.reward))
    change_source(own, tmp_path)
    with pytest.raises(ValueError, match="reward=own_parts:reward, whose source has changed"):
        check_record(found, train_config(), Objects(reward=own.reward), "here")


def test_what_a_configuration_names_is_recorded_and_checked(own, tmp_path):
    config = train_config(reward="own_parts:reward", network="own_parts:Net")
    found = record(config, Objects())
    assert set(found) == {"reward", "network"}
    assert found["reward"]["path"] == "own_parts:reward"
    check_record(found, config, Objects(), "here")
    change_source(own, tmp_path)
    with pytest.raises(ValueError, match="reward=own_parts:reward, whose source has changed"):
        check_record(found, config, Objects(), "here")


def test_the_values_of_an_instance_count(own):
    config = train_config()
    for first, other in (
        (Objects(network=own.Net()), Objects(network=own.Net(num_actions=3))),
        (Objects(network=own.Net()), Objects(network=own.Net(activation=len))),
        (Objects(reward=own.Pay(1).reward), Objects(reward=own.Pay(2).reward)),
    ):
        found = record(config, first)
        check_record(found, config, first, "here")
        ((name, entry),) = found.items()
        assert " at 0x" not in entry["repr"]
        with pytest.raises(ValueError, match=rf"here was made with {name}=.*, got .*: pass the"):
            check_record(found, config, other, "here")
        # Records of the version before have no values.
        del entry["repr"]
        check_record(found, config, other, "here")


@pytest.fixture
def register(monkeypatch):
    """Registers a task that leaves again with the test."""
    monkeypatch.setattr(tasks, "_tasks", dict(tasks._tasks))
    return tasks.register


def test_a_registered_task_that_is_not_of_the_package_counts(own, register, tmp_path):
    register("own_task", own.OwnTask)
    config = train_config(task="own_task")
    found = record(config, Objects())
    assert found["task"]["path"] == "own_parts:OwnTask"
    assert only_here(found) == []
    check_record(found, config, Objects(), "here")
    assert record(train_config(task="reach", reward=""), Objects()) == {}
    change_source(own, tmp_path, "    pass", "    lift = 0.2")
    with pytest.raises(ValueError, match="task=own_parts:OwnTask, whose source has changed since"):
        check_record(found, config, Objects(), "here")


def test_a_registered_task_that_no_file_has_counts_in_this_process_alone(register):
    register("local_task", make_local())
    config = train_config(task="local_task")
    found = record(config, Objects())
    assert len(only_here(found)) == 1
    check_record(found, config, Objects(), "here")
    found["task"]["only_in"] = "the token of another process"
    with pytest.raises(ValueError, match=r"task=.*, which only the process that made it had"):
        check_record(found, config, Objects(), "here")


def test_the_reward_of_an_own_environment_is_the_one_that_it_has(own):
    """The environment was made with it; nobody else may have it."""
    for reward, lasting in ((own.reward, True), (make_local(), False)):
        config = train_config(reward=reference_to(reward))
        env = OwnEnv(config.env, reward)
        found = record(config, Objects(env=env))
        assert set(found) == {"env", "reward"}
        assert found["reward"]["path"] == reference_to(reward)
        assert (only_here(found) == []) == lasting
        check_record(found, config, Objects(env=env), "here")
        with pytest.raises(ValueError, match="pass it again as env="):
            check_record(found, config, Objects(), "here")
        if not lasting:
            other = Objects(env=OwnEnv(config.env, make_local()))
            with pytest.raises(ValueError, match=r"reward=.*, which only the process"):
                check_record(found, config, other, "here")


class OwnEnv:
    def __init__(self, config, reward):
        self.config, self.reward = config, reward


@pytest.mark.parametrize("command", ["train", "sweep"])
def test_a_command_line_does_not_start_from_a_configuration_without_its_objects(
    command, own, tmp_path, capsys
):
    config = train_config(reward="own_parts:reward", total_steps=1_000)
    run = SavedRun(
        config,
        record(config, Objects(reward=own.reward, network=own.Net())),
        load_scene("arm_cube").source,
    )
    save_run(tmp_path, run)
    file = str(tmp_path / "config.json")
    for given, missing in (
        ([], "network=own_parts:Net"),
        (["--reward", "own_parts:other"], "network=own_parts:Net"),
        (["--network=own_parts:Net"], "reward=own_parts:reward"),
    ):
        assert main([command, "--config", file, *given]) == 2
        error = capsys.readouterr().err
        name = missing.split("=")[0]
        assert error == (
            f"error: {file} is of a run that was passed {missing} from Python, which the file does "
            f"not hold: give --{name} MODULE:NAME\n"
        )
    told = ["--reward", "own_parts:other", "--network", "own_parts:Net"]
    parsed, _ = parse([command, "--config", file, *told])
    assert parsed.options.total_steps == 1_000
    assert parsed.options.env.reward == "own_parts:other"
    assert parsed.options.network.network == "own_parts:Net"


def test_what_a_command_line_cannot_name_is_rejected(tmp_path, capsys):
    config = train_config()
    objects = Objects(env=OwnEnv(config.env, None))
    save_run(tmp_path, SavedRun(config, record(config, objects), load_scene("arm_cube").source))
    assert main(["train", "--config", str(tmp_path / "config.json")]) == 2
    assert "was passed env=test_objects:OwnEnv from Python" in capsys.readouterr().err


@pytest.mark.parametrize("values", [5, ["reward"], {"reward": "own"}, {"reward": {"given": 3}}])
def test_a_record_that_is_none_is_rejected(values):
    with pytest.raises(ValueError, match=r"some\.json: 'objects' must be the record of a run, got"):
        parse_record(values, "some.json")


def make_local():
    def local(before, after, action):
        return {}

    return local


@pytest.mark.parametrize(
    "value",
    [lambda before, after, action: {}, make_local(), sum, functools.partial(max, 1)],
    ids=["lambda", "function in a function", "no source", "partial"],
)
def test_what_no_other_process_can_have_counts_in_this_one_alone(value):
    config = train_config()
    found = record(config, Objects(reward=value))
    (sentence,) = only_here(found)
    assert sentence.startswith(f"reward is {reference_to(value)}, which no other process can have")
    check_record(found, config, Objects(reward=value), "here")
    for objects in (Objects(), Objects(reward=lambda before, after, action: {})):
        with pytest.raises(ValueError, match=r"here was made with reward=.* which only"):
            check_record(found, config, objects, "here")
    found["reward"]["only_in"] = "the token of another process"
    with pytest.raises(ValueError, match="which only the process that made it had"):
        check_record(found, config, Objects(reward=value), "here")


def test_what_a_script_defines_can_be_passed_again_by_the_same_script(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(MODULE + SCRIPT)
    for _ in range(2):  # the second time as a process of its own, with the record of the first
        done = subprocess.run(
            [sys.executable, script, tmp_path / "record.json"], capture_output=True, text=True
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout == "__main__:Net\n"


def test_only_what_was_given_counts(own):
    assert Objects().given() == {}
    objects = Objects(network=own.Net())
    assert set(objects.given()) == {"network"}
    assert set(dataclasses.asdict(Objects())) == {"env", "network", "reward", "algorithm"}
