"""Results for other programs: identified models, and designs for the programs that run robots."""

# Programs for which a design can be exported.
TARGETS = ("ros2", "ros2-bag", "player", "lerobot")
