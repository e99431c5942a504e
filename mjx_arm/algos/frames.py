"""How the replay stores a frame, and how an observation is made from it again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from mjx_arm.envs.auto_reset import AutoResetState
from mjx_arm.envs.env import Env
from mjx_arm.envs.state import EnvState

Obs = Any
Frame = Any


@dataclasses.dataclass(frozen=True)
class Frames:
    """Encodes what the environments show, and decodes it.

    Attributes:
      observe: `(envs [N]) -> obs [N, ...]`, what the policy sees.
      encode: `(envs [N], obs [N, ...]) -> frame`, a pytree of `[N, ...]` to be stored.
      decode: `(frame) -> obs`.
      features: `(frame) -> [N, F] float32`, the state features, where they are stored.
    """

    observe: Callable[[AutoResetState], Obs]
    encode: Callable[[AutoResetState, Obs], Frame]
    decode: Callable[[Frame], Obs]
    features: Callable[[Frame], jax.Array]


def make_frames(env: Env, storage: str, *, with_features: bool = False) -> Frames:
    """Makes the functions of a storage.

    Args:
      env: the environment.
      storage: `"states"` keeps what a frame can be rendered from again, `"pixels"` the image.
      with_features: whether to store the state features beside it.
    """
    observe = jax.vmap(lambda state: env.observe(state.env))

    def features(frame: Frame) -> jax.Array:
        stored: jax.Array = frame["features"]
        return stored

    if env.config.observation == "state":
        return Frames(observe, lambda envs, obs: {"features": obs}, features, features)

    def render(frame: Frame) -> jax.Array:
        return env.look(frame["qpos"], frame["params"])[0]

    def state_of(state: EnvState) -> Frame:
        return {"qpos": env.shown_qpos(state), "params": env.image_params(state.params)}

    def encode(envs: AutoResetState, obs: Obs) -> Frame:
        frame = jax.vmap(state_of)(envs.env) if storage == "states" else {"obs": obs}
        if with_features:
            frame["features"] = jax.vmap(env.features)(envs.env)
        return frame

    decode = jax.vmap(render) if storage == "states" else lambda frame: frame["obs"]

    def without_features(frame: Frame) -> Obs:
        return decode({name: x for name, x in frame.items() if name != "features"})

    return Frames(observe, encode, without_features, features)
