from .lerobot import is_lerobot_dataset, lerobot_episodes
from .read import read_columns, read_table

__all__ = [
    "is_lerobot_dataset",
    "lerobot_episodes",
    "read_columns",
    "read_table",
]
