from .datasets.audio.sound import Sound as Sound
from .datasets.base.errors import UserError as UserError
from .datasets.base.register import register as register
from .pipeline.contract.sampling import SamplingConfig as SamplingConfig
from .pipeline.inference.files.outputs import write_motions as write_motions
from .pipeline.inference.model import MotionModel as MotionModel
from .pipeline.inference.motion import GeneratedMotion as GeneratedMotion
from .pipeline.runs.api import evaluate_run as evaluate_run
from .pipeline.runs.api import export_run as export_run
from .pipeline.runs.api import report_run as report_run
from .pipeline.runs.api import run_recipe as run_recipe
from .pipeline.runs.training import finish as finish
from .pipeline.runs.training import training as training

__version__: str
