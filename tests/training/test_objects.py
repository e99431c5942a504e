from __future__ import annotations

import dataclasses
import functools
import importlib
import subprocess
import sys

import pytest

from mjx_arm.config import train_config
from mjx_arm.references import reference_to
from mjx_arm.training.objects import Objects, check_record, only_here, record

MODULE = """
import flax.linen as nn


def reward(before, after, action):
    return {"nothing": 0.0 * after.measured["height"]}


def other(before, after, action):
    return {"height": after.measured["height"]}


class Net(nn.Module):
    num_actions: int = 14

    @nn.compact
    def __call__(self, obs):
        return nn.Dense(self.num_actions)(obs)
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


def test_a_different_one_is_refused(own):
    found = record(train_config(), Objects(reward=own.reward))
    with pytest.raises(ValueError, match="made with reward=own_parts:reward, got own_parts:other"):
        check_record(found, train_config(), Objects(reward=own.other), "here")


def test_an_unexpected_one_is_refused(own):
    with pytest.raises(ValueError, match="made without reward=, got own_parts:reward"):
        check_record({}, train_config(), Objects(reward=own.reward), "here")


def change_source(own, tmp_path) -> None:
    (tmp_path / "own_parts.py").write_text(MODULE.replace("0.0 *", "1.0 *"))
    import linecache

    linecache.checkcache()
    importlib.reload(own)


def test_changed_source_is_refused(own, tmp_path):
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
