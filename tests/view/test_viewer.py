"""The viewer in a real browser, which clicks. It must reach no address but this machine's own."""

from __future__ import annotations

import json
import os
import pathlib
import re
import shutil
import socket
import threading
import time

import flax.traverse_util
import imageio.v3 as imageio
import numpy as np
import pytest
from made_runs import make_run

from mjx_arm.config import parse_config
from mjx_arm.scene import SceneSource
from mjx_arm.training.agent import find_agent, read_agent, save_agent
from mjx_arm.view.viewer import Viewer, ViewOptions, is_loopback

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
# A missing browser fails where all is to be tested.
NEEDED = os.environ.get("MJX_ARM_REQUIRE_BROWSER") == "1"
BROWSER = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
]
PATIENCE = 120.0


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


def save_again(path: pathlib.Path, env_steps: int, scale: float) -> None:
    """The shipped agent as a training would save it, with other parameters."""
    metadata, tensors = read_agent(find_agent(pathlib.Path("agent-b")))
    scaled = {name: np.float32(scale) * x for name, x in tensors.items()}
    save_agent(
        path,
        parse_config(metadata["config"], "test"),
        flax.traverse_util.unflatten_dict(scaled, sep="/"),
        scene=SceneSource.from_json(json.loads(metadata["scene"]), "test"),
        objects={},
        env_steps=env_steps,
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> pathlib.Path:
    """A run that still trains: metrics and the last agent; none is the best one yet."""
    folder = tmp_path_factory.mktemp("runs") / "live"
    make_run(folder, env="B")
    save_again(folder / "last.safetensors", 1_000, 0.9)
    return folder


@pytest.fixture(scope="module")
def viewer(run):
    """The viewer at work, in a thread of its own."""
    made = Viewer(ViewOptions(subject=run, port=free_port(), epsilon=0.0))
    ended, failures = threading.Event(), []

    def work() -> None:
        try:
            while not ended.is_set():
                time.sleep(min(0.05, made.advance()))
        except BaseException as error:  # shown by the test, which would wait for ever
            failures.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    yield made
    ended.set()
    thread.join()
    made.close()
    assert not failures


@pytest.fixture(scope="module")
def page(viewer):
    if CHROMIUM is None:
        assert not NEEDED, "chromium is not installed"
        pytest.skip("chromium is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(1000 * PATIENCE)
        page.asked, page.errors = [], []
        page.on("request", lambda request: page.asked.append(request.url))
        page.on("websocket", lambda websocket: page.asked.append(websocket.url))
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.goto(viewer.url)
        page.get_by_role("button", name="Pause", exact=True).wait_for()
        yield page
        browser.close()


def wait_until(condition, page) -> None:
    """Until a condition holds; the page's own events are handled meanwhile."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        page.wait_for_timeout(50)


def pause(page) -> None:
    """Pauses, and waits until nothing moves any more."""
    if page.get_by_role("button", name="Pause", exact=True).count():
        page.get_by_role("button", name="Pause", exact=True).click()
    page.get_by_role("button", name="Continue", exact=True).wait_for()
    page.get_by_text(re.compile(r"step \d+ · (paused|success|failed)")).wait_for()


def choose(page, name: str) -> None:
    """Chooses an agent; the page shows it some seconds later."""
    names = ("best", "last", "agent-a", "agent-b")
    inputs = page.locator("input:not([type=range])").all()
    next(each for each in inputs if each.input_value() in names).click()
    page.get_by_role("option", name=name, exact=True).click()


def pixel_of(viewer, point) -> np.ndarray:
    """Where the one visitor sees a point `[3]`, m, of the scene: `[2]`, pixels of the page."""
    (client,) = viewer.server.get_clients().values()
    camera = client.camera
    ahead = np.asarray(camera.look_at) - np.asarray(camera.position)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, np.asarray(camera.up_direction))
    right /= np.linalg.norm(right)
    beside = np.asarray(point) - np.asarray(camera.position)
    across = np.asarray([beside @ right, -beside @ np.cross(right, ahead)]) / (beside @ ahead)
    half = np.asarray([camera.image_width, camera.image_height]) / 2
    return half + across * half[1] / np.tan(camera.fov / 2)


@pytest.mark.slow
def test_it_runs_until_it_is_paused(page, viewer):
    wait_until(lambda: viewer.session.step_count >= 3, page)
    page.get_by_text(re.compile(r"step \d+ · running")).wait_for()
    pause(page)
    step = viewer.session.step_count
    page.wait_for_timeout(500)
    assert viewer.session.step_count == step


@pytest.mark.slow
def test_a_step_is_one_iteration(page, viewer):
    pause(page)
    # A step after the end would begin another episode.
    page.get_by_role("button", name="next seed", exact=True).click()
    page.get_by_text(re.compile(r"step 0 · paused")).wait_for()
    step = viewer.session.step_count
    page.get_by_role("button", name="step", exact=True).click()
    page.get_by_text(f"step {step + 1} ·").wait_for()
    assert viewer.session.step_count == step + 1


@pytest.mark.slow
def test_the_scene_the_image_and_the_bars_are_there(page, viewer, tmp_path):
    page.get_by_text("Q-values").wait_for()
    page.get_by_text("Reward of the last step").wait_for()
    assert page.get_by_text("waist −").count() == 1
    path = tmp_path / "scene.png"
    page.locator("canvas").first.screenshot(path=path)
    # The cube is the only thing in the scene that is red.
    red, green, blue = np.asarray(imageio.imread(path), int)[..., :3].transpose(2, 0, 1)
    assert np.count_nonzero((red > 2 * green) & (red > 2 * blue) & (red > 60)) > 50


@pytest.mark.slow
@pytest.mark.parametrize(("button", "action"), [("close", 13), ("open", 12)])
def test_the_gripper_obeys(page, viewer, button, action):
    pause(page)
    page.get_by_role("button", name=button, exact=True).click()
    wait_until(lambda: viewer.session.outcome.action == action, page)
    arm = viewer.session.simulation.env.arm
    low, high = arm.ctrl_range[arm.gripper_ctrl]
    expected = high if button == "open" else low
    assert float(viewer.session.state.ctrl[arm.gripper_ctrl]) == pytest.approx(expected)


@pytest.mark.slow
def test_the_cube_is_pushed_by_hand(page, viewer):
    pause(page)
    before = viewer.session.position("cube")
    page.get_by_role("button", name="left", exact=True).click()
    wait_until(lambda: (viewer.session.position("cube") != before).any(), page)
    moved = viewer.session.position("cube") - before
    assert moved == pytest.approx([0.0, 0.02, 0.0], abs=1e-3)


@pytest.mark.slow
def test_the_cube_is_dragged_while_paused(page, viewer):
    """By the arrow of its handle that points along y, whose length is 12 cm."""
    pause(page)
    before = viewer.session.position("cube")
    start, end = (pixel_of(viewer, before + np.asarray([0.0, y, 0.0])) for y in (0.06, 0.11))

    def is_dragged() -> bool:
        return viewer.session.position("cube")[1] > before[1] + 0.04

    # Until the browser has rendered the handle at the cube, the mouse grips nothing.
    for _ in range(20):
        page.wait_for_timeout(1000)
        page.mouse.move(*start)
        page.mouse.down()
        page.mouse.move(*((start + end) / 2), steps=5)
        page.mouse.move(*end, steps=5)
        page.wait_for_timeout(2000)
        if is_dragged():
            break
        page.mouse.up()
    assert is_dragged()
    step = viewer.session.step_count
    page.mouse.up()
    page.wait_for_timeout(500)
    moved = viewer.session.position("cube") - before
    assert moved == pytest.approx([0.0, 0.05, 0.0], abs=0.01)
    assert viewer.session.step_count == step


@pytest.mark.slow
def test_another_seed_is_another_episode(page, viewer):
    pause(page)
    seed = viewer.session.seed
    page.get_by_role("button", name="next seed", exact=True).click()
    page.get_by_text(f"seed {seed + 1} · step 0 ·").wait_for()
    assert viewer.session.seed == seed + 1


@pytest.mark.slow
def test_the_best_and_the_last_agent_of_a_run_change_places(page, viewer, run):
    pause(page)
    # The training selects its first agent while a visitor looks.
    save_again(run / "best.safetensors", 500, 1.0)
    wait_until(lambda: "best" in [choice.name for choice in viewer._choices], page)
    seed, seen = viewer.session.seed, {}
    for name, steps in (("last", "1,000"), ("best", "500"), ("last", "1,000")):
        choose(page, name)
        page.get_by_text(f"{name}, trained for {steps} steps").wait_for()
        before = seen.setdefault(name, np.array(viewer.session.seen.q))
        assert (viewer.session.seen.q == before).all()
        assert (viewer.session.seed, viewer.session.step_count) == (seed, 0)
    assert (seen["best"] != seen["last"]).any()


@pytest.mark.slow
def test_a_live_run_is_followed(page, viewer, run):
    pause(page)
    if page.get_by_text("last, trained for").count() == 0:
        choose(page, "last")
        page.get_by_text("last, trained for").wait_for()
    q = np.array(viewer.session.seen.q)
    save_again(run / "last.safetensors", 222_222, 0.5)
    page.get_by_text("trained for 222,222 steps").wait_for()
    page.get_by_text("training: 60,000 steps, success 50 %").wait_for()
    assert (viewer.session.seen.q != q).any()


@pytest.mark.slow
def test_another_agent_is_chosen(page, viewer):
    pause(page)
    choose(page, "agent-b")
    page.get_by_text("agent-b, trained for 2,506,752 steps").wait_for()
    assert viewer.session.simulation.has_agent


@pytest.mark.slow
def test_nothing_came_from_another_host(page):
    hosts = {re.sub(r"^(\w+:)(//[^/:]*)?.*", r"\1\2", url, flags=re.S) for url in page.asked}
    assert hosts <= {"http://127.0.0.1", "ws://127.0.0.1", "data:", "blob:"}
    assert page.errors == []


@pytest.mark.slow
def test_it_listens_on_this_machine_alone(viewer):
    assert ViewOptions(subject=pathlib.Path("x")).host == "127.0.0.1"
    assert viewer.server.get_host() == "127.0.0.1"
    # viser would share a view over a host of its own.
    assert viewer.server.request_share_url() is None
    other = next(
        (
            address[4][0]
            for address in socket.getaddrinfo(socket.gethostname(), None)
            if not is_loopback(address[4][0])
        ),
        None,
    )
    if other is not None:
        with pytest.raises(OSError, match=r"refused|unreachable"):
            socket.create_connection((other, viewer.server.get_port()), timeout=5)


@pytest.mark.slow
def test_an_object_that_is_let_go_at_once_stays_where_it_was_held():
    """Both events of a short drag may come between two steps of the viewer."""
    viewer = Viewer(ViewOptions(subject=pathlib.Path("arm_push"), port=free_port()))
    try:
        viewer._wish("pause", None)
        viewer.advance()
        name = viewer.session.objects[0]
        held = viewer.session.position(name) + np.float32([0.01, 0.02, 0.0])
        viewer._wish("drag", held)
        viewer._wish("drag", None)
        viewer.advance()
        assert (viewer.session.position(name) == held).all()
        assert viewer.session.step_count == 0
        # Nothing but the panel is due while it is paused.
        assert viewer.advance() > 0.0
    finally:
        viewer.close()


@pytest.mark.slow
def test_a_scene_is_shown_without_an_agent():
    viewer = Viewer(ViewOptions(subject=pathlib.Path("arm_push"), port=free_port()))
    try:
        for _ in range(3):
            time.sleep(viewer.advance())
        session = viewer.session
        assert session.simulation.env.config.task == "push"
        assert (session.actor, session.seen.q.shape) == ("nobody", (0,))
        assert session.step_count >= 1
        assert session.objects
    finally:
        viewer.close()


@pytest.mark.parametrize(
    ("host", "expected"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("0.0.0.0", False), ("a.b", False)],
)
def test_loopback_addresses_are_known(host, expected):
    assert is_loopback(host) == expected
