from __future__ import annotations

import dataclasses
import importlib
import sys

import pytest

from mjx_arm.config import train_config
from mjx_arm.training.objects import Objects, check_record, record

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


def test_what_no_other_process_can_import_is_refused(own):
    def local(before, after, action):
        return {}

    for value in (lambda before, after, action: {}, local):
        with pytest.raises(ValueError, match=r"reward is .* which no other process can import"):
            record(train_config(), Objects(reward=value))


def test_what_has_no_source_is_refused():
    with pytest.raises(ValueError, match=r"the source of 'builtins:.*' is not in a file"):
        record(train_config(), Objects(reward=sum))


def test_only_what_was_given_counts(own):
    assert Objects().given() == {}
    objects = Objects(network=own.Net())
    assert set(objects.given()) == {"network"}
    assert set(dataclasses.asdict(Objects())) == {"env", "network", "reward", "algorithm"}
