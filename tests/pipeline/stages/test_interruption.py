"""A signal in the middle of a training: it saves the step that it is at, and goes on as if nothing had been.

The processes of the two ranks run this file as a script.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from test_goes_on import assert_same_stage
from tiny_players import Duel, Vectors, train
from torch import Tensor, nn
from torch.utils.data import Dataset
from two_ranks import run_two_ranks

from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.launch.process import SAVED, Interrupted
from motionloom.pipeline.stages.interruption import SIGNALS, Agreement, Signals, unsignalled

FULL: dict[str, Any] = {"ema": 0.9, "accumulate": 2, "checkpoint_every": 7, "validate_every": 7}
