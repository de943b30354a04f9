"""Registers the toy that trains, for programs started with `MOTIONLOOM_STAGES=toy_training_stage`."""

from __future__ import annotations

from toy_training import ToyTraining

from motionloom.pipeline.contract.stage import register

register(ToyTraining())
