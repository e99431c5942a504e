"""Feature maps of a network for the same moment in the simulator and in the stand-in.

After figure 5 of James & Johns 2016, which shows the maps of each layer for a simulated and for a
real image. The similarity of two images in a layer is the cosine of the angle between the layer's
outputs, flattened: 1 for equal ones. Outputs after a rectifier are never negative, so any two
images are similar; the yardstick beside it is the mean similarity of the simulated image to other
moments of the same episode.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.export import image_shape
from mjx_arm.networks import make_network
from mjx_arm.networks.q_network import PatchConv
from mjx_arm.physics import compiler_options
from mjx_arm.render import rgb
from mjx_arm.render.packing import NO_GEOM, pack
from mjx_arm.standin.episodes import Start
from mjx_arm.standin.levels import Offsets
from mjx_arm.standin.world import StandIn
from mjx_arm.tools.transfer import NEAR_CUBE
from mjx_arm.training.agent import Agent

_LAYERS = (PatchConv, nn.Conv, nn.Dense, nn.LayerNorm)
_MOST_MAPS = 16


@dataclasses.dataclass(frozen=True)
class Layer:
    """One layer for one moment, seen twice.

    Attributes:
      name: as flax has it.
      simulated: `[...] float32`, its output for the simulator's image; see `layer_outputs`.
      real: the same for the stand-in's image.
      similarity: cosine of the two.
      yardstick: mean cosine of the simulated image's output and that of other moments.
    """

    name: str
    simulated: np.ndarray
    real: np.ndarray
    similarity: float
    yardstick: float


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A moment in both worlds.

    Attributes:
      moment: its iteration in the episode.
      simulated: `[H, W, 3] uint8`, the image.
      real: the same of the stand-in.
      q: `[2, A] float32`, Q-values of both.
      layers: in the order of the network.
    """

    moment: int
    simulated: np.ndarray
    real: np.ndarray
    q: np.ndarray
    layers: list[Layer]


def cosine(one: np.ndarray, other: np.ndarray) -> float:
    """Cosine of the angle between two arrays of the same size, flattened; 0 where one is zero."""
    one, other = one.ravel().astype(np.float64), other.ravel().astype(np.float64)
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / size if size else 0.0


