"""Two cameras in one observation, one of them on the wrist, added to the scene by MjSpec."""

from __future__ import annotations

import pathlib
import tempfile

import jax
import mujoco
import numpy as np

import mjx_arm


def main() -> None:
    """Adds a camera to the gripper, renders both views, and trains for a moment from both."""
    text = mjx_arm.load_scene("arm_cube").xml
    spec = mujoco.MjSpec.from_string(text)
    spec.body("gripper").add_camera(
        name="wrist", pos=[-0.02, 0.0, 0.09], xyaxes=[0, -1, 0, 0.5, 0, 0.87], fovy=70
    )
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "arm_cube_wrist.xml"
        path.write_text(spec.to_xml())
        cameras = ("front", "wrist")
        env = mjx_arm.make("A", scene=str(path), camera=cameras, observation="rgb")
        obs, _ = jax.jit(env.reset)(jax.random.key(0))
        seen = [len(np.unique(np.asarray(image).reshape(-1, 3), axis=0)) for image in obs]
        print(f"observations {obs.shape}; colours in each view: {seen}")

        config = mjx_arm.train_config(
            scene=str(path), camera=cameras, size=(32, 32), num_envs=16, total_steps=4_096,
            chunk_steps=2_048, learning_starts=1_000, replay_size=20_000,
        )  # fmt: skip
        trainer = mjx_arm.make_trainer(config)
        state = trainer.init(jax.random.key(0))
        for _ in range(config.num_chunks):
            state, counts = trainer.run_chunk(state)
        print(f"mean loss {float(counts['loss'] / counts['updates']):.4f}")


if __name__ == "__main__":
    main()
