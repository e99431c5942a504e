"""What is in a MuJoCo model, as a number."""

from __future__ import annotations

import hashlib

import mujoco
import numpy as np


def model_digest(mj_model: mujoco.MjModel) -> str:
    """SHA-256 of everything in a model, in hexadecimal digits."""
    buffer = np.empty(mujoco.mj_sizeModel(mj_model), np.uint8)
    mujoco.mj_saveModel(mj_model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
