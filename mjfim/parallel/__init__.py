"""Work on several processes or computers: threads, a pool that can be stopped, other executors.

`Workers` wraps any executor of the kind of `concurrent.futures`, and `carry_out` does independent
orders on it, whatever happens to its workers.
"""

import lazy_loader

# A name is imported from its module, which `__init__.pyi` states, when it is used first.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
