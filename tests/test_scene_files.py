"""A scene is compiled from exactly the files that are stored with it."""

from __future__ import annotations

import pathlib

import mujoco
import numpy as np
import pytest

from mjx_arm.scene import SceneSource, compile_scene, load_scene, read_source

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
MAIN = """<mujoco>
  <compiler meshdir="meshes"/>
  <include file="parts/ball.xml"/>
  <asset><mesh name="hull" file="hull.obj"/></asset>
  <worldbody>
    <!-- 0.1234567890123456789 must not be rounded -->
    <geom type="mesh" mesh="hull" group="3" pos="0.1234567890123456789 0 0"/>
  </worldbody>
</mujoco>
"""


def include(body: str) -> str:
    return f"<mujocoinclude>{body}</mujocoinclude>"


def ball(size: float) -> str:
    return f'<worldbody><geom size="{size}"/></worldbody>'


@pytest.fixture
def folder(tmp_path) -> pathlib.Path:
    (tmp_path / "parts").mkdir()
    (tmp_path / "meshes").mkdir()
    (tmp_path / "main.xml").write_text(MAIN)
    (tmp_path / "parts/ball.xml").write_text(include('<include file="small.xml"/>' + ball(0.2)))
    (tmp_path / "parts/small.xml").write_text(include(ball(0.1)))
    (tmp_path / "meshes/hull.obj").write_text(TETRAHEDRON)
    return tmp_path


def test_includes_and_assets_are_read_with_the_text_as_given(folder, monkeypatch):
    monkeypatch.chdir(folder.parent)
    scene = load_scene(f"{folder.name}/main.xml")
    assert scene.xml == MAIN
    assert {name: data.decode() for name, data in scene.files.items()} == {
        "ball.xml": (folder / "parts/ball.xml").read_text(),
        "small.xml": (folder / "parts/small.xml").read_text(),
        "hull.obj": TETRAHEDRON,
    }
    expected = mujoco.MjModel.from_xml_path(str(folder / "main.xml"))
    np.testing.assert_array_equal(scene.mj_model.geom_size, expected.geom_size)
    np.testing.assert_array_equal(scene.mj_model.mesh_vert, expected.mesh_vert)


def test_a_scene_compiles_from_what_is_stored_and_from_nothing_else(folder, tmp_path, monkeypatch):
    source = load_scene(folder / "main.xml").source
    stored = SceneSource.from_json(source.to_json(), "stored")
    for path in sorted(folder.rglob("*.*")):
        path.unlink()
    # A file of the same name in the working directory is not the scene's.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "parts/ball.xml").write_text(include(ball(9.0)))
    (tmp_path / "ball.xml").write_text(include(ball(9.0)))
    model = compile_scene("gone", stored).mj_model
    assert sorted(model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE, 0]) == [0.1, 0.2]


@pytest.mark.parametrize("name", ["main.xml", "parts/small.xml", "meshes/hull.obj"])
def test_the_digest_covers_every_file(name, folder):
    before = read_source(str(folder / "main.xml")).digest
    assert before == read_source(str(folder / "main.xml")).digest
    with (folder / name).open("a") as file:
        file.write("\n")
    assert read_source(str(folder / "main.xml")).digest != before


def test_a_damaged_source_is_rejected(folder):
    values = read_source(str(folder / "main.xml")).to_json()
    for changed in (None, [], values | {"xml": MAIN + " "}, values | {"files": {"a": "%"}}):
        with pytest.raises(ValueError, match="somewhere: the scene in it is damaged"):
            SceneSource.from_json(changed, "somewhere")


def test_two_files_with_one_name_are_rejected(folder):
    (folder / "ball.xml").write_text(include(ball(0.3)))
    (folder / "main.xml").write_text(MAIN.replace("<asset>", '<include file="ball.xml"/><asset>'))
    with pytest.raises(ValueError, match=r"takes two files with the name 'ball.xml': rename one"):
        load_scene(folder / "main.xml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"<mujoco><worldbody", "does not compile"),
        (b"", "does not compile"),
        (b"\xff\xfe\x00", "."),
        (b'<mujoco><include file="none.xml"/></mujoco>', "does not compile: .*none.xml"),
        (b'<mujoco><asset><mesh file="no.obj"/></asset></mujoco>', "no.obj cannot be read"),
        (b"<mujoco><model/></mujoco>", "does not compile: .*unrecognized element"),
        (b'<mujoco><include file="scene.xml"/></mujoco>', "scene.xml"),
    ],
)
def test_a_file_that_is_no_scene_is_one_sentence(text, message, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_bytes(text)
    with pytest.raises(ValueError, match=message) as rejected:
        load_scene(path)
    assert "\n" not in str(rejected.value)
    assert str(path) in str(rejected.value)


def test_a_folder_is_not_a_scene(tmp_path):
    with pytest.raises(ValueError, match="must be an MJCF file, got a folder"):
        load_scene(tmp_path)
