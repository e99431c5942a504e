from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mujoco_reference import scene_of

from mjx_arm import load_scene
from mjx_arm.render.geoms import geom_rgba, static_geoms, validate_geoms, visible_geoms

TETRAHEDRON = '<mesh name="tetra" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'
CHECKER = '<texture name="t" type="2d" builtin="checker" width="8" height="8"/>'


def _model(world: str, assets: str = "") -> str:
    return f"<mujoco><asset>{assets}</asset><worldbody>{world}</worldbody></mujoco>"


@pytest.mark.parametrize(
    ("world", "assets", "parts"),
    [
        ('<geom name="skull" type="mesh" mesh="tetra"/>', TETRAHEDRON, ("'skull'", "mesh")),
        ('<geom size="1"/><geom type="ellipsoid" size="1 1 2"/>', "", ("id 1", "ellipsoid")),
        (
            '<geom name="hill" type="hfield" hfield="h"/>',
            '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1" elevation="0 1 0 1"/>',
            ("'hill'", "hfield"),
        ),
        (
            '<geom name="mat" size="1" material="m"/>',
            CHECKER + '<material name="m" texture="t"/>',
            ("'mat'", "texture", "'m'"),
        ),
        (
            '<flexcomp name="cloth" type="grid" count="3 3 1" spacing="0.1 0.1 0.1" radius="0.01" '
            'mass="1"/>',
            "",
            ("flex 'cloth'",),
        ),
        (
            '<site name="a"/><site name="b" pos="0 0 1"/></worldbody><tendon>'
            '<spatial name="rope"><site site="a"/><site site="b"/></spatial></tendon><worldbody>',
            "",
            ("tendon 'rope'", "group"),
        ),
    ],
)
def test_load_scene_rejects_by_name(
    world: str, assets: str, parts: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(_model(world, assets))
    with pytest.raises(ValueError, match="supported are") as error:
        load_scene(path)
    assert all(part in str(error.value) for part in parts)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("hidden", ['group="3"', 'rgba="1 1 1 0"'])
def test_what_is_not_rendered_may_be_anything(hidden: str) -> None:
    world = (
        f'<geom type="mesh" mesh="tetra" {hidden}/><site name="a"/><site name="b" pos="0 0 1"/>'
        f'</worldbody><tendon><spatial {hidden}><site site="a"/><site site="b"/></spatial></tendon>'
        "<worldbody>"
    )
    validate_geoms(scene_of(_model(world, TETRAHEDRON)).mj_model)


def test_a_geom_that_may_become_visible_is_checked() -> None:
    model = scene_of(
        _model('<geom name="g" type="mesh" mesh="tetra" rgba="1 1 1 0"/>', TETRAHEDRON)
    ).mj_model
    with pytest.raises(ValueError, match="'g' is of type mesh"):
        validate_geoms(model, {"geom_rgba": (0,)})


def test_the_ids_of_a_byte_are_enough() -> None:
    validate_geoms(scene_of(_model('<geom size="1"/>' * 255)).mj_model)
    with pytest.raises(ValueError, match="256 geoms"):
        validate_geoms(scene_of(_model('<geom size="1"/>' * 256)).mj_model)


def test_colour_of_geom_and_material() -> None:
    material = '<material name="m" rgba="0.1 0.2 0.3 1"/>'
    world = (
        '<geom size="1" material="m"/><geom size="1" material="m" rgba="1 0 0 1"/>'
        '<geom size="1"/><geom size="1" rgba="0 0 1 0"/><geom size="1" group="4"/>'
    )
    model = scene_of(_model(world, material)).mj_model
    colours = [[0.1, 0.2, 0.3], [1, 0, 0], [0.5, 0.5, 0.5], [0, 0, 1], [0.5, 0.5, 0.5]]
    np.testing.assert_allclose(geom_rgba(model)[:, :3], colours, rtol=1e-6)
    assert visible_geoms(model).tolist() == [True, True, True, False, False]


def test_only_what_is_welded_to_the_world_is_static() -> None:
    model = scene_of(
        _model(
            '<geom size="1"/><body><geom size="1"/></body>'
            '<body mocap="true"><geom size="1"/></body>'
            '<body><freejoint/><geom size="1"/><body><geom size="1"/></body></body>'
        )
    ).mj_model
    assert static_geoms(model).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize(
    ("varies", "static"),
    [
        ({"geom_pos": (1,)}, [True, False, True, True]),
        ({"geom_rgba": (0, 2)}, [False, True, False, True]),
        ({"body_quat": (1,)}, [True, False, False, True]),
        ({"geom_friction": (0, 1), "body_mass": (1,)}, [True, True, True, True]),
    ],
)
def test_what_varies_by_episode_is_not_static(
    varies: dict[str, tuple[int, ...]], static: list[bool]
) -> None:
    world = (
        '<geom size="1"/><body><geom size="1"/><body><geom size="1"/></body></body>'
        '<body><geom size="1"/></body>'
    )
    assert static_geoms(scene_of(_model(world)).mj_model, varies).tolist() == static
