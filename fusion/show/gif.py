"""An animated GIF that is written frame by frame; Pillow's own way holds all frames until the last one."""

from __future__ import annotations

from typing import BinaryIO

from PIL import Image, ImageChops
from PIL.GifImagePlugin import getdata, getheader


class GifStream:
    """Frames of one size into a stream, each as it comes, and of each only the part that differs from the one before.

    >>> from io import BytesIO
    >>> stream = BytesIO()
    >>> gif = GifStream(stream, seconds=0.1)
    >>> for colour in ("white", "black"):
    ...     gif.add(Image.new("RGB", (4, 3), colour))
    >>> gif.finish()
    >>> Image.open(stream).n_frames
    2
    """

    def __init__(self, stream: BinaryIO, *, seconds: float) -> None:
        """``seconds``: how long each frame stands."""
        self._stream = stream
        self._milliseconds = round(1000 * seconds)
        self._last: Image.Image | None = None

    def add(self, frame: Image.Image) -> None:
        """One more frame, of mode RGB."""
        few = frame.convert("P", palette=Image.Palette.ADAPTIVE)
        place = (0, 0, *frame.size)
        if self._last is None:
            self._stream.writelines(getheader(few.copy(), info={"loop": 0})[0])
        else:
            # a frame needs a pixel at least
            place = ImageChops.difference(frame, self._last).getbbox() or (0, 0, 1, 1)
        part = few.crop(place)
        blocks = getdata(part, place[:2], duration=self._milliseconds, include_color_table=True)
        self._stream.writelines(blocks)
        self._last = frame

    def finish(self) -> None:
        """The end of the file; the stream stays open."""
        self._stream.write(b";")


__all__ = ["GifStream"]
