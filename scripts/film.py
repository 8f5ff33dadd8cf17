"""Film for the README how σ of each parameter falls in a chirp and in a design, side by side.

python -m scripts.film docs/images/design.gif
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageSequence

import mjfim
from scripts.benchmarks.child import ROOT

EXPERIMENT = ROOT / "models" / "cart_pendulum_rig.toml"

# Width of the GIF, height of a bar, row and longest bar [pixels], and milliseconds of a frame and
# of the last one.
WIDTH, BAR, ROW, LENGTH, PACE, LAST = 860, 18, 34, 210, 80, 2500

# Percent at the left end of the logarithmic bars, their decades, and the wanted percent.
LEAST, DECADES, WANTED = 0.1, 2.5, 1.0

GREEN, RED, GREY, INK = "#008c5a", "#c83c28", "#e1e4e9", "#282c34"


def main() -> None:
    """Design, film and draw the bars below each picture."""
    experiment = mjfim.Experiment.from_file(EXPERIMENT)
    design = mjfim.design(experiment)
    mjfim.save_video(experiment, replace(design, rehearsal=None, valley=None), sys.argv[1])
    letters, frames = ImageFont.load_default(17), []
    with Image.open(sys.argv[1]) as film:
        scenes = [scene.convert("RGB") for scene in ImageSequence.Iterator(film)]
    for k, scene in enumerate(scenes):
        top = scene.height * WIDTH // scene.width
        frame = Image.new("RGB", (WIDTH, top + ROW * len(design.theta)), "white")
        frame.paste(scene.resize((WIDTH, top), Image.Resampling.LANCZOS))
        draw = ImageDraw.Draw(frame)
        for i, side in enumerate((design.initial, design.final)):
            row = k * (len(side.std_over_time) - 1) // (len(scenes) - 1)
            for j, percent in enumerate(100.0 * side.std_over_time[row] / design.sizes):
                x, y = WIDTH // 2 * i + 100, top + ROW * j + 6
                share = np.clip(np.log10(percent / LEAST) / DECADES, 0.0, 1.0)
                colour = GREEN if percent <= WANTED else RED
                draw.rectangle((x, y, x + LENGTH, y + BAR), GREY)
                draw.rectangle((x, y, x + share * LENGTH, y + BAR), colour)
                draw.text((x - 86, y + 9), design.parameters[j], INK, letters, anchor="lm")
                draw.text(
                    (x + LENGTH + 14, y + 9),
                    f"{min(percent, 99):.3g} %",
                    colour,
                    letters,
                    anchor="lm",
                )
        frames.append(frame)

    # All frames have the colours of the last one, which has bars of both.
    palette = frames[-1].quantize(64)
    first, *others = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]
    pace = [PACE] * len(others) + [LAST]
    first.save(sys.argv[1], save_all=True, append_images=others, duration=pace, loop=0)


if __name__ == "__main__":
    main()
