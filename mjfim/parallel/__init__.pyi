from .carry_out import carry_out, results_or_here
from .dispatch import Dispatch, LostWorkError, NumberedOrder, Outcome
from .pool import LOST_SENTENCE, Pool
from .threads import cores, one_blas_thread, process_count, require_threads
from .worker_process import offer_result, pool_stop_token
from .workers import ExecutorLike, Workers

__all__ = [
    "LOST_SENTENCE",
    "Dispatch",
    "ExecutorLike",
    "LostWorkError",
    "NumberedOrder",
    "Outcome",
    "Pool",
    "Workers",
    "carry_out",
    "cores",
    "offer_result",
    "one_blas_thread",
    "pool_stop_token",
    "process_count",
    "require_threads",
    "results_or_here",
]
