"""Frames as a file: mp4 by PyAV, GIF and WebP by Pillow."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from PIL import Image as PillowImage

from mjfim.output.video.picture import Image
from mjfim.output.video.record import Format

# Quality of H.264 (0 is best, 51 worst), and how much work goes into it.
CONSTANT_RATE_FACTOR, PRESET = "24", "veryfast"

# Share of the largest size that the pictures may take; the rest is for tables of the file.
SHARE_OF_PICTURES = 0.85

# Quality of WebP (0..100), and how much work goes into it (0..6).
WEBP_QUALITY, WEBP_METHOD = 60, 1

# Colours of a GIF.
GIF_COLOURS = 96

# Every how many-th frame a format shows at most; GIF and WebP become large or slow.
SMALLEST_STEP: dict[Format, int] = {"mp4": 1, "gif": 2, "webp": 2}


@dataclass(frozen=True, eq=False, kw_only=True)
class Frames:
    """The frames that are encoded.

    Attributes:
        images: The frames, one after the other.
        count: Number of frames.
        rate: Frames per second.
        width: Width [pixels].
        height: Height [pixels].
        max_bytes: Largest size of an mp4 file.
    """

    images: Iterator[Image]
    count: int
    rate: float
    width: int
    height: int
    max_bytes: int


def write_mp4(path: Path, frames: Frames) -> None:
    """Write H.264 in a form that every browser plays.

    Args:
        path: The file.
        frames: The frames.
    """
    # An optional package, which `require_encoder` looks for beforehand.
    import av

    bits_per_second = 8 * SHARE_OF_PICTURES * frames.max_bytes * frames.rate / frames.count
    settings = {
        "crf": CONSTANT_RATE_FACTOR,
        "preset": PRESET,
        "maxrate": f"{bits_per_second:.0f}",
        "bufsize": f"{bits_per_second:.0f}",
    }

    # With its table at the beginning, a page plays the file before it has all of it.
    exact_rate = Fraction(frames.rate).limit_denominator(1000)
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=exact_rate, options=settings)
        stream.width, stream.height = frames.width, frames.height
        stream.pix_fmt = "yuv420p"
        for image in frames.images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def write_gif(path: Path, frames: Frames) -> None:
    """Write a GIF that repeats for ever; all frames have the colours of the first one.

    Args:
        path: The file.
        frames: The frames.
    """
    first = PillowImage.fromarray(next(frames.images))
    palette = first.quantize(GIF_COLOURS, dither=PillowImage.Dither.NONE)
    others = (
        PillowImage.fromarray(image).quantize(palette=palette, dither=PillowImage.Dither.NONE)
        for image in frames.images
    )
    palette.save(
        path,
        save_all=True,
        append_images=others,
        duration=round(1000 / frames.rate),
        loop=0,
        optimize=False,
    )


def write_webp(path: Path, frames: Frames) -> None:
    """Write an animated WebP that repeats for ever.

    Args:
        path: The file.
        frames: The frames.
    """
    first = PillowImage.fromarray(next(frames.images))
    first.save(
        path,
        save_all=True,
        append_images=(PillowImage.fromarray(image) for image in frames.images),
        duration=round(1000 / frames.rate),
        loop=0,
        quality=WEBP_QUALITY,
        method=WEBP_METHOD,
    )


ENCODERS: dict[Format, Callable[[Path, Frames], None]] = {
    "mp4": write_mp4,
    "gif": write_gif,
    "webp": write_webp,
}
