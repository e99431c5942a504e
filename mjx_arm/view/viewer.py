"""The viewer: a session, shown in the browser and worked from there."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import ipaddress
import pathlib
import queue
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_arm.algos.exploration import check_epsilon
from mjx_arm.envs.env import Env
from mjx_arm.training.agent import Agent
from mjx_arm.view.choices import (
    Choice,
    find_choices,
    is_scene,
    load_choice,
    read_params,
    scene_env,
    training_line,
)
from mjx_arm.view.panel import Panel
from mjx_arm.view.session import Session, action_names, make_simulation
from mjx_arm.view.shapes import make_shapes, varying_look
from mjx_arm.view.stage import Stage

if TYPE_CHECKING:
    import viser

# Seconds between two looks at the files of a run, two updates of the panel, and two episodes.
_LOOK_EVERY = 2.0
_SHOW_EVERY = 0.1
_REST = 1.5
_SPEED = 30.0


@dataclasses.dataclass(frozen=True)
class ViewOptions:
    """What the viewer is asked for.

    Attributes:
      subject: an agent, a run folder, or the name or path of a scene.
      env: environment, `A` or `B`; by default the agent's own, and `A` for a scene.
      task: of a scene; by default the one that the scene was made for.
      physics: backend; by default native on a CPU and mjx on other devices.
      seed: of the first episode.
      epsilon: share of random actions.
      max_steps: iterations until an episode is truncated.
      host: address to listen on. Whoever reaches an address other than 127.0.0.1 can use the
        viewer.
      port: to listen on.
    """

    subject: pathlib.Path
    env: str | None = None
    task: str | None = None
    physics: str | None = None
    seed: int = 0
    epsilon: float = 0.1
    max_steps: int = 1_000
    host: str = "127.0.0.1"
    port: int = 8080

    def __post_init__(self) -> None:
        """Raises ValueError for an option that does not fit."""
        check_epsilon(self.epsilon)
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must be from 0 to {2**31 - 1}, got {self.seed}")
        if not 0 < self.port < 2**16:
            raise ValueError(f"port must be from 1 to {2**16 - 1}, got {self.port}")

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the environment that were given."""
        options = {"env": self.env, "physics": self.physics, "max_steps": self.max_steps}
        return {name: value for name, value in options.items() if value is not None}


