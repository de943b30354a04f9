"""Text or music to whole-body motion: HumanTOMATO, UDE and what both are compared with, as one framework.

`motionloom.models`, `motionloom.datasets` and `motionloom.pipeline` each list their public names; those that
most programs begin with are here. Each is imported on first use: `import motionloom` alone brings in no
torch.
"""

from importlib.metadata import version

import lazy_loader

__version__ = version("motionloom")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
