"""What varies by episode: the colour of the cube and the friction of its contacts.

On the command line: `mjx-arm train --task own_randomisation:varied_lift --env B`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import mjx_arm
from mjx_arm.envs.tasks.lift import Lift, LiftConfig


class VariedLift(Lift):
    """The task `lift` with a placement that also says how the cube looks and how it grips."""

    def __init__(self, config, scene, arm):
        super().__init__(config, scene, arm)
        model = scene.mj_model
        touches = (model.pair_geom1 == self.cube_geom) | (model.pair_geom2 == self.cube_geom)
        pairs = np.flatnonzero(touches).tolist()
        self.friction = model.pair_friction[pairs].astype(np.float32)
        # Name of a field of MjModel -> the ids of its rows that vary.
        self.varies = {"geom_rgba": (self.cube_geom,), "pair_friction": tuple(pairs)}
        self.rgba = model.geom_rgba[self.cube_geom].astype(np.float32)

    def fixed_placement(self):
        own = {"rgba": jnp.asarray(self.rgba), "grip": jnp.float32(1)}
        return {"place": super().fixed_placement(), **own}

    def sample_placement(self, key):
        place, colour, grip = jax.random.split(key, 3)
        return {
            "place": super().sample_placement(place),
            "rgba": jnp.append(jax.random.uniform(colour, (3,)), jnp.float32(1)),
            "grip": jax.random.uniform(grip, (), jnp.float32, 0.7, 1.3),
        }

    def start(self, qpos, ctrl, placement):
        qpos, ctrl, _ = super().start(qpos, ctrl, placement["place"])
        friction = placement["grip"] * self.friction
        return qpos, ctrl, {"geom_rgba": placement["rgba"][None], "pair_friction": friction}


units = {"height": "m", "distance": "m"}
mjx_arm.register("varied_lift", VariedLift, config=LiftConfig, scene="arm_cube", units=units)


def main() -> None:
    """Prints what three episodes of environment B have."""
    env = mjx_arm.make("B", task="varied_lift", placement="always")
    obs, state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 3))
    print("images", obs.shape, "colours", np.round(state.params["geom_rgba"][:, 0, :3], 2).tolist())
    print("friction, times that of the scene", np.round(state.placement["grip"], 2).tolist())


if __name__ == "__main__":
    main()
