"""What varies by episode: some rows of some arrays of an MjModel.

Environment, physics, kinematics and renderer are made with the same `Varies`, which is static. Each
episode then has its own `Params`, which are traced. A part of the library reads the fields that it
knows from `Params`, and all other numbers from the model.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from typing import TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

Varies: TypeAlias = Mapping[str, tuple[int, ...]]
"""Name of a float array of MjModel, or of `EXTRA_FIELDS` -> the ids of its rows that vary."""

Params: TypeAlias = dict[str, jax.Array]
"""The same names -> the values of those rows, `[len(ids), ...] float32`, in the ids' order."""

_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)

# What has no float array in MjModel -> its rows in a model.
_EXTRA: dict[str, Callable[[mujoco.MjModel], np.ndarray]] = {
    "headlight_ambient": lambda model: np.asarray(model.vis.headlight.ambient)[None],
    "headlight_diffuse": lambda model: np.asarray(model.vis.headlight.diffuse)[None],
    "light_shadow": lambda model: np.asarray(model.light_castshadow, np.float32),
    "mat_texture": lambda model: np.asarray(model.mat_texid[:, _RGB], np.float32),
    "image_background": lambda model: np.zeros((1, 3), np.float32),
    "image_gain": lambda model: np.ones((1, 3), np.float32),
    "image_noise": lambda model: np.zeros(1, np.float32),
    "image_blur": lambda model: np.zeros(1, np.float32),
    "image_seed": lambda model: np.zeros(1, np.float32),
    "image_delay": lambda model: np.zeros(1, np.float32),
    "action_delay": lambda model: np.zeros(1, np.float32),
}
EXTRA_FIELDS = tuple(_EXTRA)
"""Names that vary like fields of MjModel, but are none.

- `headlight_ambient`, `headlight_diffuse`: `[1, 3]`, colours of `mj_model.vis.headlight`.
- `light_shadow`: `[nlight]`, above 0 where a light casts shadows.
- `mat_texture`: `[nmat]`, id of the texture that colours a material, a whole number.
- `image_background`: `[1, 3]`, colour in 0..1 of pixels that hit nothing.
- `image_gain`: `[1, 3]`, factors on red, green and blue: exposure and white balance.
- `image_noise`: `[1]`, standard deviation of the noise of a pixel, in levels of 255.
- `image_blur`: `[1]`, share of the blurred image, in 0..1.
- `image_seed`: `[1]`, any number, whose bits seed the noise of an episode.
- `image_delay`, `action_delay`: `[1]`, iterations, a whole number.
"""


def check_varies(mj_model: mujoco.MjModel, varies: Varies | None) -> None:
    """Checks that every name and row exists.

    Besides the float arrays of MjModel the names may be those of `EXTRA_FIELDS`.

    Raises:
      ValueError: a name is not a float array of MjModel, or its rows are not distinct ids of it.
    """
    for field, ids in (varies or {}).items():
        count = len(_values(mj_model, field))
        wrong = [row for row in ids if not _is_row(row, count)]
        if wrong:
            raise ValueError(
                f"varies[{field!r}] has the row {wrong[0]!r}; allowed are the integers from 0 to "
                f"{count - 1}, the rows of this field in the model"
            )
        if len(set(ids)) != len(ids):
            raise ValueError(f"varies[{field!r}] = {tuple(ids)} must name each row once")


def check_params(mj_model: mujoco.MjModel, varies: Varies | None, params: Params | None) -> None:
    """Checks that `params` has the fields and shapes that `varies` announces.

    Raises:
      ValueError: a field is missing, was not announced, or has another shape.
    """
    varies, params = varies or {}, params or {}
    for field, ids in varies.items():
        if field not in params:
            raise ValueError(f"params lacks {field!r}, which varies; it has {sorted(params)}")
        expected = (len(ids), *_values(mj_model, field).shape[1:])
        if jnp.shape(params[field]) != expected:
            raise ValueError(
                f"params[{field!r}] has the shape {list(jnp.shape(params[field]))}; it must be "
                f"{list(expected)}, the rows of one episode (use jax.vmap for several)"
            )
    for field in params:
        if field not in varies:
            raise ValueError(
                f"params has {field!r}, which does not vary; name its rows in `varies` as well"
            )


