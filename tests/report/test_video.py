"""Videos: their labels, and what they show."""

from __future__ import annotations

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import ImageDraw

import mjx_arm
from mjx_arm.report.video import Episode, _label, record_episode

ENV = types.SimpleNamespace(config=types.SimpleNamespace(size=(16, 24)))


@pytest.fixture
def said(monkeypatch) -> dict[str, tuple[int, int]]:
    """The texts of the labels and where they begin, x and y."""
    found = {}
    draw = ImageDraw.ImageDraw.text

    def text(self, place, text, **options):
        found[text] = place
        draw(self, place, text, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    return found


def label(step: int, *, success: bool = True) -> np.ndarray:
    qpos = np.zeros((3, 1))
    episode = Episode(qpos, qpos, np.asarray([1.0, 2.5, -3.0]), {}, success)
    return _label(np.zeros((384, 768, 3), np.uint8), ENV, episode, step)


def test_labels_name_both_sides_the_step_and_the_q_value(said):
    frame = label(1)
    assert said == {
        "scene": (6, 4),
        "what the agent sees, 24 by 16 pixels": (390, 4),
        "step 1   max Q 2.50": (6, 361),
    }
    # They can be read on both sides, and the rest of the frame is as it was.
    assert frame[:30, :384].max() == frame[:30, 384:].max() == 255
    assert not frame[40:350].any()


def test_the_agents_side_shows_what_the_agent_saw():
    env = mjx_arm.make("A", physics="native", size=(8, 8), max_steps=5, image_delay=3)
    apply = lambda params, obs: jnp.zeros((1, env.num_actions)) + params  # noqa: E731
    episode = record_episode(env, apply, jnp.zeros(()), epsilon=1.0, key=jax.random.key(0))
    assert len(episode) == 6
    assert np.ptp(episode.qpos, axis=0).max() > 0
    delay = int(episode.params["image_delay"][0])
    assert delay > 0, "another key, for an episode with a delay"
    np.testing.assert_array_equal(episode.shown[delay:], episode.qpos[:-delay])
    np.testing.assert_array_equal(episode.shown[:delay], episode.qpos[[0] * delay])


@pytest.mark.parametrize(("success", "result"), [(True, "success"), (False, "failed")])
def test_the_last_frame_says_how_the_episode_ended(said, success, result):
    label(2, success=success)
    assert f"step 2   max Q -3.00   {result}" in said
