from .dispatch import carry_out, results, results_on
from .pool import (
    LOST_SENTENCE,
    Pool,
    cores,
    offer_result,
    one_blas_thread,
    pool_stop_token,
    process_count,
    require_threads,
)
from .workers import ExecutorLike, Workers

__all__ = [
    "LOST_SENTENCE",
    "ExecutorLike",
    "Pool",
    "Workers",
    "carry_out",
    "cores",
    "offer_result",
    "one_blas_thread",
    "pool_stop_token",
    "process_count",
    "require_threads",
    "results",
    "results_on",
]
