"""The panel beside the scene: buttons, what the agent sees, and bars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_arm.view.bars import facts, q_bars, reward_bars
from mjx_arm.view.session import ACTORS, Session

if TYPE_CHECKING:
    import viser

# Edge that the agent's image is enlarged to, at least, pixels.
_EDGE = 192
# How far one push moves an object, m, by the button's name; x points away from the arm's base.
PUSHES = {
    "away": (0.02, 0.0, 0.0),
    "near": (-0.02, 0.0, 0.0),
    "left": (0.0, 0.02, 0.0),
    "right": (0.0, -0.02, 0.0),
    "up": (0.0, 0.0, 0.05),
}
Send = Callable[[str, Any], None]


class Panel:
    """Widgets of a viser server. Whatever a visitor does is sent as a name and a value.

    Args:
      server: of viser.
      choices: names of the agents to choose from; empty for a scene without one.
      chosen: the one that is shown.
      actions: names of the actions.
      objects: names of what can be pushed.
      session: what the widgets show first.
      speed: iterations per second.
      send: called with `pause`, `step`, `restart`, `speed`, `epsilon`, `choose`, `actor`, `act` or
        `push`, and a value.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        choices: Sequence[str],
        chosen: str,
        actions: Sequence[str],
        objects: Sequence[str],
        session: Session,
        speed: float,
        send: Send,
    ):
        self._gui, self._send, self._actions = server.gui, send, list(actions)
        self._reward_scale = 1e-6
        self._status = self._gui.add_markdown("starting")
        self._training = self._gui.add_markdown("", visible=False)
        self._agents: Any = None
        if choices:
            agents = self._gui.add_dropdown("agent", list(choices), initial_value=chosen)
            agents.on_update(self._changed("choose", lambda: agents.value))
            self._agents = agents
        self._pause = self._gui.add_button("Pause")
        self._pause.on_click(lambda _: send("pause", None))
        self._group("episode", {"step": ("step", None), "next seed": ("restart", None)})
        self._hands(session, objects)
        self._gui.add_markdown("**What the agent sees**" if choices else "**The camera**")
        self._image = self._gui.add_image(enlarge(np.asarray(session.seen.image)), format="png")
        self._facts = self._gui.add_html("")
        self._q = self._gui.add_html("", visible=session.simulation.has_agent)
        self._reward = self._gui.add_html("")
        with self._gui.add_folder("Settings"):
            self._settings(session, speed)
        with self._gui.add_folder("Joints", expand_by_default=False):
            for joint in range(session.simulation.env.arm.num_joints):
                name = self._actions[2 * joint].rpartition(" ")[0]
                self._group(name, {"−": ("act", 2 * joint), "+": ("act", 2 * joint + 1)})

    def _settings(self, session: Session, speed: float) -> None:
        gui, send = self._gui, self._send
        self._seed: Any = gui.add_number("seed", session.seed, min=0, max=2**31 - 1, step=1)
        self._seed.on_update(self._changed("restart", lambda: int(self._seed.value)))
        rate = gui.add_slider("steps/s", min=1, max=100, step=1, initial_value=round(speed))
        rate.on_update(lambda _: send("speed", float(rate.value)))
        if session.simulation.has_agent:
            share = gui.add_slider(
                "epsilon", min=0.0, max=1.0, step=0.05, initial_value=session.epsilon
            )
            share.on_update(lambda _: send("epsilon", float(share.value)))
        actors = ACTORS if session.simulation.has_agent else ACTORS[1:]
        actor = gui.add_dropdown("who acts", list(actors), initial_value=session.actor)
        actor.on_update(lambda _: send("actor", actor.value))

    def offer(self, choices: Sequence[str]) -> None:
        """Changes the agents to choose from; the one that is shown stays chosen."""
        self._agents.options = tuple(choices)

    def choose(self, name: str) -> None:
        """Shows which agent is chosen."""
        self._agents.value = name

    def _changed(self, name: str, value: Callable[[], Any]) -> Callable[[Any], None]:
        """Sends what a visitor changed, not what the program itself set."""

        def changed(event: Any) -> None:
            if event.client is not None:
                self._send(name, value())

        return changed

    def _hands(self, session: Session, objects: Sequence[str]) -> None:
        arm = session.simulation.env.arm
        self._group(
            "gripper", {"open": ("act", arm.open_action), "close": ("act", arm.close_action)}
        )
        for name in objects:
            self._group(
                f"push {name}", {side: ("push", (name, shift)) for side, shift in PUSHES.items()}
            )

    def _group(self, label: str, wishes: dict[str, tuple[str, Any]]) -> None:
        """Buttons in one row, and what each of them sends."""
        group = self._gui.add_button_group(label, list(wishes))
        group.on_click(lambda _: self._send(*wishes[group.value]))

    def say(self, text: str) -> None:
        """Says what is being done, until `show` is called."""
        self._status.content = text

    def show(
        self, session: Session, *, paused: bool, agent: str, training: str, error: str
    ) -> None:
        """Shows a session.

        Args:
          session: the session.
          paused: it does not advance on its own.
          agent: what acts, in words.
          training: where its training stands, in words; may be empty.
          error: what went wrong last, in words; may be empty.
        """
        self._pause.label = "Continue" if paused else "Pause"
        if self._seed.value != session.seed:
            self._seed.value = session.seed
        self._status.content = _status(session, paused, agent, error)
        self._training.content, self._training.visible = training, bool(training)
        self._image.image = enlarge(np.asarray(session.seen.image))
        measured = {
            name: bool(x) if np.asarray(x).dtype == bool else float(x)
            for name, x in session.seen.measured.items()
        }
        self._facts.content = facts("Measured", measured)
        if session.simulation.has_agent:
            values = session.seen.q.tolist()
            chosen = int(np.argmax(values)) if session.actor == "agent" else None
            self._q.content = q_bars(self._actions, values, chosen)
        if session.outcome is not None:
            terms = session.outcome.terms
            # A success pays many times what a step does, and would flatten all other bars.
            shown = [abs(x) for name, x in terms.items() if name != "success"]
            self._reward_scale = max(self._reward_scale, *shown, 1e-6)
            self._reward.content = reward_bars(terms, self._reward_scale)


def _status(session: Session, paused: bool, agent: str, error: str) -> str:
    outcome = session.outcome
    doing = "paused" if paused else "running"
    if outcome is not None and outcome.ended:
        doing = "success" if outcome.success else "failed"
    blocked = " · blocked" if outcome is not None and outcome.blocked else ""
    line = f"**{agent}** · seed {session.seed} · step {session.step_count} · {doing}{blocked}"
    return f"{line}\n\n⚠ {error}" if error else line


def enlarge(image: np.ndarray) -> np.ndarray:
    """An image `[H, W, 3]` with each pixel as a square, at least 192 pixels high."""
    factor = max(1, -(-_EDGE // image.shape[0]))
    return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)


__all__ = ["PUSHES", "Panel", "enlarge"]
