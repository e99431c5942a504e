"""What randomisation does to the physics: masses, sizes, friction, servos, late actions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.envs.randomisation.config import Ranges
from mjx_arm.envs.randomisation.parts import (
    Growth,
    Part,
    between,
    delay_of,
    free_bodies,
    geoms_of,
    is_fixed,
    scaled,
)
from mjx_arm.varies import Params, rows

_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)


def dynamics_parts(mj_model: mujoco.MjModel, ranges: Ranges) -> list[Part]:
    """The parts that change the physics; the size of objects changes the image too."""
    found = [
        _links(mj_model, ranges),
        _objects(mj_model, ranges),
        _friction(mj_model, ranges),
        _servos(mj_model, ranges),
        _action_delay(ranges),
    ]
    return [part for part in found if part is not None]


def _links(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    """Masses of bodies on joints, with the inertias that go with them."""
    moving = (model.body_weldid != 0) & (model.body_mass > 0)
    ids = [int(i) for i in np.flatnonzero(moving) if int(i) not in free_bodies(model)]
    if is_fixed(ranges.link_mass, 1.0) or not ids:
        return None
    mass, inertia = rows(model, "body_mass")[ids], rows(model, "body_inertia")[ids]

    def make(uniform: jax.Array, growth: Growth) -> Params:
        factor = between(uniform, *ranges.link_mass, 1.0, growth)
        return {"body_mass": scaled(mass, factor), "body_inertia": scaled(inertia, factor[:, None])}

    return Part({"body_mass": tuple(ids), "body_inertia": tuple(ids)}, len(ids), make)


def _objects(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    """Sizes and masses of bodies on free joints. All geoms of a body are scaled together."""
    bodies = free_bodies(model)
    sized, weighed = not is_fixed(ranges.cube_size, 1.0), not is_fixed(ranges.cube_mass, 1.0)
    if not bodies or not (sized or weighed):
        return None
    geoms = geoms_of(model, bodies)
    apart = [i for i in geoms if model.geom_pos[i].any()]
    mass, inertia = rows(model, "body_mass")[bodies], rows(model, "body_inertia")[bodies]
    sizes, places = rows(model, "geom_size")[geoms], rows(model, "geom_pos")[apart]
    varies = {"body_inertia": tuple(bodies)}
    if weighed:
        varies["body_mass"] = tuple(bodies)
    if sized:
        varies |= {"geom_size": tuple(geoms), "geom_pos": tuple(apart)}
    of_geom, of_apart = (
        np.asarray([bodies.index(int(model.geom_bodyid[i])) for i in ids], int)
        for ids in (geoms, apart)
    )

    def make(uniform: jax.Array, growth: Growth) -> Params:
        uniform = uniform.reshape(-1, 2)
        size = between(uniform[:, 0], *ranges.cube_size, 1.0, growth)
        weight = between(uniform[:, 1], *ranges.cube_mass, 1.0, growth)
        # Of a body of one shape: mass times the square of its size.
        params = {"body_inertia": scaled(inertia, (weight * size * size)[:, None])}
        if weighed:
            params["body_mass"] = scaled(mass, weight)
        if sized:
            params["geom_size"] = scaled(sizes, size[of_geom][:, None])
            params["geom_pos"] = scaled(places, size[of_apart][:, None])
        return params

    return Part(varies, 2 * len(bodies), make)


def _friction(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    """Friction of objects: one factor where they touch what moves, one for what stands still."""
    objects = geoms_of(model, free_bodies(model))
    if is_fixed(ranges.friction, 1.0) or not objects:
        return None
    pairs = [
        i
        for i in range(model.npair)
        if int(model.pair_geom1[i]) in objects or int(model.pair_geom2[i]) in objects
    ]
    field, ids = ("pair_friction", pairs) if pairs else ("geom_friction", objects)
    still = model.body_weldid[model.geom_bodyid] == 0
    kind = [
        int(still[model.pair_geom1[i]] or still[model.pair_geom2[i]]) if pairs else 0 for i in ids
    ]
    own, which = rows(model, field)[ids], np.asarray(kind)

    def make(uniform: jax.Array, growth: Growth) -> Params:
        factor = between(uniform, *ranges.friction, 1.0, growth)
        return {field: scaled(own, factor[which][:, None])}

    return Part({field: tuple(ids)}, 2, make)


def _servos(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    """Gain and damping of position servos: force = kp (ctrl - x) - kv v."""
    ids = [i for i in range(model.nu) if int(model.actuator_biastype[i]) == _AFFINE]
    stiff, damped = not is_fixed(ranges.servo_gain, 1.0), not is_fixed(ranges.servo_damping, 1.0)
    if not ids or not (stiff or damped):
        return None
    gain, bias = rows(model, "actuator_gainprm")[ids], rows(model, "actuator_biasprm")[ids]
    varies = {"actuator_biasprm": tuple(ids)}
    if stiff:
        varies["actuator_gainprm"] = tuple(ids)

    def make(uniform: jax.Array, growth: Growth) -> Params:
        uniform = uniform.reshape(-1, 2)
        stiffness = between(uniform[:, 0], *ranges.servo_gain, 1.0, growth)
        damping = between(uniform[:, 1], *ranges.servo_damping, 1.0, growth)
        factors = jnp.stack([stiffness, stiffness, damping], axis=1)
        params = {"actuator_biasprm": jnp.concatenate([bias[:, :3] * factors, bias[:, 3:]], axis=1)}
        if stiff:
            params["actuator_gainprm"] = scaled(gain, stiffness[:, None])
        return params

    return Part(varies, 2 * len(ids), make)


def _action_delay(ranges: Ranges) -> Part | None:
    if not ranges.action_delay:
        return None

    def make(uniform: jax.Array, growth: Growth) -> Params:
        return {"action_delay": delay_of(uniform, ranges.action_delay, growth)}

    return Part({"action_delay": (0,)}, 1, make)
