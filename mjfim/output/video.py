"""Videos of results: MuJoCo draws the frames, PyAV writes an mp4, Pillow a GIF or a WebP."""

from __future__ import annotations

import io
import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mjfim.errors import NoVideoError, RecordingError
from mjfim.files import replacing

if TYPE_CHECKING:
    from mjfim.experiment.system import System
    from mjfim.output.film import Film, Filmed, Painter

# Format of a video: that of the ending of its file. Pages may hold a WebP, too.
Format = Literal["mp4", "gif", "webp"]
MEDIA_TYPES: dict[Format, str] = {"mp4": "video/mp4", "gif": "image/gif", "webp": "image/webp"}
FILE_FORMATS: dict[str, Format] = {".mp4": "mp4", ".gif": "gif"}

# Time that drawing may take, for a film that the user asks for and for one in a report [s]; a
# slower computer draws fewer frames. A report has none with fewer frames per second, or more bytes.
WANTED_SECONDS, REPORT_SECONDS = 60.0, 1.0
FEWEST_FRAMES = 7.0
MAX_BYTES = 2_000_000

# Step between the drawn frames up to which a film looks smooth, and the smallest one of a format;
# GIF and WebP become large or slow.
SMOOTH_STEP = 2
SMALLEST_STEP: dict[Format, int] = {"mp4": 1, "gif": 2, "webp": 2}

# Shadows and samples of a pixel, from the best to the quickest pictures. Without a graphics card,
# each takes half as long as the one before.
QUALITIES = ((True, 4), (False, 4), (False, 0))

# Quality of H.264 (0 is best, 51 worst) and the work that goes into it, and the share of the
# largest size that the pictures may take; the rest is for tables of the file.
CONSTANT_RATE_FACTOR, PRESET = "24", "veryfast"
SHARE_OF_PICTURES = 0.85

# Settings of Pillow: quality of WebP (0..100) and the work that goes into it, colours of a GIF.
WEBP = {"quality": 60, "method": 1}
GIF_COLOURS = 96

# Frames that are drawn to measure how long one takes; before the first one, shaders are compiled.
MEASURED_FRAMES = 2


@dataclass(frozen=True, kw_only=True)
class Video:
    """A video of a motion.

    Attributes:
        data: Contents of its file.
        media_type: `video/mp4`, which a page shows as a video, or `image/gif` or `image/webp`,
            which it shows as an image.
        caption: What it shows and how fast it is played, in one or two sentences.
        width: Width [pixels].
        height: Height [pixels].
    """

    data: bytes = field(repr=False)
    media_type: str
    caption: str
    width: int
    height: int


def write_video(path: Path, system: System, result: Filmed) -> Video:
    """Write a video of a result of a resolved experiment. See `mjfim.save_video`."""
    from mjfim.output.film import film_of

    video = render(film_of(system, result), require_format(path))
    with replacing(path) as temporary:
        temporary.write_bytes(video.data)
    return video


def report_video(system: System, result: Filmed) -> tuple[Video | None, str]:
    """Draw the video of a report, if that takes little time.

    Args:
        system: The experiment, resolved.
        result: The result.

    Returns:
        The video or None, and the sentence that says why there is none.
    """
    from mjfim.output.film import film_of

    # Every browser shows both; an mp4 is smaller.
    kind: Format = "mp4" if find_spec("av") else "webp"
    try:
        video = render(film_of(system, result), kind, REPORT_SECONDS, FEWEST_FRAMES)
        if len(video.data) > MAX_BYTES:
            raise NoVideoError("its file is larger than 2 MB")
    except NoVideoError as reason:
        return None, f"There is no video of the robot: {reason}."
    return video, ""


def require_format(path: Path) -> Format:
    """Make sure before the work that a video can be written, and return its format.

    Args:
        path: The file.

    Raises:
        RecordingError: Its ending is neither .mp4 nor .gif.
        NoVideoError: A package is missing.
    """
    kind = FILE_FORMATS.get(path.suffix.lower())
    if kind is None:
        raise RecordingError(f"{path}: the name of a video ends in .mp4 or .gif")
    if kind == "mp4" and find_spec("av") is None:
        raise NoVideoError(
            "mp4 needs the package av; install it with `pip install 'mjfim[video]'`, or write a "
            "file that ends in .gif"
        )
    return kind


