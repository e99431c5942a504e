"""Feature maps of a network for the same moment in the simulator and in the stand-in.

After figure 5 of James & Johns 2016, which shows the maps of each layer for a simulated and for a
real image. The similarity of two images in a layer is the cosine of the angle between the layer's
outputs, flattened: 1 for equal ones. Outputs after a rectifier are never negative, so any two
images are similar; the yardstick beside it is the mean similarity of the simulated image to other
moments of the same episode.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.export import image_shape, to_observation
from mjx_arm.networks import make_network
from mjx_arm.networks.q_network import PatchConv
from mjx_arm.options import Count, check_value
from mjx_arm.physics import compiler_options
from mjx_arm.render import rgb
from mjx_arm.standin.levels import Offsets
from mjx_arm.standin.world import StandIn
from mjx_arm.tools.transfer import ITERATIONS, NEAR_CUBE, start_keys, without_randomisation
from mjx_arm.training.agent import Agent

_LAYERS = (PatchConv, nn.Conv, nn.Dense, nn.LayerNorm)
_MOST_MAPS = 16


@dataclasses.dataclass(frozen=True)
class Layer:
    """One layer for one moment, seen twice.

    Attributes:
      name: as flax has it.
      simulated: `[...] float32`, its output for the simulator's image; see `make_layer_outputs`.
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
    """Cosine of the angle between two arrays of the same size, flattened; 0 if one is all zeros."""
    one, other = one.ravel().astype(np.float64), other.ravel().astype(np.float64)
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / size if size else 0.0


