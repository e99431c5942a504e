"""Figure 1: the scenes, by the renderer in JAX and by MuJoCo's."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from mjx_arm.envs.env import Env, make
from mjx_arm.envs.scripted import make_scripted_policy
from mjx_arm.reproduce.opengl import render_by_mujoco
from mjx_arm.reproduce.strips import enlarge, make_frames, strip

# The scene of the paper's environments, and the one that looks like a real desk.
SCENES = ("arm_cube", "arm_cube_desk")
EDGE, NETWORK_EDGE = 224, 64
# Of the two starts in B; the scripted episode has the second one.
_SEED, _OTHER_SEED = 0, 1
_MOST_STEPS = 400


def measure_scene(scene: str) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Renders moments of both environments by both renderers, at camera and at network size.

    Args:
      scene: a scene's name.

    Returns:
      For each size the difference between the renderers, in 1/255 of a colour channel, and a strip
      of the images.
    """
    states = _moments(scene)
    env = make("A", scene=scene, observation="packed", physics="auto")
    qpos = np.stack(list(states.values()))
    large, small = make_frames(env, edge=EDGE), make_frames(env)
    ours = {EDGE: large(qpos, {}), NETWORK_EDGE: small(qpos, {})}
    names = {EDGE: "camera", NETWORK_EDGE: "network"}
    rows, labels, result = [], [], {"moments": list(states), "edges": [EDGE, NETWORK_EDGE]}
    try:
        sizes = {EDGE: True, NETWORK_EDGE: env.config.shadows}
        found = render_by_mujoco(env.scene.mj_model, qpos, env.config.cameras[0], sizes)
        theirs = dict(zip(ours, found, strict=True))
    except ValueError as error:
        theirs, result["mujoco_missing"] = {}, str(error)
    for edge, images in ours.items():
        rows.append(enlarge(images, EDGE))
        labels.append([] if edge in theirs else list(states))
        if edge in theirs:
            rows.append(enlarge(theirs[edge], EDGE))
            labels.append(list(states))
            result[names[edge]] = _difference(images, theirs[edge])
    return result, {f"figure1-{scene}.png": strip(rows, labels)}


def _difference(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    gap = np.abs(ours.astype(float) - theirs.astype(float))
    return {
        "median": float(np.median(gap)),
        "mean": float(gap.mean()),
        "share_of_pixels_above_16": float((gap.max(axis=-1) > 16).mean()),
    }


def _moments(scene: str) -> dict[str, np.ndarray]:
    """States by name, `[nq] float32`: starts of A and B, and moments of a scripted episode in B."""
    a, b = (make(env, scene=scene, observation="state") for env in ("A", "B"))
    found = {"A: start": _start(a, _SEED), "B: start": _start(b, _SEED)}
    found["B: another start"] = _start(b, _OTHER_SEED)
    return found | _scripted(b)


def _start(env: Env, seed: int) -> np.ndarray:
    return np.asarray(jax.jit(env.reset)(jax.random.key(seed))[1].physics.qpos)


def _scripted(env: Env) -> dict[str, np.ndarray]:
    """The first grasp and the end of an episode by the scripted policy."""
    policy, step = jax.jit(make_scripted_policy(env)), jax.jit(env.transition)
    state = jax.jit(env.reset)(jax.random.key(_OTHER_SEED))[1]
    found: dict[str, np.ndarray] = {}
    for _ in range(_MOST_STEPS):
        state, transition = step(state, policy(state))
        if bool(transition.metrics["grasped"]):
            found.setdefault("B: grasped", np.asarray(state.physics.qpos))
        if bool(transition.terminated):
            found["B: lifted"] = np.asarray(state.physics.qpos)
            break
    return found
