"""Command line, recipes, the stage graph, training, generation and pages.

The public names are in `__init__.pyi` (`docs/generating.md`, `docs/library.md`); each is imported on first
use: `import motionloom.pipeline` alone brings in no torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