def make_layer_outputs(agent: Agent) -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """Makes `images [N, H, W, 3] uint8 -> outputs of the network's layers, [N, ...] float32 each`.

    Layers are convolutions, hidden dense layers and LayerNorms, in the network's order, each after
    a rectifier. The last one is `Q-values`, less their mean and without a rectifier.

    Args:
      agent: that sees pixels.
    """
    network: Any = getattr(agent.algorithm, "network", None) or make_network(
        agent.config.network, num_actions=agent.env.num_actions, feature_scales=None
    )
    order: list[str] = []

    @jax.jit
    def capture(obs: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        keep = lambda module, _: isinstance(module, _LAYERS)  # noqa: E731
        q, state = network.apply(agent.params, obs, capture_intermediates=keep)
        found = dict(_flat(state["intermediates"]))
        order[:] = found  # jit sorts the names
        return q, {name: jax.nn.relu(x) for name, x in found.items()}

    def outputs(images: np.ndarray) -> dict[str, np.ndarray]:
        q, found = capture(to_observation(agent, jnp.asarray(images)))
        # Dense layers that end in Q-values or in a value are no features.
        ends = (1, agent.env.num_actions)
        names = [x for x in order if found[x].ndim > 2 or found[x].shape[-1] not in ends]
        named = {name: np.asarray(found[name]) for name in names}
        return named | {"Q-values": np.asarray(q - q.mean(axis=-1, keepdims=True))}

    return outputs


def _flat(tree: Any, prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for name, value in tree.items():
        if name == "__call__":
            found.append((prefix.rstrip("/"), value[0]))
        else:
            found += _flat(value, f"{prefix}{name}/")
    return found


def compare_moments(
    agent: Agent,
    offsets: Offsets,
    *,
    seed: int,
    episodes: int,
    shadows: bool = True,
    others: int = 8,
) -> list[Comparison]:
    """Compares the moment at which an agent is to close the gripper, in both worlds.

    The agent acts greedily in the simulator, without randomisation: the two worlds then differ by
    the level alone. The moment is the first one at which it closes the gripper within 3 cm of the
    cube; if it never does, the one nearest to the cube. The stand-in is put into the same state.

    Args:
      agent: that sees pixels by one camera.
      offsets: of the stand-in.
      seed: of the starts, as for `mjx_arm.tools.transfer.sample_starts`.
      episodes: number of episodes, with one moment each.
      shadows: render the stand-in's shadows.
      others: number of other moments for the yardstick, spread over the episode.

    Raises:
      ValueError: the agent sees no image, or several, or there is no OpenGL.
    """
    check_value("episodes", Count, episodes)
    check_value("others", Count, others)
    if len(image_shape(agent)) != 3:
        raise ValueError("feature maps are compared for an agent with one camera")
    agent = dataclasses.replace(agent, env=without_randomisation(agent.env))
    play, outputs = _make_episode(agent), make_layer_outputs(agent)
    comparisons = []
    with contextlib.closing(StandIn(agent.env, offsets, shadows=shadows)) as world:
        for key in start_keys(seed, episodes):
            qposes, images, closes = play(key)
            moment = _moment(world, qposes, closes)
            world.reset(qposes[moment], agent.env.arm.home_ctrl)
            rest = _spread(len(images), moment, others)
            seen = np.stack([images[moment], world.image, *images[rest]])
            layers = [_layer(name, x) for name, x in outputs(seen).items()]
            q = agent.apply(agent.params, to_observation(agent, jnp.asarray(seen[:2])))
            comparisons.append(Comparison(moment, seen[0], seen[1], np.asarray(q), layers))
    return comparisons


def _layer(name: str, x: np.ndarray) -> Layer:
    """A layer's outputs of the simulated image, the real one, and other moments."""
    yardstick = float(np.mean([cosine(x[0], other) for other in x[2:]]))
    return Layer(name, x[0], x[1], cosine(x[0], x[1]), yardstick)


def _spread(length: int, moment: int, count: int) -> np.ndarray:
    """Other moments, evenly spread over those that are not next to `moment`."""
    apart = length // (2 * count + 2)
    far = [i for i in range(length) if abs(i - moment) > apart] or [0]
    return np.asarray(far)[np.linspace(0, len(far) - 1, count).astype(int)]


def _make_episode(
    agent: Agent, iterations: int = ITERATIONS
) -> Callable[[jax.Array], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Makes the function that runs a greedy episode in the simulator.

    It takes the key of a start, and returns states `[T, nq]`, images `[T, H, W, 3] uint8`, and
    whether the agent closes the gripper, `[T] bool`.
    """
    env = agent.env

    def step(state: Any, _: None) -> tuple[Any, tuple[jax.Array, ...]]:
        obs: Any = env.observe(state)
        action = jnp.argmax(agent.q_values(obs)).astype(jnp.int32)
        after, transition = env.transition(state, action)
        ended = transition.terminated | transition.truncated
        image = rgb(obs) if env.config.observation == "packed" else obs
        return after, (state.physics.qpos, image, action == env.arm.close_action, ended)

    def run(key: jax.Array) -> Any:
        return jax.lax.scan(step, env.reset(key)[1], None, length=iterations)[1]

    compiled = jax.jit(run, compiler_options=compiler_options(env.physics))

    def play(key: jax.Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        *records, ended = jax.device_get(compiled(key))
        ends = np.flatnonzero(ended)
        length = int(ends[0]) + 1 if len(ends) else iterations
        qposes, images, closes = (x[:length] for x in records)
        return qposes, images, closes

    return play


def _moment(world: StandIn, qposes: np.ndarray, closes: np.ndarray) -> int:
    """See `compare_moments`."""
    distances = []
    for qpos in qposes:
        world.data.qpos[:] = qpos
        world.update()
        distances.append(world.measure().distance)
    there = np.flatnonzero(closes & (np.asarray(distances) <= NEAR_CUBE))
    return int(there[0]) if len(there) else int(np.argmin(distances))


def draw_comparisons(comparisons: Sequence[tuple[str, Comparison]]) -> bytes:
    """The picture of a number of agents, each beside its name, as PNG.

    For each agent a row for the image and for every convolution, with the simulator on the left and
    the stand-in on the right; dense layers are strips.
    """
    import matplotlib.figure

    heights = [x for _, found in comparisons for x in (1.2, *map(_height, found.layers))]
    figure = matplotlib.figure.Figure(figsize=(11, sum(heights) + 0.6), layout="constrained")
    rows = len(heights)
    grid = figure.subplots(rows, 2, squeeze=False, gridspec_kw={"height_ratios": heights})
    row = 0
    for name, comparison in comparisons:
        _show(grid[row], comparison.simulated, comparison.real, f"{name}\nimage", colour=True)
        row += 1
        for layer in comparison.layers:
            chosen = _strongest(layer.simulated)
            one, other = (_tiles(x[..., chosen]) for x in (layer.simulated, layer.real))
            figures = f"{layer.similarity:.3f} ({layer.yardstick:.3f})"
            _show(grid[row], one, other, f"{layer.name.split('/')[-1]}\n{figures}")
            row += 1
    grid[0][0].set_title("simulator, without randomisation", fontsize=10)
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
        aspect = "equal" if len(picture) > 1 else "auto"
        axis.imshow(picture, interpolation="nearest", aspect=aspect, **options)
        axis.set_xticks([])
        axis.set_yticks([])
    axes[0].set_ylabel(words, fontsize=8, rotation=0, ha="right", va="center")


def _height(layer: Layer) -> float:
    """Height of a layer's row, inches."""
    return 1.2 if layer.simulated.ndim == 3 else 0.35


def _strongest(x: np.ndarray) -> np.ndarray:
    """The channels of maps `[H, W, C]` that are shown; all of a vector."""
    if x.ndim != 3:
        return np.arange(x.shape[-1])
    return np.sort(np.argsort(-x.max(axis=(0, 1)), kind="stable")[:_MOST_MAPS])


def _tiles(x: np.ndarray) -> np.ndarray:
    """Maps `[H, W, C]` side by side in two rows, or a vector in one."""
    if x.ndim != 3:
        return x.reshape(1, -1)
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