def is_loopback(host: str) -> bool:
    """Whether only programs on this machine reach a server on this address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Viewer:
    """A server with a scene, an agent in it, and a panel.

    All that visitors do is put into a queue, and done by `advance`, one after another.

    Args:
      options: what it is asked for.

    Raises:
      ValueError: there is no such agent or scene, the extra `view` is missing, or the port is
        taken.
    """

    def __init__(self, options: ViewOptions):
        self._options = options
        self._wishes: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._paused, self._speed, self._error = False, _SPEED, ""
        self._dragged: np.ndarray | None = None
        self._choices: list[Choice] = []
        self._choice: Choice | None = None
        self._agent: Agent | None = None
        self._version, self._env_steps, self._training = 0, 0, ""
        module = _import_viser()
        if is_scene(options.subject):
            env = scene_env(str(options.subject), options.task, **options.env_options)
            self.session = self._make_session(env, None)
        else:
            if options.task is not None:
                raise ValueError("--task is for a scene; an agent brings its own")
            self._choices = find_choices(options.subject)
            self.session = self._load(self._choices[0], options.seed)
        self.server: viser.ViserServer = _serve(module, options, self._title)
        self._stage = Stage(self.server, lambda position: self._wish("drag", position))
        self._panel = self._build()
        now = time.monotonic()
        self._next_step, self._next_look, self._next_show = now, now + _LOOK_EVERY, now

    @property
    def url(self) -> str:
        """Address to open in a browser."""
        host = self._options.host
        shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        return f"http://{shown}:{self.server.get_port()}"

    @property
    def _title(self) -> str:
        name = self._options.subject.name or str(self._options.subject)
        return f"mjx_arm: {name}"

    def close(self) -> None:
        """Stops the server."""
        self.server.stop()

    def advance(self) -> float:
        """Does what visitors wish for and what is due.

        Returns:
          Seconds until something is due again.
        """
        while not self._wishes.empty():
            self._obey(*self._wishes.get())
        now = time.monotonic()
        if now >= self._next_look:
            self._next_look = now + _LOOK_EVERY
            self._follow()
        if self._paused:
            self._place_dragged()
        elif now >= self._next_step:
            self._step(now)
        if now >= self._next_show:
            self._next_show = now + _SHOW_EVERY
            self._show()
        due = self._next_show if self._paused else min(self._next_step, self._next_show)
        return max(0.0, due - time.monotonic())

    def _wish(self, name: str, value: Any) -> None:
        self._wishes.put((name, value))

    def _obey(self, name: str, value: Any) -> None:
        wishes: dict[str, Callable[[Any], None]] = {
            "pause": lambda _: setattr(self, "_paused", not self._paused),
            "step": lambda _: self._one_step(None),
            "restart": lambda seed: self._restart(seed),
            "speed": lambda speed: setattr(self, "_speed", speed),
            "epsilon": lambda epsilon: setattr(self.session, "epsilon", epsilon),
            "actor": lambda actor: setattr(self.session, "actor", actor),
            "choose": self._choose,
            "act": self._one_step,
            "push": lambda push: self.session.push(*push),
            "drag": self._drag,
        }
        wishes[name](value)
        self._next_show = 0.0

    def _restart(self, seed: int | None) -> None:
        self.session.restart((self.session.seed + 1) % 2**31 if seed is None else seed)
        if varying_look(self.session.simulation.env.varies):
            self._build_stage()

    def _one_step(self, action: int | None) -> None:
        """One iteration at a visitor's wish, by which the session is paused."""
        self._paused = self._paused or action is None
        if self.session.ended:
            self._restart(None)
        self.session.step(action)

    def _step(self, now: float) -> None:
        self._next_step = max(self._next_step + 1.0 / self._speed, now)
        if self.session.ended:
            self._restart(None)
            return
        self._place_dragged()
        self.session.step()
        if self.session.ended:
            self._next_step = now + _REST

    def _drag(self, position: np.ndarray | None) -> None:
        """Notes where a visitor holds the object; None when it is let go, and stays there."""
        if position is None:
            self._place_dragged()
        self._dragged = position

    def _place_dragged(self) -> None:
        """Puts the object where a visitor holds it, if it is not there."""
        if self._dragged is None:
            return
        name = self.session.objects[0]
        held = np.asarray(self._dragged, np.float32)
        if (self.session.position(name) != held).any():
            self.session.place(name, held)

    def _show(self) -> None:
        objects = self.session.objects
        self._stage.show(self.session.seen, self.session.position(objects[0]) if objects else None)
        steps = f", trained for {self._env_steps:,} steps" if self._choice else ""
        self._panel.show(
            self.session,
            paused=self._paused,
            agent=f"{self._choice.name if self._choice else self._options.subject}{steps}",
            training=self._training,
            error=self._error,
        )

    def _choose(self, name: str) -> None:
        """Shows another agent, in the episode of the same seed."""
        before = self.session
        (choice,) = [choice for choice in self._choices if choice.name == name]
        self._panel.say(f"loading {choice.name}: some seconds")
        try:
            self.session = self._load(choice, self.session.seed)
        except ValueError as error:
            self._error = f"{choice.name} cannot be shown: {error}"
            if self._choice is not None:
                self._panel.choose(self._choice.name)
            return
        self._error = ""
        self.session.epsilon, self.session.actor = before.epsilon, before.actor
        self.server.gui.reset()
        self._panel = self._build()

    def _follow(self) -> None:
        """Takes what the training of the agent has written since the last look."""
        choice, agent = self._choice, self._agent
        if choice is None or agent is None:
            return
        self._training = training_line(choice)
        self._offer_new()
        version = choice.version
        if version in (0, self._version):
            return
        self._version = version
        try:
            found = read_params(choice, agent)
        except ValueError as error:
            self._error = str(error)
            return
        self._error = ""
        if found is None:
            self._choose(choice.name)
            return
        params, self._env_steps = found
        self.session.set_params(params)

    def _offer_new(self) -> None:
        """Offers an agent that the training has saved for the first time, such as its best one."""
        choices = find_choices(self._options.subject)
        # A file is away for a moment while it is written again.
        if {choice.name for choice in choices} > {choice.name for choice in self._choices}:
            self._choices = choices
            self._panel.offer([choice.name for choice in choices])

    def _load(self, choice: Choice, seed: int) -> Session:
        version = choice.version
        agent = load_choice(choice, **self._options.env_options)
        session = self._make_session(agent.env, agent, seed)
        self._choice, self._agent, self._version = choice, agent, version
        self._env_steps, self._training = agent.env_steps, training_line(choice)
        return session

    def _make_session(self, env: Env, agent: Agent | None, seed: int | None = None) -> Session:
        simulation = make_simulation(env, None if agent is None else agent.apply)
        return Session(
            simulation,
            None if agent is None else agent.params,
            seed=self._options.seed if seed is None else seed,
            epsilon=self._options.epsilon,
        )

    def _build(self) -> Panel:
        self._build_stage()
        return Panel(
            self.server,
            choices=[choice.name for choice in self._choices],
            chosen="" if self._choice is None else self._choice.name,
            actions=action_names(self.session.simulation.env),
            objects=self.session.objects,
            session=self.session,
            speed=self._speed,
            send=self._wish,
        )

    def _build_stage(self) -> None:
        self._dragged = None
        env = self.session.simulation.env
        model = env.scene.mj_model
        shapes = make_shapes(model, env.varies, self.session.state.params)
        self._stage.build(model, shapes, handle=bool(self.session.objects))


def _import_viser() -> Any:
    try:
        return importlib.import_module("viser")
    except ImportError:
        raise ValueError("the viewer needs the extra 'view': pip install 'mjx-arm[view]'") from None


def _serve(module: Any, options: ViewOptions, title: str) -> Any:
    try:
        # It prints a box with its address whatever `verbose` is.
        with contextlib.redirect_stdout(io.StringIO()):
            server = module.ViserServer(
                host=options.host, port=options.port, label=title, verbose=False
            )
    except OSError as error:
        raise ValueError(
            f"the viewer cannot listen on {options.host}, port {options.port} "
            f"({error.strerror or error}): give --port another one"
        ) from None
    # A shared view would travel over another host, and any visitor may ask for it.
    server.request_share_url = lambda verbose=True: None
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def view(options: ViewOptions) -> None:
    """Serves the viewer until the process ends.

    Raises:
      ValueError: see `Viewer`.
    """
    viewer = Viewer(options)
    if not is_loopback(options.host):
        print(f"warning: whoever reaches {options.host} can work this viewer")
    print(f"viewer: {viewer.url} (Ctrl-C ends it)", flush=True)
    while True:
        time.sleep(viewer.advance())