def rows(mj_model: mujoco.MjModel, field: str) -> np.ndarray:
    """Returns the model's own values of a field, `[n, ...] float32`.

    Raises:
      ValueError: the field is not a float array of MjModel.
    """
    return np.array(_values(mj_model, field), np.float32)


def own_params(mj_model: mujoco.MjModel, varies: Varies | None) -> Params:
    """Returns the params with which nothing differs from the model."""
    return {
        field: jnp.asarray(rows(mj_model, field)[list(ids)])
        for field, ids in (varies or {}).items()
    }


def merge_varies(first: Varies, second: Varies) -> Varies:
    """What varies by either; the rows of the first come first."""
    merged = {field: tuple(ids) for field, ids in first.items()}
    for field, ids in second.items():
        own = merged.get(field, ())
        merged[field] = (*own, *(row for row in ids if row not in own))
    return merged


def merge_params(
    first_varies: Varies, first: Params, second_varies: Varies, second: Params
) -> Params:
    """The params of `merge_varies`; of a row that both give, the first one's value counts."""
    merged = dict(first)
    for field, ids in second_varies.items():
        own = first_varies.get(field, ())
        places = [k for k, row in enumerate(ids) if row not in own]
        # An integer type even where no row is left.
        rows = np.asarray(places, np.int32)
        values = second[field] if len(places) == len(ids) else second[field][rows]
        merged[field] = jnp.concatenate([first[field], values]) if own else values
    return merged


def fill(
    mj_model: mujoco.MjModel, varies: Varies | None, params: Params | None, field: str
) -> jax.Array | np.ndarray:
    """Returns a whole field: the model's values, with the varying rows taken from `params`.

    Args:
      mj_model: the model.
      varies: which rows vary.
      params: their values. Other fields in it are ignored.
      field: name of the field.

    Returns:
      `[n, ...] float32`. A constant numpy array if no row of the field varies.

    Raises:
      ValueError: the field is unknown, or varies and is missing in `params`.
    """
    own = rows(mj_model, field)
    ids = tuple((varies or {}).get(field, ()))
    if not ids:
        return own
    if field not in (params or {}):
        raise ValueError(f"params lacks {field!r}, which varies; it has {sorted(params or {})}")
    return replace_rows(own, ids, (params or {})[field])


def replace_rows(array: np.ndarray, ids: tuple[int, ...], values: jax.Array) -> jax.Array:
    """Returns `array [n, ...]` with the rows `ids` replaced by `values [len(ids), ...]`, float32.

    This is a concatenation of slices, because XLA on CPU runs a scatter as a loop.
    """
    values = jnp.asarray(values, jnp.float32)
    place = {row: k for k, row in enumerate(ids)}
    pieces: list[jax.Array] = []
    row = 0
    while row < len(array):
        end = row + 1
        if row in place:
            while place.get(end) == place[row] + end - row:
                end += 1
            pieces.append(values[place[row] : place[row] + end - row])
        else:
            while end < len(array) and end not in place:
                end += 1
            pieces.append(jnp.asarray(array[row:end], jnp.float32))
        row = end
    return jnp.concatenate(pieces) if len(pieces) > 1 else pieces[0]


def _values(mj_model: mujoco.MjModel, field: str) -> np.ndarray:
    if field in _EXTRA:
        return _EXTRA[field](mj_model)
    values = getattr(mj_model, field, None)
    if not isinstance(values, np.ndarray) or not np.issubdtype(values.dtype, np.floating):
        near = difflib.get_close_matches(field, _float_fields(mj_model), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"{field!r} is not a float array of MjModel{hint}")
    return values


def _float_fields(mj_model: mujoco.MjModel) -> list[str]:
    found = [
        name
        for name in dir(mj_model)
        if isinstance(values := getattr(mj_model, name, None), np.ndarray)
        and np.issubdtype(values.dtype, np.floating)
    ]
    return [*found, *_EXTRA]


def _is_row(row: object, count: int) -> bool:
    whole = isinstance(row, int | np.integer) and not isinstance(row, bool)
    return whole and 0 <= int(row) < count  # type: ignore[call-overload]