def render(
    film: Film, kind: Format, seconds: float = WANTED_SECONDS, fewest_frames: float = 0.0
) -> Video:
    """Draw a film.

    Args:
        film: The film.
        kind: Format of the video.
        seconds: Time that drawing may take [s].
        fewest_frames: Frames per second of the film below which there is none.

    Raises:
        NoVideoError: Nothing can be drawn here, or not in time.
    """
    from mjfim.output.film import FRAME_RATE, Painter

    # A slow computer draws less well, and then every second or third frame, and so on.
    for shadows, samples in QUALITIES:
        painter = Painter(film, shadows, samples)
        needed = len(film.t) * _seconds_per_frame(painter, len(film.t))
        step = max(math.ceil(needed / seconds), SMALLEST_STEP[kind])
        if step <= SMOOTH_STEP or samples == 0:
            break
        painter.close()

    try:
        if FRAME_RATE / step < fewest_frames:
            raise NoVideoError(
                f"drawing it takes about {needed:.0f} s here, for which --video FILE.mp4 waits"
            )
        chosen = range(0, len(film.t), step)
        images = (painter.frame(k) for k in chosen)
        rate = FRAME_RATE / step
        if kind == "mp4":
            data = _mp4(images, (painter.width, painter.height), rate, len(chosen) / rate)
        else:
            data = _pictures(images, kind, rate)
    finally:
        painter.close()
    return Video(
        data=data,
        media_type=MEDIA_TYPES[kind],
        caption=film.caption,
        width=painter.width,
        height=painter.height,
    )


def _seconds_per_frame(painter: Painter, frames: int) -> float:
    """Time to draw a frame [s], without that in which other programs use the processor."""
    painter.frame(0)
    wall, processor = time.perf_counter(), time.process_time()
    for k in range(MEASURED_FRAMES):
        painter.frame((frames - 1) * k // MEASURED_FRAMES)
    spent = time.perf_counter() - wall, time.process_time() - processor
    return min(spent) / MEASURED_FRAMES


def _mp4(images: Iterator[Any], size: tuple[int, int], rate: float, seconds: float) -> bytes:
    """H.264 in a form that every browser plays, of some seconds."""
    import av  # optional

    bits_per_second = f"{8 * SHARE_OF_PICTURES * MAX_BYTES / seconds:.0f}"
    settings = {
        "crf": CONSTANT_RATE_FACTOR,
        "preset": PRESET,
        "maxrate": bits_per_second,
        "bufsize": bits_per_second,
    }

    # With its table at the beginning, a page plays the file before it has all of it. For that, the
    # encoder reads the file again.
    with tempfile.TemporaryDirectory(prefix="mjfim-video-") as folder:
        file = Path(folder) / "film.mp4"
        with av.open(str(file), "w", options={"movflags": "+faststart"}) as container:
            exact_rate = Fraction(rate).limit_denominator(1000)
            stream = container.add_stream("libx264", rate=exact_rate, options=settings)
            stream.width, stream.height = size
            stream.pix_fmt = "yuv420p"
            for image in images:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())
        return file.read_bytes()


def _pictures(images: Iterator[Any], kind: Format, rate: float) -> bytes:
    """A GIF or a WebP that repeats for ever; all frames of a GIF have the colours of the first."""
    from PIL import Image

    pictures = (Image.fromarray(image) for image in images)
    first = next(pictures)
    if kind == "gif":
        first = first.quantize(GIF_COLOURS, dither=Image.Dither.NONE)
        palette, others = first, pictures
        pictures = (each.quantize(palette=palette, dither=Image.Dither.NONE) for each in others)

    file = io.BytesIO()
    first.save(
        file,
        kind,
        save_all=True,
        append_images=pictures,
        duration=round(1000 / rate),
        loop=0,
        **(WEBP if kind == "webp" else {"optimize": False}),
    )
    return file.getvalue()
