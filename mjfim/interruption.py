"""Names of `mjfim.parallel.budget` under their earlier module."""

from mjfim.parallel.budget import hurried as hurried
