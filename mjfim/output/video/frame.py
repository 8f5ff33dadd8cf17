"""Frames of a film: pictures side by side with titles above and the time below."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from mjfim.output.video.picture import Image

# Heights of the strips above and below the pictures, and the gap between pictures [pixels]. All are
# even, as the encoder of mp4 needs.
TITLE_HEIGHT, FOOT_HEIGHT, GAP = 36, 32, 4

# Sizes of the letters of titles and foot [pixels], and the distance from the edge.
TITLE_SIZE, FOOT_SIZE, MARGIN = 21, 17, 14

# Colours of the strips and of the text in the foot (0..255).
PAPER, INK, FAINT_INK = (255, 255, 255), (40, 44, 52), (110, 116, 126)


class FrameLayout:
    """Puts pictures, titles and the time together."""

    def __init__(self, job: dict[str, Any]) -> None:
        """Draw what is equal in all frames.

        Args:
            job: Settings and words of the film.
        """
        count = len(job["views"])
        self._width, self._height = int(job["width"]), int(job["height"])
        self._font = _font("DejaVuSans.ttf", FOOT_SIZE)
        self.width = count * self._width + (count - 1) * GAP
        self.height = TITLE_HEIGHT + self._height + FOOT_HEIGHT
        self._paper = self._empty_frame(job)

    def image(self, pictures: Sequence[Image], t: float) -> Image:
        """Return a frame.

        Args:
            pictures: A picture for each view.
            t: Time of the motion [s].

        Returns:
            (height, width, 3) picture of bytes.
        """
        frame = self._paper.copy()
        for k, picture in enumerate(pictures):
            corner = (k * (self._width + GAP), TITLE_HEIGHT)
            frame.paste(PillowImage.fromarray(picture), corner)

        text = ImageDraw.Draw(frame)
        middle = self.height - FOOT_HEIGHT // 2
        text.text((MARGIN, middle), f"t = {t:.2f} s", INK, self._font, anchor="lm")
        return np.asarray(frame)

    def _empty_frame(self, job: dict[str, Any]) -> PillowImage.Image:
        """Draw the titles and the speed."""
        frame = PillowImage.new("RGB", (self.width, self.height), PAPER)
        text = ImageDraw.Draw(frame)
        bold = _font("DejaVuSans-Bold.ttf", TITLE_SIZE)
        plain = _font("DejaVuSans.ttf", TITLE_SIZE)

        for k, tracks in enumerate(job["views"]):
            x = float(k * (self._width + GAP) + MARGIN)
            for j, track in enumerate(tracks):
                words = [(" and ", FAINT_INK, plain)] if j else []
                words.append((str(track["word"]), tuple(track["colour"]), bold))
                if float(track["opacity"]) < 1.0:
                    words.append((" (transparent)", FAINT_INK, plain))
                for word, colour, font in words:
                    text.text((x, TITLE_HEIGHT // 2), word, colour, font, anchor="lm")
                    x += font.getlength(word)

        place = (self.width - MARGIN, self.height - FOOT_HEIGHT // 2)
        text.text(place, str(job["remark"]), FAINT_INK, self._font, anchor="rm")
        return frame


def _font(name: str, size: int) -> ImageFont.FreeTypeFont:
    """A font that comes with matplotlib, so that it is the same on every computer."""
    # The package is only looked for, because its import takes longer than a second of film.
    spec = find_spec("matplotlib")
    assert spec is not None and spec.origin is not None
    fonts = Path(spec.origin).parent / "mpl-data" / "fonts" / "ttf"
    return ImageFont.truetype(fonts / name, size)
