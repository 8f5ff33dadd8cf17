"""All figures of the package.

Each function turns records into a matplotlib Figure; `save` writes it as PNG, SVG or PDF.

Only the modules of this package import matplotlib.
"""

import lazy_loader

# A name is imported from its module, which `__init__.pyi` states, when it is used first.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
