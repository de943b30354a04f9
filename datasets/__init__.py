"""Motion, captions and music: shards, their readers and writers, batches, converters and layouts of columns.

The public names are in `__init__.pyi`; each is imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
