"""The vocabulary of everything that is shown: one word and one colour for each thing.

Terminal, pictures, reports and the viewer all take their words and colours from here. The keys of
JSON files and arrays are part of the file formats and stay as they are; `SHOWN_WORDS` translates
them.

| word       | meaning                                                           |
|------------|-------------------------------------------------------------------|
| initial    | the trajectory, or the control, with which the search begins      |
| designed   | the trajectory that the search found                              |
| nominal    | the model as its file states it, or a parameter's initial guess   |
| measured   | what a sensor of the robot recorded                               |
| identified | the model, or a parameter, with the estimate from the recordings  |
| σ          | the standard deviation of a parameter                             |
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Term:
    """A thing that is shown, and how.

    The colours differ also for readers who cannot tell red from green, and can be read on white and
    on dark grey.

    Attributes:
        word: The word for it.
        colour: Its colour, as `#rrggbb`.
        colour_on_dark: A brighter shade of it, for thin lines and text on a dark page.
        colour_name: The word for its colour.
    """

    word: str
    colour: str
    colour_on_dark: str
    colour_name: str

    @property
    def rgb(self) -> tuple[int, int, int]:
        """Its colour as red, green and blue from 0 to 255."""
        red, green, blue = bytes.fromhex(self.colour.removeprefix("#"))
        return red, green, blue


INITIAL = Term(word="initial", colour="#0077bb", colour_on_dark="#4fb0f0", colour_name="blue")
DESIGNED = Term(word="designed", colour="#cc3311", colour_on_dark="#ff7f66", colour_name="red")
NOMINAL = Term(word="nominal", colour="#ee7733", colour_on_dark="#f7a55c", colour_name="orange")
MEASURED = Term(word="measured", colour="#009988", colour_on_dark="#2fc9b5", colour_name="teal")
IDENTIFIED = Term(
    word="identified", colour="#aa3377", colour_on_dark="#e884bd", colour_name="purple"
)

# What is beside the five, such as a baseline.
OTHER = Term(word="other", colour="#8a6d3b", colour_on_dark="#cdb07a", colour_name="brown")

TERMS = (INITIAL, DESIGNED, NOMINAL, MEASURED, IDENTIFIED)

# The terms of the two trajectories of a design or study, by their key in the records and files.
TRAJECTORY_TERMS: dict[str, Term] = {"initial": INITIAL, "final": DESIGNED}

# Words that are shown for keys of records and files; other keys are shown as they are.
SHOWN_WORDS: dict[str, str] = {key: term.word for key, term in TRAJECTORY_TERMS.items()}


def shown_word(key: str) -> str:
    """Return the word that is shown for a key.

    Args:
        key: Key of a record or file, such as `final`.
    """
    return SHOWN_WORDS.get(key, key)
