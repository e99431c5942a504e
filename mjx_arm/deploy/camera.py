"""A camera that ffmpeg reads: a video device of Linux, or a video in its place."""

from __future__ import annotations

import os
import threading
import time
from typing import Any

import numpy as np
from PIL import Image

from mjx_arm.deploy.robot import Frame, RobotError

_PATIENCE = 5.0


class VideoCamera:
    """Reads a camera in a thread, and keeps its newest image, scaled down to what the agent sees.

    Args:
      source: path of a video device, such as `/dev/video0`, or of a video.
      size: height and width of an image, pixels. The middle of the camera's image with this aspect
        is scaled down by averaging.

    Raises:
      RobotError: there is no such camera.
    """

    def __init__(self, source: str, size: tuple[int, int]) -> None:
        # Without this, ffmpeg is forked from a process with many threads, and may deadlock.
        os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
        import imageio_ffmpeg

        self._size = size
        options = ["-f", "v4l2"] if source.startswith("/dev/") else []
        frames = imageio_ffmpeg.read_frames(source, input_params=options)
        try:
            # Of the first frame on the description alone; width and height.
            self._shape: tuple[int, int] = next(frames)["size"]
        except Exception as error:  # a device that is busy, a file that is no video, ...
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise RobotError(f"the camera {source!r} cannot be read: {reason}") from error
        self._lock = threading.Condition()
        self._frame: Frame | None = None
        self._error = ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, args=(frames,), daemon=True)
        self._thread.start()

    def _read(self, frames: Any) -> None:
        (width, height), number = self._shape, 0
        reason = "the camera has ended"
        try:
            for data in frames:
                if self._ended.is_set():
                    break
                large = np.frombuffer(data, np.uint8).reshape(height, width, 3)
                frame = Frame(scale_down(large, self._size), time.monotonic(), number)
                number += 1
                with self._lock:
                    self._frame = frame
                    self._lock.notify_all()
        except Exception as error:
            reason = f"the camera has failed: {str(error).splitlines()[0]}"
        finally:
            frames.close()
        with self._lock:
            self._error = reason
            self._lock.notify_all()

    def frame(self) -> Frame:
        """The newest image; the first call waits for it.

        Raises:
          RobotError: the camera has sent no image within its time, or has failed.
        """
        with self._lock:
            self._lock.wait_for(lambda: self._frame is not None or self._error, _PATIENCE)
            if self._frame is None:
                raise RobotError(self._error or "the camera is silent: it has sent no image")
            # After its end the last image grows old, and the watchdog says so.
            return self._frame

    def close(self) -> None:
        """Frees the camera."""
        self._ended.set()
        self._thread.join(_PATIENCE)


def scale_down(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The middle of an image `[H, W, 3] uint8`, averaged to a size: `[*size, 3] uint8`."""
    height, width = size
    scale = min(image.shape[0] / height, image.shape[1] / width)
    rows, columns = round(scale * height), round(scale * width)
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    middle = Image.fromarray(image[top : top + rows, left : left + columns])
    return np.asarray(middle.resize((width, height), Image.Resampling.BOX))
