"""Largest numbers that a user may ask for, in an experiment file or on the command line.

Larger ones are mistyped: the work would not end, would only use memory, or would mean nothing. They
stand below all rooms, so that the help of the command line states them without importing a room.
"""

from __future__ import annotations

# Threads for MuJoCo; more would only use memory.
MAX_THREADS = 1024

# Repeated work of a design.
MAX_STARTS = 10_000
MAX_ITERATIONS = 1_000_000
MAX_REPLICATES = 100_000
MAX_SAMPLES = 10_000

# Largest relative error of a guess, and largest ratio of the noise to the stated one. Robots beyond
# them have nothing in common with the model, and their numbers overflow in the end.
MAX_WRONG, MAX_NOISE = 10.0, 1e6
