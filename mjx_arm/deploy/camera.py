"""A camera that ffmpeg reads: a video device of Linux, or a video in its place."""

from __future__ import annotations

import subprocess
import tempfile
import threading
import time
from typing import IO

import numpy as np
from PIL import Image

from mjx_arm.deploy.robot import Frame, RobotError

# A camera sends its first image within this time, s.
_PATIENCE = 10.0


class VideoCamera:
    """Reads a camera in a thread, and keeps its newest image, scaled down to what the agent sees.

    Args:
      source: path of a video device, such as `/dev/video0`, or of a video, which plays at its own
        rate.
      size: height and width of an image, pixels. The largest part around the middle of the camera's
        image that has this aspect is scaled down by averaging.

    Raises:
      RobotError: there is no such camera, or it sends no image within 10 s.
    """

    def __init__(self, source: str, size: tuple[int, int]) -> None:
        import imageio_ffmpeg

        self._size = size
        self._lock = threading.Condition()
        self._frame: Frame | None = None
        self._error = ""
        options = ["-f", "v4l2"] if source.startswith("/dev/") else ["-re"]
        output = ["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"]
        # Not a pipe, which a camera with many errors would fill.
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115 (closed by `close`)
        self._process = subprocess.Popen(
            [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *options, "-i", source, *output],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._messages,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        try:
            self.frame()
        except BaseException as error:
            self.close()
            if isinstance(error, RobotError):
                raise RobotError(f"the camera {source!r} cannot be read: {error}") from None
            raise

    def _read(self) -> None:
        stream, number = self._process.stdout, 0
        assert stream is not None
        while (image := _read_ppm(stream)) is not None:
            taken = time.monotonic()
            frame = Frame(scale_down(image, self._size), taken, number)
            number += 1
            with self._lock:
                self._frame = frame
                self._lock.notify_all()
        self._messages.seek(0)
        said = self._messages.read().decode(errors="replace").split("\n")
        said = [line for line in said if line.strip()]
        with self._lock:
            self._error = said[-1] if said else "it has ended"
            self._lock.notify_all()

    def frame(self) -> Frame:
        """The newest image.

        Raises:
          RobotError: the camera has not sent any.
        """
        with self._lock:
            self._lock.wait_for(lambda: self._frame is not None or self._error, _PATIENCE)
            if self._frame is None:
                raise RobotError(self._error or "it has sent no image")
            # After the end of the camera its last image grows old, and the watchdog says so.
            return self._frame

    def close(self) -> None:
        """Frees the camera."""
        self._process.kill()
        self._process.wait()
        self._thread.join()
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._messages.close()


def _read_ppm(stream: IO[bytes]) -> np.ndarray | None:
    """The next image of a stream in the format PPM, `[H, W, 3] uint8`; None at its end."""
    kind, size, most = (stream.readline().split() for _ in range(3))
    if kind != [b"P6"] or len(size) != 2 or most != [b"255"]:
        return None
    width, height = map(int, size)
    data = stream.read(width * height * 3)
    if len(data) < width * height * 3:
        return None
    return np.frombuffer(data, np.uint8).reshape(height, width, 3)


def scale_down(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The middle of an image `[H, W, 3] uint8`, averaged to a size: `[*size, 3] uint8`."""
    height, width = size
    scale = min(image.shape[0] / height, image.shape[1] / width)
    rows, columns = round(scale * height), round(scale * width)
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    middle = Image.fromarray(image[top : top + rows, left : left + columns])
    return np.asarray(middle.resize((width, height), Image.Resampling.BOX))
