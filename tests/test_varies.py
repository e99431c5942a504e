from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_arm.varies import (
    check_params,
    check_varies,
    fill,
    merge_params,
    merge_varies,
    own_params,
    rows,
)

XML = """
<mujoco>
  <visual><headlight diffuse="0.1 0.2 0.3"/></visual>
  <worldbody>
    <geom size="0.1"/><geom size="0.2"/><geom size="0.3"/><geom size="0.4"/><geom size="0.5"/>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.mark.parametrize("ids", [(0,), (4,), (1, 2, 3), (3, 1), (4, 0, 2, 1, 3), (2, 3, 0)])
def test_fill_replaces_the_varying_rows(model, ids):
    values = np.arange(3 * len(ids), dtype=np.float32).reshape(-1, 3) + 10
    expected = np.array(model.geom_size, np.float32)
    expected[list(ids)] = values
    varies, params = {"geom_size": ids}, {"geom_size": jnp.asarray(values)}
    filled = jax.jit(lambda p: fill(model, varies, p, "geom_size"))(params)
    assert filled.dtype == jnp.float32
    np.testing.assert_array_equal(filled, expected)
    own = fill(model, varies, own_params(model, varies), "geom_size")
    np.testing.assert_array_equal(own, rows(model, "geom_size"))


@pytest.mark.parametrize("varies", [None, {}, {"geom_size": ()}, {"geom_rgba": (1,)}])
def test_a_field_that_does_not_vary_is_a_constant(model, varies):
    filled = fill(model, varies, {}, "geom_size")
    assert type(filled) is np.ndarray
    np.testing.assert_array_equal(filled, model.geom_size.astype(np.float32))


def test_the_headlight_is_one_row(model):
    check_varies(model, {"headlight_diffuse": (0,), "headlight_ambient": (0,)})
    np.testing.assert_allclose(rows(model, "headlight_diffuse"), [[0.1, 0.2, 0.3]], rtol=1e-6)


@pytest.mark.parametrize(
    ("varies", "message"),
    [
        (
            {"geom_rgb": (0,)},
            "'geom_rgb' is not a float array of MjModel; did you mean 'geom_rgba'",
        ),
        ({"geom_type": (0,)}, "'geom_type' is not a float array"),
        ({"names": (0,)}, "'names' is not a float array"),
        ({"geom_rgba": (5,)}, r"varies\['geom_rgba'\] has the row 5.*0 to 4"),
        ({"geom_rgba": (0, -1)}, "has the row -1"),
        ({"geom_rgba": (0.5,)}, "has the row 0.5"),
        ({"geom_rgba": (True,)}, "has the row True"),
        ({"geom_rgba": (1, 2, 1)}, "must name each row once"),
        ({"headlight_diffuse": (1,)}, "has the row 1"),
    ],
)
def test_what_does_not_exist_is_rejected_by_name(model, varies, message):
    with pytest.raises(ValueError, match=message):
        check_varies(model, varies)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({}, "params lacks 'geom_size', which varies"),
        ({"geom_size": jnp.zeros(3)}, r"params\['geom_size'\] has the shape \[3\].*\[2, 3\]"),
        ({"geom_size": jnp.zeros((4, 2, 3))}, "jax.vmap"),
        (
            {"geom_size": jnp.zeros((2, 3)), "geom_rgba": jnp.zeros((1, 4))},
            "'geom_rgba', which does not vary",
        ),
    ],
)
def test_params_must_fit(model, params, message):
    with pytest.raises(ValueError, match=message):
        check_params(model, {"geom_size": (0, 2)}, params)


def test_fill_names_a_missing_field(model):
    with pytest.raises(ValueError, match="params lacks 'geom_size'"):
        fill(model, {"geom_size": (0,)}, {}, "geom_size")


def test_what_both_vary_has_the_first_ones_value():
    first, second = {"body_mass": (2,)}, {"body_mass": (1, 2)}
    values = merge_params(
        first, {"body_mass": np.asarray([7.0])}, second, {"body_mass": np.asarray([1.0, 2.0])}
    )
    assert merge_varies(first, second) == {"body_mass": (2, 1)}
    assert values["body_mass"].tolist() == [7.0, 1.0]
    # Also where nothing is left of the second.
    values = merge_params(
        first, {"body_mass": np.asarray([7.0])}, first, {"body_mass": np.asarray([2.0])}
    )
    assert values["body_mass"].tolist() == [7.0]
