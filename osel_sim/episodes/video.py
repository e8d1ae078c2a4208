"""Videos: what the camera saw, with instruction, policy, step and price written into the frame."""

import textwrap
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, override

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import SuiteHostError, UsageError
from osel_sim.core.files import atomic
from osel_sim.episodes.loop import Frame, Subscriber
from osel_sim.interface.outcome import Outcome

if TYPE_CHECKING:
    from collections.abc import Generator

SIZE = 480  # pixels; the picture is square, the text stands in a band above it
RATE = 10  # frames a second, as near as control steps allow, in real time
HOLD_SECONDS = 1  # the last frame stays that long, with the result
_BAND = 80
_WHITE, _GREY, _GREEN, _RED, _AMBER = (255, 255, 255), (170, 170, 170), (120, 220, 120), (255, 120, 110), (255, 200, 90)


class Video(Subscriber):
    """Writes one episode to an .mp4 file, which appears when the episode is over.

    Args:
        file: where to; its folder is made.
        camera: which camera to show; None: the environment's context camera.
        quality: of the rendering, `full` or `fast`.
    """

    def __init__(self, file: Path, camera: str | None = None, quality: str = "full") -> None:
        self.file, self.camera, self.quality = file, camera, quality
        self._file = ExitStack()
        self._writer: Generator[None, NDArray[np.uint8] | None, None] | None = None
        self._last: Frame | None = None
        self._every, self._fps = 1, float(RATE)
        self._picture: NDArray[np.uint8] = np.zeros((SIZE, SIZE, 3), np.uint8)
        self._image = self._picture

    @override
    def on_start(self, frame: Frame) -> None:
        import imageio_ffmpeg  # type: ignore[import-untyped]

        specification = frame.env.specification
        self.camera = self.camera or specification.context_camera
        self._every = max(1, round(specification.control_hz / RATE))
        self._fps = specification.control_hz / self._every
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self._writer = imageio_ffmpeg.write_frames(
            f"file:{self._file.enter_context(atomic(self.file.absolute()))}",  # else `12:30/0.mp4` is a protocol to ffmpeg, and `-x/0.mp4` an option
            (SIZE, SIZE + _BAND),
            fps=self._fps,
            codec="libx264",
            quality=8,
            macro_block_size=16,
            output_params=["-f", "mp4"],
            ffmpeg_log_level="error",
        )
        with self._named():
            self._writer.send(None)
        self._show(frame)

    @override
    def on_step(self, frame: Frame) -> None:
        if frame.steps % self._every == 0:
            self._show(frame)
        else:
            self._last = frame

    @override
    def on_end(self, outcome: Outcome) -> None:
        if self._writer is None or self._last is None:
            return
        self._show(self._last, outcome)
        for _ in range(int(HOLD_SECONDS * self._fps) - 1):
            self._send(self._image)
        with self._named():
            self._writer.close()
        self._file.close()

    def _show(self, frame: Frame, outcome: Outcome | None = None) -> None:
        self._last = frame
        try:
            self._picture = frame.env.image(self.camera or frame.env.specification.context_camera, SIZE, SIZE, self.quality)
        except SuiteHostError:
            if outcome is None:
                raise
        self._image = annotate(self._picture, frame, outcome)
        self._send(self._image)

    def _send(self, image: NDArray[np.uint8]) -> None:
        if self._writer is not None:
            with self._named():
                self._writer.send(image)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """What goes wrong in ffmpeg, as one line about the video."""
        try:
            yield
        except (OSError, RuntimeError) as error:
            raise UsageError(f"{self.file}: ffmpeg cannot write the video ({' '.join(str(error).split())[:200]})") from None


def annotate(picture: NDArray[np.uint8], frame: Frame, outcome: Outcome | None = None) -> NDArray[np.uint8]:
    """The picture (SIZE, SIZE, 3) below a band of text: uint8 (SIZE + band, SIZE, 3)."""
    image = np.zeros((SIZE + _BAND, SIZE, 3), np.uint8)
    image[_BAND:] = picture
    lines = textwrap.wrap(frame.instance.instruction, 54)[:2]
    for number, line in enumerate(lines):
        _write(image, line, (10, 22 + 20 * number), _WHITE)
    _write(image, f"{frame.policy}   step {frame.steps}   {frame.price:.2f} cents", (10, 68), _GREY)
    if outcome is not None:
        word, colour = ("error", _AMBER) if outcome.error else ("success", _GREEN) if outcome.success else ("not done", _RED)
        _write(image, word, (SIZE - 100, 68), colour)
    elif frame.waiting:
        _write(image, "waiting", (SIZE - 100, 68), _AMBER)
    return image


def _write(image: NDArray[np.uint8], text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    import cv2

    canvas: Any = image
    cv2.putText(canvas, text.encode("ascii", "replace").decode(), at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
