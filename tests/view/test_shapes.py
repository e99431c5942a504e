"""Triangles of primitives: closed, turned outwards, and where the shape is."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjx_arm.render.geoms import visible_geoms
from mjx_arm.scene import load_scene
from mjx_arm.view.shapes import make_shapes, triangles

SIZE = np.asarray([0.2, 0.3, 0.4])
VOLUMES = {
    "box": 8 * 0.2 * 0.3 * 0.4,
    "sphere": 4 / 3 * np.pi * 0.2**3,
    "capsule": 4 / 3 * np.pi * 0.2**3 + np.pi * 0.2**2 * 0.6,
    "cylinder": np.pi * 0.2**2 * 0.6,
}


@pytest.mark.parametrize("kind", VOLUMES)
def test_a_solid_is_closed_and_turned_outwards(kind):
    vertices, faces = triangles(kind, SIZE)
    a, b, c = (vertices[faces[:, i]].astype(float) for i in range(3))
    # The divergence theorem: negative where the faces look inwards, wrong where there is a hole.
    volume = np.sum(a * np.cross(b, c)) / 6
    assert volume == pytest.approx(VOLUMES[kind], rel=0.03)
    assert np.sum(np.cross(b - a, c - a), axis=0) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("kind", VOLUMES)
def test_a_solid_has_the_extent_of_its_geom(kind):
    vertices, _ = triangles(kind, SIZE)
    half = {"box": SIZE, "sphere": [0.2] * 3, "capsule": [0.2, 0.2, 0.5]}
    expected = half.get(kind, [0.2, 0.2, 0.3])
    assert vertices.max(0) == pytest.approx(expected, rel=1e-2)
    assert vertices.min(0) == pytest.approx(-np.asarray(expected), rel=1e-2)


def test_an_infinite_plane_is_shown_in_part():
    vertices, faces = triangles("plane", np.asarray([0.0, 0.0, 0.05]))
    assert faces.shape == (2, 3)
    assert np.abs(vertices[:, :2]).min() > 1
    assert not vertices[:, 2].any()


def test_all_that_the_renderer_shows_is_a_shape():
    model = load_scene("arm_cube").mj_model
    shapes = {shape.name: shape for shape in make_shapes(model)}
    assert {shape.geom for shape in shapes.values()} == set(np.flatnonzero(visible_geoms(model)))
    red, green, blue = shapes["cube"].colour
    assert red > 2 * max(green, blue)
    assert shapes["cube"].opacity == 1.0


def test_shapes_take_what_varies_by_episode():
    xml = "<mujoco><worldbody><geom size='0.1 0.1 0.1' type='box'/></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    params = {
        "geom_size": np.asarray([[0.5, 0.1, 0.1]], np.float32),
        "geom_rgba": np.asarray([[0, 0, 1, 0.5]], np.float32),
    }
    (shape,) = make_shapes(model, {"geom_size": (0,), "geom_rgba": (0,)}, params)
    assert shape.vertices[:, 0].max() == pytest.approx(0.5)
    assert (shape.colour, shape.opacity) == ((0, 0, 255), 0.5)


def test_a_texture_is_shown_by_its_mean_colour():
    scene = load_scene("arm_cube_desk")
    shapes = {shape.name: shape for shape in make_shapes(scene.mj_model)}
    # The mean of xml/desk_wood.png, which is 132.8, 90.0 and 53.1.
    assert shapes["table"].colour == pytest.approx((132.8, 90.0, 53.1), abs=1)
    assert shapes["cube"].colour[0] > 200
