"""Designs for the programs that run robots."""

# Programs for which a design can be exported.
TARGETS = ("ros2", "ros2-bag", "player", "lerobot")
