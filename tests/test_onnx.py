"""In the environment of `make onnx`: `make test-onnx`."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_arm.cli import main
from mjx_arm.export import policy_function
from mjx_arm.training.agent import load_agent

pytestmark = pytest.mark.onnx


@pytest.mark.parametrize("name", ["agent-a", "agent-b"])
def test_the_model_is_the_original(name: str, tmp_path) -> None:
    """By onnxruntime, on 1,000 images."""
    import jax
    import onnxruntime

    path = tmp_path / "policy.onnx"
    assert main(["export", name, "--format", "onnx", "--out", str(path)]) == 0
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    agent = load_agent(name)
    policy = jax.jit(policy_function(agent))
    images = np.random.default_rng(0).integers(0, 256, (1_000, 64, 64, 3), np.uint8)
    assert [x.name for x in session.get_inputs()] == ["image"]
    for i, image in enumerate(images):
        if i % 2:
            image = np.sort(image.reshape(-1, 3), axis=0).reshape(image.shape)  # smooth ones
        q, action = session.run(["q_values", "action"], {"image": image})
        expected, best = policy(image)
        assert np.abs(q - expected).max() < 1e-4
        gap = np.diff(np.sort(np.asarray(expected))[-2:])[0]
        assert action == best or gap < 1e-4
