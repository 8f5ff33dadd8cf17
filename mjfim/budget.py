"""Names of `mjfim.parallel.budget` under their earlier module."""

from mjfim.parallel.budget import Budget as Budget
from mjfim.parallel.budget import StopReason as StopReason
from mjfim.parallel.budget import StopToken as StopToken
from mjfim.parallel.budget import measured_by as measured_by
from mjfim.parallel.budget import stop_on_interrupt as stop_on_interrupt