def layer_outputs(agent: Agent, images: np.ndarray) -> dict[str, np.ndarray]:
    """Outputs of a network's layers after a rectifier, `[N, ...]` each, in the network's order.

    Layers are convolutions, hidden dense layers and LayerNorms. The last one is `Q-values`, less
    their mean and without a rectifier.

    Args:
      agent: that sees pixels.
      images: `[N, H, W, 3] uint8`.
    """
    network: Any = getattr(agent.algorithm, "network", None) or make_network(
        agent.config.network, num_actions=agent.env.num_actions, feature_scales=None
    )
    order: list[str] = []

    def capture(obs: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        keep = lambda module, _: isinstance(module, _LAYERS)  # noqa: E731
        q, state = network.apply(agent.params, obs, capture_intermediates=keep)
        found = dict(_flat(state["intermediates"]))
        order[:] = found  # jit sorts the names
        return q, found

    q, found = jax.jit(capture)(as_observations(agent, images))
    # Dense layers that end in Q-values or in a value are no features.
    ends = (1, agent.env.num_actions)
    names = [x for x in order if found[x].ndim > 2 or found[x].shape[-1] not in ends]
    outputs = {name: np.asarray(jax.nn.relu(found[name])) for name in names}
    return outputs | {"Q-values": np.asarray(q - q.mean(axis=-1, keepdims=True))}


def _flat(tree: Any, prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for name, value in tree.items():
        if name == "__call__":
            found.append((prefix.rstrip("/"), value[0]))
        else:
            found += _flat(value, f"{prefix}{name}/")
    return found


def as_observations(agent: Agent, images: np.ndarray) -> jax.Array:
    """Images `[N, ..., 3] uint8` as an agent's observations."""
    x = jnp.asarray(images)
    if agent.env.config.observation != "packed":
        return x
    red, green, blue = (x[..., i].astype(jnp.uint32) for i in range(3))
    return pack(red, green, blue, jnp.full(red.shape, NO_GEOM, jnp.uint32))


def compare_moment(
    agent: Agent, offsets: Offsets, start: Start, *, shadows: bool = True, others: int = 8
) -> Comparison:
    """Compares the moment at which an agent is to close the gripper, in both worlds.

    The agent acts greedily in the simulator. The moment is the first at which it closes the gripper
    within 3 cm of the cube, or where it never does, the one nearest to the cube; the stand-in is
    put into the same state.

    Args:
      agent: that sees pixels by one camera.
      offsets: of the stand-in.
      start: of the episode.
      shadows: render the stand-in's shadows.
      others: number of other moments for the yardstick, spread over the episode.

    Raises:
      ValueError: the agent sees no image, or several.
    """
    if len(image_shape(agent)) != 3:
        raise ValueError("feature maps are compared for an agent with one camera")
    qposes, images = _episode(agent, start)
    world = StandIn(agent.env, offsets, shadows=shadows)
    moment = _moment(agent, world, qposes, images)
    world.reset(qposes[moment], start.ctrl)
    real = world.image
    world.close()
    rest = np.unique(np.linspace(0, len(images) - 1, others + 2).astype(int))
    rest = rest[np.abs(rest - moment) > len(images) // (2 * others + 2)]
    outputs = layer_outputs(agent, np.stack([images[moment], real, *images[rest]]))
    layers = [
        Layer(
            name,
            x[0],
            x[1],
            cosine(x[0], x[1]),
            float(np.mean([cosine(x[0], other) for other in x[2:]])) if len(x) > 2 else 0.0,
        )
        for name, x in outputs.items()
    ]
    q = agent.apply(agent.params, as_observations(agent, np.stack([images[moment], real])))
    return Comparison(moment, images[moment], real, np.asarray(q), layers)


def _episode(agent: Agent, start: Start, iterations: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """States `[T, nq]` and images `[T, H, W, 3] uint8` of a greedy episode in the simulator."""
    env = agent.env

    def step(state: Any, _: None) -> tuple[Any, tuple[jax.Array, ...]]:
        obs: Any = env.observe(state)
        action = jnp.argmax(agent.q_values(obs)).astype(jnp.int32)
        after, transition = env.transition(state, action)
        ended = transition.terminated | transition.truncated
        image = rgb(obs) if env.config.observation == "packed" else obs
        return after, (state.physics.qpos, image, ended)

    def run(qpos: jax.Array, ctrl: jax.Array) -> Any:
        _, state = env.reset(jax.random.key(0))
        physics = env.physics.init(qpos, ctrl, state.params)
        state = dataclasses.replace(state, physics=physics, ctrl=ctrl)
        return jax.lax.scan(step, state, None, length=iterations)[1]

    compiled = jax.jit(run, compiler_options=compiler_options(env.physics))
    qpos, images, ended = jax.device_get(compiled(start.qpos, start.ctrl))
    ends = np.flatnonzero(ended)
    length = int(ends[0]) + 1 if len(ends) else iterations
    return qpos[:length], images[:length]


def _moment(agent: Agent, world: StandIn, qposes: np.ndarray, images: np.ndarray) -> int:
    """See `compare_moment`."""
    distances = []
    for qpos in qposes:
        world.data.qpos[:] = qpos
        world.update()
        distances.append(world.measure().distance)
    q = np.asarray(jax.jit(agent.apply)(agent.params, as_observations(agent, images)))
    closes = q.argmax(axis=-1) == agent.env.arm.close_action
    there = np.flatnonzero(closes & (np.asarray(distances) <= NEAR_CUBE))
    return int(there[0]) if len(there) else int(np.argmin(distances))


def draw_comparisons(comparisons: Sequence[tuple[str, Comparison]]) -> bytes:
    """The picture of a number of agents, each beside its name, as PNG.

    For each agent a row for the image and for every convolution, with the simulator on the left and
    the stand-in on the right; dense layers are strips.
    """
    import matplotlib.figure

    rows = sum(1 + len(comparison.layers) for _, comparison in comparisons)
    figure = matplotlib.figure.Figure(figsize=(11, 1.35 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, 2, squeeze=False)
    row = 0
    for name, comparison in comparisons:
        _show(grid[row], comparison.simulated, comparison.real, f"{name}\nimage", colour=True)
        row += 1
        for layer in comparison.layers:
            chosen = _strongest(layer.simulated)
            one, other = (_tiles(x[..., chosen]) for x in (layer.simulated, layer.real))
            words = f"{layer.name.split('/')[-1]}\n{layer.similarity:.3f}\n({layer.yardstick:.3f})"
            _show(grid[row], one, other, words)
            row += 1
    grid[0][0].set_title("simulator", fontsize=10)
    grid[0][1].set_title("stand-in for reality", fontsize=10)
    figure.supxlabel(
        "cosine similarity of the two (in brackets: of the simulated image to other moments)",
        fontsize=9,
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _show(axes: Any, one: np.ndarray, other: np.ndarray, words: str, colour: bool = False) -> None:
    # One scale for both worlds.
    low, high = min(one.min(), other.min()), max(one.max(), other.max())
    options = {} if colour else {"cmap": "viridis", "vmin": low, "vmax": high}
    for axis, picture in zip(axes, (one, other), strict=True):
        axis.imshow(picture, interpolation="nearest", **options)
        axis.set_xticks([])
        axis.set_yticks([])
    axes[0].set_ylabel(words, fontsize=8, rotation=0, ha="right", va="center")


def _strongest(x: np.ndarray) -> np.ndarray:
    """The channels of maps `[H, W, C]` that are shown; all of a vector."""
    if x.ndim != 3:
        return np.arange(x.shape[-1])
    return np.sort(np.argsort(-x.max(axis=(0, 1)), kind="stable")[:_MOST_MAPS])


def _tiles(x: np.ndarray) -> np.ndarray:
    """Maps `[H, W, C]` side by side in two rows, or a vector in two rows."""
    if x.ndim != 3:
        flat = x.ravel()
        half = -(-len(flat) // 2)
        return np.pad(flat, (0, 2 * half - len(flat))).reshape(2, half)
    maps = np.pad(np.moveaxis(x, -1, 0), ((0, 0), (0, 1), (0, 1)))
    half = -(-len(maps) // 2)
    maps = np.concatenate([maps, np.zeros((2 * half - len(maps), *maps.shape[1:]))])
    return np.concatenate([np.concatenate(list(part), axis=1) for part in np.split(maps, 2)])


def to_json(comparison: Comparison) -> dict[str, Any]:
    """A comparison as a JSON object, without its pictures."""
    return {
        "moment": comparison.moment,
        "measure": "cosine similarity of flattened outputs after a rectifier",
        "layers": [
            {"name": x.name, "similarity": x.similarity, "other_moments": x.yardstick}
            for x in comparison.layers
        ],
        "q_simulated": comparison.q[0].tolist(),
        "q_standin": comparison.q[1].tolist(),
        "same_action": bool(comparison.q[0].argmax() == comparison.q[1].argmax()),
    }
