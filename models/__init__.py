"""Networks, losses and LightningModules of the two papers, and the figures that judge motion.

The public names are in `__init__.pyi`; each is imported on first use. Networks, losses and figures need torch
alone; the `...Module` classes and `AveragedWeights` bring in Lightning.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
